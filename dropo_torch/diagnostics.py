"""What a fit says beyond its numbers: residuals, and the identifiability of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.data.trajectory import Transitions
from dropo_torch.distribution import Distribution, coordinate_limits, truncated_interval, truncated_moments
from dropo_torch.initial_noise import InitialStateNoise
from dropo_torch.objective import Objective
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.support.by_value import ByValue
from dropo_torch.support.random import draw_uniforms

#: Windows that follow on each other in what is judged of a log that is too long to be judged whole.
RUN = 20
#: Trajectories from which on windows of one trajectory are left out together to tell how sure an estimate is.
MANY = 10
#: Standard deviations of a parameter at which the log's likelihood is taken, and decades below its bound.
GRID, GRID_SPAN = 33, 5.0
#: Quantiles of them by which means' errors are averaged.
QUANTILES = 5
#: Two parameters whose estimates are correlated more than this cannot be told apart on the log.
CONFOUNDED = 0.95


@dataclass(frozen=True, eq=False)
class Diagnostics(ByValue):
    """Simulated against measured next states under a fitted distribution.

    Attributes:
        labels, units: the m compared columns.
        rows: row of the log at which each window starts, ``(T,)``.
        episodes: episode of each window, ``(T,)``.
        measured: ``(T, m)``.
        mean: mean of the simulated next states over p_φ, ``(T, m)``.
        spread: their standard deviation, ``(T, m)``.
        expected: square root of the diagonal of Σ: spread, ε and noise together, ``(T, m)``.
        given: what ε and the noise alone let expect, ``(T, m)``.
        change: by how much each column changed over the window, measured, ``(T, m)``.
        follows: whether the next window begins where this one ends, ``(T,)``; not the last.
        at_center: the simulated next state at μ, ``(T, m)``.
        sensitivity: root mean square change of each column when a parameter moves by 1 % of its
            search width, ``(d, m)``.
        standard_error: of each mean, in coordinates, ``(d,)``, by the Fisher information of the whole covariance: that
            of parameters that vary, ε and noise.
        std_error: of each σ, likewise; NaN where it is at its floor, or parameters are correlated.
        correlation: of the estimates of the means, ``(d, d)``.
        confounded: pairs of parameters that this log cannot tell apart, with their correlation.
        diverged: simulations that diverged.
        at_rest: joints at rest in every initial state, because the log has their position alone.
        noisy_starts: whether initial states are noisy, so that windows that follow on each other share a measurement.
        is_sensed: whether windows start from estimated states.
        unjoined: coordinates in which such states are not what the model leads to, and by how much, in words.
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
    change: np.ndarray
    follows: np.ndarray
    at_center: np.ndarray
    sensitivity: np.ndarray
    standard_error: np.ndarray
    std_error: np.ndarray
    correlation: np.ndarray
    confounded: tuple[tuple[str, str, float], ...]
    diverged: int
    at_rest: tuple[str, ...] = ()
    noisy_starts: bool = False
    is_sensed: bool = False
    unjoined: tuple[str, ...] = ()

    @property
    def residual(self) -> np.ndarray:
        """Measured minus simulated mean, ``(T, m)``."""
        return self.measured - self.mean


def diagnose(
    objective: Objective, distribution: Distribution, *, samples: int = 50, seed: int = 0, max_transitions: int = 5000,
    known: tuple[np.ndarray, np.ndarray] | None = None,
) -> Diagnostics:  # fmt: skip
    """Simulate the log under a distribution, and around its center.

    A log of more than ``max_transitions`` windows is judged on about that many, in runs spread evenly over it.

    Args:
        objective: the likelihood of the log.
        distribution: the fit.
        samples: of the distribution.
        seed: of the samples.
        max_transitions: windows that are judged, about.
        known: standard errors of the means, in coordinates, ``(d,)``, and the correlation of their estimates
            ``(d, d)``, where more was estimated than the objective knows of.
    """
    objective = _judged(objective, max_transitions)
    initial = objective.initial_noise_of(distribution)
    simulated = _simulate(objective, distribution, draw_uniforms(samples, len(distribution), seed, 3), initial)
    covariance = objective.base_covariance(slice(None), initial)
    base = torch.diagonal(covariance, dim1=-2, dim2=-1)
    widened = torch.ones(1, dtype=torch.float64) if initial is None else initial.widening[:, None]
    follows = _follows(objective.transitions)
    if known is None:
        residual = objective.target(slice(None), initial) - simulated.mean
        together = None if initial is None else initial.carried[1:] * torch.from_numpy(follows[:-1, None, None])
        error, correlation, std_error = _standard_errors(
            objective, distribution, covariance, simulated.jacobian, residual, together
        )
    else:
        (error, correlation), std_error = known, np.full(len(distribution), np.nan)
    started, columns = objective.evaluator.columns_at_start, objective.evaluator.columns
    width = objective.box.width[:, None]
    return Diagnostics(
        labels=objective.features.labels,
        units=objective.features.units,
        rows=objective.transitions.rows,
        episodes=objective.transitions.episodes,
        measured=objective.measured.numpy(),
        mean=simulated.mean.numpy(),
        spread=simulated.variance.sqrt().numpy(),
        expected=(simulated.variance + base).sqrt().numpy(),
        given=(base / widened).sqrt().numpy(),
        change=(objective.measured - objective.features.values(started, columns)).numpy(),
        follows=follows,
        at_center=simulated.center.numpy(),
        sensitivity=0.01 * width * simulated.jacobian.square().mean(0).sqrt().numpy(),
        standard_error=error,
        std_error=std_error,
        correlation=correlation,
        confounded=_confounded(distribution.names, correlation),
        diverged=simulated.diverged,
        at_rest=objective.observation.at_rest,
        noisy_starts=objective.noise is not None,
        is_sensed=objective.observation.is_sensed,
    )


