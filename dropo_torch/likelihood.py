"""The likelihood of measured next states, equations 2 and 3 of Tiboni et al. 2023: pure functions of states.

Beside the paper's Gaussians: what a noisy initial state does to them, and how orientations enter.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch.nn.functional import pad

#: Degrees of freedom of Student's t distribution, by which windows that noise does not explain are widened.
STUDENT_DOF = 5.0
#: Log-density ``(...)`` of residuals ``(..., n)``, given covariances or scale matrices ``(..., n, n)``.
LogDensity = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def sample_moments(samples: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean ``(..., n)`` and unbiased covariance ``(..., n, n)`` of samples ``(..., K, n)`` (eq. 2)."""
    mean = samples.mean(-2)
    centered = samples - mean.unsqueeze(-2)
    return mean, centered.mT @ centered / (samples.shape[-2] - 1)


def gaussian_log_density(residual: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Return log N(residual; 0, covariance), constant term included (eq. 3).

    Args:
        residual: ``(..., n)``.
        covariance: positive definite, ``(..., n, n)``.

    Returns:
        ``(...)``.
    """
    chi2, log_det = _whitened(residual, covariance)
    return -0.5 * chi2 - log_det - 0.5 * residual.shape[-1] * math.log(2 * math.pi)


def student_log_density(residual: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Return the log-density of Student's multivariate t distribution, :data:`STUDENT_DOF` degrees of freedom.

    Args:
        residual: ``(..., n)``.
        scale: its scale matrix, positive definite, ``(..., n, n)``.

    Returns:
        ``(...)``.
    """
    n, dof = residual.shape[-1], STUDENT_DOF
    chi2, log_det = _whitened(residual, scale)
    constant = math.lgamma((dof + n) / 2) - math.lgamma(dof / 2) - 0.5 * n * math.log(dof * math.pi)
    return constant - log_det - 0.5 * (dof + n) * torch.log1p(chi2 / dof)


def _whitened(residual: torch.Tensor, matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rᵀM⁻¹r and half of log |M|, ``(...)`` each."""
    factor = robust_cholesky(matrix)
    white = torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False).squeeze(-1)
    return white.square().sum(-1), torch.diagonal(factor, dim1=-2, dim2=-1).log().sum(-1)


def robust_cholesky(covariance: torch.Tensor) -> torch.Tensor:
    """Return the lower Cholesky factor, ``(..., n, n)``.

    A matrix that rounding has left indefinite (standard deviations of very different size) gets the smallest
    multiple of its trace on the diagonal that cures it; all others are left as they are.
    """
    factor, info = torch.linalg.cholesky_ex(covariance)
    jitter = 1e-15
    while bool((info > 0).any()) and jitter < 1e-3:
        scale = torch.diagonal(covariance, dim1=-2, dim2=-1).mean(-1)[..., None, None]
        eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype)
        covariance = torch.where((info > 0)[..., None, None], covariance + jitter * scale * eye, covariance)
        factor, info = torch.linalg.cholesky_ex(covariance)
        jitter *= 10
    return factor


def log_likelihood(
    samples: torch.Tensor, measured: torch.Tensor, epsilon: torch.Tensor | float, extra: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the log-likelihood of each measured next state under its simulated samples (eq. 2 and 3).

    Args:
        samples: simulated next states, ``(..., K, n)``, K at least 2.
        measured: measured next states, broadcast to ``(..., n)``.
        epsilon: added to the covariance's diagonal, scalar or ``(n,)``.
        extra: a further covariance, broadcast to ``(..., n, n)``.

    Returns:
        ``(...)``, one value a transition, in nats.
    """
    mean, covariance = sample_moments(samples)
    diagonal = torch.as_tensor(epsilon, dtype=samples.dtype).expand(samples.shape[-1])
    covariance = covariance + torch.diag(diagonal)
    return gaussian_log_density(measured - mean, covariance if extra is None else covariance + extra)


def survivors(
    features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the transitions of which no simulation diverged, and how many the others are, ``()``."""
    alive = torch.isfinite(features).flatten(1).all(-1)
    return features[alive], measured[alive], covariance[alive], (~alive).sum().to(features.dtype)


def propagate(outcomes: torch.Tensor, draws: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return shift ``(t, m)``, covariance ``(t, m, m)`` and G √ν ``(t, m, c)`` of outcomes of noisy initial states.

    Args:
        outcomes: the undisturbed one, then those of antithetic draws, ``(t, 1 + M, m)``.
        draws: standard normal, ``(1 + M, c)``, the first zero.
    """
    outcomes = torch.nan_to_num(torch.where(torch.isfinite(outcomes), outcomes, outcomes[:, :1]))
    spread = outcomes[:, 1:] - outcomes[:, 1:].mean(1, keepdim=True)
    gain = (torch.linalg.pinv(draws[1:]) @ spread).mT  # G √ν, (t, m, c)
    left = spread - draws[1:] @ gain.mT
    variance = left.square().sum(1) / (len(draws) - 1 - draws.shape[1])
    shift = outcomes[:, 1:].mean(1) - outcomes[:, 0]
    return shift, gain @ gain.mT + torch.diag_embed(variance), gain


def widening(residual: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Return the factors ``(t,)`` by which covariances ``(t, m, m)`` are too small for residuals ``(t, m)``.

    They are those of the scale-mixture form of Student's t distribution: (ν + χ²) / (ν + m), at least 1.
    """
    chi2, _ = _whitened(residual, covariance)
    return ((STUDENT_DOF + chi2) / (STUDENT_DOF + residual.shape[-1])).clamp(min=1.0)


def likelihood_with_losses(
    samples: torch.Tensor,
    measured: torch.Tensor,
    covariance: torch.Tensor,
    num_angles: int,
    log_density: LogDensity = gaussian_log_density,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return log-likelihood, eq. 3, squared error and number of diverged samples, ``(t, P)`` each.

    Diverged samples are left out. A transition of which fewer than two are left has log-likelihood 0 and a squared
    error that is NaN: whoever compares counts what diverged first.

    Args:
        samples: features of the samples, ``(t, P, K, m)``.
        measured: ``(t, 1, m)``.
        covariance: what no parameter explains, ``(t, 1, m, m)``.
        num_angles: of how many rotations, the last features, the angle counts in place of the vector.
        log_density: of the log-likelihood.
    """
    finite = torch.isfinite(samples).all(-1)
    lost = (~finite).sum(-1)
    if not bool(lost.any()):
        return *_likelihood(samples, measured, covariance, num_angles, log_density), lost.double()
    values, gaussian = samples.new_zeros(lost.shape), samples.new_zeros(lost.shape)
    squared = torch.full_like(values, torch.nan)
    for t, p in (finite.sum(-1) >= 2).nonzero().tolist():
        kept = samples[t, p, finite[t, p]]
        values[t, p], gaussian[t, p], squared[t, p] = _likelihood(
            kept, measured[t, 0], covariance[t, 0], num_angles, log_density
        )
    return values, gaussian, squared, lost.double()


def _likelihood(
    samples: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor, num_angles: int, log_density: LogDensity
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Log-likelihood, eq. 3, and squared error of the mean features."""
    squared = (measured - samples.mean(-2)).square().sum(-1)
    if num_angles:
        residual, total = _angle_moments(samples, measured, covariance, num_angles)
    else:
        mean, sampled = sample_moments(samples)
        residual, total = measured - mean, sampled + covariance
    value = log_density(residual, total)
    is_same = log_density is gaussian_log_density
    return value, value if is_same else gaussian_log_density(residual, total), squared


def _angle_moments(
    samples: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor, num_angles: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Residual and covariance with each rotation vector's angle α in its place: of the paper's sample, α and −α.

    Measured, an angle is 0, and so is its sample's mean; it goes with no other feature, which the signs cancel. The
    variance that no parameter explains is the rotation vector's, averaged over the axes.
    """
    plain = samples.shape[-1] - 3 * num_angles
    mean, sampled = sample_moments(samples[..., :plain])
    angles = samples[..., plain:].unflatten(-1, (num_angles, 3)).norm(dim=-1)
    base = torch.diagonal(covariance, dim1=-2, dim2=-1)[..., plain:].unflatten(-1, (num_angles, 3)).mean(-1)
    variance = 2 * angles.square().sum(-2) / (2 * samples.shape[-2] - 1) + base
    total = pad(sampled + covariance[..., :plain, :plain], (0, num_angles, 0, num_angles))
    return pad(measured[..., :plain] - mean, (0, num_angles)), total + torch.diag_embed(pad(variance, (plain, 0)))
