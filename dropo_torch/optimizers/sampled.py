"""Fisher scoring on the sampled objective itself, for simulations that bend within the distribution.

Where the next state is far from quadratic in the parameters (a contact that some samples make and others
do not), sigma points mislead. Here the likelihood is that of K samples x_k = μ + σz_k with fixed z_k, and
its gradient follows from how the samples' next states regress on z: no further simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch

from dropo_torch.distribution import SearchBox, truncated_normal_icdf
from dropo_torch.likelihood import LOST_TRANSITION, gaussian_log_density, sample_moments
from dropo_torch.objective import Reduce
from dropo_torch.optimizers.least_squares import damped_step

MAX_ITERATIONS = 25
#: The stage stops after two accepted steps in a row that each gain less than this, in nats.
SMALL_GAIN = 0.1
MAX_DAMPING = 1e2


@dataclass
class SampledStage:
    """Maximises the sampled likelihood over μ and log σ on fixed base uniforms.

    Attributes:
        box: bounds of μ and σ in coordinates.
        limits: physical limits in coordinates, low and high, ``(d,)`` each.
        uniforms: base uniforms, ``(K, d)``.
        mean, std: the best φ so far, ``(d,)`` each.
        is_log: which parameters are searched by their logarithm, ``(d,)`` bool; none by default.
    """

    box: SearchBox
    limits: tuple[np.ndarray, np.ndarray]
    uniforms: torch.Tensor
    mean: np.ndarray
    std: np.ndarray
    is_log: np.ndarray = field(default_factory=lambda: np.zeros(1, dtype=bool))
    damping: float = 1e-2
    log_likelihood: float = -np.inf
    iterations: int = 0
    small_gains: int = 0
    reason: str | None = None
    candidate: tuple[np.ndarray, np.ndarray] | None = None
    sums: np.ndarray | None = None

    def points(self) -> np.ndarray:
        """Return the candidate's samples in coordinates, ``(K, d)``."""
        mean, std = (torch.as_tensor(x) for x in self.candidate or (self.mean, self.std))
        low, high = (torch.as_tensor(x) for x in self.limits)
        return truncated_normal_icdf(self.uniforms, mean, std, low, high).numpy()

    def reduction(self) -> Reduce:
        """Return the reduction to log-likelihood, scores and Fisher matrices, ``(1 + 2d + 2d²,)``."""
        mean, std = self.candidate or (self.mean, self.std)
        z = torch.from_numpy((self.points() - mean) / std)
        sigma = torch.from_numpy(std)

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            return sampled_scores(features, measured, covariance, sigma, z)

        return reduce

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Accept or reject the candidate, and propose the next one.

        Args:
            sums: of :meth:`reduction`.
            gradient: of the log-likelihood in the samples' values, ``(K, d)``; replaces the regressed scores.
        """
        if gradient is not None:
            sums = self._with_exact_scores(sums, gradient)
        judge(self, sums, small_gain=SMALL_GAIN, max_damping=MAX_DAMPING, max_iterations=MAX_ITERATIONS)
        if self.reason is None and self.sums is not None:
            self.candidate = scoring_step(self.mean, self.std, self.sums, self.box, self.damping)

    def state(self) -> dict[str, Any]:
        """Return everything but the box, the limits, the uniforms and the scales."""
        return {k: v for k, v in vars(self).items() if k not in ("box", "limits", "uniforms", "is_log")}

    def _with_exact_scores(self, sums: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """Put the chain rule's scores of (μ, log σ) in the place of the regressed ones."""
        mean, std = (torch.as_tensor(x).clone().requires_grad_(True) for x in self.candidate or (self.mean, self.std))
        low, high = (torch.as_tensor(x) for x in self.limits)
        x = truncated_normal_icdf(self.uniforms, mean, std, low, high)
        values = torch.where(torch.as_tensor(self.is_log), torch.exp(x), x) if self.is_log.any() else x
        by_mean, by_std = torch.autograd.grad(values, (mean, std), gradient)
        d = len(mean)
        return torch.cat([sums[:1], by_mean, by_std * std.detach(), sums[1 + 2 * d :]])


class Ascent(Protocol):
    """What a stage that climbs the likelihood by steps in (μ, log σ) remembers."""

    mean: np.ndarray
    std: np.ndarray
    damping: float
    log_likelihood: float
    iterations: int
    small_gains: int
    reason: str | None
    candidate: tuple[np.ndarray, np.ndarray] | None
    sums: np.ndarray | None


