"""What the measurement noise of initial states does to the predicted next states: statistical linearisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.distribution import SearchBox
from dropo_torch.evaluator import Evaluator
from dropo_torch.likelihood import propagate
from dropo_torch.support.random import draw_uniforms
from dropo_torch.support.threads import single_thread

#: Antithetic pairs of draws per noisy column, and their seed.
NOISE_DRAWS = 2
NOISE_SEED = 4

#: Factors ``(t,)`` by which covariances ``(t, m, m)`` are too small for residuals ``(t, m)``.
Widening = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, eq=False)
class InitialStateNoise:
    """The noise of a log's initial states, propagated through its simulation at one φ.

    Attributes:
        mean: μ at which it was propagated, in coordinates, ``(d,)``.
        std: σ that counted as explained when windows were widened, ``(d,)``, or ``None``.
        shift: by which the noise moves the predicted features, ``(T, m)``.
        covariance: of the features, by the noise of initial and measured next states, widened, ``(T, m, m)``.
        widening: factor of each window's covariance, ``(T,)``.
        simulated_transitions: logged steps that were simulated for it.
    """

    mean: np.ndarray
    std: np.ndarray | None
    shift: torch.Tensor
    covariance: torch.Tensor
    widening: torch.Tensor
    simulated_transitions: int

    def is_at(self, mean: np.ndarray, std: np.ndarray | None) -> bool:
        """Return whether it was propagated at these μ and σ."""
        same_std = std is self.std or (std is not None and self.std is not None and np.array_equal(std, self.std))
        return same_std and np.array_equal(mean, self.mean)


def propagate_noise(
    evaluator: Evaluator,
    box: SearchBox,
    mean: np.ndarray,
    std: np.ndarray | None,
    *,
    noise: torch.Tensor,
    fixed: torch.Tensor,
    epsilon: torch.Tensor,
    widen: Widening,
) -> InitialStateNoise:
    """Propagate the noise of the initial states through the simulation at μ.

    Each initial state is simulated from antithetic draws of its noise. The mean of the outcomes shifts the prediction.
    The regression of the outcomes on the draws gives G and with it the covariance G diag(ν²) Gᵀ, to which the variance
    that the regression leaves is added: a contact that some draws make and others do not. Windows that the result still
    does not explain, nor parameters that vary with σ around μ, have their covariance widened.

    Args:
        evaluator: simulates the log.
        box: of μ and σ.
        mean: μ in coordinates, ``(d,)``.
        std: σ in coordinates, ``(d,)``; ``None`` for a point estimate.
        noise: standard deviation of each observed column, ``(n,)``.
        fixed: covariance of the features by ε and the noise of measured next states, ``(m, m)``.
        epsilon: ε alone, ``(m,)``.
        widen: gives the factors by which windows are widened.
    """
    mean = np.array(mean, dtype=np.float64)
    std = None if std is None else np.array(std, dtype=np.float64)
    values = torch.from_numpy(box.values(mean))[None]
    columns = torch.nonzero(noise)[:, 0].tolist()
    half = torch.special.ndtri(draw_uniforms(NOISE_DRAWS * len(columns), len(columns), NOISE_SEED))
    draws = torch.cat([torch.zeros(1, len(columns), dtype=torch.float64), half, -half])
    parts = []
    with single_thread():
        for block in evaluator.blocks(len(draws)):
            states = _perturbed(evaluator, block, columns, noise, draws)
            outcomes = evaluator.after(block, values, states).reshape(-1, len(draws), evaluator.features.size)
            shift, covariance = propagate(outcomes, draws)
            total = covariance + fixed
            spread = 0.0 if std is None else _parameter_covariance(evaluator, box, block, mean, std)
            factor = widen(evaluator.measured[block] - torch.nan_to_num(outcomes[:, 0]) - shift, total + spread)
            parts.append((shift, total * factor[:, None, None] - torch.diag(epsilon), factor))
    shift, covariance, factor = (torch.cat(part) for part in zip(*parts, strict=True))
    simulations = len(draws) + (0 if std is None else 2 * len(std))
    cost = len(evaluator) * simulations * evaluator.transitions.lag
    return InitialStateNoise(mean, std, shift, covariance, factor, cost)


def _perturbed(
    evaluator: Evaluator, block: slice, columns: list[int], noise: torch.Tensor, draws: torch.Tensor
) -> torch.Tensor:
    """Initial states moved by draws ``(M, c)`` of the noise of c columns, ``(t, M, num_states)``."""
    observation = evaluator.observation
    moved = evaluator.states[block][:, None].repeat(1, len(draws), 1)
    moved[..., observation.index[columns]] += noise[columns] * draws
    for q in observation.quaternions:
        target = observation.index[list(q)]
        moved[..., target] = moved[..., target] / moved[..., target].norm(dim=-1, keepdim=True)
    return moved


def _parameter_covariance(
    evaluator: Evaluator, box: SearchBox, block: slice, mean: np.ndarray, std: np.ndarray
) -> torch.Tensor:
    """Covariance of features by parameters that vary with σ around μ, to first order, ``(t, m, m)``."""
    ends = np.clip(mean + np.concatenate([np.diag(std), -np.diag(std)]), box.low, box.high)
    features = evaluator.after(block, torch.from_numpy(box.values(ends)))
    reach = torch.from_numpy(2 * std / np.maximum(np.diag(ends[: len(std)] - ends[len(std) :]), 1e-300))
    half = torch.nan_to_num(0.5 * (features[:, : len(std)] - features[:, len(std) :]) * reach[:, None])
    return half.mT @ half
