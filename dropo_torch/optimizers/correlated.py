"""A full covariance of p_φ: expectation-maximization after Fisher scoring.

With the next state linear in the parameters around μ, the parameters of each transition are a random effect:
r_t = A_t (ξ_t − μ) + noise, ξ_t ~ N(μ, C). The likelihood depends on the log through G_t = A_tᵀΣ_t⁻¹A_t and
g_t = A_tᵀΣ_t⁻¹r_t alone, which one stencil gives for every transition.
"""

from __future__ import annotations

import numpy as np
import torch

from dropo_torch.distribution import DRAWN_STD, Distribution
from dropo_torch.likelihood import survivors
from dropo_torch.objective import Objective, Reduce
from dropo_torch.optimizers.base import Progress, Request
from dropo_torch.optimizers.fisher import FisherOptimizer
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.parameters import ParameterSpace

#: Times that the simulation is linearized anew, at most.
_ROUNDS = 5
_ITERATIONS = 500
#: The means have converged when no round moves them by more than this share of their box.
_AT_REST = 1e-4


def random_effects(
    gram: torch.Tensor, force: torch.Tensor, start: torch.Tensor, entropy: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the covariance C ``(d, d)`` and the shift of μ ``(d,)`` that make the residuals most likely.

    With ``entropy`` β, the log-likelihood plus ½ β log det C is maximized: each step's C is larger by T / (T − β).

    Args:
        gram: G_t, ``(T, d, d)``.
        force: g_t, ``(T, d)``.
        start: first guess of C, positive definite, ``(d, d)``; its standard deviations stay below 1.
        entropy: β.
    """
    wider = len(gram) / max(len(gram) - entropy, 1e-3 * len(gram))
    eye = torch.eye(len(start), dtype=start.dtype)
    covariance, total = start, torch.zeros(len(start), dtype=start.dtype)
    for _ in range(_ITERATIONS):
        # (C⁻¹ + G)⁻¹ = (I + CG)⁻¹ C, which needs no inverse of C
        inner = torch.linalg.solve(eye + covariance @ gram, covariance.expand(len(gram), -1, -1))
        inner = 0.5 * (inner + inner.mT)
        means = (inner @ (force - gram @ total)[..., None])[..., 0]
        shift = means.mean(0)
        centered = means - shift
        updated = wider * (inner.mean(0) + centered.T @ centered / len(means))
        within = updated.diagonal().clamp(min=1.0).rsqrt()
        updated = updated * torch.outer(within, within)
        change = (updated - covariance).abs().max() / covariance.diagonal().max().clamp(min=1e-300)
        covariance, total = 0.5 * (updated + updated.T), total + shift
        if float(change) < 1e-6:
            break
    return covariance, total


class CorrelatedOptimizer(FisherOptimizer):
    """Fisher scoring with independent parameters, then their full covariance; the likelier of both is the result."""

    STATE = (*FisherOptimizer.STATE, "_center", "_covariance", "_rounds", "_stable")

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        super().__init__(objective, settings)
        self._center: np.ndarray | None = None
        self._covariance: np.ndarray | None = None
        self._rounds = 0
        self._stable: tuple[np.ndarray, float] | None = None  # the last μ, and what diverged around it
        self._gathered: list[tuple[torch.Tensor, torch.Tensor]] = []

    def ask(self) -> Request:
        """Return the points of the stage at work, or the stencil that linearizes the simulation."""
        if super().stop_reason is None:
            return super().ask()
        stage = MeansStage(self._box.low, self._box.high, self._at)
        self._gathered = []
        return Request(
            values=self._box.values(stage.points()),
            reduce=self._gather(stage.points()),
            evaluations=1,
            linearise_at=self._linearised,
            linearise_std=self._explained,
            is_stencil=True,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Hand the sums to the stage at work, or maximize over μ and C."""
        if super().stop_reason is None:
            super().tell(sums, gradient)
            return
        lost = float(sums[0])
        if self._stable is not None and lost > self._stable[1]:  # more diverge here than where it came from
            self._center, self._rounds = self._stable[0], _ROUNDS
            return
        self._stable = (self._at, lost)
        gram, force = (torch.cat(parts) for parts in zip(*self._gathered, strict=True))
        if not len(gram):  # every simulation diverges here
            self._center, self._rounds = self._at, _ROUNDS
            return
        scale = torch.from_numpy(self._box.width)  # parameters of very different size, as shares of their boxes
        area = torch.outer(scale, scale)
        start = torch.from_numpy(self._first_guess() if self._covariance is None else self._covariance) / area
        found, shift = random_effects(gram * area, force * scale, start, self._settings.entropy)
        self._covariance = (found * area).numpy()
        moved = np.clip(self._at + (shift * scale).numpy(), self._box.low, self._box.high)
        converged = bool((np.abs(moved - self._at) <= _AT_REST * self._box.width).all())
        self._center, self._rounds = moved, (_ROUNDS if converged else self._rounds + 1)

    @property
    def stop_reason(self) -> str | None:
        """The reason of the scoring, when the covariance is found too."""
        reason = super().stop_reason
        return None if reason is None or self._rounds < _ROUNDS else f"{reason}; the covariance is found"

    @property
    def progress(self) -> Progress:
        """The stage at work."""
        if super().stop_reason is None:
            return super().progress
        return Progress("full covariance", float("nan"), 0.9)

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the independent distribution and the correlated one."""
        independent = super().distributions(space)
        if self._covariance is None:
            return independent
        drawn = np.sqrt(np.maximum(np.diag(self._covariance), 1e-300))
        correlation = self._covariance / np.outer(drawn, drawn)
        bounded = np.clip(drawn / DRAWN_STD, self._box.min_std, self._box.max_std)  # the cut takes its share again
        return [*independent, Distribution.over(space, self._at, bounded, correlation=correlation)]

    @property
    def _at(self) -> np.ndarray:
        """Where the simulation is linearized, in coordinates, ``(d,)``."""
        return self.candidates()[0][0] if self._center is None else self._center

    def _first_guess(self) -> np.ndarray:
        """A diagonal covariance wider than the scoring's: from a point, expectation-maximization never leaves."""
        return np.diag(np.maximum(1.5 * self.candidates()[0][1], self._box.width / 200) ** 2)

    def _gather(self, points: np.ndarray) -> Reduce:
        """A reduction that keeps G and g of every transition whose simulations survive."""
        steps = torch.from_numpy(np.diag(points[1:] - points[0]).copy())
        gathered = self._gathered

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            features, measured, covariance, lost = survivors(features, measured, covariance)
            base = features[:, 0]
            jacobian = (features[:, 1:] - base[:, None]) / steps[:, None]
            residual = (measured - base)[:, None]
            solved = torch.linalg.solve(covariance, torch.cat([residual, jacobian], 1).mT)
            gathered.append((jacobian @ solved[..., 1:], (jacobian @ solved[..., :1])[..., 0]))
            return lost[None]

        return reduce
