"""Logged trajectories, and the transitions that the likelihood compares."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.data.observation import Observation
from dropo_torch.errors import InputError
from dropo_torch.support.by_value import ByValue


@dataclass(frozen=True)
class Origin:
    """Where in its file a log stood, for messages and for the config lines that correct it.

    Attributes:
        observation_names: the file's name of each observed column.
        action_names: of each column of the commands.
        rows: row of the file at which each transition starts, ``(T,)``; ``None`` for what was resampled.
        durations: seconds of each transition by the time stamps, ``(T,)``; ``None`` without stamps.
    """

    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    rows: np.ndarray | None = None
    durations: np.ndarray | None = None

    def select(self, index: np.ndarray) -> Origin:
        """Return the origin of the given transitions."""
        kept = (None if array is None else array[index] for array in (self.rows, self.durations))
        return Origin(self.observation_names, self.action_names, *kept)

    @classmethod
    def joined(cls, parts: Sequence[Origin | None]) -> Origin | None:
        """Return the origin of several logs, one after the other; ``None`` where their columns' names differ."""
        known = [part for part in parts if part is not None]
        names = {(part.observation_names, part.action_names) for part in known}
        if len(known) < len(parts) or len(names) != 1:
            return None
        arrays = [[getattr(part, name) for part in known] for name in ("rows", "durations")]
        return cls(*names.pop(), *(None if any(a is None for a in of) else np.concatenate(of) for of in arrays))


