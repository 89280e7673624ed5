"""The simulated Hopper experiments of the DROPO paper, redone: ``dropo reproduce hopper``.

The logs are recorded here (:mod:`dropo_sims.hopper.record`): compare numbers with the paper's in kind, not digit by
digit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.config import make_config
from dropo_torch.problem import make_problem
from dropo_torch.studies.study import run_cells
from dropo_torch.studies.sweep import NEGLIGIBLE
from dropo_torch.support.extras import require
from dropo_torch.support.parallel import Workers

from . import SIM, paper, paper_tables
from .fits import METHODS, UNMODELED, Size, fitted, method_keys, mse_at
from .paper import PaperPlan
from .record import NOISE_VARIANCE, HopperLog, record
from .study_tables import write_results


@dataclass(frozen=True)
class Plan(Size):
    """How large a study is.

    Attributes:
        epsilons: values of the sweeps.
        noise_variances: of the sweeps against noise.
        noise_steps: length of the episodes of their log.
        sizes: numbers of transitions whose estimates are compared.
        resamples: bootstrap samples of each size.
        cma_steps, cma_budget, cma_samples: length of the log's episodes, evaluations and K of the CMA-ES run.
        paper: how large the part with the paper's own masses and boxes is, or none.
    """

    epsilons: tuple[float, ...] = tuple(10.0**k for k in range(-9, 0))
    noise_variances: tuple[float, ...] = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
    noise_steps: int = 100
    sizes: tuple[int, ...] = (10, 30, 100, 300, 1000, 3000)
    resamples: int = 9
    cma_steps: int = 50
    cma_budget: int = 800
    cma_samples: int = 50
    paper: PaperPlan | None = paper.FULL


#: Minutes instead of hours: short logs, one seed, coarse sweeps.
REDUCED = Plan(
    seeds=1, steps=60, samples=40, droid_budget=400, simulations=200, horizon=20,
    epsilons=(1e-8, 1e-6, 1e-4, 1e-2), noise_variances=(1e-5, 1e-4), noise_steps=60, sizes=(10, 30, 100), resamples=4,
    cma_steps=20, cma_budget=60, cma_samples=10, backend="mujoco", paper=paper.REDUCED,
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One fit of the study.

    Attributes:
        block: what it is part of: ``table``, ``recovery``, ``sweep``, ``noise``, ``size`` or ``cma``.
        variant: of the log.
        method: of the fit.
        seed: of the log and the fit.
        epsilon: ε.
        knows_noise: whether the fit is given the standard deviation of the noise.
        noise: variance of noise put on a noiseless log, on the end of a transition independently of the next one's
            initial state; ``None`` for the variant's own, whose transitions share a measurement.
        ends_only: whether that noise is on the ends of transitions alone, not on their initial states.
        noisy_starts: whether ε stands for the variance of every measurement, of the initial states, too.
        size: transitions of a bootstrap sample; ``None`` for the whole log.
        resample: number of the bootstrap sample.
        optimizer: of DROPO.
        features: of BayesSim.
    """

    block: str
    variant: str
    method: str = "dropo"
    seed: int = 0
    epsilon: float = 1e-5
    knows_noise: bool = False
    noise: float | None = None
    ends_only: bool = False
    noisy_starts: bool = False
    size: int | None = None
    resample: int = 0
    optimizer: str = "fisher"
    features: str = ""

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        parts = [self.block, self.variant, self.method + self.features, f"seed{self.seed}", f"eps{self.epsilon:g}"]
        parts += ["known"] * self.knows_noise
        parts += ["starts"] * self.noisy_starts
        parts += [] if self.noise is None else [f"noise{self.noise:g}", "ends" if self.ends_only else "all"]
        parts += [] if self.size is None else [f"n{self.size}", f"b{self.resample}"]
        parts += [] if self.optimizer == "fisher" else [self.optimizer]
        return "-".join(parts)


def run_study(
    out: Path,
    *,
    reduced: bool = False,
    resume: bool = False,
    report: Callable[[str, float], None] = lambda stage, share: None,
    plan: Plan | None = None,
    workers: Workers = 1,
) -> Sequence[str]:
    """Run every cell that is not there yet, then write tables and figures.

    Args:
        out: the folder: ``cells/`` and ``logs/``, and at the end ``study.json``, ``tables.md``,
            ``report.html`` and figures; and ``paper/``, with the same of the part with the paper's masses and boxes.
        reduced: the plan :data:`REDUCED`.
        resume: keep finished cells of the same plan.
        report: called with what is being done and the share that is.
        plan: a size of one's own.
        workers: processes that fit cells side by side, or ``"ray"``. The results do not depend on it.

    Raises:
        InputError: a folder with another study, or with one that is not to be resumed; ``sbi`` is not installed.
    """
    require("baselines", "method: bayessim")
    plan = plan or (REDUCED if reduced else Plan())
    run = functools.partial(run_cell, plan=plan, logs=out / "logs")
    results = run_cells(out, plan, all_cells(plan), run, resume=resume, workers=workers, report=report)
    report("tables and figures", 1.0)
    found = write_results(out, results, asdict(plan))
    if plan.paper is None:
        return found
    more = run_paper(out / "paper", resume=resume, report=report, plan=plan.paper, workers=workers)
    return [*found, *(f"{line}, with the paper's masses" for line in more)]


