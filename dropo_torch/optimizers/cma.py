"""CMA-ES over normalized φ, as in the paper, by pycma."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import cma
import numpy as np
import torch

from dropo_torch.distribution import SearchBox
from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import LikelihoodOptimizer, Optimizer, Progress, Request
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.support.random import draw_uniforms

#: Cost that pycma is told of what diverges, times its rank: beyond every finite one.
DIVERGED = 1e100


class Normals:
    """Standard normals for pycma from a generator of their own."""

    def __init__(self, seed: int) -> None:
        self.generator = np.random.default_rng(seed)

    def __call__(self, *shape: int) -> np.ndarray:
        """Return standard normals of a shape."""
        return self.generator.standard_normal(shape)


def evolution(
    dimensions: int, *, seed: int, budget: int, population: int | None, tolerances: dict[str, float],
    start: np.ndarray | None = None, step: float = 1.0,
) -> cma.CMAEvolutionStrategy:  # fmt: skip
    """Return pycma's search over [0, 4] in each dimension; ``tolerances`` end it.

    It starts from the middle with step 1 unless told where and how wide.
    """
    options = {
        "bounds": [0, SearchBox.WIDTH],
        "randn": Normals(seed),
        "seed": np.nan,  # the generator above is the only source of randomness
        "verbose": -9,
        "verb_log": 0,
        "verb_disp": 0,
        "maxfevals": budget,
    }
    if population:
        options["popsize"] = population
    begin = np.full(dimensions, SearchBox.WIDTH / 2) if start is None else start
    return cma.CMAEvolutionStrategy(begin, step, options | tolerances)


def why_stopped(search: cma.CMAEvolutionStrategy, budget: str, value: str) -> str | None:
    """Return pycma's termination conditions, in words for what is spent and what is searched for; ``None`` without."""
    words = {
        "maxfevals": f"the budget of {budget} is spent",
        "tolfun": f"the {value} no longer differs within a generation",
        "tolfunhist": f"the best {value} no longer changes",
        "tolx": "the search distribution has shrunk to a point",
        "tolstagnation": f"the {value} has not improved for long",
        "tolflatfitness": f"the {value} is flat",
    }
    return "; ".join(words.get(k, f"pycma stopped: {k}") for k in search.stop()) or None


class Evolution(Optimizer):
    """A search by pycma: a generation stands until it was told, and the state holds what every generation was told.

    Nothing outweighs a divergence: whatever diverges more often than the least of all generations ranks behind all
    that does not, whatever it costs.

    Args:
        begin: makes the search as it begins; from there what was told leads anywhere else.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_told", "_best", "_least")
    _least: float = np.inf

    def __init__(self, begin: Callable[[], cma.CMAEvolutionStrategy]) -> None:
        self._begin, self._search = begin, begin()
        self._asked: list[np.ndarray] | None = None
        self._told: list[list[float]] = []

    def state(self) -> dict[str, Any]:
        """Return what every generation was told, and where that has led."""
        return super().state() | {"mean": np.array(self._search.mean)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state: tell a new search the same once more.

        Raises:
            InputError: this leads elsewhere, as another version of pycma may.
        """
        super().restore({name: state[name] for name in self.STATE})
        self._search, self._asked, told, self._told = self._begin(), None, self._told, []
        for values in told:
            self._search.stop()  # keeps records of its own, once a generation
            self._generation()
            self._rank(values)
        if not np.array_equal(self._search.mean, state["mean"]):
            raise InputError(
                f"resume: pycma {cma.__version__} searches differently than the one that began; install that, or "
                "start again without --resume"
            )

    def _generation(self) -> np.ndarray:
        """The points in [0, 4] to be told next, ``(population, dimensions)``."""
        if self._asked is None:
            self._asked = self._search.ask()
        return np.array(self._asked)

    def _tell(self, costs: np.ndarray, lost: np.ndarray) -> None:
        """Rank the generation by how often each point diverged, then by its costs, ``(population,)`` each."""
        self._least = min(self._least, float(lost.min()))
        costs = np.minimum(np.nan_to_num(costs, nan=DIVERGED), DIVERGED)
        rank = np.argsort(np.lexsort((costs, lost)))
        self._rank(np.where(lost > self._least, DIVERGED * (1.0 + rank), costs).tolist())

    def _rank(self, values: list[float]) -> None:
        """Tell the search the generation's values, of which the least is the best."""
        self._search.tell(self._asked, values)
        self._told.append(values)
        self._asked = None


class CMAOptimizer(Evolution, LikelihoodOptimizer):
    """CMA-ES on the sampled objective: μ linear, σ logarithmic, all in [0, 4], step 1.

    Args:
        objective: gives the reduction; it is not evaluated here.
        settings: samples, budget and population of the search, and its seed.
    """

    name = "cma"
    STATE = (*Evolution.STATE, "_best_phi")
    _best: tuple[float, float] = (-np.inf, -np.inf)

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        LikelihoodOptimizer.__init__(self, objective, settings)
        Evolution.__init__(self, partial(
            evolution, 2 * len(self._space), seed=settings.seed, budget=settings.budget,
            population=settings.population, tolerances={"tolfun": 1e-3, "tolfunhist": 1e-4, "tolstagnation": 200},
        ))  # fmt: skip
        self._best_phi: np.ndarray | None = None

    def ask(self) -> Request:
        """Return the samples of a generation, ``(population · K, d)``.

        Where initial states are noisy, the best so far is among them: under the noise as it is propagated here.
        """
        generation = self._generation()
        if self._noisy and self._best_phi is not None:
            generation = np.concatenate([generation, self._best_phi[None]])
        mean, std = self._box.denormalize(generation)
        settings = self._settings
        draw = 0 if settings.common_random_numbers else self._search.countiter
        uniforms = draw_uniforms(settings.samples, len(self._space), settings.seed, 1, draw)
        return Request(
            values=self._objective.values(mean, std, uniforms).flatten(0, 1).numpy(),
            reduce=self._objective.likelihood(len(mean)),
            evaluations=len(mean),
            linearise_at=self._center() if self._noisy else None,
            widen=False,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Rank the generation by its log-likelihoods."""
        every, count = sums.reshape(5, -1).numpy(), len(self._generation())
        points = np.array([*self._generation(), self._best_phi][: every.shape[1]])
        values = every[0] + self._settings.entropy * np.log(self._box.denormalize(points)[1]).sum(-1)
        if len(points) > count:  # the best so far, under the noise of this generation
            self._best = (-every[4, -1], values[-1])
        best = int(np.lexsort((values, -every[4]))[-1])
        if (-every[4, best], values[best]) > self._best:
            self._best, self._best_phi = (-float(every[4, best]), float(values[best])), points[best]
        self._tell(-values[:count], every[4, :count])

    @property
    def stop_reason(self) -> str | None:
        """Pycma's termination conditions, in words."""
        return why_stopped(self._search, f"{self._settings.budget} evaluations", "likelihood")

    @property
    def progress(self) -> Progress:
        """Best sampled log-likelihood and the share of the budget that is spent."""
        best = self._best[1] if np.isfinite(self._best[1]) else float("nan")
        return Progress("CMA-ES", best, min(1.0, self._search.countevals / self._settings.budget))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the search distribution's mean and the best φ that was evaluated."""
        found = [np.asarray(self._search.result.xfavorite)]
        if self._best_phi is not None:
            found.append(self._best_phi)
        return [self._box.denormalize(phi) for phi in found]

    def _center(self) -> np.ndarray:
        """Return μ of the search distribution, in coordinates."""
        return self._box.denormalize(np.asarray(self._search.mean))[0]