def judge(stage: Ascent, sums: torch.Tensor, *, small_gain: float, max_damping: float, max_iterations: int) -> None:
    """Accept or reject a stage's candidate by its log-likelihood, the first of its sums; stop where it is time.

    Args:
        stage: changed in place.
        sums: of the candidate.
        small_gain: two accepted steps in a row that each gain less end the stage, in nats.
        max_damping: damping beyond which no step is tried.
        max_iterations: candidates after which the stage ends.
    """
    value = float(sums[0])
    if np.isfinite(value) and value > stage.log_likelihood:
        gain = value - stage.log_likelihood
        stage.mean, stage.std = stage.candidate or (stage.mean, stage.std)
        stage.log_likelihood, stage.sums = value, sums.numpy().copy()
        stage.damping = max(stage.damping / 4, 1e-6)
        stage.small_gains = stage.small_gains + 1 if gain < small_gain else 0
        if stage.small_gains >= 2:
            stage.reason = f"two steps in a row gained less than {small_gain:g} nat"
    elif stage.candidate is None:
        stage.reason = "no simulation succeeded at the starting point"
    else:
        stage.damping *= 8
        if stage.damping > max_damping:
            stage.reason = "no step improves the likelihood"
    stage.iterations += 1
    if stage.iterations >= max_iterations and stage.reason is None:
        stage.reason = f"{max_iterations} iterations of Fisher scoring"


def scoring_step(
    mean: np.ndarray, std: np.ndarray, sums: np.ndarray, box: SearchBox, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the next (μ, σ): a damped Fisher step in μ and log σ, clipped and kept inside the box.

    Args:
        mean, std: φ, ``(d,)`` each.
        sums: log-likelihood, scores and Fisher matrices of (μ, log σ), packed as ``(1 + 2d + 2d² ...,)``.
        box: bounds of μ and σ.
        damping: Marquardt's, on the diagonal of the Fisher matrices scaled to 1.
    """
    d = len(mean)
    score_mean, score_log = sums[1 : 1 + d], sums[1 + d : 1 + 2 * d]
    fisher_mean, fisher_log = sums[1 + 2 * d : 1 + 2 * d + 2 * d * d].reshape(2, d, d)
    free = ~((mean <= box.low) & (score_mean < 0)) & ~((mean >= box.high) & (score_mean > 0))
    move = np.clip(damped_step(fisher_mean, score_mean, free, damping), -0.25 * box.width, 0.25 * box.width)
    log_std, low, high = np.log(std), np.log(box.min_std), np.log(box.max_std)
    free = ~((log_std <= low) & (score_log < 0)) & ~((log_std >= high) & (score_log > 0))
    turn = np.clip(damped_step(fisher_log, score_log, free, damping), -1.5, 1.5)
    # a deviation that no longer shows in the covariance has no curvature left: send it down
    turn = np.where(free & (score_log <= 0) & (np.diag(fisher_log) < 1e-3), -1.5 / (1 + damping), turn)
    return np.clip(mean + move, box.low, box.high), np.exp(np.clip(log_std + turn, low, high))


def sampled_scores(
    features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor, std: torch.Tensor, z: torch.Tensor
) -> torch.Tensor:
    """Return sampled log-likelihood, scores and Fisher information of (μ, log σ), ``(1 + 2d + 2d²,)``.

    Args:
        features: at the samples, ``(t, K, m)``.
        measured: ``(t, m)``.
        covariance: what no parameter explains, ``(t, m, m)``.
        std: σ, ``(d,)``.
        z: the samples' deviations from μ in units of σ, ``(K, d)``.
    """
    num_samples = len(z)
    alive = torch.isfinite(features).flatten(1).all(-1)
    lost = float((~alive).sum()) * LOST_TRANSITION
    features, measured, covariance = features[alive], measured[alive], covariance[alive]
    mean, sampled = sample_moments(features)
    total = sampled + covariance
    residual = measured - mean
    value = gaussian_log_density(residual, total).sum() + lost
    slope, bend = _regress(features, z)
    solved = torch.linalg.solve(total, residual[..., None])  # C⁻¹ r
    pull = torch.linalg.solve(total, (features - mean[:, None]).mT).mT  # C⁻¹ (s_k − s̄), (t, K, m)
    along = (features - mean[:, None]) @ solved  # (s_k − s̄)ᵀ C⁻¹ r, (t, K, 1)
    # ∂ log N / ∂ s_k, with C's and s̄'s dependence on the samples (eq. 2)
    force = (along * solved.mT - pull) / (num_samples - 1) + solved.mT / num_samples
    flat = torch.einsum("tkm,tdm->tkd", force, slope) + torch.einsum("tkm,tdm->tkd", force, bend) * z
    score_mean = flat.sum((0, 1)) / std
    score_log = (flat * z).sum((0, 1))
    gram = slope @ torch.linalg.solve(total, slope.mT)
    v = z.var(0)
    fisher_mean = gram.sum(0) / torch.outer(std, std)
    fisher_log = 2 * torch.outer(v, v) * gram.square().sum(0)
    return torch.cat([value[None], score_mean, score_log, fisher_mean.flatten(), fisher_log.flatten()])


def _regress(features: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Slopes and bends per unit of z, ``(t, d, m)`` each; bends only where the samples can carry them."""
    num_samples, d = z.shape
    quadratic = num_samples >= 6 * d
    columns = [torch.ones(num_samples, 1, dtype=z.dtype), z] + ([0.5 * z.square()] if quadratic else [])
    inverse = torch.linalg.pinv(torch.cat(columns, 1))  # (1 + d [+ d], K)
    fitted = inverse @ features
    slope = fitted[:, 1 : 1 + d]
    return slope, fitted[:, 1 + d :] if quadratic else torch.zeros_like(slope)
