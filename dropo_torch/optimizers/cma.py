"""CMA-ES over normalised φ, as in the paper, by pycma."""

from __future__ import annotations

import pickle
from typing import Any

import cma
import numpy as np
import torch

from dropo_torch.distribution import SearchBox
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import LikelihoodOptimizer, Progress, Request
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.support.random import draw_uniforms


class Normals:
    """Standard normals for pycma from a generator of their own, which travels with a checkpoint."""

    def __init__(self, seed: int) -> None:
        self.generator = np.random.default_rng(seed)

    def __call__(self, *shape: int) -> np.ndarray:
        """Return standard normals of a shape."""
        return self.generator.standard_normal(shape)


class CMAOptimizer(LikelihoodOptimizer):
    """CMA-ES on the sampled objective: μ linear, σ logarithmic, all in [0, 4], step 1.

    Args:
        objective: gives the reduction; it is not evaluated here.
        settings: samples, budget and population of the search, and its seed.
    """

    name = "cma"
    STATE = ("_asked", "_best", "_best_phi")

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        super().__init__(objective, settings)
        options = {
            "bounds": [0, SearchBox.WIDTH],
            "randn": Normals(settings.seed),
            "seed": np.nan,  # the generator above is the only source of randomness
            "verbose": -9,
            "verb_log": 0,
            "verb_disp": 0,
            "maxfevals": settings.budget,
            "tolfun": 1e-3,
            "tolfunhist": 1e-4,
            "tolstagnation": 200,
        }
        if settings.population is not None:
            options["popsize"] = settings.population
        dim = 2 * len(self._space)
        self._search = cma.CMAEvolutionStrategy(np.full(dim, SearchBox.WIDTH / 2), 1.0, options)
        self._asked: list[np.ndarray] | None = None
        self._best = -np.inf
        self._best_phi: np.ndarray | None = None

    def ask(self) -> Request:
        """Return the samples of a generation, ``(population · K, d)``."""
        if self._asked is None:
            self._asked = self._search.ask()
        mean, std = self._box.denormalise(np.array(self._asked))
        settings = self._settings
        generation = 0 if settings.common_random_numbers else self._search.countiter
        uniforms = draw_uniforms(settings.samples, len(self._space), settings.seed, 1, generation)
        return Request(
            values=self._objective.values(mean, std, uniforms).flatten(0, 1).numpy(),
            reduce=self._likelihood(len(mean)),
            evaluations=len(mean),
            linearise_at=self._center() if self._noisy else None,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Rank the generation by its log-likelihoods."""
        assert self._asked is not None
        std = self._box.denormalise(np.array(self._asked))[1]
        values = sums[: len(self._asked)].numpy() + self._settings.entropy * np.log(std).sum(-1)
        best = int(np.argmax(values))
        if values[best] > self._best:
            self._best, self._best_phi = float(values[best]), np.array(self._asked[best])
        self._search.tell(self._asked, list(-values))
        self._asked = None

    @property
    def stop_reason(self) -> str | None:
        """Pycma's termination conditions, in words."""
        met = self._search.stop()
        if not met:
            return None
        words = {
            "maxfevals": f"the budget of {self._settings.budget} evaluations is spent",
            "tolfun": "the likelihood no longer differs within a generation",
            "tolfunhist": "the best likelihood no longer changes",
            "tolx": "the search distribution has shrunk to a point",
            "tolstagnation": "the likelihood has not improved for long",
            "tolflatfitness": "the likelihood is flat",
        }
        return "; ".join(words.get(k, f"pycma stopped: {k}") for k in met)

    @property
    def progress(self) -> Progress:
        """Best sampled log-likelihood and the share of the budget that is spent."""
        best = self._best if np.isfinite(self._best) else float("nan")
        return Progress("CMA-ES", best, min(1.0, self._search.countevals / self._settings.budget))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the search distribution's mean and the best φ that was evaluated."""
        found = [np.asarray(self._search.result.xfavorite)]
        if self._best_phi is not None:
            found.append(self._best_phi)
        return [self._box.denormalise(phi) for phi in found]

    def state(self) -> dict[str, Any]:
        """Return pycma's own pickle and what stands beside it."""
        return super().state() | {"_search": self._search.pickle_dumps()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        super().restore(state | {"_search": pickle.loads(state["_search"])})

    def _center(self) -> np.ndarray:
        """Return μ of the search distribution, in coordinates."""
        return self._box.denormalise(np.asarray(self._search.mean))[0]
