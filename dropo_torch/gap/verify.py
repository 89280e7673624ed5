"""How far a hypothesis is from data that it was not fitted to, beside what noise alone would leave."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from dropo_torch.data.features import Features
from dropo_torch.data.trajectory import Trajectories, make_transitions
from dropo_torch.distribution import to_coordinates
from dropo_torch.effects.base import Setting
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.effects.simulator import effect_simulator
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows, feature_sizes, longest_episode, spread
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Score
from dropo_torch.gap.twin import Windows
from dropo_torch.objective import LIMITS, Objective
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import Simulator
from dropo_torch.simulators.hidden import filter_memory
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.support.rows import evenly

#: Seconds of an open-loop prediction that are tried, the longest first.
SECONDS = (3.0, 1.0, 0.3, 0.1)
#: Simulations from which the error that noise alone makes is estimated, at least, and their seed.
DRAWS, SEED = 100, 5
#: ε relative to the smallest variance of the measurement.
BELOW = 1e-3
#: Rows at an episode's beginning whose derived velocities lack rows on one side, and have several times the noise.
EDGE = 2
#: Most windows that are scored: single steps, and open-loop stretches.
MOST, MOST_ROLLOUTS = 600, 60


@dataclass(frozen=True)
class Held:
    """Held-out data, cut for the scores.

    Attributes:
        log: the data.
        rows: those of its transitions that are scored as single steps.
        rollouts: open-loop stretches.
        seconds: length of a stretch.
        floor: open-loop error of each feature that noise alone makes under the hypothesis they were cut for, ``(m,)``.
        since: logged step of each episode before which nothing is cut, ``(E,)``.
    """

    log: Trajectories
    rows: np.ndarray
    rollouts: Windows
    seconds: float
    floor: np.ndarray
    since: np.ndarray


def hold_out(log: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Return a log's training and held-out parts: its last quarter, in whole episodes where there are four or more.

    Raises:
        InputError: a log of one transition.
    """
    if len(log) < 2:
        raise InputError(
            f"data: {log.source} has one transition; expected enough of them to learn from three quarters and to "
            "verify on the rest, some seconds of motion at least"
        )
    if log.num_episodes >= 4:
        first = log.num_episodes - max(1, log.num_episodes // 4)
        return log.select_episodes(range(first)), log.select_episodes(range(first, log.num_episodes))
    cut = len(log) - max(1, len(log) // 4)
    return log.select(slice(0, cut)), log.select(slice(cut, len(log)))


def cut_held(evidence: Evidence, log: Trajectories, hypothesis: Hypothesis) -> Held:
    """Cut held-out data into single steps, and into stretches over which noise at the start does not take over.

    Steps before which a hypothesis remembers commands that are not in the log are left out.
    """
    setting = evidence.twin.setting
    observation, timestep = setting.observation, setting.signals.timestep
    since = evidence.twin.settled(hypothesis.variant, log.commands)
    if any(p.effect.has("sense") and p.effect.memory(np.array(p.values)) > 0 for p in hypothesis.placed):
        since = np.maximum(since, 1)  # a late sensor asks for the command just before
    if setting.masked and is_rate(setting)[list(setting.masked)].any():
        since = np.maximum(since, EDGE)
    begins = np.flatnonzero(np.append(True, log.terminals[:-1]))
    known = np.flatnonzero(np.arange(len(log)) >= (begins + since)[log.episodes])
    if not len(known):  # better scores of something
        since, known = np.zeros_like(since), np.arange(len(log))
    rows = known[evenly(len(known), MOST)]
    positions = position_features(setting)
    size = _rms(feature_sizes(setting, observation.observed(log.observations[rows]))[positions])

    def over(wanted: float) -> Held:
        length = min(max(1, round(wanted / timestep)), longest_episode(log))
        windows = cut_windows(log, observation, length, stride=max(1, length // 3), since=since)
        windows = spread(windows, MOST_ROLLOUTS if wanted else MOST)
        floor = rollout_floor(evidence.on(windows), hypothesis) if len(windows) else np.zeros(evidence.chart.size)
        return Held(log, rows, windows, length * timestep, floor, since)

    found = None
    for wanted in SECONDS:
        if len((held := over(wanted)).rollouts):
            found = held
            if _rms(held.floor[positions]) < evidence.rules.weighed.growth * size:
                break
    return found or over(0.0)


def is_rate(setting: Setting) -> np.ndarray:
    """Return which observed columns are velocities, ``(n,)`` bool; those that are masked are derived from positions."""
    return np.asarray(setting.observation.index >= setting.model.nq)


def position_features(setting: Setting) -> np.ndarray:
    """Return which compared features are positions, ``(m,)`` bool; all that are compared where none is."""
    compared, positions = Features.of(setting.observation, setting.masked), setting.observation.index < setting.model.nq
    found = compared.known(positions)
    return found if found.any() else compared.known(np.ones_like(positions))


def score(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> Score:
    """Return the scores of a hypothesis on held-out data.

    Single steps are those of a fit: the same simulator, the same covariance by the noise of start and end. One that
    diverges makes its error infinite, as it does an open-loop one: no model gains by diverging.
    """
    return _score_of(evidence, held, hypothesis, *_one_step(evidence, held, hypothesis))


def scores(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> tuple[Score, Score]:
    """Return :func:`score`, and what a perfect model would have by the noise of start and end alone.

    Args:
        evidence: with the noise.
        held: cut for this hypothesis.
        hypothesis: what is scored.
    """
    error, covariance = _one_step(evidence, held, hypothesis)
    mse = float(np.mean(np.einsum("tmm->tm", covariance)))
    floor = _score(evidence, mse, _log_likelihood(covariance, covariance.shape[-1]), held.floor)
    return _score_of(evidence, held, hypothesis, error, covariance), floor


def _score_of(
    evidence: Evidence, held: Held, hypothesis: Hypothesis, error: np.ndarray, covariance: np.ndarray
) -> Score:
    """The scores of a hypothesis, from its errors of single steps and their covariance."""
    mse, likelihood = math.inf, -math.inf
    if np.isfinite(error).all() and np.isfinite(covariance).all():
        solved = np.linalg.solve(covariance, error[..., None])[..., 0]
        mse, likelihood = float(np.mean(error**2)), _log_likelihood(covariance, (error * solved).sum(1))
    return _score(evidence, mse, likelihood, _rollout(evidence.on(held.rollouts), hypothesis))


def _score(evidence: Evidence, mse: float, likelihood: float, rollout: np.ndarray) -> Score:
    return Score(mse, likelihood, _rms(rollout[position_features(evidence.twin.setting)]), tuple(rollout.tolist()))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _log_likelihood(covariance: np.ndarray, distance: np.ndarray | int) -> float:
    """Of Gaussian errors at squared Mahalanobis distances ``(T,)``, with covariances ``(T, m, m)``."""
    m, logdet = covariance.shape[-1], np.linalg.slogdet(covariance)[1]
    return float(-0.5 * np.sum(m * np.log(2 * np.pi) + logdet + distance))


def _one_step(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Errors of single steps ``(T, m)``, not finite where one diverges, and their covariance by the noise."""
    twin, values = evidence.twin, np.array(hypothesis.declared)
    objective = one_step_objective(evidence, held, hypothesis)
    initial = objective.initial_noise(to_coordinates(values, twin.space.is_log), widen=False)
    parts: list[tuple[torch.Tensor, ...]] = []

    def collect(simulated: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        parts.append((measured - simulated[:, 0], covariance))
        return torch.zeros(1)

    sums = objective.map(values[None], collect, initial=initial)
    twin.simulated_transitions += sums.simulated_transitions + (initial.simulated_transitions if initial else 0)
    error, covariance = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    return error, covariance


def one_step_objective(evidence: Evidence, held: Held, hypothesis: Hypothesis) -> Objective:
    """Return the likelihood that a fit would have of held-out data, with a hypothesis in its simulator."""
    twin = evidence.twin
    setting, space, threads = twin.setting, twin.space, twin.num_threads
    placed = twin.effects(hypothesis.variant)

    def make(model: mujoco.MjModel, frame_skip: int, parameters: ParameterSpace) -> Simulator:
        history = math.ceil(filter_memory(parameters) / frame_skip)
        return MujocoSimulator(
            model, parameters=parameters, frame_skip=frame_skip, num_threads=threads, history=history
        )

    if placed:
        entries = tuple(Entry(p.effect, p.target, p.values, (-1,) * len(p.values)) for p in placed)
        simulator = effect_simulator(
            "mujoco", EffectSet(entries, setting), space, make, timestep=setting.signals.timestep,
            longest=longest_episode(held.log), num_threads=threads,
        )  # fmt: skip
    else:
        simulator = make(setting.model, setting.frame_skip, space)
    cut = make_transitions(held.log, setting.observation, history=simulator.history, past=simulator.past)
    transitions = cut.select(held.rows)
    noise = Features.of(setting.observation).column_noise(evidence.noise)
    if held.log.gains is not None:  # of rows between samples, on average
        gains = held.log.gains[held.rows][..., list(setting.observation.log_columns)]
        noise = noise * np.sqrt((gains**2).mean((0, 1)))
    mask = [setting.observation.labels[c] for c in sorted(setting.masked)]
    given = {"epsilon": below(noise), "noise": noise.tolist(), "mask": mask}
    return Objective(simulator, transitions, setting.observation, **given)


def below(noise: np.ndarray) -> float:
    """Return an ε that adds next to nothing to the variance of noise ``(n,)``."""
    return max(BELOW * float(noise[noise > 0].min(initial=1.0)) ** 2, LIMITS["epsilon"][0])


def _rollout(evidence: Evidence, hypothesis: Hypothesis) -> np.ndarray:
    """Root mean square open-loop error of each feature ``(m,)``; infinite where it diverged, NaN where it is masked."""
    found, known = (_after(x, evidence) for x in evidence.residuals([hypothesis.variant]))
    error = found * evidence.noises[:, 1:]
    error = np.where(np.isfinite(error), error, np.inf)
    error = np.sqrt((error**2 * known).sum((0, 1, 2)) / np.maximum(known.sum((0, 1, 2)), 1))
    return np.where(_compared(evidence), error, np.nan)


def _compared(evidence: Evidence) -> np.ndarray:
    """Which features are compared, ``(m,)`` bool."""
    return evidence.chart.known(np.ones(evidence.twin.setting.observation.size, dtype=bool))


def open_loop_error(
    evidence: Evidence, log: Trajectories, hypothesis: Hypothesis, seconds: float
) -> tuple[float, float]:
    """Return the root mean square open-loop error of positions over some seconds, and constant velocity's.

    Raises:
        InputError: no trajectory is that long.
    """
    setting = evidence.twin.setting
    length, longest = max(1, round(seconds / setting.signals.timestep)), longest_episode(log)
    if length > longest:
        most = longest * setting.signals.timestep
        raise InputError(f"open loop: no trajectory of {log.source} lasts {seconds:g} s; at most {most:g} s")
    windows = spread(cut_windows(log, setting.observation, length, stride=max(1, length // 3)), MOST_ROLLOUTS)
    own = _rollout(evidence.on(windows), hypothesis)
    return _rms(own[position_features(setting)]), constant_velocity(evidence, windows)


def _after(rows: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Rows of residuals ``(K, W, N)`` by instant and feature, the initial one left out, ``(K, W, L, m)``."""
    return rows.reshape(*rows.shape[:2], -1, evidence.chart.size)[:, :, 1:]


def constant_velocity(evidence: Evidence, windows: Windows) -> float:
    """Return the open-loop error of positions that go on with the velocity at the start of windows."""
    setting = evidence.twin.setting
    time = np.arange(windows.length + 1)[None, :, None] * setting.signals.timestep
    moved = evidence.chart.move(windows.measured[:, :1], _rates(evidence, windows)[:, None] * time)
    error = evidence.chart.difference(windows.measured, moved)[:, 1:]
    return _rms(error[..., position_features(setting)])


def _rates(evidence: Evidence, windows: Windows) -> np.ndarray:
    """Time derivatives of the features at the starts, ``(W, m)``: velocities of the log, or how its positions change.

    Those of rotations are angular velocities in the body's frame; every observed orientation has its own.
    """
    twin, plain, start = evidence.twin, list(evidence.chart.plain), windows.measured[:, 0]
    model, index = twin.setting.model, twin.setting.observation.index
    rates = [np.where(twin.rates >= 0, start[:, np.maximum(twin.rates, 0)], windows.rates)[:, plain]]
    for quaternion in evidence.chart.quaternions:
        joint = int(np.searchsorted(model.jnt_qposadr, index[quaternion[0]], side="right")) - 1
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        first = model.nq + model.jnt_dofadr[joint] + (3 if free else 0)
        rates.append(start[:, [int(np.flatnonzero(index == first + axis)[0]) for axis in range(3)]])
    return np.concatenate(rates, 1)


def rollout_floor(evidence: Evidence, hypothesis: Hypothesis) -> np.ndarray:
    """Return the open-loop error of each feature that noise at start and end alone would make, ``(m,)``.

    Draws of the noise from which a perfect model would diverge tell no size and are left out.
    """
    m, num_windows = evidence.chart.size, len(evidence.windows)
    count = max(2, -(-DRAWS // num_windows))
    draws = np.random.default_rng(SEED).standard_normal((count, num_windows, m))
    moved = np.concatenate([np.zeros((1, num_windows, m)), draws])
    found, _ = evidence.residuals([hypothesis.variant] * len(moved), moved)
    change = _after(found[1:] - found[:1], evidence)
    finite = np.isfinite(change).all((-2, -1))
    if not finite.any():
        return np.full(m, np.inf)
    noises = np.broadcast_to(evidence.noises[:, 1:], change.shape)[finite]
    return np.where(_compared(evidence), np.sqrt(((change[finite] ** 2 + 1) * noises**2).mean((0, 1))), np.nan)
