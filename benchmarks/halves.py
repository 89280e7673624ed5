"""Does one half of a log say the same as the other? `dropo gap` on each, their names and their intervals side by side.

    python benchmarks/halves.py CONFIG.yaml [--data.path LOG.csv ...] [--blocks 8]

Trajectories are dealt out in turn; where there are fewer than four, each is cut into blocks first. So the halves share
no row, and each has all parts of a motion. A name is the same where one half names what the other one names or has as
its tie.
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
from dropo_torch.gap import Gap, NamedEffect, find_gap

#: Trajectories below which they are cut.
FEW = 4
Number = tuple[str, str, str]


def halves(log: Trajectories, blocks: int) -> tuple[Trajectories, Trajectories]:
    """Return two halves of a log that share no row."""
    if log.num_episodes < FEW:
        ends = np.flatnonzero(log.terminals)
        starts = np.concatenate([[0], ends[:-1] + 1])
        terminals = log.terminals.copy()
        for start, end in zip(starts, ends, strict=True):
            terminals[np.linspace(start - 1, end, blocks + 1).astype(int)[1:]] = True
        log = replace(log, terminals=terminals)
    numbers = range(log.num_episodes)
    return log.select_episodes(numbers[::2]), log.select_episodes(numbers[1::2])


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


def numbers(gap: Gap) -> dict[Number, tuple[float, float]]:
    """Return the 90 % interval of every number of what is named."""
    found: dict[Number, tuple[float, float]] = {}
    for effect, target, entry in members(gap):
        of = {target: entry.parameters[target]} if entry.target == "*" else entry.parameters
        found |= {(effect, target, key): (s.low, s.high) for key, s in of.items() if np.isfinite(s.low)}
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("--blocks", type=int, default=8, help="into which each of a few trajectories is cut")
    given, rest = parser.parse_known_args(arguments)
    problem = dropo.make_problem(dropo.load_config(given.config, parse_overrides(rest)), general=True)
    gaps = []
    for half in halves(problem.trajectories, given.blocks):
        gaps.append(find_gap(replace(problem, trajectories=half)))
        print(f"{len(half)} rows, {gaps[-1].seconds:.0f} s: χ²/ν {gaps[-1].reduced[1]:.2f}", flush=True)
    first, second = gaps
    said = [names(gap) for gap in gaps]
    alike = (said[0] & names(second, ties=True)) | (said[1] & names(first, ties=True))
    intervals = [numbers(gap) for gap in gaps]
    common = sorted(intervals[0].keys() & intervals[1].keys())
    overlap = 0
    for key in common:
        (a, b), (c, d) = intervals[0][key], intervals[1][key]
        overlap += max(a, c) <= min(b, d)
        apart = "" if max(a, c) <= min(b, d) else "   apart"
        print(f"  {' '.join(key):<50}{a:>10.4g} to {b:<10.4g}{c:>10.4g} to {d:<10.4g}{apart}")
    for label, own, gap in (("first", said[0], second), ("second", said[1], first)):
        print(f"only in the {label} half: {sorted(own - names(gap, ties=True))}")
    print(f"names alike: {len(alike)} of {len(said[0] | said[1])}")
    print(f"intervals that overlap: {overlap} of {len(common)}")


if __name__ == "__main__":
    main()
