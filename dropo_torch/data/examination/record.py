"""The log as it is examined: observed columns with their meaning in the model, rows that follow one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.data.observation import Observation, joint_name
from dropo_torch.data.trajectory import Trajectories, column_names

#: Windows of a log over which sums are compared, about.
MOST_WINDOWS = 3000


@dataclass(frozen=True)
class Coordinate:
    """A scalar position of the model and its velocity.

    Attributes:
        name: the joint's, with an axis for those that have several.
        position, velocity: their observed columns; ``None`` for what is not observed.
        qpos, dof: their places in the model.
        angle: whether it is an angle.
        limits: the joint's range, or ``None``.
    """

    name: str
    position: int | None
    velocity: int | None
    qpos: int
    dof: int
    angle: bool
    limits: tuple[float, float] | None


@dataclass(frozen=True)
class Pair(Coordinate):
    """A coordinate of which both position and velocity are observed."""

    position: int
    velocity: int


@dataclass(frozen=True)
class Orientation:
    """A quaternion and its angular velocity: observed columns ``(4,)`` and ``(3,)``, or ``None`` without the latter."""

    name: str
    quaternion: tuple[int, ...]
    velocity: tuple[int, ...] | None
    qpos: int


@dataclass(frozen=True)
class Record:
    """A log to be examined.

    Attributes:
        log: the log.
        observation: what its columns are.
        model: the model, or ``None``.
        frame_skip: physics steps of one logged transition.
        tolerance: relative deviation of stamps that the reader would refuse.
        before, after: observed columns before and after each transition, ``(T, n)``.
        cut: transitions that are none, since another episode begins within, ``(T,)`` bool.
        parted: transitions which the next row does not continue, ``(T,)`` bool.
        turns: turns by which wrapping changed a column's step, ``(T, n)``.
    """

    log: Trajectories
    observation: Observation
    model: mujoco.MjModel | None
    frame_skip: int
    tolerance: float
    before: np.ndarray
    after: np.ndarray
    cut: np.ndarray
    parted: np.ndarray
    turns: np.ndarray

    @classmethod
    def of(
        cls, log: Trajectories, observation: Observation, model: mujoco.MjModel | None, frame_skip: int,
        tolerance: float = np.inf,
    ) -> Record:  # fmt: skip
        """Return a log as it is examined first: nothing known of jumps and turns."""
        before, after = observation.observed(log.observations), observation.observed(log.next_observations)
        return cls(
            log, observation, model, frame_skip, tolerance, before, after,
            np.zeros(len(log), dtype=bool), log.terminals.copy(), np.zeros_like(before),
        )  # fmt: skip

    def with_breaks(self, cut: np.ndarray, parted: np.ndarray) -> Record:
        """Return the record with episodes' ends that the log does not mark."""
        return replace(self, cut=self.cut | cut, parted=self.parted | parted | cut)

    @property
    def step(self) -> float | None:
        """Seconds of a transition: the model's, or those that the log says."""
        if self.model is None:
            return self.log.dt
        return float(self.model.opt.timestep) * self.frame_skip

    @cached_property
    def steps(self) -> np.ndarray:
        """What each transition adds to each observed column, without turns, ``(T, n)``."""
        return self.after - self.before - 2 * np.pi * self.turns

    @cached_property
    def runs(self) -> np.ndarray:
        """A number for each stretch of rows that follow one another, ``(T,)``."""
        ends = np.cumsum(self.parted)
        return np.concatenate([[0], ends[:-1]])

    @cached_property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The model's scalar positions of which something is observed."""
        return () if self.model is None else tuple(_coordinates(self.model, self.observation))

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """Those of which both position and velocity are observed."""
        return tuple(
            Pair(c.name, c.position, c.velocity, c.qpos, c.dof, c.angle, c.limits)
            for c in self.coordinates
            if c.position is not None and c.velocity is not None
        )

    @property
    def positions(self) -> list[tuple[Coordinate, int]]:
        """Those of which the position is observed, with its column."""
        return [(c, c.position) for c in self.coordinates if c.position is not None]

    @cached_property
    def orientations(self) -> tuple[Orientation, ...]:
        """The observed quaternions."""
        return () if self.model is None else tuple(_orientations(self.model, self.observation))

    def is_velocity(self, place: int) -> bool:
        """Return whether a column of the extended state is a velocity of the state."""
        return self.model is None or self.model.nq <= place < self.model.nq + self.model.nv

    def label(self, column: int) -> str:
        """Return an observed column's label."""
        return self.observation.labels[column]

    def signal(self, column: int) -> str:
        """Return what the file calls an observed column."""
        index = self.observation.log_columns[column]
        if self.log.origin is not None and len(self.log.origin.observation_names) > index:
            return self.log.origin.observation_names[index]
        return column_names("observations", self.log.observations.shape[1])[index]

    def command(self, column: int) -> str:
        """Return what the file calls a command."""
        if self.log.origin is not None and len(self.log.origin.action_names) > column:
            return self.log.origin.action_names[column]
        return column_names("actions", self.log.actions.shape[1])[column]

    def file_row(self, transition: int) -> int:
        """Return the row of the file at which a transition starts."""
        rows = None if self.log.origin is None else self.log.origin.rows
        return int(transition if rows is None else rows[transition])

    def named(self, columns: Sequence[int]) -> str:
        """Return columns for a sentence, with the file's names where they differ from the labels."""
        return ", ".join(
            self.label(c) if self.label(c) == self.signal(c) else f"{self.label(c)} ({self.signal(c)})" for c in columns
        )


