"""What a robot's logger wrote: samples in time, before they become transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.data.trajectory import Origin, Trajectories, check_values, set_frozen
from dropo_torch.errors import InputError, choices
from dropo_torch.support.by_value import ByValue

TOLERANCE = 0.05
"""Fraction by which the spacing of regular time stamps may differ from its median."""


@dataclass(frozen=True, eq=False)
class Recording(ByValue):
    """Samples in time of named signals, one row a time stamp, in one or more episodes.

    A transition runs from a sample to the next one of the same episode, under the first one's action.
    NaN says that a signal has no sample at that time: :meth:`trajectories` refuses it where it is
    needed, and preprocessing can interpolate over it.

    Attributes:
        observations: what was measured, ``(N, n)``.
        actions: the commands in force from each sample on, ``(N, m)``; ``m`` may be 0.
        time: time stamps in seconds, ``(N,)``, rising within an episode; ``None`` where the log does not say.
        episodes: episode of each sample, counted from 0, ``(N,)`` int, never falling.
        observation_names: a name for each column of ``observations``.
        action_names: a name for each column of ``actions``.
        source: where it came from, for messages.
        rows: row of the file of each sample, ``(N,)``; by default all from 0 on.
        sparse: whether signals have time stamps of their own, so that NaN says only that another has a sample there.
        quaternions: names of four observations each that are a unit quaternion (w, x, y, z).
        cut: whether episodes begin where rows are missing, so that some may be too short for a transition.

    Raises:
        InputError: shapes that do not fit, an infinite value, a name that stands twice, time stamps
            that do not rise.
    """

    observations: np.ndarray
    actions: np.ndarray
    time: np.ndarray | None
    episodes: np.ndarray
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    source: str = "recording"
    rows: np.ndarray | None = None
    sparse: bool = False
    quaternions: tuple[tuple[str, ...], ...] = ()
    cut: bool = False

    def __post_init__(self) -> None:
        rows = len(self.observations)
        for name, names in (("observations", self.observation_names), ("actions", self.action_names)):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (rows, len(names)):
                raise InputError(
                    f"{self.source}: {name} has shape {array.shape}; expected ({rows}, {len(names)}), "
                    "one row a sample and one column a name"
                )
            check_values(array, names, self.source, missing_allowed=True)
            set_frozen(self, name, array)
        twice = [name for name in self.names if self.names.count(name) > 1]
        if twice:
            raise InputError(f"{self.source}: two columns are named {twice[0]!r}; give each a name of its own")
        episodes = np.array(self.episodes, dtype=np.int64)
        if episodes.shape != (rows,) or (np.diff(episodes) < 0).any():
            raise InputError(f"{self.source}: episodes must be {rows} whole numbers that never fall")
        set_frozen(self, "episodes", episodes)
        set_frozen(self, "rows", np.arange(rows) if self.rows is None else np.array(self.rows, dtype=np.int64))
        if self.time is not None:
            set_frozen(self, "time", self._checked_time(self.time))

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.observations)

    @property
    def names(self) -> tuple[str, ...]:
        """The signals: observations, then actions."""
        return self.observation_names + self.action_names

    def split(self) -> tuple[Recording, ...]:
        """Return each episode as a recording of its own."""
        bounds = np.flatnonzero(np.diff(self.episodes)) + 1
        names = [
            name for name in ("observations", "actions", "time", "episodes", "rows") if getattr(self, name) is not None
        ]
        parts = zip(*(np.split(getattr(self, name), bounds) for name in names), strict=True)
        return tuple(replace(self, **dict(zip(names, part, strict=True))) for part in parts)

    def signal(self, name: str) -> np.ndarray:
        """Return the samples ``(N,)`` of one named observation or action.

        Raises:
            InputError: a name that is not there.
        """
        for names, values in ((self.observation_names, self.observations), (self.action_names, self.actions)):
            if name in names:
                return values[:, names.index(name)]
        raise InputError(f"{self.source}: there is no signal {name!r}{choices(name, self.names)}")

    def origin(self, start: np.ndarray) -> Origin:
        """Return what the file says of the transitions that start at the given samples."""
        assert self.rows is not None
        durations = None
        if self.time is not None:
            follows = start + 1 < len(self)
            durations = np.where(follows, self.time[np.where(follows, start + 1, start)] - self.time[start], np.nan)
            durations[np.append(np.diff(self.episodes) != 0, True)[start]] = np.nan
        return Origin(self.observation_names, self.action_names, self.rows[start], durations)

    def interval(self, tolerance: float) -> float | None:
        """Return the mean spacing of the time stamps in seconds; ``None`` without them, or if no episode has two.

        Args:
            tolerance: fraction by which a spacing may differ from the median.

        Raises:
            InputError: a spacing that differs by more.
        """
        end = np.flatnonzero(np.diff(self.episodes) == 0) + 1
        if self.time is None or end.size == 0:
            return None
        steps = self.time[end] - self.time[end - 1]
        median = float(np.median(steps))
        off = np.flatnonzero(np.abs(steps - median) > tolerance * median)
        if off.size:
            first = off[0]
            raise InputError(
                f"{self.source}: irregular time stamps: {steps[first]:.6g} s before row {end[first]} (counted from 0) "
                f"and {median:.6g} s as a rule, {off.size} spacings in all are off by more than {tolerance:.0%}; "
                "resample the log with the option preprocess: {dt: SECONDS}"
            )
        return float(steps.mean())

    def trajectories(self, *, tolerance: float = TOLERANCE) -> Trajectories:
        """Return the transitions between consecutive samples, ``dt`` being the mean spacing of the time stamps.

        An episode's last sample is the end of its last transition; its action is not used.

        Args:
            tolerance: fraction by which the spacing may differ from its median.

        Raises:
            InputError: a missing value, irregular time stamps, no two samples in one episode.
        """
        dt = self.interval(tolerance)
        check_values(self.observations, self.observation_names, self.source)
        start = np.flatnonzero(self.episodes[1:] == self.episodes[:-1])
        if start.size == 0:
            raise InputError(
                f"{self.source}: no episode has two samples, {len(self)} samples in all; a transition needs two"
            )
        used = np.zeros_like(self.actions)
        used[start] = self.actions[start]
        check_values(used, self.action_names, self.source)
        return Trajectories(
            observations=self.observations[start],
            next_observations=self.observations[start + 1],
            actions=self.actions[start],
            terminals=np.diff(start, append=len(self) + 1) != 1,
            dt=dt,
            source=self.source,
            origin=self.origin(start),
        )

    def _checked_time(self, time: np.ndarray) -> np.ndarray:
        """Time stamps as float64 seconds, each later than the one before it in its episode."""
        stamps = np.array(time, dtype=np.float64)
        if stamps.shape != self.episodes.shape:
            raise InputError(
                f"{self.source}: time has shape {stamps.shape}; expected ({len(self)},), one stamp a sample"
            )
        check_values(stamps[:, None], ["time"], self.source)
        backwards = np.flatnonzero((np.diff(stamps) <= 0) & (np.diff(self.episodes) == 0)) + 1
        if backwards.size:
            row = int(backwards[0])
            raise InputError(
                f"{self.source}: time goes from {stamps[row - 1]:.9g} s to {stamps[row]:.9g} s at row {row} (counted "
                "from 0); it must rise within an episode (name the column that tells episodes apart with episode, or "
                "remove the row)"
            )
        return stamps


def resolve_names(wanted: Sequence[str], names: Sequence[str], where: str) -> list[str]:
    """Return the column names meant by ``wanted``, where ``q`` stands for ``q[0]``, ``q[1]``, ... as well.

    Raises:
        InputError: a name that is not there.
    """
    found: list[str] = []
    for name in wanted:
        matches = [n for n in names if n == name or n.startswith(f"{name}[")]
        if not matches:
            raise InputError(f"{where}: there is no signal {name!r}{choices(name, names)}")
        found += matches
    return found
