"""How often the 90 % intervals of a fit's means, by its standard errors, hold the truth, over simulated logs.

    python benchmarks/standard_errors.py --seed 1 --out out/standard_errors --workers 2     # --resume goes on

The driven pendulum of ``calibration.py``: parameters are fixed, or drawn anew for every transition; the noise is on the
ends of transitions alone (``epsilon`` has its variance), or on every measurement (``noise``). The interval is the mean
± 1.64 of ``fit.json``'s ``standard_errors``. Writes ``cells/``, a file a fit, and ``standard_errors.md``: its "distance
/ error" is the root mean square of how far means are from the truth, in standard errors.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import calibration
import numpy as np

import dropo_torch as dropo
from benchmarks.intervals import KINDS, CalibrationCell, draw_truths, synthesize, wilson, with_log
from dropo_torch.distribution import SearchBox, to_values
from dropo_torch.gap.refit import Z90
from dropo_torch.studies.study import grouped

#: Where the noise is, in the place of a cell's method → what the config says of it.
SENSORS: dict[str, dict[str, Any]] = {
    "ends": {"epsilon": (calibration.NOISE**2).tolist()},
    "every measurement": {"epsilon": 1e-12, "noise": calibration.NOISE.tolist()},
}


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
    return with_log(problem, noisy)


def fit_cell(cell: CalibrationCell, *, transitions: int, seed: int, threads: int) -> dict[str, Any]:
    """Fit one simulated log: how far each mean lies from what its parameters were drawn around, in standard errors."""
    with tempfile.TemporaryDirectory() as folder:
        problem = calibration.problem_of(Path(folder), SENSORS[cell.method], transitions, threads)
        space, seed, ends = problem.space, 100_003 * seed + cell.log, cell.method == "ends"
        truths, center = draw_truths(problem, cell.kind, seed)
        values, noise = to_values(truths, space.is_log), calibration.NOISE * ends
        made = synthesize(problem, values, noise, seed)
        made = made if ends else with_noise(made, seed)
        found = dropo.fit_problem(made).distribution
        error = dropo.diagnose(made.objective, found).standard_error
        width = 2 * Z90 * error / SearchBox.of(space).width
        return {"off": space.named((found.mean - center) / error), "width": space.named(width)}


def markdown(found: Sequence[dict[str, Any]]) -> str:
    lines = ["| parameters | noise on | mean of | in 90 % intervals [95 %] | distance / error | width / box | logs |"]
    lines.append("|---|---|---|---|---|---|---|")
    for (kind, noisy), own in grouped(found, lambda run: (run["cell"]["kind"], run["cell"]["method"])).items():
        for name in own[0]["off"]:
            off, width = (np.array([run[key][name] for run in own]) for key in ("off", "width"))
            share = float((np.abs(off) <= Z90).mean())
            low, high = (100 * x for x in wilson(share, len(own)))
            covered = f"{100 * share:.0f} % [{low:.0f}, {high:.0f}]"
            rms = np.sqrt(np.mean(off**2))
            lines.append(f"| {kind} | {noisy} | {name} | {covered} | {rms:.2f} | {width.mean():.2g} | {len(own)} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = calibration.options(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    cells = [CalibrationCell(k, where, n) for n in range(given.logs) for k in KINDS for where in SENSORS]
    work = functools.partial(fit_cell, transitions=given.transitions, seed=given.seed)
    found = calibration.fit_all(parser, given, Plan(given.transitions, given.seed), cells, work)
    calibration.write_table(given.out / "standard_errors.md", markdown(found))


if __name__ == "__main__":
    main()
