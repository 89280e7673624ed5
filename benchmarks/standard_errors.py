"""How often the 90 % intervals of a fit's means, by its standard errors, hold the truth, over simulated logs.

    python benchmarks/standard_errors.py --seed 1 --out out/standard_errors --workers 2     # --resume goes on

The driven pendulum of ``calibration.py``: parameters are fixed, or drawn anew for every transition; the noise is on the
ends of transitions alone (``epsilon`` has its variance), or on every measurement (``noise``). The interval is the mean
± 1.64 of ``fit.json``'s ``standard_errors``. Writes ``cells/``, a file a fit, and ``standard_errors.md``.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import calibration
import numpy as np

import dropo_torch as dropo
from dropo_torch.data.trajectory import make_transitions
from dropo_torch.distribution import SearchBox, to_values
from dropo_torch.studies.calibration import KINDS, Kind, draw_truths, synthesise, wilson
from dropo_torch.studies.study import grouped, run_cells

#: Where the noise is → what the config says of it.
SENSORS: dict[str, dict[str, Any]] = {
    "ends": {"epsilon": (calibration.NOISE**2).tolist()},
    "every measurement": {"epsilon": 1e-12, "noise": calibration.NOISE.tolist()},
}
NORMAL_90 = 1.645


@dataclass(frozen=True)
class Cell:
    """One fit of one simulated log.

    Attributes:
        kind: whether the parameters vary.
        noisy: a key of ``SENSORS``.
        log: number of the log; with ``seed``, it seeds it.
        seed: of the run.
    """

    kind: Kind
    noisy: str
    log: int
    seed: int

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        return f"{self.log:04d}-{self.kind}-{self.noisy.replace(' ', '-')}"


@dataclass(frozen=True)
class Plan:
    """What all fits have in common."""

    transitions: int
    seed: int


def with_noise(problem: dropo.Problem, seed: int) -> dropo.Problem:
    """The same log with noise on every measurement: the end of a transition is the start of the next."""
    log = problem.trajectories
    drawn = np.random.default_rng([seed, 29]).standard_normal((len(log) + 1, log.observations.shape[1]))
    drawn *= calibration.NOISE
    noisy = replace(
        log, observations=log.observations + drawn[:-1], next_observations=log.next_observations + drawn[1:]
    )
    transitions = make_transitions(noisy, problem.observation, lag=problem.objective.transitions.lag)
    return replace(problem, trajectories=noisy, objective=problem.objective.on(transitions))


def fit_cell(cell: Cell, *, transitions: int, threads: int) -> dict[str, Any]:
    """Fit one simulated log: how far each mean lies from what its parameters were drawn around, in standard errors."""
    with tempfile.TemporaryDirectory() as folder:
        problem = calibration.problem_of(Path(folder), SENSORS[cell.noisy], transitions, threads)
        space, seed, ends = problem.space, 100_003 * cell.seed + cell.log, cell.noisy == "ends"
        truths, center = draw_truths(problem, cell.kind, seed)
        values, noise = to_values(truths, space.is_log), calibration.NOISE * ends
        made = synthesise(problem, values, noise, seed)
        made = made if ends else with_noise(made, seed)
        found = dropo.fit_problem(made).distribution
        error = dropo.diagnose(made.objective, found).standard_error
        width = 2 * NORMAL_90 * error / SearchBox.of(space).width
        return {"off": space.named((found.mean - center) / error), "width": space.named(width)}


def markdown(found: Sequence[dict[str, Any]]) -> str:
    titles = (
        "parameters",
        "noise on",
        "mean of",
        "in 90 % intervals [95 %]",
        "rms distance / standard error",
        "width / box",
        "logs",
    )
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for (kind, noisy), own in grouped(found, lambda run: (run["cell"]["kind"], run["cell"]["noisy"])).items():
        for name in own[0]["off"]:
            off, width = (np.array([run[key][name] for run in own]) for key in ("off", "width"))
            share = float((np.abs(off) <= NORMAL_90).mean())
            low, high = (100 * x for x in wilson(share, len(own)))
            covered = f"{100 * share:.0f} % [{low:.0f}, {high:.0f}]"
            rms = np.sqrt(np.mean(off**2))
            lines.append(f"| {kind} | {noisy} | {name} | {covered} | {rms:.2f} | {width.mean():.2g} | {len(own)} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=100, help="of each kind")
    parser.add_argument("--transitions", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=1, help="logs at a time")
    parser.add_argument("--resume", action="store_true", help="keep the fits that --out holds")
    given = parser.parse_args(arguments)
    cells = [Cell(k, n, i, given.seed) for i in range(given.logs) for k in KINDS for n in SENSORS]
    work = functools.partial(fit_cell, transitions=given.transitions)
    plan = Plan(given.transitions, given.seed)
    try:
        found = run_cells(
            given.out, plan, cells, work, resume=given.resume, workers=given.workers,
            report=lambda stage, _: print(stage, flush=True),
        )  # fmt: skip
    except dropo.InputError as error:
        parser.error(str(error))
    table = markdown(found)
    (given.out / "standard_errors.md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
