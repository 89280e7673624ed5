"""What the measurement noise of initial states does to the predicted next states: statistical linearization."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.data.features import Features
from dropo_torch.distribution import SearchBox
from dropo_torch.evaluator import Evaluator
from dropo_torch.likelihood import propagate, widening
from dropo_torch.support.random import draw_uniforms
from dropo_torch.support.threads import single_thread

#: Antithetic pairs of draws per noisy column, and their seed.
NOISE_DRAWS = 2
NOISE_SEED = 4


@dataclass(frozen=True, eq=False)
class InitialStateNoise:
    """The noise of a log's initial states, propagated through its simulation at one φ.

    Attributes:
        mean: μ at which it was propagated, in coordinates, ``(d,)``.
        std: σ that counted as explained when windows were widened, ``(d,)``, or ``None``.
        shift: by which the noise moves the predicted features, ``(T, m)``.
        covariance: of the features, by the noise of initial and measured next states, widened, ``(T, m, m)``.
        widening: factor of each window's covariance, ``(T,)``; 1 where the noise is as given.
        is_widened: whether windows that it does not explain were widened at all.
        carried: covariance of the noise of each initial state's features with what it does to the next state's,
            ``(T, m, m)``: where a window's initial state is the measured end of the one before, both err together.
        simulated_transitions: logged steps that were simulated for it.
    """

    mean: np.ndarray
    std: np.ndarray | None
    shift: torch.Tensor
    covariance: torch.Tensor
    widening: torch.Tensor
    is_widened: bool
    carried: torch.Tensor
    simulated_transitions: int

    def is_at(self, mean: np.ndarray, std: np.ndarray | None, widen: bool = True) -> bool:
        """Return whether it was propagated at these μ and σ, with or without widening."""
        same_std = std is self.std or (std is not None and self.std is not None and np.array_equal(std, self.std))
        return same_std and widen == self.is_widened and np.array_equal(mean, self.mean)


def propagate_noise(
    evaluator: Evaluator,
    box: SearchBox,
    mean: np.ndarray,
    std: np.ndarray | None,
    *,
    noise: torch.Tensor,
    fixed: torch.Tensor,
    epsilon: torch.Tensor,
    widen: bool = True,
) -> InitialStateNoise:
    """Propagate the noise of the initial states through the simulation at μ.

    Each initial state is simulated from antithetic draws of its noise. The mean of the outcomes shifts the prediction.
    The regression of the outcomes on the draws gives G and with it the covariance G diag(ν²) Gᵀ, to which the variance
    that the regression leaves is added: a contact that some draws make and others do not. An orientation is turned in
    its body's frame, so that the world's does not matter. Windows that the result still does not explain, nor do
    parameters that vary with σ around μ, have their covariance widened.

    Args:
        evaluator: simulates the log.
        box: of μ and σ.
        mean: μ in coordinates, ``(d,)``.
        std: σ in coordinates, ``(d,)``; ``None`` for a point estimate.
        noise: standard deviation of each observed column, ``(n,)``.
        fixed: covariance of the features by ε and the noise of measured next states, ``(m, m)``.
        epsilon: ε alone, ``(m,)``.
        widen: whether to widen windows; else the noise is as given.
    """
    mean = np.array(mean, dtype=np.float64)
    std = None if std is None else np.array(std, dtype=np.float64)
    values = torch.from_numpy(box.values(mean))[None]
    every = Features.of(evaluator.observation)
    size = torch.from_numpy(every.feature_noise(noise.numpy()))
    noisy = torch.nonzero(size)[:, 0]
    half = torch.special.ndtri(draw_uniforms(NOISE_DRAWS * len(noisy), len(noisy), NOISE_SEED))
    draws = torch.cat([torch.zeros(1, len(noisy), dtype=torch.float64), half, -half])
    moves = torch.zeros(len(draws), every.size, dtype=torch.float64)
    moves[:, noisy] = size[noisy] * draws
    own = evaluator.features
    same = np.array([[ours == every.labels[j] for j in noisy] for ours in own.labels])
    sizes = torch.from_numpy(same / own.scale[:, None]) * size[noisy]  # of each draw, in compared features, (m, c)
    parts = []
    with single_thread():
        for block in evaluator.blocks(len(draws)):
            states = _perturbed(evaluator, block, every, moves)
            outcomes = evaluator.after(block, values, states).reshape(-1, len(draws), evaluator.features.size)
            shift, covariance, gain = propagate(outcomes, draws)
            total = covariance + fixed
            spread = 0.0 if std is None else parameter_covariance(evaluator, box, block, mean, std)
            residual = evaluator.measured[block] - torch.nan_to_num(outcomes[:, 0]) - shift
            factor = widening(residual, total + spread) if widen else torch.ones_like(residual[:, 0])
            parts.append((shift, total * factor[:, None, None] - torch.diag(epsilon), factor, sizes @ gain.mT))
    shift, covariance, factor, carried = (torch.cat(part) for part in zip(*parts, strict=True))
    simulations = len(draws) + (0 if std is None else 2 * len(std))
    cost = len(evaluator) * simulations * evaluator.transitions.lag
    return InitialStateNoise(mean, std, shift, covariance, factor, widen, carried, cost)


def _perturbed(evaluator: Evaluator, block: slice, every: Features, moves: torch.Tensor) -> torch.Tensor:
    """Initial states of which all features are moved by ``(M, features)``, ``(t, M, num_states)``."""
    moved = evaluator.states[block][:, None].repeat(1, len(moves), 1)
    index = evaluator.observation.index
    moved[..., index] = torch.from_numpy(
        every.move(moved[..., index].numpy(), moves.expand(*moved.shape[:2], -1).numpy())
    )
    return moved


def parameter_covariance(
    evaluator: Evaluator, box: SearchBox, block: slice, mean: np.ndarray, std: np.ndarray
) -> torch.Tensor:
    """Return the covariance of features by parameters that vary with σ around μ, to first order, ``(t, m, m)``."""
    ends = np.clip(mean + np.concatenate([np.diag(std), -np.diag(std)]), box.low, box.high)
    features = evaluator.after(block, torch.from_numpy(box.values(ends)))
    reach = torch.from_numpy(2 * std / np.maximum(np.diag(ends[: len(std)] - ends[len(std) :]), 1e-300))
    half = torch.nan_to_num(0.5 * (features[:, : len(std)] - features[:, len(std) :]) * reach[:, None])
    return half.mT @ half
