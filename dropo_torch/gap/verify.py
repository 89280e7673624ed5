"""How far a hypothesis is from data that it was not fitted to, beside what noise alone would leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.twin import Twin, Windows
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Score

#: Seconds of an open-loop prediction that are tried, the longest first.
SECONDS = (3.0, 1.0, 0.3, 0.1)
#: Share of the motion's own deviation that noise at the start may grow to in an open-loop prediction.
GROWTH = 0.1
#: Simulations from which the error that noise alone makes is estimated, at least.
DRAWS = 150
#: Most windows that are scored.
MOST = 600


@dataclass(frozen=True)
class Held:
    """Held-out data, cut for the scores.

    Attributes:
        steps: single logged steps.
        rollouts: open-loop stretches.
        seconds: length of a stretch.
    """

    steps: Windows
    rollouts: Windows
    seconds: float


def hold_out(log: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Return a log's training and held-out parts: its last quarter, in whole episodes where there are four or more."""
    if log.num_episodes >= 4:
        first = log.num_episodes - max(1, log.num_episodes // 4)
        return log.select_episodes(range(first)), log.select_episodes(range(first, log.num_episodes))
    cut = len(log) - max(1, len(log) // 4)
    return log.select(slice(0, cut)), log.select(slice(cut, len(log)))


def cut_held(
    twin: Twin, log: Trajectories, observation: Observation, hypothesis: Hypothesis, noise: np.ndarray, timestep: float
) -> Held:
    """Cut held-out data into single steps, and into stretches over which noise at the start does not take over."""
    longest = int(np.diff(np.append(-1, np.flatnonzero(log.terminals))).max())
    steps = spread(cut_windows(log, observation, 1, stride=1), MOST)
    evidence = Evidence(twin, steps, noise, rough=False)
    deviation = evidence.chart.difference(steps.measured[:, 0], steps.measured[:1, 0]).std(0)
    positions = position_features(evidence)
    chosen, seconds = steps, timestep
    for wanted in SECONDS:
        length = min(max(1, round(wanted / timestep)), longest)
        windows = spread(cut_windows(log, observation, length, stride=max(1, length // 3)), 60)
        if not len(windows):
            continue
        chosen, seconds = windows, length * timestep
        floor = rollout_floor(evidence.on(windows), hypothesis)
        if float(np.sqrt((floor[positions] ** 2).mean())) < GROWTH * float(np.sqrt((deviation[positions] ** 2).mean())):
            break
    return Held(steps, chosen, seconds)


def spread(windows: Windows, most: int) -> Windows:
    """Return at most so many windows, evenly spread."""
    if len(windows) <= most:
        return windows
    return windows.select(np.unique(np.linspace(0, len(windows) - 1, most).astype(int)))


def position_features(evidence: Evidence) -> np.ndarray:
    """Return which features are positions, ``(m,)`` bool; all of them where none is."""
    found = np.array([".velocity" not in label for label in evidence.chart.labels])
    return found if found.any() else ~found


def score(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> Score:
    """Return the scores of a hypothesis on held-out data."""
    error, covariance = _one_step(evidence.on(held.steps), hypothesis)
    value = _log_likelihood(error, covariance)
    rollout = _rollout(evidence.on(held.rollouts), hypothesis)
    positions = position_features(evidence)
    return Score(
        float(np.mean(error**2)), value, float(np.sqrt(np.mean(rollout[positions] ** 2))),
        tuple(rollout.tolist()),
    )  # fmt: skip


def floor_score(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> Score:
    """Return the scores that a perfect model would have, by the noise of start and end alone."""
    _, covariance = _one_step(evidence.on(held.steps), hypothesis)
    m = covariance.shape[-1]
    logdet = np.linalg.slogdet(covariance)[1]
    rollout = rollout_floor(evidence.on(held.rollouts), hypothesis)
    positions = position_features(evidence)
    mse = float(np.mean(np.einsum("tmm->tm", covariance)))
    likelihood = float(-0.5 * np.sum(m * np.log(2 * np.pi) + logdet + m))
    return Score(mse, likelihood, float(np.sqrt(np.mean(rollout[positions] ** 2))), tuple(rollout.tolist()))


def _one_step(evidence: Evidence, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Errors of single steps ``(T, m)``, and their covariance by the noise ``(T, m, m)``."""
    m, noise = evidence.chart.size, evidence.noise
    moved = np.concatenate([np.zeros((1, m)), np.eye(m), -np.eye(m)])[:, None]
    found, _ = evidence.residuals([hypothesis.variant] * len(moved), moved)
    end = found.reshape(len(moved), len(evidence.windows), 2, m)[:, :, 1] * noise
    end = np.where(np.isfinite(end), end, 1e3 * noise)
    slope = np.moveaxis((end[1 : 1 + m] - end[1 + m :]) / 2, 0, -1)
    covariance = slope @ np.swapaxes(slope, 1, 2) + np.diag(noise**2)
    return end[0], covariance


def _log_likelihood(error: np.ndarray, covariance: np.ndarray) -> float:
    m = error.shape[1]
    logdet = np.linalg.slogdet(covariance)[1]
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return float(-0.5 * np.sum(m * np.log(2 * np.pi) + logdet + (error * solved).sum(1)))


def _rollout(evidence: Evidence, hypothesis: Hypothesis) -> np.ndarray:
    """Root mean square open-loop error of each feature, ``(m,)``; infinite where a simulation diverged."""
    found, known = evidence.residuals([hypothesis.variant])
    m = evidence.chart.size
    error = found.reshape(len(evidence.windows), -1, m)[:, 1:] * evidence.noise
    error = np.where(np.isfinite(error), error, np.inf)
    known = known.reshape(len(evidence.windows), -1, m)[:, 1:]
    return np.sqrt((error**2 * known).sum((0, 1)) / np.maximum(known.sum((0, 1)), 1))


def constant_velocity(evidence: Evidence, held: Held) -> float:
    """Return the open-loop error of positions that go on with the velocity at the start."""
    windows = held.rollouts
    time = np.arange(windows.length + 1)[None, :, None] * evidence.twin.setting.signals.timestep
    rate_of = evidence.twin.rates
    rates = np.where(rate_of >= 0, windows.measured[:, 0][:, np.maximum(rate_of, 0)], windows.rates)
    moved = windows.measured[:, :1] + rates[:, None] * time
    error = evidence.chart.difference(windows.measured, moved)[:, 1:]
    return float(np.sqrt((error[..., position_features(evidence)] ** 2).mean()))


def rollout_floor(evidence: Evidence, hypothesis: Hypothesis) -> np.ndarray:
    """Return the open-loop error of each feature that noise at start and end alone would make, ``(m,)``."""
    m = evidence.chart.size
    count = max(4, -(-DRAWS // len(evidence.windows)))
    draws = np.random.default_rng(5).standard_normal((count, len(evidence.windows), m))
    moved = np.concatenate([np.zeros((1, len(evidence.windows), m)), draws])
    found, _ = evidence.residuals([hypothesis.variant] * len(moved), moved)
    change = np.nan_to_num(found[1:] - found[:1], nan=1e3).reshape(len(draws), len(evidence.windows), -1, m)[:, :, 1:]
    return np.sqrt((change**2).mean((0, 1, 2)) + 1) * evidence.noise
