"""The paper's simulated experiment with a pushed box, redone: ``dropo reproduce push``.

Fifty pushes of 30 transitions, the box redrawn for every push. Arm, controller and pushes are this project's
(:mod:`dropo_sims.push.record`): compare numbers with the paper's in kind, not digit by digit.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dropo_torch.baselines import fit_problem
from dropo_torch.config import make_config
from dropo_torch.diagnostics import diagnose
from dropo_torch.distribution import Distribution
from dropo_torch.problem import Problem, make_problem
from dropo_torch.studies.study import run_cells
from dropo_torch.support.extras import require

from . import SIM
from .record import PushLog, record
from .study_tables import write_results

#: The paper's box, in whose middle the parameters are redrawn.
TRUTH = {"mass": 0.7, "friction_x": 0.8, "friction_y": 0.8, "com_x": 0.01, "com_y": 0.01}
#: Method, with its optimizer or features.
METHODS = (
    ("dropo", "fisher"), ("dropo", "adam"), ("droid", ""), ("bayessim", "mdnn"), ("bayessim", "mdrff"), ("simopt", ""),
    ("udr", ""),
)  # fmt: skip
#: Optimizers that are compared on a small log.
OPTIMIZERS = ("fisher", "adam", "cma")
#: Variance of what is measured where parameters are looked at for what a log tells of them: millimeters.
MEASURED = 1e-6


@dataclass(frozen=True)
class Plan:
    """How large a study is.

    Attributes:
        seeds: logs of each kind.
        episodes, steps: pushes of a log, and transitions of each.
        epsilon: ε.
        samples: K.
        droid_budget: simulations of the log by DROID.
        simulations: of BayesSim.
        simopt_samples, simopt_iterations: of SimOpt.
        horizon: logged steps that BayesSim and SimOpt replay.
        small_episodes, small_samples, cma_budget: pushes, K and evaluations of the comparison with CMA-ES.
        adam_steps: of each of Adam's stages, there and in the table.
        backend: of all fits. The logs are MuJoCo's own.
    """

    seeds: int = 3
    episodes: int = 50
    steps: int = 30
    epsilon: float = 1e-6
    samples: int = 100
    droid_budget: int = 1200
    simulations: int = 1000
    simopt_samples: int = 60
    simopt_iterations: int = 20
    horizon: int = 30
    small_episodes: int = 8
    small_samples: int = 50
    cma_budget: int = 1500
    adam_steps: int = 400
    backend: Literal["mujoco", "warp"] = "warp"


#: Minutes instead of hours: few pushes, one seed.
REDUCED = Plan(
    seeds=1, episodes=6, samples=40, droid_budget=150, simulations=60, simopt_samples=12, simopt_iterations=3,
    horizon=10, small_episodes=2, small_samples=20, cma_budget=40, adam_steps=20,
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One fit of the study, or what a log tells of each parameter.

    Attributes:
        block: what it is part of: ``table``, ``optimizers`` or ``identify``.
        variant: of the log.
        method: of the fit.
        seed: of the log and the fit.
        optimizer: of DROPO.
        features: of BayesSim.
    """

    block: str
    variant: str
    method: str = "dropo"
    seed: int = 0
    optimizer: str = ""
    features: str = ""

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        parts = (self.block, self.variant, self.method, self.optimizer + self.features, f"seed{self.seed}")
        return "-".join(part for part in parts if part)


def run_study(
    out: Path, *, reduced: bool = False, resume: bool = False,
    report: Callable[[str, float], None] = lambda stage, share: None, plan: Plan | None = None, workers: int = 1,
) -> Sequence[str]:  # fmt: skip
    """Run every cell that is not there yet, then write tables and figures.

    Args:
        out: the folder: ``cells/`` and ``logs/``, and at the end ``study.json``, ``tables.md``, ``report.html`` and
            a figure.
        reduced: the plan :data:`REDUCED`.
        resume: keep finished cells of the same plan.
        report: called with what is being done and the share that is.
        plan: a size of one's own.
        workers: processes that fit cells side by side. The results do not depend on it.

    Raises:
        InputError: a folder with another study, or with one that is not to be resumed; a package that is missing.
    """
    require("baselines", "method: bayessim")
    plan = plan or (REDUCED if reduced else Plan())
    run = functools.partial(run_cell, plan=plan, logs=out / "logs")
    results = run_cells(out, plan, all_cells(plan), run, resume=resume, workers=workers, report=report)
    report("tables and figures", 1.0)
    return write_results(out, results, asdict(plan))


