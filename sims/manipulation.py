"""Studies of arms that manipulate: what each method finds of an object that is redrawn for every episode."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
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
from dropo_torch.support.parallel import Workers

from .manipulation_tables import About, write_results

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
        episodes, steps: of a log, and transitions of each.
        epsilon: ε.
        samples: K.
        droid_budget: simulations of the log by DROID.
        simulations: of BayesSim.
        simopt_samples, simopt_iterations: of SimOpt.
        horizon: logged steps that BayesSim and SimOpt replay.
        small_episodes, small_samples, cma_budget: episodes, K and evaluations of the comparison with CMA-ES.
        adam_steps: of each of Adam's stages, there and in the table.
        backend: of all fits. The logs are MuJoCo's own.
    """

    seeds: int
    episodes: int
    steps: int
    small_episodes: int
    epsilon: float = 1e-6
    samples: int = 100
    droid_budget: int = 600
    simulations: int = 1000
    simopt_samples: int = 40
    simopt_iterations: int = 15
    horizon: int = 30
    small_samples: int = 50
    cma_budget: int = 150
    adam_steps: int = 200
    backend: Literal["mujoco", "warp"] = "warp"


@dataclass(frozen=True)
class Study:
    """A study of one bundled simulation.

    Attributes:
        about: what its pages say.
        record: records a log: ``record(variant=..., episodes=..., steps=..., seed=..., truth=...)``.
        truth: the parameters, in whose middle those that vary are redrawn.
        plan, reduced: its whole and its reduced size.
    """

    about: About
    record: Callable[..., Any]
    truth: Mapping[str, float]
    plan: Plan
    reduced: Plan

    def run(
        self, out: Path, *, reduced: bool = False, resume: bool = False,
        report: Callable[[str, float], None] = lambda stage, share: None, plan: Plan | None = None,
        workers: Workers = 1,
    ) -> Sequence[str]:  # fmt: skip
        """Run every cell that is not there yet, then write tables and figures; return what it found.

        Args:
            out: the folder: ``cells/`` and ``logs/``, and at the end ``study.json``, ``tables.md``, ``report.html`` and
                a figure.
            reduced: the small plan.
            resume: keep finished cells of the same plan.
            report: called with what is being done and the share that is.
            plan: a size of one's own.
            workers: processes that fit cells side by side. The results do not depend on it.

        Raises:
            InputError: a folder with another study, or with one that is not to be resumed; a package that is missing.
        """
        require("baselines", "method: bayessim")
        plan = plan or (self.reduced if reduced else self.plan)
        run = functools.partial(run_cell, study=self, plan=plan, logs=out / "logs")
        results = run_cells(out, plan, all_cells(plan), run, resume=resume, workers=workers, report=report)
        report("tables and figures", 1.0)
        return write_results(out, self.about, results, asdict(plan))


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


def run_cell(cell: Cell, *, study: Study, plan: Plan, logs: Path, threads: int = 0) -> dict[str, Any]:
    """Record the cell's log, fit it, and return what was found beside what is true."""
    episodes = plan.small_episodes if cell.block == "optimizers" else plan.episodes
    log = study.record(variant=cell.variant, episodes=episodes, steps=plan.steps, seed=cell.seed, truth=study.truth)
    path = logs / f"{cell.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    log.save(path)
    document = {**config_of(cell, study, plan), "data": str(path.resolve()), "threads": threads}
    problem = make_problem(make_config(document))
    path.unlink()
    if cell.block == "identify":
        return {"identifiability": identifiability(problem, study)}
    begun = time.monotonic()
    fit = fit_problem(problem)
    return {
        "truth": realized(log.parameters, study),
        "transitions": len(log.actions),
        "wall_seconds": round(time.monotonic() - begun, 3),
        "fit": fit.document(),
    }


def realized(parameters: np.ndarray, study: Study) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation of the parameters that were drawn for a log, ``(E, d)``."""
    drawn = zip(study.about.sim.parameters, parameters.T, strict=True)
    return {name: {"mean": float(values.mean()), "std": float(values.std())} for name, values in drawn}


def identifiability(problem: Problem, study: Study) -> list[dict[str, Any]]:
    """Return, for each parameter, its standard error on a log at the truth, and with what it is confounded most."""
    space = problem.simulator.parameters
    mean = np.array([study.truth[name] for name in space.names])
    found = diagnose(problem.objective, Distribution.over(space, mean, problem.objective.box.min_std))
    rows = []
    for i, name in enumerate(space.names):
        others = np.abs(found.correlation[i]) * (np.arange(len(space)) != i)
        error = float(found.standard_error[i])
        rows.append({
            "parameter": name,
            "standard_error": error,
            "share_of_box_percent": 100 * error / float(space.high[i] - space.low[i]),
            "correlated_with": space.names[int(others.argmax())],
            "correlation": float(found.correlation[i, others.argmax()]),
        })  # fmt: skip
    return rows


def config_of(cell: Cell, study: Study, plan: Plan) -> dict[str, Any]:
    """Return the config of a cell's fit, but for its log."""
    options = {
        "droid": {"budget": plan.droid_budget},
        "bayessim": {"simulations": plan.simulations, "horizon": plan.horizon, "features": cell.features or "mdnn"},
        "simopt": {
            "samples": plan.simopt_samples, "iterations": plan.simopt_iterations, "horizon": plan.horizon,
        },
    }  # fmt: skip
    document = {
        "sim": study.about.sim.name,
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
