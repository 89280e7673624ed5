"""DROID (Tsai et al. 2021): CMA-ES on the error of replayed transitions; the distribution is its last generation's."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from dropo_torch.baselines.settings import DroidSettings
from dropo_torch.distribution import Distribution, SearchBox
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Progress, Request
from dropo_torch.optimizers.cma import Evolution, evolution, why_stopped
from dropo_torch.parameters import ParameterSpace


def squared_errors(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Return Σ‖s − s'‖² of each parameter vector and how many transitions diverge under it, which it leaves out."""
    error = (features - measured[:, None]).square().sum(-1)
    alive = error.isfinite()
    return torch.cat([torch.where(alive, error, 0.0).sum(0), (~alive).sum(0).double()])


class DroidOptimizer(Evolution):
    """CMA-ES over parameter vectors, scaled to [0, 4], first step 1, start in the middle.

    Each logged transition (window of λ steps) is replayed from its logged state; the error is the squared L2 distance
    in the compared columns, summed. The distribution is the search's normal after the last generation: it says
    how far the search had contracted when it stopped, and nothing about the log.

    Args:
        objective: gives what varies.
        settings: budget and population.
        seed: seeds the search.
    """

    name = "cma"
    method = "droid"

    def __init__(self, objective: Objective, *, settings: DroidSettings, seed: int) -> None:
        self._space, self._box, self._settings = objective.simulator.parameters, objective.box, settings
        super().__init__(partial(
            evolution, max(2, len(self._space)),  # pycma needs two dimensions; the second is idle
            seed=seed, budget=settings.budget, population=settings.population,
            tolerances={"tolfun": 1e-12, "tolfunhist": 1e-13},
        ))  # fmt: skip
        self._best = np.inf

    def ask(self) -> Request:
        """Return a generation, ``(population, d)``."""
        points = self._coordinates(self._generation())
        return Request(values=self._box.values(points), reduce=squared_errors, evaluations=len(points))

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Rank the generation by its errors."""
        costs, lost = sums.reshape(2, -1).numpy()
        best = int(np.lexsort((costs, lost))[0])
        if (lost[best], costs[best]) < (self._least, self._best):
            self._best = float(costs[best])
        self._tell(costs, lost)

    @property
    def stop_reason(self) -> str | None:
        """Pycma's termination conditions, in words."""
        return why_stopped(self._search, f"{self._settings.budget} simulations of the log", "error")

    @property
    def progress(self) -> Progress:
        """The share of the budget that is spent."""
        return Progress("DROID", float("nan"), min(1.0, self._search.countevals / self._settings.budget))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return mean and standard deviations of the search distribution."""
        d, scale = len(self._space), self._box.width / SearchBox.WIDTH
        mean = self._coordinates(np.asarray(self._search.result.xfavorite)[None])[0]
        std = np.asarray(self._search.result.stds)[:d] * scale
        return [(mean, np.clip(std, self._box.min_std, self._box.width))]

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the search distribution with its correlation."""
        mean, std = self.candidates()[0]
        d = len(space)
        correlation = np.asarray(self._search.sm.correlation_matrix)[:d, :d]
        return [Distribution.over(space, mean, std, correlation=correlation)]

    def extras(self) -> dict[str, Any]:
        """Return the best squared error, summed over the log."""
        return {"squared_error": self._best}

    def _coordinates(self, points: np.ndarray) -> np.ndarray:
        """Parameter vectors in coordinates of points in [0, 4], ``(P, d)``."""
        share = np.clip(points[:, : len(self._space)] / SearchBox.WIDTH, 0, 1)
        return self._box.low + share * self._box.width
