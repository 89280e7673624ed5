"""Climbing a likelihood by damped Fisher steps in μ and log σ."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from dropo_torch.distribution import SearchBox
from dropo_torch.objective import Reduce
from dropo_torch.optimizers.least_squares import damped_step

#: Damping after a step that was no good, at least: with less, the next one would be the same.
LEAST_RAISED = 0.05


@dataclass
class Ascent(abc.ABC):
    """A stage that maximizes a likelihood over μ and log σ, and where it stands.

    Attributes:
        box: bounds of μ and σ in coordinates.
        mean, std: the best φ so far, ``(d,)`` each.
        candidate: the φ that is evaluated next; ``None`` for the first one.
        sums: of the best φ: log-likelihood, losses, scores and Fisher matrices, ``(2 + 2d + 2d² ...,)``.
        lost: transitions of which a simulation diverges there; no likelihood outweighs one.
        narrows: whether a smaller σ may still lose fewer; that is tried before anything else.
        reason: why the stage has ended, in words.
    """

    box: SearchBox
    mean: np.ndarray
    std: np.ndarray
    damping: float = 1e-2
    log_likelihood: float = -np.inf
    lost: float = np.inf
    narrows: bool = True
    iterations: int = 0
    small_gains: int = 0
    reason: str | None = None
    candidate: tuple[np.ndarray, np.ndarray] | None = None
    sums: np.ndarray | None = None

    #: What it does, for people, and the share of a fit that is done when it begins.
    TITLE: ClassVar[str]
    BEGUN_AT: ClassVar[float]
    #: Two accepted steps in a row that each gain less end the stage, in nats.
    SMALL_GAIN: ClassVar[float]
    #: Damping beyond which no step is tried.
    MAX_DAMPING: ClassVar[float] = 1e2
    #: Candidates after which the stage ends.
    MAX_ITERATIONS: ClassVar[int]

    @abc.abstractmethod
    def points(self) -> np.ndarray:
        """Return the points at which the candidate is simulated, in coordinates, ``(P, d)``."""

    @abc.abstractmethod
    def reduction(self) -> Reduce:
        """Return the reduction to log-likelihood, losses, scores and Fisher matrices, ``(2 + 2d + 2d² ...,)``."""

    @property
    def phi(self) -> tuple[np.ndarray, np.ndarray]:
        """μ and σ of the candidate, ``(d,)`` each."""
        return self.candidate or (self.mean, self.std)

    @property
    def small_gain(self) -> float:
        """The gain of a step that is as good as none, in nats."""
        return self.SMALL_GAIN

    def tell(self, sums: torch.Tensor) -> None:
        """Accept or reject the candidate, and propose the next one unless it is time to stop.

        One at which fewer transitions diverge is better, whatever its log-likelihood.
        """
        value, lost = float(sums[0]), float(sums[1])
        if np.isfinite(value) and (-lost, value) > (-self.lost, self.log_likelihood):
            gain = value - self.log_likelihood if lost == self.lost else np.inf
            self.mean, self.std = self.phi
            self.lost, self.log_likelihood, self.sums = lost, value, sums.numpy().copy()
            self.narrows = self.narrows and lost > 0
            self.damping = max(self.damping / 4, 1e-6)
            self.small_gains = self.small_gains + 1 if gain < self.small_gain and not self.narrows else 0
            if self.small_gains >= 2:
                self.reason = f"two steps in a row gained less than {self.small_gain:.3g} nat"
        elif self.candidate is None:
            self.reason = "no simulation succeeded at the starting point"
        elif not self.narrows:
            self.damping = max(8 * self.damping, LEAST_RAISED)
            if self.damping > self.MAX_DAMPING:
                self.reason = "no step improves the likelihood"
        self.iterations += 1
        if self.iterations >= self.MAX_ITERATIONS and self.reason is None:
            self.reason = f"{self.MAX_ITERATIONS} iterations of Fisher scoring"
        if self.reason is None and self.sums is not None:
            self.candidate = self._narrower() or scoring_step(self.mean, self.std, self.sums, self.box, self.damping)

    def _narrower(self) -> tuple[np.ndarray, np.ndarray] | None:
        """A quarter of the σ that was tried last, down to the floor, while it may lose fewer transitions."""
        tried = self.phi[1]
        self.narrows = self.narrows and bool((tried > self.box.min_std).any())
        return (self.mean, np.maximum(tried / 4, self.box.min_std)) if self.narrows else None

    def with_entropy(self, sums: torch.Tensor, weight: float) -> torch.Tensor:
        """Return the candidate's sums for the log-likelihood plus ``weight`` β times Σ log σ.

        Where the bonus holds a σ open, residuals are smaller than their covariance, and the likelihood bends by 2β
        where its Fisher information is next to nothing: that is added too, or steps overshoot.
        """
        std = self.phi[1]
        d, added = len(std), sums.clone()
        added[0] += weight * float(np.log(std).sum())
        added[2 + d : 2 + 2 * d] += weight
        added[2 + 2 * d + d * d : 2 + 2 * d + 2 * d * d].view(d, d).diagonal().add_(2 * weight)
        return added


def scoring_step(
    mean: np.ndarray, std: np.ndarray, sums: np.ndarray, box: SearchBox, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the next (μ, σ): a damped Fisher step in μ and log σ, clipped and kept inside the box.

    Args:
        mean, std: φ, ``(d,)`` each.
        sums: log-likelihood, losses, scores and Fisher matrices of (μ, log σ), packed as ``(2 + 2d + 2d² ...,)``.
        box: bounds of μ and σ.
        damping: Marquardt's, on the diagonal of the Fisher matrices scaled to 1.
    """
    d = len(mean)
    score_mean, score_log = sums[2 : 2 + 2 * d].reshape(2, d)
    fisher_mean, fisher_log = sums[2 + 2 * d : 2 + 2 * d + 2 * d * d].reshape(2, d, d)
    free = ~((mean <= box.low) & (score_mean < 0)) & ~((mean >= box.high) & (score_mean > 0))
    move = np.clip(damped_step(fisher_mean, score_mean, free, damping), -0.25 * box.width, 0.25 * box.width)
    log_std, low, high = np.log(std), np.log(box.min_std), np.log(box.max_std)
    free = ~((log_std <= low) & (score_log < 0)) & ~((log_std >= high) & (score_log > 0))
    turn = np.clip(damped_step(fisher_log, score_log, free, damping), -1.5, 1.5)
    # a σ that no longer shows in the covariance has no curvature left: send it down
    turn = np.where(free & (score_log <= 0) & (np.diag(fisher_log) < 1e-3), -1.5 / (1 + damping), turn)
    return np.clip(mean + move, box.low, box.high), np.exp(np.clip(log_std + turn, low, high))
