"""What a fit says beyond its numbers: residuals, and which parameters the log can tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.distribution import Distribution, to_values
from dropo_torch.objective import Objective, draw_uniforms
from dropo_torch.optimizers.gauss_newton import DIFFERENCE_STEP

#: Two parameters whose estimates are correlated more than this cannot be told apart on the log.
CONFOUNDED = 0.95


@dataclass(frozen=True)
class Diagnostics:
    """Simulated against measured next states under a fitted distribution.

    Attributes:
        labels, units: the m compared columns.
        rows: row of the log at which each window starts, ``(T,)``.
        episodes: episode of each window, ``(T,)``.
        measured: ``(T, m)``.
        mean: mean of the simulated next states over p_φ, ``(T, m)``.
        spread: their standard deviation, ``(T, m)``.
        expected: square root of the diagonal of Σ: spread, ε and start noise together, ``(T, m)``.
        given: what ε and the noise alone let expect, ``(T, m)``.
        at_center: the simulated next state at μ, ``(T, m)``.
        sensitivity: root mean square change of each column when a parameter moves by 1 % of its
            search width, ``(d, m)``.
        standard_error: of each mean, in coordinates, from the likelihood's curvature, ``(d,)``.
        correlation: of the estimates of the means, ``(d, d)``.
        confounded: pairs of parameters that this log cannot tell apart, with their correlation.
        diverged: simulations that diverged.
        at_rest: joints that every window starts at rest, because the log has their position alone.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    rows: np.ndarray
    episodes: np.ndarray
    measured: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    expected: np.ndarray
    given: np.ndarray
    at_center: np.ndarray
    sensitivity: np.ndarray
    standard_error: np.ndarray
    correlation: np.ndarray
    confounded: tuple[tuple[str, str, float], ...]
    diverged: int
    at_rest: tuple[str, ...] = ()

    @property
    def residual(self) -> np.ndarray:
        """Measured minus simulated mean, ``(T, m)``."""
        return self.measured - self.mean

    @property
    def residual_rms(self) -> np.ndarray:
        """Root mean square residual of each column, ``(m,)``."""
        return np.sqrt(np.nanmean(self.residual**2, axis=0))

    @property
    def standardised_rms(self) -> np.ndarray:
        """Root mean square of residual over expected deviation, ``(m,)``: 1 where the model explains the log."""
        return np.sqrt(np.nanmean((self.residual / self.expected) ** 2, axis=0))


def diagnose(
    objective: Objective, distribution: Distribution, *, samples: int = 50, seed: int = 0, max_transitions: int = 5000
) -> Diagnostics:
    """Simulate the log under a distribution, and around its center.

    A log of more than ``max_transitions`` windows is judged on that many, spread evenly over it.
    """
    before = objective.simulated_transitions
    if len(objective) > max_transitions:
        chosen = np.unique(np.linspace(0, len(objective) - 1, max_transitions).astype(int))
        part = objective.on(objective.transitions.select(chosen))
        if objective.linearised_at is not None:
            part.linearise(objective.linearised_at, objective.linearised_std)
        objective = part
    values = distribution.rsample(draw_uniforms(samples, len(distribution), seed, 3))
    stencil, steps = _stencil(objective, distribution)
    mean, variance, center, jacobian, lost = _simulate(objective, values, stencil, steps)
    covariance = torch.cat([objective.base_covariance(slice(i, i + 1)) for i in range(len(objective))])
    information = torch.einsum("tdm,tmn,ten->de", jacobian, torch.linalg.inv(covariance), jacobian).numpy()
    error, correlation = estimates(information)
    base = torch.diagonal(covariance, dim1=-2, dim2=-1)
    widened = torch.ones(1) if objective.widening is None else objective.widening[:, None]
    width = objective.box.width[:, None]
    names = distribution.names
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(correlation[i, j]) > CONFOUNDED]
    objective.simulated_transitions = before  # looking at a result is not part of finding it
    return Diagnostics(
        labels=objective.labels,
        units=objective.units,
        rows=objective.transitions.rows,
        episodes=objective.transitions.episodes,
        measured=objective.measured.numpy(),
        mean=mean.numpy(),
        spread=variance.sqrt().numpy(),
        expected=(variance + base).sqrt().numpy(),
        given=(base / widened).sqrt().numpy(),
        at_center=center.numpy(),
        sensitivity=0.01 * width * jacobian.square().mean(0).sqrt().numpy(),
        standard_error=error,
        correlation=correlation,
        confounded=tuple((names[j], names[i], float(correlation[i, j])) for i, j in pairs),
        diverged=lost,
        at_rest=objective.observation.at_rest,
    )


def _stencil(objective: Objective, distribution: Distribution) -> tuple[np.ndarray, torch.Tensor]:
    """μ and one moved point a parameter, in units, ``(d + 1, d)``, and the steps in coordinates."""
    box = objective.box
    steps = np.where(distribution.mean + DIFFERENCE_STEP * box.width > box.high, -1, 1) * DIFFERENCE_STEP * box.width
    points = np.concatenate([distribution.mean[None], distribution.mean + np.diag(steps)])
    return to_values(points, distribution.is_log), torch.from_numpy(steps)


def _simulate(
    objective: Objective, values: torch.Tensor, stencil: np.ndarray, steps: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, int]:
    """Mean and variance over samples, the state at μ, its Jacobian ``(T, d, m)``, and how many diverged."""
    num_samples = len(values)
    parts: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]] = []
    lost = 0

    def keep(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        nonlocal lost
        sampled, around = features[:, :num_samples], features[:, num_samples:]
        finite = torch.isfinite(sampled)
        lost += int((~finite.all(-1)).sum())
        count = finite.sum(1).clamp(min=1)
        mean = torch.nan_to_num(sampled).sum(1) / count
        variance = torch.nan_to_num(sampled - mean[:, None]).square().sum(1) / (count - 1).clamp(min=1)
        jacobian = torch.nan_to_num((around[:, 1:] - around[:, :1]) / steps[:, None])
        parts.append((mean, variance, around[:, 0], jacobian))
        return torch.zeros(1)

    objective.map(np.concatenate([values.numpy(), stencil]), keep)
    mean, variance, center, jacobian = (torch.cat(p) for p in zip(*parts, strict=True))
    return mean, variance, center, jacobian, lost


def estimates(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors ``(d,)`` and correlations ``(d, d)`` from an information matrix, however singular.

    A direction of which the log says nothing has a very large variance, not none.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12 * max(float(values.max()), 1e-300))) @ vectors.T
    deviation = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    return deviation / scale, np.clip(inverse / np.outer(deviation, deviation), -1, 1)
