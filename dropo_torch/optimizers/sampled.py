"""Fisher scoring on the sampled objective itself, for simulations that bend within the distribution.

Where the next state is far from quadratic in the parameters (a contact that some samples make and others
do not), sigma points mislead. Here the likelihood is that of K samples x_k = μ + σz_k with fixed z_k, and
its gradient follows from how the samples' next states regress on z: no further simulation. The exact gradient would
cost more and climb worse: where contacts come and go from sample to sample, it is that of one bump of many.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch

from dropo_torch.likelihood import gaussian_log_density, sample_moments, survivors
from dropo_torch.objective import Reduce
from dropo_torch.optimizers.ascent import Ascent


@dataclass
class SampledStage(Ascent):
    """Maximizes the sampled likelihood on fixed base uniforms.

    Attributes:
        uniforms: base uniforms, ``(K, d)``.
    """

    uniforms: torch.Tensor = field(kw_only=True)

    TITLE = "Fisher scoring on samples"
    BEGUN_AT = 0.7
    SMALL_GAIN = 0.1
    #: Share of the likelihood's own sampling error that is worth no further step, either.
    OF_ERROR = 0.1
    MAX_ITERATIONS = 25

    def points(self) -> np.ndarray:
        """Return the candidate's samples in coordinates, ``(K, d)``."""
        return self.box.draw_coordinates(self.uniforms, *map(torch.as_tensor, self.phi)).numpy()

    def reduction(self) -> Reduce:
        """Return the reduction to what :func:`sampled_scores` gives, ``(2 + 2d + 2d² + K,)``."""
        mean, std = self.phi
        z = torch.from_numpy((self.points() - mean) / std)
        return partial(sampled_scores, std=torch.from_numpy(std), z=z)

    @property
    def small_gain(self) -> float:
        """The gain of a step that is as good as none: far less than other draws would change."""
        if self.sums is None:
            return self.SMALL_GAIN
        influences = self.sums[-len(self.uniforms) :]
        return max(self.SMALL_GAIN, self.OF_ERROR * float(influences.std() / len(influences) ** 0.5))


def sampled_scores(
    features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor, std: torch.Tensor, z: torch.Tensor
) -> torch.Tensor:
    """Return sampled log-likelihood, losses, scores and Fisher information of (μ, log σ), and influences.

    ``(2 + 2d + 2d² + K,)`` together. The influence of a sample is by how much the log-likelihood changes per share of
    weight that it gains, but for what is common to all samples.

    Args:
        features: at the samples, ``(t, K, m)``.
        measured: ``(t, m)``.
        covariance: what no parameter explains, ``(t, m, m)``.
        std: σ, ``(d,)``.
        z: how far the samples lie from μ, in σ, ``(K, d)``.
    """
    num_samples = len(z)
    features, measured, covariance, lost = survivors(features, measured, covariance)
    mean, sampled = sample_moments(features)
    total = sampled + covariance
    residual, centered = measured - mean, features - mean[:, None]
    value = gaussian_log_density(residual, total).sum()
    slope, bend = _regress(features, z)
    solved = torch.linalg.solve(total, residual[..., None])  # C⁻¹ r
    pull = torch.linalg.solve(total, centered.mT).mT  # C⁻¹ (s_k − s̄), (t, K, m)
    along = centered @ solved  # (s_k − s̄)ᵀ C⁻¹ r, (t, K, 1)
    # ∂ log N / ∂ s_k, with C's and s̄'s dependence on the samples (eq. 2)
    force = (along * solved.mT - pull) / (num_samples - 1) + solved.mT / num_samples
    flat = torch.einsum("tkm,tdm->tkd", force, slope) + torch.einsum("tkm,tdm->tkd", force, bend) * z
    score_mean = flat.sum((0, 1)) / std
    score_log = (flat * z).sum((0, 1))
    gram = slope @ torch.linalg.solve(total, slope.mT)
    v = z.var(0)
    fisher_mean = gram.sum(0) / torch.outer(std, std)
    fisher_log = 2 * torch.outer(v, v) * gram.square().sum(0)
    distance = (centered * pull).sum(-1)  # (s_k − s̄)ᵀ C⁻¹ (s_k − s̄), (t, K)
    influence = (along[..., 0] + 0.5 * (along[..., 0].square() - distance)).sum(0)
    parts = (value, lost, score_mean, score_log, fisher_mean, fisher_log, influence)
    return torch.cat([p.flatten() for p in parts])


def _regress(features: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Slopes and bends per unit of z, ``(t, d, m)`` each; bends only where the samples can carry them."""
    num_samples, d = z.shape
    quadratic = num_samples >= 6 * d
    columns = [torch.ones(num_samples, 1, dtype=z.dtype), z] + ([0.5 * z.square()] if quadratic else [])
    fitted = torch.linalg.pinv(torch.cat(columns, 1)) @ features  # (t, 1 + d [+ d], m)
    slope = fitted[:, 1 : 1 + d]
    return slope, fitted[:, 1 + d :] if quadratic else torch.zeros_like(slope)