def resampled(record: Record, **settings: object) -> dict[str, object]:
    """Return the keys of a config that resample the log onto the simulation's steps: its positions, its velocities."""
    columns = list(enumerate(record.observation.columns))
    speeds = [i for i, place in columns if record.is_velocity(place)]
    positions = [i for i, _ in columns if i not in speeds]
    options: dict[str, object] = {"dt": record.step}
    if record.orientations:
        options["quaternions"] = [[record.signal(i) for i in o.quaternion] for o in record.orientations]
    if speeds:
        options["velocities"] = [record.signal(i) for i in speeds]
    timed = record.log.origin is not None and record.log.origin.durations is not None
    data: dict[str, object] = {} if timed else {"dt": record.step}
    if record.observation.log_width > len(columns):  # columns that are no state are left out
        data["observations"] = [record.signal(i) for i in positions + speeds]
    cure: dict[str, object] = {"data": data | {"preprocess": options | settings}}
    if [i for i, _ in columns] != positions + speeds or "observations" in data:
        places = [record.observation.columns[i] for i in positions + speeds]
        cure["observation"] = [entry(record, p) for p in places]
    return cure


def entry(record: Record, place: int) -> str:
    """Return an entry of ``observation`` for one observed column: its joint's or sensor's, or its number."""
    nq, nv = (0, 0) if record.model is None else (record.model.nq, record.model.nv)
    label = record.label(record.observation.columns.index(place))
    if place >= nq + nv > 0:
        return f"sensor[{place - nq - nv}]"
    if "[" not in label:
        return label
    return f"qpos[{place}]" if place < nq else f"qvel[{place - nq}]"


def windows(record: Record, values: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return sums over ``length`` rows of ``values (T, k)`` that follow one another, ``(W, k)``, and first rows."""
    count = len(values) - length + 1
    if count < 1:
        return values[:0], np.empty(0, dtype=int)
    runs = record.runs
    start = np.arange(0, count, max(1, length // 2, count // MOST_WINDOWS))
    spoiled = np.concatenate([[0], np.cumsum(record.cut)])
    start = start[(runs[start] == runs[start + length - 1]) & (spoiled[start + length] == spoiled[start])]
    if length == 1:
        return values[start], start
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return total[start + length] - total[start], start


def _coordinates(model: mujoco.MjModel, observation: Observation) -> list[Coordinate]:
    place = {c: i for i, c in enumerate(observation.columns)}
    found = []
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), joint_name(model, j)
        first, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            continue
        axes = [f"{name}[{axis}]" for axis in "xyz"] if kind == mujoco.mjtJoint.mjJNT_FREE else [name]
        limited = bool(model.jnt_limited[j]) and len(axes) == 1
        limits = (float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1])) if limited else None
        for i, label in enumerate(axes):
            position, velocity = place.get(first + i), place.get(model.nq + dof + i)
            if position is not None or velocity is not None:
                angle = kind == mujoco.mjtJoint.mjJNT_HINGE
                found.append(Coordinate(label, position, velocity, first + i, dof + i, angle, limits))
    return found


def _orientations(model: mujoco.MjModel, observation: Observation) -> list[Orientation]:
    place = {c: i for i, c in enumerate(observation.columns)}
    found = []
    for j in range(model.njnt):
        kind = int(model.jnt_type[j])
        if kind not in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            continue
        skip = 3 if kind == mujoco.mjtJoint.mjJNT_FREE else 0
        first, dof = int(model.jnt_qposadr[j]) + skip, model.nq + int(model.jnt_dofadr[j]) + skip
        if first not in place:
            continue
        velocity = tuple(place[dof + i] for i in range(3)) if all(dof + i in place for i in range(3)) else None
        found.append(Orientation(joint_name(model, j), tuple(place[first + i] for i in range(4)), velocity, first))
    return found
