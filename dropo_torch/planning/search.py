"""The search for a motion: CMA-ES over a family, by what is promised and by what limits are exceeded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cma
import numpy as np

from dropo_torch.distribution import SearchBox
from dropo_torch.errors import InputError
from dropo_torch.optimizers.cma import evolution, why_stopped
from dropo_torch.planning.motion import Family
from dropo_torch.support.checkpoint import Checkpoint
from dropo_torch.support.report import Report

#: Generations of multi-sines and motions at random among which a search begins, and cost of a motion that diverges.
FIRST, DIVERGED = 4, 1e6
#: Motions that are tried unless told otherwise: at least, and for each of a motion's numbers.
FEWEST, EACH = 400, 15
#: Width of the search that begins there, of [0, 1] in each number.
STEP = 0.15

#: Costs ``(P,)`` of motions ``(P, dimensions)`` in [0, 1]; the least is the best.
Cost = Callable[[np.ndarray], np.ndarray]


@dataclass
class Found:
    """The best motion so far.

    Attributes:
        numbers: of the motion, ``(dimensions,)``.
        cost: what it costs.
        evaluations: motions that were tried.
        why: why the search stopped.
    """

    numbers: np.ndarray
    cost: float
    evaluations: int
    why: str = ""


def search(
    cost: Cost, family: Family, *, seed: int, evaluations: int | None, population: int | None, report: Report,
    kept: Checkpoint | None = None, resume: bool = False,
) -> Found:  # fmt: skip
    """Return the motion that costs least.

    Args:
        cost: of motions.
        family: of the motions.
        seed: of all that is drawn.
        evaluations: motions that may be tried; by default more where they have more numbers.
        population: of a generation; pycma's choice by default.
        report: is told the share of them that is done.
        kept: where the search's state is kept after every generation.
        resume: go on from there; the result is that of a search never interrupted.
    """
    told: list[list[float]] = []
    if resume and kept is not None and kept.path.exists():
        told = kept.load()["told"]
    size = population or 4 + int(3 * np.log(family.dimensions))
    budget = evaluations or max(FEWEST, EACH * family.dimensions)
    rng, count = np.random.default_rng([seed, 7]), min(FIRST * size, budget)
    first = np.concatenate([family.multisines(count - count // 2, rng), rng.random((count // 2, family.dimensions))])
    done = 0

    def value(points: np.ndarray, label: str) -> np.ndarray:
        """Costs of the next points: those that were told before, or new ones, which are kept."""
        nonlocal done
        if done < len(told):
            costs = np.array(told[done])
            if len(costs) != len(points):
                raise InputError("resume: the search that was interrupted tried others; start again without --resume")
        else:
            costs = np.minimum(np.nan_to_num(cost(points), nan=DIVERGED), DIVERGED)
            told.append(costs.tolist())
            if kept is not None:
                kept.save({"told": told})
        done += 1
        report(label, min(1.0, sum(map(len, told[:done])) / budget))
        return costs

    parts = [first[i : i + size] for i in range(0, len(first), size)]
    costs = np.concatenate([value(part, "trying multi-sines and motions at random") for part in parts])
    best = Found(first[costs.argmin()], float(costs.min()), len(first))
    engine = _engine(best.numbers, seed, budget - len(first), size)
    while engine is not None and not engine.stop():
        points = np.array(engine.ask()) / SearchBox.WIDTH
        costs = value(points, "searching")
        engine.tell(list(points * SearchBox.WIDTH), costs.tolist())
        best.evaluations += len(points)
        if costs.min() < best.cost:
            best.numbers, best.cost = points[costs.argmin()], float(costs.min())
    best.why = f"{budget} motions were tried" if engine is None else _why(engine, budget)
    return best


def _engine(start: np.ndarray, seed: int, budget: int, population: int) -> Any:
    """Pycma's search about the best motion at random; ``None`` where nothing is left to try."""
    if budget < population:
        return None
    tolerances = {"tolfun": 1e-3, "tolfunhist": 1e-3, "tolstagnation": 100}
    begin = np.clip(start * SearchBox.WIDTH, 0.05, SearchBox.WIDTH - 0.05)
    return evolution(
        len(start),
        seed=seed,
        budget=budget,
        population=population,
        tolerances=tolerances,
        start=begin,
        step=STEP * SearchBox.WIDTH,
    )


def _why(engine: cma.CMAEvolutionStrategy, evaluations: int) -> str:
    return why_stopped(engine, f"{evaluations} motions", "information") or f"{evaluations} motions were tried"