@dataclass(frozen=True, eq=False)
class Trajectories(ByValue):
    """Logged episodes, one row a transition, in the order in which they were recorded.

    Attributes:
        observations: what was observed before each transition, ``(T, n)``.
        next_observations: what was observed after it, ``(T, n)``.
        actions: the command applied during it, ``(T, m)``.
        terminals: whether it is the last of its episode, for whatever reason, ``(T,)`` bool. The
            last row always is.
        dt: duration of a transition in seconds, or ``None`` where the log does not say.
        source: where the log came from, for messages.
        origin: what the file calls its columns and rows, where it was read from one.
        unseen: positions before each transition that no column has and that follow from the others, ``(T, k)``; see
            :func:`with_unseen`. ``None`` where there are none.
        gains: noise of each column before and after each transition, relative to that of a sample, ``(T, 2, n)``: what
            lies between two samples has less. ``None`` where rows are samples.
        slopes: numbers of the columns that are velocities derived from positions.
        lead: seconds before each row at which these are taken; see :func:`with_slopes_before`.

    Raises:
        InputError: shapes that do not fit, a value that is not finite, no transition.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    terminals: np.ndarray
    dt: float | None = None
    source: str = "log"
    origin: Origin | None = None
    unseen: np.ndarray | None = None
    gains: np.ndarray | None = None
    slopes: tuple[int, ...] = ()
    lead: float = 0.0

    def __post_init__(self) -> None:
        for name in ("observations", "next_observations", "actions"):
            set_frozen(self, name, _matrix(getattr(self, name), name, self.source))
        rows = len(self.observations)
        if rows == 0:
            raise InputError(f"{self.source}: the log has no transition; at least one is needed")
        terminals = np.asarray(self.terminals)
        if terminals.dtype.kind not in "biuf" or not np.isin(terminals, (0, 1)).all():
            raise InputError(f"{self.source}: terminals must be true/false or 0/1 flags")
        set_frozen(self, "terminals", np.append(terminals.reshape(-1).astype(bool)[:-1], True))
        for name in ("next_observations", "actions", "terminals"):
            if (found := len(getattr(self, name))) != rows:
                raise InputError(
                    f"{self.source}: {name} has {found} rows and observations has {rows}; "
                    "both need one row a transition"
                )
        if self.next_observations.shape != self.observations.shape:
            raise InputError(
                f"{self.source}: next_observations has {self.next_observations.shape[1]} columns and observations has "
                f"{self.observations.shape[1]}; both need the same columns"
            )
        if self.dt is not None and not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(
                f"{self.source}: the time between samples is {self.dt}; expected a positive number of seconds"
            )

    @classmethod
    def of_samples(
        cls, observations: np.ndarray, actions: np.ndarray, *, dt: float | None, source: str
    ) -> Trajectories:
        """Return the episode of observations ``(T + 1, n)`` with the actions ``(T, m)`` between them."""
        ends = np.arange(1, len(observations)) == len(observations) - 1
        return cls(observations[:-1], observations[1:], actions, ends, dt, source)

    def __len__(self) -> int:
        """Return the number of transitions T."""
        return len(self.observations)

    def __repr__(self) -> str:
        """Return one line: where the log came from, and how much there is of what."""
        widths = {"observed columns": self.observations.shape[1], "action columns": self.actions.shape[1]}
        amounts = {"transitions": len(self), "episodes": self.num_episodes, **widths}
        counted = ", ".join(f"{n} {what.removesuffix('s') if n == 1 else what}" for what, n in amounts.items())
        step = "no time stamps" if self.dt is None else f"every {self.dt:.6g} s"
        return f"<Trajectories of {self.source}: {counted}, {step}>"

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return int(self.terminals.sum())

    @property
    def episodes(self) -> np.ndarray:
        """The episode of each transition, counted from 0, ``(T,)`` int."""
        ends = np.cumsum(self.terminals)
        return np.concatenate([[0], ends[:-1]])

    @property
    def commands(self) -> np.ndarray:
        """The commands of every episode, the last one repeated once more than the longest needs, ``(E, N, m)``."""
        bounds = np.append(0, np.flatnonzero(self.terminals) + 1)
        ahead = np.arange(np.diff(bounds).max() + 1)
        return np.stack([self.actions[np.minimum(a + ahead, b - 1)] for a, b in itertools.pairwise(bounds)])

    def select(self, rows: np.ndarray | slice) -> Trajectories:
        """Return the given rows, ascending; an episode ends wherever rows are left out."""
        index = np.arange(len(self))[rows]
        gap = np.append(np.diff(index) != 1, True)
        rest = {name: getattr(self, name)[index] for name in ("observations", "next_observations", "actions")}
        origin = None if self.origin is None else self.origin.select(index)
        more = {name: getattr(self, name) for name in ("unseen", "gains")}
        rest |= {name: array[index] for name, array in more.items() if array is not None}
        return replace(self, **rest, terminals=self.terminals[index] | gap, origin=origin)

    def select_episodes(self, which: Sequence[int]) -> Trajectories:
        """Return the given episodes, counted from 0."""
        wanted = [int(e) for e in which]
        bad = [e for e in wanted if not 0 <= e < self.num_episodes]
        if bad or not wanted:
            raise InputError(
                f"{self.source}: episode {bad[0] if bad else 'list'} asked for; "
                f"the log has {self.num_episodes} episodes, counted from 0"
            )
        return self.select(np.isin(self.episodes, wanted))


def with_unseen(
    trajectories: Trajectories, observation: Observation, timestep: float | None, ahead: float = 0.0
) -> Trajectories:
    """Return a log with the positions that follow from its columns: :attr:`Observation.unseen`.

    Args:
        trajectories: the log.
        observation: its columns.
        timestep: seconds of a transition where the log does not say; without either, no position is reckoned from its
            velocity.
        ahead: of :meth:`Observation.reckon`.

    Raises:
        InputError: loops that the logged positions do not close.
    """
    log, loops, step = trajectories, observation.loops, trajectories.dt or timestep
    reckons = bool(observation.reckoned) and step is not None
    if not reckons and loops is None:
        return log
    states = np.tile(np.asarray(observation.default_state), (len(log), 1))
    states[:, observation.index] = observation.observed(log.observations)
    if reckons:
        assert step is not None
        at = [r.position for r in observation.reckoned]
        states[:, at] = observation.reckon(log.observations, log.next_observations, log.terminals, step, ahead)
    if loops is not None:
        states = loops.closed(states, near=False)
        loops.check(states, log.source)
    return replace(log, unseen=states[:, list(observation.unseen)])


def with_slopes_before(log: Trajectories, lead: float) -> Trajectories:
    """Return a log whose derived velocities are those of an instant before each row.

    A semi-implicit simulation moves positions with the velocities after each of its steps h: along a motion its
    velocities are those of h / 2 before its positions. One that begins with the velocities of a row itself is off by
    h / 2 of acceleration for good.

    Args:
        log: the log.
        lead: seconds before each row.
    """
    if not log.slopes or log.dt is None or lead == log.lead:
        return log
    columns, bounds = list(log.slopes), np.append(0, np.flatnonzero(log.terminals) + 1)
    before, after = log.observations.copy(), log.next_observations.copy()
    for a, b in itertools.pairwise(bounds):
        path = np.concatenate([before[a:b, columns], after[b - 1 : b, columns]])
        path = path + (log.lead - lead) * np.gradient(path, log.dt, axis=0)
        before[a:b, columns], after[a:b, columns] = path[:-1], path[1:]
    return replace(log, observations=before, next_observations=after, lead=lead)


def concatenate(logs: Sequence[Trajectories]) -> Trajectories:
    """Join several logs of the same columns; no window crosses from one into the next.

    Raises:
        InputError: logs whose columns or sampling times differ.
    """
    if not logs:
        raise InputError("data: no log given; expected at least one")
    first, timed = logs[0], next((log for log in logs if log.dt is not None), logs[0])
    for log in logs[1:]:
        for name in ("observations", "actions"):
            ours, theirs = getattr(first, name).shape[1], getattr(log, name).shape[1]
            if ours != theirs:
                raise InputError(f"{log.source}: {theirs} columns of {name}, but {first.source} has {ours}")
        if log.dt is not None and timed.dt is not None and not np.isclose(log.dt, timed.dt, rtol=1e-3):
            raise InputError(f"{log.source}: sampled every {log.dt:g} s, but {timed.source} every {timed.dt:g} s")
    names = ("observations", "next_observations", "actions", "terminals")
    gains = [np.ones((len(log), 2, log.observations.shape[1])) if log.gains is None else log.gains for log in logs]
    return Trajectories(
        **{name: np.concatenate([getattr(log, name) for log in logs]) for name in names},
        dt=timed.dt,
        source=first.source if len(logs) == 1 else f"{first.source} and {len(logs) - 1} more",
        origin=Origin.joined([log.origin for log in logs]),
        gains=None if all(log.gains is None for log in logs) else np.concatenate(gains),
        slopes=first.slopes,
        lead=first.lead,
    )


#: Numbers in the states before windows that are held at once.
MOST_BEFORE = 2**24


@dataclass(frozen=True, eq=False)
class StatesBefore:
    """The states of so many rows before windows of a log, which are copied only for windows that are asked for.

    Attributes:
        padded: states of the log, ``count`` rows of NaN before each episode, ``(·, nq + nv)``.
        first: row of it at which a window's past begins, ``(T,)``.
        count: rows P of it.
    """

    padded: np.ndarray
    first: np.ndarray
    count: int

    def __getitem__(self, rows: np.ndarray | slice) -> np.ndarray:
        """Return the states before some windows, ``(t, P, nq + nv)``, NaN where their episode has not begun."""
        return np.asarray(self.padded[self.first[rows][:, None] + np.arange(self.count)])

    def select(self, rows: np.ndarray | slice) -> StatesBefore:
        """Return those of the given windows."""
        return replace(self, first=self.first[rows])


def states_before(
    trajectories: Trajectories, observation: Observation, rows: np.ndarray, count: int
) -> StatesBefore | None:
    """Return the states of ``count`` rows before rows of a log, ``(T,)``; ``None`` of no rows."""
    if not count:
        return None
    states = observation.states(trajectories.observations, trajectories.unseen)
    begins = np.append(True, trajectories.terminals[:-1])
    at = np.arange(len(trajectories)) + count * np.cumsum(begins)
    padded = np.full((at[-1] + 1, states.shape[1]), np.nan)
    padded[at] = states
    return StatesBefore(padded, at[rows] - count, count)


@dataclass(frozen=True, eq=False)
class Transitions(ByValue):
    """λ-step windows of a log: from a state, through λ controls, to what was measured.

    Attributes:
        states: simulator states at the windows' starts, ``(T, nq + nv)``.
        controls: the controls applied, after those of ``history`` steps before, ``(T, history + lag, nu)``.
        measured: observed columns at the windows' ends, ``(T, n)``.
        rows: row of the log at which each window starts, ``(T,)``.
        episodes: episode of each window, ``(T,)``.
        history: logged steps before a window whose controls come with it, for actuators that remember.
        past: the states before, for effects that remember them.
    """

    states: np.ndarray
    controls: np.ndarray
    measured: np.ndarray
    rows: np.ndarray
    episodes: np.ndarray
    history: int = 0
    past: StatesBefore | None = None

    def __len__(self) -> int:
        """Return the number of windows T."""
        return len(self.states)

    @property
    def lag(self) -> int:
        """Number of logged steps λ of a window."""
        return int(self.controls.shape[1]) - self.history

    def select(self, rows: np.ndarray | slice) -> Transitions:
        """Return the given windows."""
        names = ("states", "controls", "measured", "rows", "episodes")
        past = None if self.past is None else self.past.select(rows)
        return replace(self, **{name: getattr(self, name)[rows] for name in names}, past=past)


def make_transitions(
    trajectories: Trajectories,
    observation: Observation,
    *,
    lag: int = 1,
    history: int = 0,
    past: int = 0,
    since: np.ndarray | None = None,
) -> Transitions:
    """Cut a log into consecutive windows of ``lag`` transitions that never cross an episode's end.

    With ``history``, the controls of so many logged steps before each window stand before its own; before an
    episode's start its first control does.

    Args:
        trajectories: the log.
        observation: its columns.
        lag: transitions of a window.
        history: logged steps before a window whose controls come with it.
        past: logged steps before a window whose states come with it.
        since: transition of each episode at which its first window starts, ``(E,)``; its first one by default.

    Raises:
        InputError: a log without an episode of ``lag`` transitions.
    """
    if lag < 1:
        raise InputError(f"lag: {lag} given; expected a whole number of logged steps, 1 or more")
    width = trajectories.observations.shape[1]
    if width != observation.log_width:
        raise InputError(
            f"{trajectories.source}: {width} observed columns; the observation has {observation.log_width}"
        )
    for what in ("observations", "next_observations"):  # both ends, of the rows between windows too
        observation.check_quaternions(getattr(trajectories, what), what)
    bounds = np.append(0, np.flatnonzero(trajectories.terminals) + 1)
    begin = bounds[:-1] if since is None else bounds[:-1] + since
    starts = [np.arange(a, b - lag + 1, lag) for a, b in zip(begin, bounds[1:], strict=True)]
    rows = np.concatenate(starts)
    first = np.repeat(bounds[:-1], [len(s) for s in starts])
    if rows.size == 0:
        longest = int(np.diff(bounds).max())
        if longest >= lag:
            raise InputError(
                f"{trajectories.source}: in every transition commands act that are from before its episode; record "
                "longer episodes, or narrow the bounds of what delays, lags or has play"
            )
        raise InputError(
            f"{trajectories.source}: too short for lag {lag}: the longest episode has {longest} transitions; "
            f"lag must be at most {longest}"
        )
    steps = np.maximum(rows[:, None] + np.arange(-history, lag), first[:, None])
    unseen = None if trajectories.unseen is None else trajectories.unseen[rows]
    return Transitions(
        states=observation.states(trajectories.observations[rows], unseen),
        controls=trajectories.actions[steps],
        measured=observation.observed(trajectories.next_observations[rows + lag - 1]),
        rows=rows,
        episodes=trajectories.episodes[rows],
        history=history,
        past=states_before(trajectories, observation, rows, past),
    )


@dataclass(frozen=True)
class Replay:
    """Windows of a log that are replayed open loop: from a logged state, through the logged controls.

    Attributes:
        states: simulator states at the windows' starts, ``(W, nq + nv)``.
        controls: the controls applied, after those of ``history`` steps before, ``(W, history + H, nu)``.
        measured: observed columns after each of the H steps, ``(W, H, n)``.
        history: logged steps before a window whose controls come with it.
        about_start: whether orientations are compared with the window's first measured one, instead of step by step.
        past: the states before, for effects that remember them.
    """

    states: np.ndarray
    controls: np.ndarray
    measured: np.ndarray
    history: int = 0
    about_start: bool = False
    past: StatesBefore | None = None

    @property
    def horizon(self) -> int:
        """Number of logged steps H of a window."""
        return int(self.measured.shape[1])


def make_replay(
    trajectories: Trajectories,
    observation: Observation,
    horizon: int,
    *,
    history: int = 0,
    past: int = 0,
    about_start: bool = False,
    since: np.ndarray | None = None,
) -> Replay:
    """Cut a log into consecutive windows of about ``horizon`` transitions; see :func:`horizon_of`."""
    steps = horizon_of(trajectories, horizon, since)
    windows = make_transitions(trajectories, observation, lag=steps, history=history, past=past, since=since)
    return Replay(
        states=windows.states,
        controls=windows.controls,
        measured=measured_path(trajectories, observation, windows),
        history=history,
        about_start=about_start,
        past=windows.past,
    )


def horizon_of(trajectories: Trajectories, horizon: int, since: np.ndarray | None = None) -> int:
    """Return the length of consecutive windows: about ``horizon`` transitions.

    Of the lengths down to half the horizon (or half the longest episode), it is the one that leaves the fewest
    transitions out, the longest of several.

    Raises:
        InputError: a horizon below 1.
    """
    if horizon < 1:
        raise InputError(f"horizon: {horizon} given; expected a whole number of logged steps, 1 or more")
    lengths = np.maximum(np.bincount(trajectories.episodes) - (0 if since is None else since), 0)
    longest = max(min(horizon, int(lengths.max())), 1)
    return max(range((longest + 1) // 2, longest + 1), key=lambda h: (int((lengths // h * h).sum()), h))


def measured_path(trajectories: Trajectories, observation: Observation, windows: Transitions) -> np.ndarray:
    """Return the observed columns after each step of windows of H, ``(W, H, n)``."""
    rows = (windows.rows[:, None] + np.arange(windows.lag)).reshape(-1)
    measured = observation.observed(trajectories.next_observations[rows])
    return np.ascontiguousarray(measured.reshape(len(windows), windows.lag, -1))


def column_names(name: str, width: int) -> list[str]:
    """Return the names of a matrix's columns: its own, or ``name[0]``, ``name[1]``, ... of several."""
    return [name] if width == 1 else [f"{name}[{i}]" for i in range(width)]


