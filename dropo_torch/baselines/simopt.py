"""SimOpt (Chebotar et al. 2019), offline: relative-entropy policy search on the error of replayed trajectories."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import scipy.optimize
import torch

from dropo_torch.baselines.settings import SimOptSettings
from dropo_torch.data.trajectory import Replay
from dropo_torch.distribution import DRAWN_STD, Distribution
from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.parameters import ParameterSpace


def discrepancy(
    features: torch.Tensor, measured: torch.Tensor, controls: torch.Tensor, *, scale: torch.Tensor
) -> torch.Tensor:
    """Return Σ (|e|₁ + |e|₂²) of each parameter vector, ``(P,)``, with e = (s − s')/scale; NaN where one diverged.

    Args:
        features: replayed, ``(w, P, H, m)``.
        measured: ``(w, H, m)``.
        controls: ``(w, H, n)``, of no account.
        scale: of each column, ``(m,)``.
    """
    error = (features - measured[:, None]) / scale
    return (error.abs() + error.square()).sum((0, 2, 3))


def reps_weights(costs: np.ndarray, kl: float) -> np.ndarray:
    """Return the weights of relative-entropy policy search, ``(N,)``, summing to 1.

    They minimize the expected cost among all reweightings of the samples whose relative entropy to the samples is
    at most ``kl``: w ∝ exp(−cost / η), with η the minimizer of the dual η kl + η log mean exp(−cost / η).

    Args:
        costs: of the samples, ``(N,)``; one that is not finite gets no weight.
        kl: in nats.
    """
    finite = np.isfinite(costs)
    if not finite.any():
        return np.full(len(costs), 1 / len(costs))
    low = costs[finite].min()
    spread = float(np.diff(np.quantile(costs[finite], [0.25, 0.75]))[0]) or float(costs[finite].std())
    if spread == 0:
        return finite / finite.sum()
    gain = np.where(finite, (costs - low) / spread, np.inf)  # quartiles: a few replays that explode set no scale

    def dual(log_eta: float) -> float:
        eta = float(np.exp(log_eta))
        return eta * kl + eta * float(np.log(np.mean(np.exp(-gain / eta))))

    best = scipy.optimize.minimize_scalar(dual, bounds=(np.log(1e-3), np.log(1e3)), method="bounded")
    weights = np.exp(-gain / np.exp(best.x))
    return weights / weights.sum()


class SimOptOptimizer(Optimizer):
    """Moves a normal with full covariance, in coordinates, towards replays that look like the log.

    The log is cut into windows of ``horizon`` steps. Each is replayed *open loop* from its logged state with its
    logged actions, so errors add up along it. The discrepancy is the sum of the L1 and squared L2 errors over all
    steps, in columns scaled by their standard deviation over the log, where they move. (SimOpt also filters the error
    in time, for robots whose clock drifts against the simulation's; a log and its replay share theirs.) The first
    distribution is the search box's middle with a quarter of its width. Each iteration fits the normal to its
    samples, weighted by :func:`reps_weights`.

    Args:
        objective: gives what varies and the compared columns.
        replay: the windows.
        settings: samples, iterations and bounds.
        seed: seeds the samples.
    """

    name = "reps"
    method = "simopt"
    STATE = ("_mean", "_covariance", "_iteration", "_cost")

    def __init__(self, objective: Objective, replay: Replay, *, settings: SimOptSettings, seed: int) -> None:
        self._box, self._replay, self._settings, self._seed = objective.box, replay, settings, seed
        std = objective.measured.std(0, unbiased=False)
        self._reduce = functools.partial(discrepancy, scale=torch.where(std > 1e-12, std, torch.ones_like(std)))
        self._mean = np.full(len(self._box.low), 0.5)  # as shares of the search box
        self._covariance = np.diag(np.full(len(self._box.low), 0.25**2))
        self._iteration = 0
        self._cost = float("nan")

    def ask(self) -> Request:
        """Return the samples of the current distribution, ``(N, d)``."""
        points = self._box.low + self._draws() * self._box.width
        values = self._box.values(points)
        return Request(values=values, reduce=self._reduce, evaluations=len(points), replay=self._replay)

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Fit the distribution to the weighted samples."""
        draws, costs = self._draws(), sums.numpy()
        alive, least = int(np.isfinite(costs).sum()), min(len(costs), max(4, len(self._mean) + 2))
        if alive < least:
            raise InputError(
                f"method: simopt: only {alive} of {len(costs)} samples were replayed without divergence; "
                "narrow the bounds, or shorten method_options.horizon"
            )
        weights = reps_weights(costs, self._settings.kl)
        self._mean = weights @ draws
        centered = draws - self._mean
        covariance = (weights[:, None] * centered).T @ centered
        lost = float(weights @ weights)  # a weighted covariance is too small by the inverse of the effective number
        covariance /= max(1 - lost, 0.1)
        floor = (self._box.min_std / self._box.width) ** 2
        self._covariance = covariance + np.diag(np.maximum(floor - np.diag(covariance), 0))
        self._cost = float(weights @ np.where(np.isfinite(costs), costs, 0.0))
        self._iteration += 1

    @property
    def stop_reason(self) -> str | None:
        """Iterations spent, or nothing left to shrink."""
        if self._iteration and (np.sqrt(np.diag(self._covariance)) < self._settings.tolerance).all():
            return f"every standard deviation is below {self._settings.tolerance:g} of the search width"
        if self._iteration >= self._settings.iterations:
            return f"{self._settings.iterations} iterations of relative-entropy policy search"
        return None

    @property
    def progress(self) -> Progress:
        """The share of iterations done."""
        return Progress("SimOpt", float("nan"), self._iteration / self._settings.iterations)

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return mean and standard deviations of the current distribution."""
        mean = np.clip(self._box.low + self._mean * self._box.width, self._box.low, self._box.high)
        return [(mean, np.maximum(np.sqrt(np.diag(self._covariance)) * self._box.width, self._box.min_std))]

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the current distribution with its correlation."""
        mean, std = self.candidates()[0]
        spread = np.sqrt(np.diag(self._covariance))
        correlation = self._covariance / np.outer(spread, spread)
        # draws end two σ from the mean: so wide that theirs have the search's standard deviation
        return [Distribution.over(space, mean, std / DRAWN_STD, correlation=correlation)]

    def extras(self) -> dict[str, Any]:
        """Return the weighted discrepancy of the last iteration, and the windows' length and number."""
        return {"discrepancy": self._cost, "horizon": self._replay.horizon, "windows": len(self._replay.states)}

    def _draws(self) -> np.ndarray:
        """The iteration's samples, as shares of the search box, ``(N, d)``; a function of seed and iteration."""
        generator = np.random.default_rng([self._seed, 11, self._iteration])
        normal = generator.standard_normal((self._settings.samples, len(self._mean)))
        values, vectors = np.linalg.eigh(self._covariance)
        return np.clip(self._mean + normal * np.sqrt(np.maximum(values, 0)) @ vectors.T, 0.0, 1.0)
