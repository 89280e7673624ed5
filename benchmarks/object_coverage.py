"""How far fits of the bundled arms with objects are from the truth, and how often their 90 % intervals hold it.

    python benchmarks/object_coverage.py --seed 1 --out out/object_coverage        # --resume goes on

Logs of the pushed box (5 parameters) and the hit puck (18), recorded with noise on every measurement; the truth of each
is drawn evenly from the inner 60 % of the search box. Fisher scoring on Warp is told the noise. The interval is the
mean ± 1.64 of ``fit.json``'s ``standard_errors``. Writes ``cells/``, a file a fit, and ``object_coverage.md``.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import calibration
import dropo_sims.puck.record
import dropo_sims.push.record
import numpy as np

import dropo_torch as dropo
from benchmarks.intervals import CalibrationCell, wilson
from dropo_torch.commands.options import workers
from dropo_torch.gap.refit import Z90
from dropo_torch.models.bundled import BundledSim
from dropo_torch.studies.study import grouped

RECORDERS: dict[str, ModuleType] = {"push": dropo_sims.push.record, "puck": dropo_sims.puck.record}
#: Truths are drawn from this inner share of the search box.
INNER = 0.6
#: ε beside the noise: nothing else is to be explained.
EPSILON = 1e-12
#: Error, as a share of the truth or, for a parameter that may be 0, of the larger bound, that a mean may have.
GOOD = 0.05


@dataclass(frozen=True)
class Plan:
    """What all fits have in common: episodes and steps by simulation, and the seed."""

    seed: int
    push: tuple[int, int] = (6, 20)
    puck: tuple[int, int] = (2, 250)


def draw_truth(sim: BundledSim, seed: int) -> dict[str, float]:
    """Return parameters drawn evenly from the inner part of their bounds."""
    generator = np.random.default_rng([seed, 31])
    found = {}
    for name, parameter in sim.parameters.items():
        low, high = parameter["bounds"]
        found[name] = low + (high - low) * (0.5 + INNER * (generator.uniform() - 0.5))
    return found


def fit_cell(cell: CalibrationCell, *, plan: Plan, threads: int) -> dict[str, Any]:
    """Record and fit one log: truth, mean and standard error of each parameter, in its unit."""
    recorder, seed = RECORDERS[cell.method], 100_003 * plan.seed + cell.log
    truth, (episodes, steps) = draw_truth(recorder.SIM, seed), getattr(plan, cell.method)
    log = recorder.record(variant="noisy", episodes=episodes, steps=steps, seed=seed, truth=truth)
    position, velocity = recorder.NOISE
    noise = np.where(np.arange(log.observations.shape[1]) < recorder.QUATERNION.stop, position, velocity)
    with tempfile.TemporaryDirectory() as folder:
        log.save(Path(folder) / "log.npz")
        document = {
            "sim": cell.method, "backend": "warp", "data": "log.npz", "epsilon": EPSILON, "noise": noise.tolist(),
            "seed": cell.log, "threads": threads,
        }  # fmt: skip
        problem = dropo.make_problem(dropo.make_config(document, base=Path(folder)))
        fitted = dropo.fit_problem(problem)
    error = dropo.diagnose(problem.objective, fitted.distribution).standard_error
    space = problem.space
    return {
        "truth": truth,
        "mean": space.named(fitted.distribution.mean),
        "error": space.named(error),
        "std": space.named(fitted.distribution.std),
        "seconds": round(fitted.seconds, 1),
    }


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """Return a line a parameter and one over all of each simulation."""
    head = ["log of", "parameter", "in 90 % intervals [95 %]", "distance / error", "error, median", "largest",
            f"known within {GOOD:.0%}", "of these right", "logs"]  # fmt: skip
    lines = [head, ["---"] * len(head)]
    for sim, own in grouped(found, lambda run: run["cell"]["method"]).items():
        names = list(own[0]["truth"])
        truth, mean, error = (
            np.array([[run[key][n] for n in names] for run in own]) for key in ("truth", "mean", "error")
        )
        bounds = np.array([RECORDERS[sim].SIM.parameters[name]["bounds"] for name in names])
        scale = np.where(bounds[:, 0] > 0, truth, bounds[:, 1])
        for i, name in enumerate(names):
            row = (truth[:, i], mean[:, i], error[:, i], scale[:, i])
            lines.append([sim, name, *_row(*row), str(len(own))])
        if len(names) > 1:
            lines.append([sim, "all", *_row(*(x.ravel() for x in (truth, mean, error, scale))), str(len(own))])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _row(truth: np.ndarray, mean: np.ndarray, error: np.ndarray, scale: np.ndarray) -> list[str]:
    off, share = (mean - truth) / error, np.abs(mean - truth) / scale
    inside = float((np.abs(off) <= Z90).mean())
    low, high = (100 * x for x in wilson(inside, len(off)))
    known = Z90 * error <= GOOD * scale
    right = f"{(share[known] <= GOOD).sum()} of {known.sum()}"
    return [
        f"{100 * inside:.0f} % [{low:.0f}, {high:.0f}]", f"{np.sqrt(np.mean(off**2)):.2f}",
        f"{100 * np.median(share):.2g} %", f"{100 * share.max():.2g} %", f"{100 * known.mean():.0f} %", right,
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sims", nargs="+", choices=list(RECORDERS), default=list(RECORDERS))
    parser.add_argument("--logs", type=int, default=20, help="of each simulation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=workers, default=1, metavar="N|ray", help="logs at a time")
    parser.add_argument("--resume", action="store_true", help="keep the fits that --out holds")
    given = parser.parse_args(arguments)
    plan = Plan(given.seed)
    cells = [CalibrationCell("fixed", sim, n) for sim in given.sims for n in range(given.logs)]
    found = calibration.fit_all(parser, given, plan, cells, functools.partial(fit_cell, plan=plan))
    calibration.write_table(given.out / "object_coverage.md", markdown(found))


if __name__ == "__main__":
    main()