def all_cells(plan: Plan) -> list[Cell]:
    """Return the study's cells, in the order in which they run."""
    cells = []
    for seed in range(plan.seeds):
        for method, kind in METHODS:
            key = "optimizer" if method == "dropo" else "features"
            cells.append(Cell("table", "distribution", method, seed, **{key: kind}))
        cells += [Cell("table", "point", "dropo", seed, "fisher"), Cell("table", "point", "droid", seed)]
    cells += [Cell("optimizers", "distribution", optimizer=name) for name in OPTIMIZERS]
    cells.append(Cell("identify", "point"))
    return [cell for cell in cells if cell.optimizer != "adam" or plan.backend == "warp"]  # it climbs gradients


def run_cell(cell: Cell, *, plan: Plan, logs: Path, threads: int = 0) -> dict[str, Any]:
    """Record the cell's log, fit it, and return what was found beside what is true."""
    episodes = plan.small_episodes if cell.block == "optimizers" else plan.episodes
    log = record(variant=cell.variant, episodes=episodes, steps=plan.steps, seed=cell.seed, truth=TRUTH)
    path = logs / f"{cell.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    log.save(path)
    problem = make_problem(make_config({**_document(cell, plan), "data": str(path.resolve()), "threads": threads}))
    path.unlink()
    if cell.block == "identify":
        return {"identifiability": identifiability(problem)}
    begun = time.monotonic()
    fit = fit_problem(problem)
    return {
        "truth": realised(log),
        "transitions": len(log.actions),
        "wall_seconds": round(time.monotonic() - begun, 3),
        "fit": fit.document(),
    }


def realised(log: PushLog) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation of the parameters that were drawn for a log."""
    drawn = zip(SIM.parameters, log.parameters.T, strict=True)
    return {name: {"mean": float(values.mean()), "std": float(values.std())} for name, values in drawn}


def identifiability(problem: Problem) -> list[dict[str, Any]]:
    """Return, for each parameter, its standard error on a log at the truth, and with what it is confounded most."""
    space = problem.simulator.parameters
    mean = np.array([TRUTH[name] for name in space.names])
    steady = Distribution.over(space, mean, problem.objective.box.min_std)
    found = diagnose(problem.objective, steady)
    rows = []
    for i, name in enumerate(space.names):
        others = np.abs(found.correlation[i]) * (np.arange(len(space)) != i)
        low, high = SIM.parameters[name]["bounds"]
        error = float(found.standard_error[i])
        rows.append({
            "parameter": name,
            "standard_error": error,
            "share_of_box_percent": 100 * error / (high - low),
            "correlated_with": space.names[int(others.argmax())],
            "correlation": float(found.correlation[i, others.argmax()]),
        })  # fmt: skip
    return rows


def _document(cell: Cell, plan: Plan) -> dict[str, Any]:
    """The config of a cell's fit, but for its log."""
    options = {
        "droid": {"budget": plan.droid_budget},
        "bayessim": {"simulations": plan.simulations, "horizon": plan.horizon, "features": cell.features or "mdnn"},
        "simopt": {
            "samples": plan.simopt_samples, "iterations": plan.simopt_iterations, "horizon": plan.horizon,
        },
    }  # fmt: skip
    document = {
        "sim": "push",
        "backend": plan.backend,
        "method": cell.method,
        "method_options": options.get(cell.method, {}),
        "samples": plan.small_samples if cell.block == "optimizers" else plan.samples,
        "seed": cell.seed,
        "epsilon": MEASURED if cell.block == "identify" else plan.epsilon,
    }
    if cell.method == "dropo" and cell.optimizer:
        document["optimizer"] = cell.optimizer
    if cell.optimizer == "cma":
        document["budget"] = plan.cma_budget
    if cell.optimizer == "adam":
        document["adam"] = {"steps": plan.adam_steps}
    return document
