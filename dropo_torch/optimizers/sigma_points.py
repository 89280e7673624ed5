"""Fisher scoring over sigma points, for simulations that hardly bend within the distribution.

The likelihood's Gaussians come from a quadratic model of the simulation around μ, built from the 2d + 1 points μ and
μ ± σᵢeᵢ, which replaces sampling: with z the truncated standard normal, s(μ + σz) ≈ s₀ + Σ Aᵢzᵢ + ½ Σ Bᵢzᵢ².
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from dropo_torch.distribution import truncated_interval, truncated_moments
from dropo_torch.likelihood import gaussian_log_density, survivors
from dropo_torch.objective import Reduce
from dropo_torch.optimizers.ascent import Ascent

#: Curvature that counts for more than this in the likelihood calls for sampling, in nats.
MUCH_BENDING = 1.0


@dataclass
class SigmaPointStage(Ascent):
    """Maximizes the sigma-point likelihood."""

    TITLE = "Fisher scoring on sigma points"
    BEGUN_AT = 0.4
    SMALL_GAIN = 0.01
    MAX_ITERATIONS = 60

    def points(self) -> np.ndarray:
        """Return the sigma points of the candidate, ``(2d + 1, d)``: μ, then all μ + σ, then all μ − σ."""
        mean, std = self.phi
        up, down = self._reach(mean, std)
        return np.concatenate([mean[None], mean + np.diag(up), mean - np.diag(down)])

    def reduction(self) -> Reduce:
        """Return the reduction to log-likelihood, scores, Fisher matrices and bending, ``(3 + 2d + 2d²,)``."""
        mean, std = self.phi
        up, down = self._reach(mean, std)
        a, b = truncated_interval(*map(torch.as_tensor, (mean, std, *self.box.limits)))
        moments = torch.stack(truncated_moments(a, b))
        reach = torch.from_numpy(np.stack([up / std, down / std]))
        return partial(scores, std=torch.from_numpy(std), reach=reach, moments=moments)

    def tell(self, sums: torch.Tensor) -> None:
        """Accept or reject the candidate, and propose the next one where it promises to gain anything.

        Where a step is no good because the simulation bends, a shorter one is no cure.
        """
        best = self.sums
        super().tell(sums)
        if self.reason is None and best is not None and self.sums is best and not self.narrows and self.bends:
            self.reason = "the simulation bends too much for sigma points"
        if self.reason is None and self.sums is not None and not self.narrows:
            mean, std = self.phi
            move = np.concatenate([mean - self.mean, np.log(std / self.std)])
            if float(self.sums[2 : 2 + len(move)] @ move) < self.SMALL_GAIN:
                self.reason = f"no step promises {self.SMALL_GAIN:g} nat"

    @property
    def misleads(self) -> bool:
        """Whether sigma points are no good description of the simulation at this φ: it bends too much within it."""
        return self.log_likelihood > -np.inf and (self.bends or self.damping > self.MAX_DAMPING)

    @property
    def bends(self) -> bool:
        """Whether curvature within the best φ counts."""
        return self.sums is not None and float(self.sums[-1]) > MUCH_BENDING

    def _reach(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the sigma points lie above and below μ: σ, less at a physical limit, ``(d,)`` each."""
        low, high = self.box.limits
        tiny = 1e-9 * self.box.width
        up = np.where(mean + std <= high, std, np.maximum(high - mean, 0))
        down = np.where(mean - std >= low, std, np.maximum(mean - low, 0))
        return np.where(up < tiny, 0, up), np.where(down < tiny, 0, down)


def scores(
    features: torch.Tensor,
    measured: torch.Tensor,
    covariance: torch.Tensor,
    std: torch.Tensor,
    reach: torch.Tensor,
    moments: torch.Tensor,
) -> torch.Tensor:
    """Return log-likelihood, losses, scores, Fisher information of (μ, log σ) and bending, ``(3 + 2d + 2d²,)``.

    Derivatives treat the Jacobian of the simulation as constant.

    Args:
        features: at the sigma points, ``(t, 2d + 1, m)``.
        measured: ``(t, m)``.
        covariance: what no parameter explains, ``(t, m, m)``.
        std: σ, ``(d,)``.
        reach: how many σ the upper and lower points lie away, ``(2, d)``; 0 for a point at a limit.
        moments: E[z], E[z²], E[z⁴] of the truncated standard normal, ``(3, d)``.
    """
    d = len(std)
    features, measured, covariance, lost = survivors(features, measured, covariance)
    base = features[:, 0]
    slope, bend = _divided_differences(base, features[:, 1 : 1 + d], features[:, 1 + d :], reach)
    first, second, fourth = moments[..., None]
    variance = second - first**2
    mean = base + (slope * first + 0.5 * bend * second).sum(1)
    spread = variance.sqrt() * slope
    curved = 0.5 * (fourth - second**2).clamp(min=0).sqrt() * bend
    total = covariance + spread.mT @ spread + curved.mT @ curved
    residual = measured - mean
    value = gaussian_log_density(residual, total).sum()
    solved = torch.linalg.solve(total, torch.cat([residual[:, None], slope], 1).mT)  # C⁻¹[r, A], (t, m, 1 + d)
    weighted = (slope @ solved[..., :1])[..., 0]  # Aᵀ C⁻¹ r
    gram = slope @ solved[..., 1:]  # Aᵀ C⁻¹ A
    v, shift = variance[:, 0], first[:, 0]
    score_mean = weighted.sum(0) / std
    drift = (shift * weighted).sum(0)  # the mean of z moves with σ where the truncation is lopsided
    score_log = v * (weighted.square() - torch.diagonal(gram, dim1=-2, dim2=-1)).sum(0) + drift
    fisher_mean = gram.sum(0) / torch.outer(std, std)
    fisher_log = 2 * torch.outer(v, v) * gram.square().sum(0) + torch.outer(shift, shift) * gram.sum(0)
    bending = (curved * torch.linalg.solve(total, curved.mT).mT).sum()
    parts = (value, lost, score_mean, score_log, fisher_mean, fisher_log, bending)
    return torch.cat([part.flatten() for part in parts])


def _divided_differences(
    base: torch.Tensor, upper: torch.Tensor, lower: torch.Tensor, reach: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Slopes A and bends B per unit of z, ``(t, d, m)`` each, from points at +p and −q σ."""
    p, q = reach[..., None]
    rise, fall = upper - base[:, None], base[:, None] - lower
    right, left = rise / torch.where(p > 0, p, 1.0), fall / torch.where(q > 0, q, 1.0)
    both = (p > 0) & (q > 0)
    slope = torch.where(both, (q * right + p * left) / (p + q).clamp(min=1e-300), torch.where(p > 0, right, left))
    return slope, torch.where(both, 2 * (right - left) / (p + q).clamp(min=1e-300), 0.0)