def check_values(values: np.ndarray, names: Sequence[str], source: str, *, missing_allowed: bool = False) -> None:
    """Check that ``values (N, len(names))`` are finite, or finite or NaN.

    Raises:
        InputError: naming the first bad row and its column.
    """
    bad = np.argwhere(np.isinf(values) if missing_allowed else ~np.isfinite(values))
    if bad.size:
        row, column = (int(i) for i in bad[0])
        more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
        sample = np.isnan(values[row, column]) and names[column] != "time"
        bridged = "; preprocess: {max_gap: SECONDS} leaves such samples out" if sample else ""
        raise InputError(
            f"{source}: {names[column]} is {values[row, column]} at row {row} (counted from 0){more}; "
            f"every value must be finite{bridged}"
        )


def set_frozen(owner: object, name: str, array: np.ndarray) -> None:
    """Give a frozen dataclass an array that cannot be written to."""
    array.flags.writeable = False
    object.__setattr__(owner, name, array)


def _matrix(array: object, name: str, source: str) -> np.ndarray:
    """``array`` as a float64 ``(T, columns)`` matrix of finite values, a copy."""
    try:
        matrix = np.array(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: {name} is not a table of numbers ({error})") from None
    if matrix.ndim == 1:
        matrix = matrix[:, None]
    if matrix.ndim != 2:
        raise InputError(f"{source}: {name} has shape {matrix.shape}; expected (transitions, columns)")
    check_values(matrix, column_names(name, matrix.shape[1]), source)
    return matrix
