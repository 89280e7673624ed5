"""A stretch of a log, simulated open loop window by window: the states along it and the residuals in units of noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.data.trajectory import states_before
from dropo_torch.errors import InputError
from dropo_torch.problem import Problem
from dropo_torch.view.run import Candidate, Run
from dropo_torch.view.settings import HORIZON, SECONDS

#: Frames a second, and frames in all, that are kept at most.
RATE, MOST = 60.0, 1500


@dataclass(frozen=True)
class Stretch:
    """Rows of a log that are shown, and how they are cut into windows.

    Attributes:
        episode: which episode, counted from 0.
        begin: row of the log at which the episode begins.
        first: row of the log at which the stretch begins.
        steps: its transitions N.
        horizon: transitions of a window; the last one may be shorter.
        timestep: seconds of a transition.
    """

    episode: int
    begin: int
    first: int
    steps: int
    horizon: int
    timestep: float

    @property
    def rows(self) -> np.ndarray:
        """Rows of its transitions, ``(N,)``."""
        return self.first + np.arange(self.steps)

    @property
    def starts(self) -> np.ndarray:
        """Instants, counted from the stretch's begin, at which windows start, ``(W,)``."""
        return np.arange(0, self.steps, self.horizon)

    @property
    def times(self) -> np.ndarray:
        """Seconds since the episode's start of its instants, ``(N + 1,)``."""
        return (self.first - self.begin + np.arange(self.steps + 1)) * self.timestep

    @property
    def frames(self) -> np.ndarray:
        """Instants that are shown: all, or as many as a screen can show, first and last among them, ``(F,)``."""
        stride = max(1, round(1 / (RATE * self.timestep)), math.ceil(self.steps / (MOST - 1)))
        return np.unique(np.append(np.arange(0, self.steps, stride), self.steps))


@dataclass(frozen=True, eq=False)
class Take:
    """A candidate's simulation of a stretch, at its frames.

    Attributes:
        name: the candidate's.
        candidate: what was simulated.
        states: simulated states, ``(F, num_states)``; where one window ends and the next begins, those of the end. NaN
            in a window that diverges.
        residuals: measured minus simulated features, in units of noise, ``(F, m)``; 0 at the first frame.
    """

    name: str
    candidate: Candidate
    states: np.ndarray
    residuals: np.ndarray

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the finite residuals of each feature, ``(m,)``; NaN where none is."""
        finite = np.isfinite(self.residuals)
        count = finite.sum(0)
        squares = np.where(finite, self.residuals, 0.0) ** 2
        return np.where(count > 0, np.sqrt(squares.sum(0) / np.maximum(count, 1)), np.nan)

    @property
    def overall(self) -> float:
        """Root mean square of all finite residuals; NaN where none is."""
        finite = self.residuals[np.isfinite(self.residuals)]
        return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


@dataclass(frozen=True, eq=False)
class View:
    """A stretch of a log with its simulations: all that pages and videos show.

    Attributes:
        run: where it comes from.
        stretch: which rows.
        times: seconds since the episode's start of each frame, ``(F,)``.
        logged: states of the log, ``(F, num_states)``.
        controls: what was commanded from each frame on, ``(F, num_controls)``.
        takes: the simulations, one for each of the run's candidates.
        labels: names of the compared features, m of them.
        units: their units.
        noise: what counts as one unit of a residual in each feature, in its unit, ``(m,)``.
        unseen: position columns of the state that the log neither has nor tells by velocities.
    """

    run: Run
    stretch: Stretch
    times: np.ndarray
    logged: np.ndarray
    controls: np.ndarray
    takes: tuple[Take, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    noise: np.ndarray
    unseen: tuple[int, ...]

    @property
    def starts(self) -> np.ndarray:
        """Seconds since the episode's start at which windows start, ``(W,)``."""
        return self.stretch.times[self.stretch.starts]


def make_view(
    run: Run, *, episode: int = 0, start: float = 0.0, seconds: float = SECONDS, horizon: float = HORIZON
) -> View:
    """Simulate a stretch of a run's log open loop by each of its candidates.

    Args:
        run: of :func:`~dropo_torch.view.run.read_run`.
        episode: which of the log's episodes, counted from 0.
        start: seconds since the episode's start at which the stretch begins.
        seconds: how long it is; less where the episode ends.
        horizon: seconds after which a simulation starts from the logged state again.

    Raises:
        InputError: an episode or a time that the log does not have, candidates of different states.
    """
    problem = run.candidates[-1].problem
    shown = cut(run, episode, start, seconds, horizon)
    noise = noise_unit(problem, run.noise)
    takes = []
    for candidate in run.candidates:
        states, difference = open_loop(candidate, shown)
        takes.append(Take(candidate.name, candidate, states[shown.frames], (difference / noise)[shown.frames]))
    features = problem.objective.features
    rows = np.append(shown.rows, shown.rows[-1])[shown.frames]
    return View(
        run=run, stretch=shown, times=shown.times[shown.frames], logged=logged_states(problem, shown)[shown.frames],
        controls=problem.trajectories.actions[rows], takes=tuple(takes), labels=features.labels, units=features.units,
        noise=noise * features.scale, unseen=_unseen(problem),
    )  # fmt: skip