def run_paper(
    out: Path,
    *,
    resume: bool = False,
    report: Callable[[str, float], None] = lambda stage, share: None,
    plan: PaperPlan | None = None,
    workers: Workers = 1,
) -> Sequence[str]:
    """Run the part with the paper's masses and boxes (:mod:`dropo_sims.hopper.paper`); as :func:`run_study`."""
    require("baselines", "method: bayessim")
    plan = plan or paper.FULL
    run = functools.partial(paper.run_cell, plan=plan, logs=out / "logs")
    results = run_cells(out, plan, paper.all_cells(plan), run, resume=resume, workers=workers, report=report)
    report("tables and figures", 1.0)
    return paper_tables.write_results(out, results, asdict(plan))


def all_cells(plan: Plan) -> list[Cell]:
    """Return the study's cells, in the order in which they run."""
    cells: list[Cell] = []
    for seed in range(plan.seeds):
        for method, features in METHODS:
            of: dict[str, Any] = {"method": method, "features": features, "seed": seed}
            known: dict[str, Any] = {"epsilon": 1e-8, "knows_noise": True} if method == "dropo" else {}
            cells += [
                Cell("table", "point", **of),
                Cell("table", "noisy", **of, **known),
                Cell("table", "unmodeled", **of, epsilon=1e-3),
                Cell("recovery", "distribution", **of, epsilon=1e-7),
            ]
        cells.append(Cell("table", "noisy", "dropo", seed, NOISE_VARIANCE))  # as in the paper: ε alone
        given = [(m, f) for m, f in METHODS if m == "bayessim"]
        cells += [Cell("table", "noisy", m, seed, features=f, knows_noise=True) for m, f in given]
    sweeps = (("point", False), ("noisy", False), ("noisy", True), ("unmodeled", False))
    cells += [Cell("sweep", variant, epsilon=e, noisy_starts=s) for variant, s in sweeps for e in plan.epsilons]
    cells += [
        Cell("noise", "point", epsilon=e, noise=noise, ends_only=ends, noisy_starts=starts)
        for noise in plan.noise_variances
        for ends, starts in ((True, False), (False, False), (False, True))
        for e in plan.epsilons
    ]
    cells += [Cell("cma", "point"), Cell("cma", "point", optimizer="cma")]
    return cells + [
        Cell("size", variant, epsilon=epsilon, knows_noise=variant == "noisy", size=size, resample=b)
        for variant, epsilon in (("noisy", 1e-8), ("distribution", 1e-7))
        for size in plan.sizes
        for b in range(plan.resamples)
    ]


def run_cell(cell: Cell, *, plan: Plan, logs: Path, threads: int = 0) -> dict[str, Any]:
    """Record the cell's log, fit it, and return what was found beside what is true."""
    if cell.block == "noise":
        plan = replace(plan, steps=plan.noise_steps)
    if cell.block == "cma":
        plan = replace(plan, steps=plan.cma_steps, samples=plan.cma_samples)
    log = _log(cell, plan)
    path = logs / f"{cell.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    log.save(path)
    problem = make_problem(make_config({**_document(cell, plan), "data": str(path.resolve()), "threads": threads}))
    found = fitted(problem, log)
    path.unlink()
    return {
        "cell": asdict(cell),
        "mse_at_truth": mse_at(problem, {name: value["mean"] for name, value in found["truth"].items()}),
        **({"robust_log_likelihood": found["fit"]["log_likelihood"]} if cell.noisy_starts else {}),
        **found,
    }


def _document(cell: Cell, plan: Plan) -> dict[str, Any]:
    """The config of a cell's fit, but for its log."""
    document = {
        **method_keys(cell.method, cell.features, plan),
        "sim": "hopper",
        "parameters": {k: v for k, v in SIM.parameters.items() if cell.variant != "unmodeled" or k != UNMODELED},
        "seed": cell.seed,
        "epsilon": cell.epsilon * (NEGLIGIBLE if cell.noisy_starts else 1),
    }
    if cell.optimizer == "cma":
        document |= {"optimizer": "cma", "budget": plan.cma_budget}
    if cell.knows_noise or cell.noisy_starts:
        document["noise"] = (NOISE_VARIANCE if cell.knows_noise else cell.epsilon) ** 0.5
    return document


def _log(cell: Cell, plan: Plan) -> HopperLog:
    """The log of a cell."""
    steps = plan.steps if cell.size is None else -(-max(plan.sizes) // plan.episodes)
    log = record(variant=cell.variant, episodes=plan.episodes, steps=steps, seed=cell.seed)
    generator = np.random.default_rng([cell.seed, cell.resample, 17])
    if cell.noise is not None:
        sigma, shape = np.sqrt(cell.noise), log.observations.shape
        ends = log.next_observations + sigma * generator.standard_normal(shape)
        starts = log.observations + (0.0 if cell.ends_only else sigma) * generator.standard_normal(shape)
        log = replace(log, observations=starts, next_observations=ends)
    if cell.size is None:
        return log
    rows = generator.integers(0, len(log.actions), cell.size)  # a bootstrap sample: with replacement
    return HopperLog(
        observations=log.observations[rows],
        next_observations=log.next_observations[rows],
        actions=log.actions[rows],
        terminals=np.ones(cell.size, dtype=bool),
        masses=log.masses,
    )
