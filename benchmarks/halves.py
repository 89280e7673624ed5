"""Does one half of a log say the same as the other? `dropo gap` on each, their names and their intervals side by side.

    python benchmarks/halves.py CONFIG.yaml [--fit] [--data.path LOG.csv ...] [--blocks 8] [--together 1]

Trajectories are dealt out in turn; where there are fewer than four, each is cut into blocks first. So the halves share
no row, and each has all parts of a motion. A name is the same where one half names what the other one names or has as
its tie. Where the other half does without an effect, it also says how large that may be all the same: a name is
contradicted if none of the sizes that it may have are allowed there. With --fit, the config's parameters are fitted to
each half, and their intervals are compared.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import dropo_torch as dropo
from dropo_torch.config import parse_overrides
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.diagnostics import diagnose
from dropo_torch.gap import Gap, NamedEffect, find_gap
from dropo_torch.problem import Problem
from dropo_torch.verdict import judge

#: Trajectories below which they are cut.
FEW = 4
#: Standard errors to either end of a 90 % interval.
NINETY = 1.645
Number = tuple[str, ...]
Intervals = dict[Number, tuple[float, float]]


def dealt(count: int, together: int) -> tuple[list[int], list[int]]:
    """Deal out trajectories in turn, by so many in a row, and return their numbers in either half."""
    first, second = ([n for n in range(count) if n // together % 2 == half] for half in (0, 1))
    return first, second


def halves(log: Trajectories, blocks: int, together: int = 1) -> list[Trajectories]:
    """Return two halves of a log that share no row.

    Args:
        log: the log.
        blocks: into which each of a few trajectories is cut.
        together: trajectories in a row that stay in one half.
    """
    if log.num_episodes < FEW:
        ends = np.flatnonzero(log.terminals)
        starts = np.concatenate([[0], ends[:-1] + 1])
        terminals = log.terminals.copy()
        for start, end in zip(starts, ends, strict=True):
            terminals[np.linspace(start - 1, end, blocks + 1).astype(int)[1:]] = True
        log = replace(log, terminals=terminals)
    return [log.select_episodes(numbers) for numbers in dealt(log.num_episodes, together)]


def intervals_of_fits(problem: Problem, together: int) -> Iterator[Intervals]:
    """Yield the 90 % intervals of a problem's parameters, fitted to either half of its log, and print the verdicts."""
    windows = problem.objective.transitions
    for numbers in dealt(problem.trajectories.num_episodes, together):
        objective = problem.objective.on(windows.select(np.isin(windows.episodes, numbers)))
        fit = dropo.fit_problem(replace(problem, objective=objective))
        diagnostics = diagnose(objective, fit.distribution, seed=problem.config.seed)
        lost = fit.diverged / (len(objective) * fit.samples)
        said = judge(fit.distribution, fit.method, diagnostics, lost)
        print(f"{len(objective)} windows, {fit.seconds:.0f} s: {said.reason}", flush=True)
        errors = {name: entry["mean"] for name, entry in said.standard_errors.items()}
        yield {
            (name,): (center - NINETY * errors[name], center + NINETY * errors[name])
            for name, center in zip(fit.distribution.names, fit.distribution.center, strict=True)
        }


def members(gap: Gap) -> Iterator[tuple[str, str, NamedEffect]]:
    """Yield effect, target and entry of everything that is named, one for each target of a family."""
    for entry in gap.effects:
        if entry.effect == "unnamed":
            continue
        targets = entry.parameters if entry.target == "*" else [str(entry.target)]
        yield from ((entry.effect, target, entry) for target in targets)


def names(gap: Gap, *, ties: bool = False) -> set[tuple[str, str]]:
    """Return (effect, target) of what is named, with what is tied with it if asked."""
    found = {(effect, target) for effect, target, _ in members(gap)}
    if ties:
        found |= {(e, str(t)) for entry in gap.effects for e, t in entry.indistinguishable_from}
    return found


def numbers(gap: Gap) -> Intervals:
    """Return the 90 % interval of every number of what is named."""
    found: Intervals = {}
    for effect, target, entry in members(gap):
        of = {target: entry.parameters[target]} if entry.target == "*" else entry.parameters
        found |= {(effect, target, key): (s.low, s.high) for key, s in of.items() if np.isfinite(s.low)}
    return found


def allowed(gap: Gap) -> Intervals:
    """Return the 90 % interval of every number of what was not needed; all there are, where it has none."""
    return {
        (e.effect, str(e.target), key): (s.low, s.high) if np.isfinite(s.low) else (-np.inf, np.inf)
        for e in gap.left_out
        for key, s in e.parameters.items()
    }


def contradicted(first: Gap, second: Gap) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """Return what only the first half names, and of this what the second does not allow as it is there, or at all."""
    only, there, other = names(first) - names(second, ties=True), numbers(first), allowed(second)
    refuted = set()
    for effect, target in only:
        own = {key: there[key] for key in there if key[:2] == (effect, target)}
        if any(k not in other or max(own[k][0], other[k][0]) > min(own[k][1], other[k][1]) for k in own):
            refuted.add((effect, target))
    return only, refuted


def compare_intervals(first: Intervals, second: Intervals) -> None:
    """Print the numbers that both halves have, and how many of their intervals overlap."""
    common, overlap = sorted(first.keys() & second.keys()), 0
    for key in common:
        (a, b), (c, d) = first[key], second[key]
        overlap += max(a, c) <= min(b, d)
        apart = "" if max(a, c) <= min(b, d) else "   apart"
        print(f"  {' '.join(key):<50}{a:>10.4g} to {b:<10.4g}{c:>10.4g} to {d:<10.4g}{apart}")
    print(f"intervals that overlap: {overlap} of {len(common)}")


def compare_names(first: Gap, second: Gap) -> None:
    """Print what only one of the halves names, and how many names are alike."""
    said = [names(first), names(second)]
    alike = (said[0] & names(second, ties=True)) | (said[1] & names(first, ties=True))
    refuted = 0
    for label, one, other in (("first", first, second), ("second", second, first)):
        only, against = contradicted(one, other)
        refuted += len(against)
        print(f"only in the {label} half: {sorted(only)}; the other one does not allow {sorted(against) or 'none'}")
    print(f"names alike: {len(alike)} of {len(said[0] | said[1])}; contradicted: {refuted}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("--fit", action="store_true", help="fit the config's parameters, and name nothing")
    parser.add_argument("--blocks", type=int, default=8, help="into which each of a few trajectories is cut, for names")
    parser.add_argument("--together", type=int, default=1, help="trajectories in a row that stay in one half")
    given, rest = parser.parse_known_args(arguments)
    problem = dropo.make_problem(dropo.load_config(given.config, parse_overrides(rest)), general=not given.fit)
    if given.fit:
        if problem.trajectories.num_episodes <= given.together:
            parser.error(f"--fit deals out trajectories, and {given.config} has too few of them for two halves")
        compare_intervals(*intervals_of_fits(problem, given.together))
        return
    gaps = []
    for half in halves(problem.trajectories, given.blocks, given.together):
        gaps.append(find_gap(replace(problem, trajectories=half)))
        print(f"{len(half)} rows, {gaps[-1].seconds:.0f} s: χ²/ν {gaps[-1].reduced[1]:.2f}", flush=True)
    compare_names(*gaps)
    compare_intervals(*map(numbers, gaps))


if __name__ == "__main__":
    main()