def cut(run: Run, episode: int, start: float, seconds: float, horizon: float) -> Stretch:
    """Return a stretch of a run's log; see :func:`make_view`."""
    problem = run.candidates[-1].problem
    log, step = problem.trajectories, problem.simulator.timestep or problem.trajectories.dt
    if step is None:
        raise InputError(
            "view: neither the simulator nor the log says how long a transition is; give the adapter a timestep"
        )
    if not 0 <= episode < log.num_episodes:
        raise InputError(
            f"--episode: {episode} asked for; {log.source} has {log.num_episodes} episodes, counted from 0"
        )
    bounds = np.append(0, np.flatnonzero(log.terminals) + 1)
    begin, end = int(bounds[episode]), int(bounds[episode + 1])
    known = max(0 if c.problem.since is None else int(c.problem.since[episode]) for c in run.candidates)
    first = begin + max(round(start / step), known)
    if first >= end:
        why = f", and the commands that act are known from {known * step:g} s on" if known else ""
        raise InputError(f"--start: {start:g} s asked for; episode {episode} lasts {(end - begin) * step:g} s{why}")
    steps = min(end - first, max(1, round(seconds / step)))
    return Stretch(episode, begin, first, steps, min(steps, max(1, round(horizon / step))), step)


def open_loop(candidate: Candidate, stretch: Stretch) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a stretch window by window, each from its logged state.

    Returns:
        States ``(N + 1, num_states)`` and measured minus simulated features ``(N + 1, m)`` at its instants; at the end
        of a window those before the next one starts afresh. NaN throughout a window that diverges.
    """
    problem, features = candidate.problem, candidate.problem.objective.features
    simulator, log, index = problem.simulator, problem.trajectories, problem.observation.index
    values = torch.from_numpy(np.asarray(candidate.values, dtype=np.float64))[None]
    begun = logged_states(problem, stretch)
    states, difference = begun.copy(), np.zeros((stretch.steps + 1, features.size))
    for starts, lag in _groups(stretch):
        rows = stretch.first + starts[:, None] + np.arange(-simulator.history, lag)
        controls = log.actions[np.maximum(rows, stretch.begin)]
        given = begun[starts]
        if (past := states_before(log, problem.observation, stretch.first + starts, simulator.past)) is not None:
            given = np.concatenate([past[:], given[:, None]], 1)
        after = simulator.rollout(torch.from_numpy(given), torch.from_numpy(controls), values)[:, 0]
        ends = starts[:, None] + np.arange(1, lag + 1)
        measured = torch.from_numpy(
            problem.observation.observed(log.next_observations[stretch.first + ends.ravel() - 1])
        )
        simulated = after.flatten(0, 1)[:, index]
        states[ends.ravel()] = after.flatten(0, 1).numpy()
        found = features.values(measured, measured) - features.values(simulated, measured)
        difference[ends.ravel()] = found.numpy()
    return states, difference


def _groups(stretch: Stretch) -> list[tuple[np.ndarray, int]]:
    """Starts of the windows of one length each, with this length; the last window may be shorter than the others."""
    starts = stretch.starts
    lengths = np.minimum(stretch.horizon, stretch.steps - starts)
    return [(starts[lengths == n], int(n)) for n in np.unique(lengths)]


def logged_states(problem: Problem, stretch: Stretch) -> np.ndarray:
    """Return the states that the log has at a stretch's instants, ``(N + 1, num_states)``."""
    log, observation, rows = problem.trajectories, problem.observation, stretch.rows
    last = rows[-1]
    observations = np.concatenate([log.observations[rows], log.next_observations[last : last + 1]])
    if log.unseen is None:
        return observation.states(observations)
    ends = np.stack([observations[-2], observations[-1]])
    after = log.unseen[last : last + 1].copy()
    after[:, : len(observation.reckoned)] += np.diff(
        observation.reckon(ends, ends[[1, 1]], np.array([False, True]), stretch.timestep), axis=0
    )
    return observation.states(observations, np.concatenate([log.unseen[rows], after]))


def noise_unit(problem: Problem, noise: Mapping[str, float] | None) -> np.ndarray:
    """Return what counts as one unit of the compared features' residuals, after their scaling, ``(m,)``.

    The standard deviations given by label, where they are; else what the likelihood takes for noise: √(ε + ν²).

    Args:
        problem: the log and its features.
        noise: standard deviations by label, before scaling.
    """
    objective, features = problem.objective, problem.objective.features
    variance = objective.epsilon.numpy() + (
        0.0 if objective.feature_noise is None else objective.feature_noise.numpy() ** 2
    )
    known: Sequence[float | None] = [(noise or {}).get(label) for label in features.labels]
    given = np.array([math.nan if value is None else value for value in known]) / features.scale
    return np.where(given > 0, given, np.sqrt(variance))


def _unseen(problem: Problem) -> tuple[int, ...]:
    """Position columns of the state that are neither observed nor follow from what is."""
    model, observation = problem.space.model, problem.observation
    if model is None:
        return ()
    known = {*observation.columns, *observation.unseen}
    return tuple(c for c in range(model.nq) if c not in known)