def _judged(objective: Objective, most: int) -> Objective:
    """The likelihood of about so many windows at most, in runs spread evenly over the log."""
    if len(objective) <= most:
        return objective
    begins = np.linspace(0, len(objective) - RUN, max(1, most // RUN)).astype(int)
    return objective.on(objective.transitions.select(np.unique(begins[:, None] + np.arange(RUN))))


def _follows(log: Transitions) -> np.ndarray:
    """Whether the next window begins where each one ends, ``(T,)``; not the last."""
    return np.append((np.diff(log.rows) == log.lag) & (np.diff(log.episodes) == 0), False)


def _confounded(names: Sequence[str], correlation: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Pairs of parameters whose estimates are correlated too much, with their correlation."""
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(correlation[i, j]) > CONFOUNDED]
    return tuple((names[j], names[i], float(correlation[i, j])) for i, j in pairs)


def _standard_errors(
    objective: Objective,
    distribution: Distribution,
    covariance: torch.Tensor,
    jacobian: torch.Tensor,
    residual: torch.Tensor,
    together: torch.Tensor | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard errors of μ and their correlations, and standard errors of σ, in coordinates.

    They are the Fisher information's of N(s̄(μ), A Σ_ξ Aᵀ + C), with C of ε and noise: AᵀΣ⁻¹A for μ, and
    ½ tr(Σ⁻¹ ∂Σ Σ⁻¹ ∂Σ) for log σ. σ is an estimate, too: where it came out too small, μ would seem too sure. So those
    of μ are averaged over what the log leaves σ, and count how far μ moves with it. They are the jackknife's
    where that is larger. It leaves out one window after the other, and one trajectory after the other of many: the
    windows may pull harder than Σ expects, and together. A measurement that ends a window and begins the next pulls in
    both: what this adds or takes is counted, too. What the log does not tell is known by a normal of the search box's
    width, so that it cannot make up for others beyond its box.

    Args:
        objective: gives the floor of σ.
        distribution: the fit.
        covariance: C, ``(T, m, m)``.
        jacobian: A, ``(T, d, m)``.
        residual: of the mean next states, ``(T, m)``.
        together: minus the covariance of each residual with the next window's, ``(T − 1, m, m)``; ``None`` for none.
    """
    limits = coordinate_limits(distribution.limits, distribution.is_log)
    a, b = truncated_interval(*map(torch.as_tensor, (distribution.mean, distribution.std, *limits)))
    first, second, _ = truncated_moments(a, b)
    drawn = torch.as_tensor(distribution.std) * (second - first**2).clamp(min=0).sqrt()
    shared = torch.eye(len(drawn)) if distribution.correlation is None else torch.as_tensor(distribution.correlation)
    spread = shared * torch.outer(drawn, drawn)
    grouped, width = _groups(objective.transitions.episodes), torch.as_tensor(objective.box.width)
    variance, correlation, gram = _of_means(covariance, jacobian, spread, residual, together, grouped, width)
    variance = torch.maximum(
        variance, _given_the_log(objective, covariance, jacobian, spread, residual, together, width)
    )
    std_error = np.full(len(drawn), np.nan)
    free = distribution.std > 2 * objective.box.min_std
    if distribution.correlation is None and free.any():
        of_std = (2 * torch.outer(drawn, drawn).square() * gram.square().sum(0)).numpy()[np.ix_(free, free)]
        std_error[free] = distribution.std[free] * estimates(of_std)[0]
    return variance.sqrt().numpy(), correlation, std_error


def _given_the_log(
    objective: Objective, covariance: torch.Tensor, jacobian: torch.Tensor, spread: torch.Tensor,
    residual: torch.Tensor, together: torch.Tensor | None, width: torch.Tensor,
) -> torch.Tensor:  # fmt: skip
    """Variances of μ, averaged over what the log leaves σ, with those of μ as σ varies, ``(d,)``.

    Of each parameter in turn, the others' σ as fitted: the restricted likelihood of N(s̄, B + σ² a aᵀ), a the
    parameter's own Jacobian, times a prior that is flat in σ up to its bound. B⁻¹ is needed once: aᵀB⁻¹a and aᵀB⁻¹r
    give it at every σ (Sherman–Morrison).
    """
    least, most = torch.as_tensor(objective.box.min_std), torch.as_tensor(objective.box.max_std)
    drawn, found = torch.diagonal(spread).sqrt(), []
    levels = (torch.arange(QUANTILES, dtype=torch.float64) + 0.5) / QUANTILES
    for j in range(len(drawn)):
        others = spread.clone()
        others[j], others[:, j] = 0.0, 0.0
        pull, gram = _pulls(covariance, jacobian, others)
        score = torch.nan_to_num((pull.mT @ residual[..., None])[..., 0])
        highest = torch.maximum(most[j], drawn[j])
        sigma = torch.logspace(-GRID_SPAN, 0, GRID, dtype=torch.float64) * highest
        sigma = sigma[sigma >= torch.minimum(least[j], highest)]
        log_density, means = _restricted(gram, score, j, sigma.square(), torch.diag(width**-2))
        share = torch.softmax(log_density + sigma.log(), 0)
        likely = sigma[torch.searchsorted(share.cumsum(0), levels).clamp(max=len(sigma) - 1)]
        ratio = torch.ones(QUANTILES, len(drawn), dtype=torch.float64)
        ratio[:, j] = likely / drawn[j].clamp(min=1e-300)
        wide = spread * ratio[:, :, None] * ratio[:, None, :]
        each = [_informed(*_pulls(covariance, jacobian, w), together, width)[0][j] for w in wide]
        found.append(torch.stack(each).mean() + share @ (means - share @ means).square())
    return torch.stack(found)


def _restricted(
    gram: torch.Tensor, score: torch.Tensor, j: int, variances: torch.Tensor, prior: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log of the restricted likelihood at variances of parameter j, and how far its mean moves there, ``(V,)`` each.

    From AB⁻¹Aᵀ ``(T, d, d)`` and AB⁻¹r ``(T, d)``, with B of everything else.
    """
    own, log_density, means = gram[:, j, j], [], []
    for v in variances:
        factor = v / (1 + v * own)
        information = gram.sum(0) - torch.einsum("t,td,te->de", factor, gram[:, j], gram[:, j]) + prior
        pulled = score.sum(0) - (factor * score[:, j]) @ gram[:, j]
        step = torch.linalg.solve(information, pulled)
        gained = factor @ score[:, j].square() + pulled @ step
        log_density.append(0.5 * (gained - (v * own).log1p().sum() - torch.logdet(information)))
        means.append(step[j])
    return torch.stack(log_density), torch.stack(means)


def _pulls(covariance: torch.Tensor, jacobian: torch.Tensor, spread: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Σ⁻¹Aᵀ ``(T, m, d)`` and AΣ⁻¹Aᵀ ``(T, d, d)`` under a covariance of the parameters."""
    total = covariance + torch.einsum("tdm,de,ten->tmn", jacobian, spread, jacobian)
    pull = torch.linalg.solve(total, jacobian.mT)
    return pull, jacobian @ pull


def _informed(
    pull: torch.Tensor, gram: torch.Tensor, together: torch.Tensor | None, width: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Variances of μ ``(d,)``, the inverse of their information, and what shared measurements pull, ``(d, d)`` each."""
    information, shared = gram.sum(0) + torch.diag(width**-2), torch.zeros_like(gram[0])
    error, correlation = estimates(information.numpy())
    bounded = np.minimum(error, 1e100)
    inverse = torch.from_numpy(correlation * np.outer(bounded, bounded))
    if together is not None:
        half = (pull[:-1].mT @ together @ pull[1:]).sum(0)
        shared = half + half.T
    variance, least = torch.diagonal(inverse @ (information - shared) @ inverse), torch.diagonal(inverse)
    return torch.where(variance > 1e-4 * least, variance, least), inverse, shared  # next to nothing is rounding


def _of_means(
    covariance: torch.Tensor, jacobian: torch.Tensor, spread: torch.Tensor, residual: torch.Tensor,
    together: torch.Tensor | None, grouped: Sequence[torch.Tensor], width: torch.Tensor,
) -> tuple[torch.Tensor, np.ndarray, torch.Tensor]:  # fmt: skip
    """Variances of μ ``(d,)`` and their correlations under a covariance of the parameters, and AΣ⁻¹Aᵀ ``(T, d, d)``."""
    pull, gram = _pulls(covariance, jacobian, spread)
    informed, inverse, shared = _informed(pull, gram, together, width)
    score = torch.nan_to_num((pull.mT @ residual[..., None])[..., 0])
    windows, *trajectories = (_scatter(gram, score, inverse, group) for group in grouped)
    left_out = [torch.diagonal(inverse @ scatter @ inverse) for scatter in (windows - shared, *trajectories)]
    variance = torch.stack([informed, *left_out]).amax(0)
    least = torch.diagonal(inverse)
    return variance, (inverse / torch.outer(least, least).sqrt()).clamp(-1, 1).numpy(), gram


def _groups(episodes: np.ndarray) -> list[torch.Tensor]:
    """Number of the group of each window that is left out at once, ``(T,)``: each alone, and by trajectory of many."""
    by_episode = np.unique(episodes, return_inverse=True)[1]
    groups = [np.arange(len(episodes))]
    if MANY <= by_episode.max(initial=0) + 1 < len(episodes):
        groups.append(by_episode)
    return [torch.from_numpy(group) for group in groups]


def _scatter(gram: torch.Tensor, score: torch.Tensor, inverse: torch.Tensor, group: torch.Tensor) -> torch.Tensor:
    """Sum of the squared pulls of groups of windows on an estimate from the other ones, ``(d, d)``."""
    count, d = int(group.max()) + 1, score.shape[-1]
    known = torch.zeros(count, d, d, dtype=gram.dtype).index_add(0, group, gram)
    pulls = torch.zeros(count, d, dtype=score.dtype).index_add(0, group, score)
    without = torch.eye(d, dtype=gram.dtype) - known @ inverse  # share that the other groups know
    left = torch.linalg.lstsq(without, pulls[..., None], driver="gelsd").solution[..., 0]
    return left.T @ left


@dataclass(frozen=True)
class _Simulated:
    """What simulations of the windows give.

    Attributes:
        mean, variance: over samples, ``(T, m)``.
        center: the state at μ, ``(T, m)``.
        jacobian: its derivative by the coordinates of μ, ``(T, d, m)``.
        diverged: simulations that did.
    """

    mean: torch.Tensor
    variance: torch.Tensor
    center: torch.Tensor
    jacobian: torch.Tensor
    diverged: int


def _simulate(
    objective: Objective, distribution: Distribution, uniforms: torch.Tensor, initial: InitialStateNoise | None
) -> _Simulated:
    """Simulate all windows under samples of a distribution, from uniforms ``(N, d)``, and around its center."""
    values = distribution.rsample(uniforms)
    stencil = MeansStage(objective.box.low, objective.box.high, distribution.mean)
    steps = torch.from_numpy(stencil.steps)
    parts: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]] = []

    def keep(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        sampled, around = features[:, : len(values)], features[:, len(values) :]
        finite = torch.isfinite(sampled)
        count = finite.sum(1).clamp(min=1)
        mean = torch.nan_to_num(sampled).sum(1) / count
        variance = torch.nan_to_num(sampled - mean[:, None]).square().sum(1) / (count - 1).clamp(min=1)
        jacobian = torch.nan_to_num((around[:, 1:] - around[:, :1]) / steps[:, None])
        parts.append((mean, variance, around[:, 0], jacobian))
        return (~finite.all(-1)).sum()[None]

    every = np.concatenate([values.numpy(), objective.box.values(stencil.points())])
    lost = objective.map(every, keep, initial=initial)
    mean, variance, center, jacobian = (torch.cat(p) for p in zip(*parts, strict=True))
    return _Simulated(mean, variance, center, jacobian, int(lost.total))


def estimates(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors ``(d,)`` and correlations ``(d, d)`` from an information matrix, however singular.

    A direction of which the log says nothing has a very large variance, not none.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12 * max(float(values.max()), 1e-6))) @ vectors.T
    error = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    return error / scale, np.clip(inverse / np.outer(error, error), -1, 1)
