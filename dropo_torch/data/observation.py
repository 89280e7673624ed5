"""What the columns of a log are: the map between observations and simulator states.

A simulator state is ``[qpos, qvel]``, ``(nq + nv,)``. An observation is a list of state columns, in
any order, some of which may be missing or of no interest, and of sensors' values: columns of the extended state
``[qpos, qvel, sensordata]``. It is written as a list of entries:

=============================  ==================================================================
``qpos``, ``qvel``             every generalized position, every generalized velocity
``qpos[1:]``, ``qvel[0:3]``    a slice
``qpos[2]``                    one column
``qpos[elbow]``                every position column of the joint ``elbow``
``elbow.position``             the same, and ``elbow.velocity`` for its velocity columns
``sensor[imu]``                every value of the sensor ``imu``; ``sensor[imu][1]``: one of them
``sensor``, ``sensor[0:3]``    every value of every sensor, a slice of ``sensordata``
``skip``, ``skip[3]``          one column, three columns of the log which are no state
=============================  ==================================================================

Joints without a column that the model's equality constraints determine, in closed loops or by coupling, are where these
are met. A sensor that is a joint's encoder (``jointpos``, ``jointvel``, ``ballquat``, ``ballangvel``) stands for the
columns of the state that it shows. With sensors, a state of which not every column is observed is estimated from the
log; and so is that of a free body of which only the orientation is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.data.loops import Loops, find_loops
from dropo_torch.data.sensors import Sensor, sensors_of
from dropo_torch.errors import InputError, choices

_SLICE = re.compile(r"(-?\d+)|(-?\d*):(-?\d*)(?::(-?\d+))?")
_SENSOR = re.compile(r"sensor(?:\[([^]]*)\])?(?:\[([^]]*)\])?")
_Labels = tuple[tuple[str, str], ...]  # a suffix and a unit for each column
_PLACE: _Labels = tuple((f"[{axis}]", "m") for axis in "xyz")
_QUATERNION: _Labels = tuple((f"[q{axis}]", "-") for axis in "wxyz")
_LINEAR: _Labels = tuple((f"[v{axis}]", "m/s") for axis in "xyz")
_ANGULAR: _Labels = tuple((f"[w{axis}]", "rad/s") for axis in "xyz")
#: Kind of joint → its position and velocity columns.
_KINDS: dict[int, tuple[_Labels, _Labels]] = {
    int(mujoco.mjtJoint.mjJNT_FREE): (_PLACE + _QUATERNION, _LINEAR + _ANGULAR),
    int(mujoco.mjtJoint.mjJNT_BALL): (_QUATERNION, _ANGULAR),
    int(mujoco.mjtJoint.mjJNT_SLIDE): ((("", "m"),), (("", "m/s"),)),
    int(mujoco.mjtJoint.mjJNT_HINGE): ((("", "rad"),), (("", "rad/s"),)),
}


@dataclass(frozen=True)
class _Joint:
    """A joint, and its columns in the state ``[qpos, qvel]`` with their labels and units."""

    name: str
    positions: dict[int, tuple[str, str]]
    velocities: dict[int, tuple[str, str]]


@dataclass(frozen=True)
class Reckoned:
    """A position that is not observed, of which the velocity is.

    Attributes:
        position: its column in the state ``[qpos, qvel]``.
        velocity: the observed column of its velocity.
        low, high: its joint's range; infinite where it has none.
    """

    position: int
    velocity: int
    low: float
    high: float


@dataclass(frozen=True)
class Observation:
    """The columns of an observation in the simulator's state.

    Attributes:
        columns: for each observed column its column in the state ``[qpos, qvel]``, ``(n,)``.
        labels: for each observed column its name, such as ``"elbow.position"``.
        log_columns: for each observed column its column in the log, ``(n,)``.
        log_width: the number of columns that the log must have.
        default_state: the state of what is not observed, ``(nq + nv,)``: the model's ``qpos0`` and zero.
        units: for each observed column ``"m"``, ``"rad"``, ``"m/s"``, ``"rad/s"`` or ``"-"``.
        quaternions: observed columns of each complete quaternion, a tuple of four each.
        at_rest: joints with a position that is observed and whose velocity is not: every window starts with that at
            rest.
        reckoned: positions that are not observed, with their velocities, which are. Such a position is where its
            velocity has led since the episode's start, where it had its default.
        is_sensed: whether states are not what the log shows: they are to be estimated from it. Then states are
            extended by ``sensordata``, at rest, reckoned and loops are none.
        loops: joints that are not observed and that the model's equality constraints determine; ``None`` for none.
    """

    columns: tuple[int, ...]
    labels: tuple[str, ...]
    log_columns: tuple[int, ...]
    log_width: int
    default_state: tuple[float, ...]
    units: tuple[str, ...]
    quaternions: tuple[tuple[int, int, int, int], ...] = ()
    at_rest: tuple[str, ...] = ()
    reckoned: tuple[Reckoned, ...] = ()
    is_sensed: bool = False
    loops: Loops | None = field(default=None, compare=False)

    @property
    def size(self) -> int:
        """Number of observed columns ``n``."""
        return len(self.columns)

    @cached_property
    def index(self) -> np.ndarray:
        """``columns`` as an integer array, ``(n,)``."""
        return np.asarray(self.columns, dtype=np.int64)

    def states(self, observations: np.ndarray, unseen: np.ndarray | None = None) -> np.ndarray:
        """Return full states ``(T, nq + nv)`` of logged observations ``(T, log_width)``.

        Args:
            observations: rows of the log.
            unseen: the positions of :attr:`unseen`, ``(T, k)``; if not given, reckoned ones have their defaults.
        """
        self.check_quaternions(np.asarray(observations, dtype=np.float64), "observations")
        states = self.full(self.observed(observations), unseen)
        for quaternion in self.quaternions:
            block = self.index[list(quaternion)]
            states[:, block] /= np.linalg.norm(states[:, block], axis=1, keepdims=True)
        return states

    def check_quaternions(self, log: np.ndarray, what: str) -> None:
        """Refuse observations ``(T, log_width)`` with a quaternion that is no orientation.

        Raises:
            InputError: a zero quaternion, with its row and ``what`` it is in.
        """
        for quaternion in self.quaternions:
            norm = np.linalg.norm(log[:, [self.log_columns[i] for i in quaternion]], axis=1)
            bad = np.flatnonzero(norm < 1e-6)
            if bad.size:
                raise InputError(
                    f"log: row {bad[0]} of {what} has a zero quaternion in {self.labels[quaternion[0]]}; "
                    "a unit quaternion (w, x, y, z) is expected"
                )

    def full(self, columns: np.ndarray, unseen: np.ndarray | None = None) -> np.ndarray:
        """Return full states ``(T, nq + nv)`` of observed columns ``(T, n)``; what is not observed has its default.

        Positions that :attr:`unseen` lists have those of ``unseen``, ``(T, k)``, where it is given; from there
        :attr:`loops` are closed.
        """
        states = np.tile(np.asarray(self.default_state), (len(columns), 1))
        states[:, self.index] = columns
        if unseen is not None:
            states[:, list(self.unseen)] = unseen
        return states if self.loops is None else self.loops.closed(states, near=unseen is not None)

    @cached_property
    def unseen(self) -> tuple[int, ...]:
        """Columns of positions in the state that no column shows and that still follow from the log, ``k`` of them."""
        held = () if self.loops is None else self.loops.positions.tolist()
        return (*(r.position for r in self.reckoned), *held)

    def reckon(
        self, before: np.ndarray, after: np.ndarray, terminals: np.ndarray, timestep: float, ahead: float = 0.0
    ) -> np.ndarray:
        """Return the positions that :attr:`reckoned` lists at the start of every transition, ``(T, k)``.

        Dead reckoning: ground that slopes, walls and springs act by where a robot is, which a log that tells its
        velocity only does not show.

        Args:
            before: observations at the transitions' starts, ``(T, log_width)``.
            after: those at their ends, ``(T, log_width)``.
            terminals: which transitions end an episode, ``(T,)`` bool.
            timestep: seconds of a transition.
            ahead: share of a transition by which positions follow later velocities: 0 is the trapezoidal rule; a
                simulator whose n steps a transition move positions by the new velocities has 1/n.
        """
        velocities = [r.velocity for r in self.reckoned]
        first, last = (self.observed(x)[:, velocities] for x in (before, after))
        moved = 0.5 * timestep * ((1 - ahead) * first + (1 + ahead) * last)
        passed = np.cumsum(moved, axis=0) - moved
        begins = np.concatenate([[0], np.flatnonzero(terminals)[:-1] + 1])
        start = np.repeat(passed[begins], np.diff(np.append(begins, len(passed))), axis=0)
        default = np.array([self.default_state[r.position] for r in self.reckoned])
        return np.clip(default + passed - start, [r.low for r in self.reckoned], [r.high for r in self.reckoned])

    def observed(self, log: np.ndarray) -> np.ndarray:
        """Return the observed columns ``(T, n)`` of a log ``(T, log_width)``."""
        return np.asarray(log, dtype=np.float64)[:, list(self.log_columns)]


def parse_observation(
    model: mujoco.MjModel, entries: Sequence[str] | None, log_width: int | None = None
) -> Observation:
    """Read the ``observation`` entry of a config.

    Args:
        model: the simulated model.
        entries: the entries listed in this module's documentation; ``None`` is ``[qpos, qvel]``.
        log_width: the number of columns of the log, checked when given.

    Raises:
        InputError: an entry that names nothing, a column named twice, a width that does not fit.
    """
    joints = _joints(model)
    about = {c: entry for joint in joints for c, entry in (joint.positions | joint.velocities).items()}
    sensors, num_states = sensors_of(model, about), model.nq + model.nv
    listed: list[int | None] = []  # a state column, or None, for each column of the log
    for entry in ("qpos", "qvel") if entries is None else entries:
        listed += _entry_columns(model, joints, sensors, str(entry).strip())
    columns, width = [c for c in listed if c is not None], len(listed)
    about |= {c: entry for sensor in sensors for c, entry in sensor.columns.items()}
    is_sensed = _names_sensors(entries or ()) and sorted(columns) != list(range(num_states))
    is_sensed |= _floats_unseen(model, columns)
    twice = {c for c in columns if columns.count(c) > 1}
    if twice:
        raise InputError(f"observation: {about[min(twice)][0]} stands there twice; name each state column once")
    if not columns:
        raise InputError("observation: no state column is named; expected entries such as 'qpos[1:]' and 'qvel'")
    if log_width is not None and log_width != width:
        described = "[qpos, qvel]" if entries is None else str(list(entries)).replace("'", "")
        raise InputError(
            f"observation: {described} has {width} columns and the log has {log_width}; "
            f"list what each of the log's columns is (the model has nq={model.nq}, nv={model.nv}), 'skip' for none; "
            "velocities that it lacks are derived by data: preprocess"
        )
    default = np.concatenate([model.qpos0, np.zeros(model.nv + is_sensed * model.nsensordata)])
    return Observation(
        columns=tuple(columns),
        labels=tuple(about[c][0] for c in columns),
        log_columns=tuple(i for i, c in enumerate(listed) if c is not None),
        log_width=width,
        default_state=tuple(default.tolist()),
        units=tuple(about[c][1] for c in columns),
        quaternions=_complete_quaternions(joints, sensors, columns),
        at_rest=() if is_sensed else tuple(joint.name for joint in joints if _is_at_rest(joint, set(columns))),
        reckoned=() if is_sensed else _reckoned(model, joints, columns),
        is_sensed=is_sensed,
        loops=None if is_sensed else find_loops(model, columns),
    )


def _names_sensors(entries: Sequence[str]) -> bool:
    return any(_SENSOR.fullmatch(str(entry).strip()) for entry in entries)


def _floats_unseen(model: mujoco.MjModel, columns: Sequence[int]) -> bool:
    """Whether a free body's orientation is observed, and neither where it is nor how fast it moves."""
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        place, speed = int(model.jnt_qposadr[joint]), model.nq + int(model.jnt_dofadr[joint])
        hidden = {*range(place, place + 3), *range(speed, speed + 3)}
        if hidden.isdisjoint(columns) and {*range(place + 3, place + 7)} <= set(columns):
            return True
    return False


def generic_observation(num_columns: int) -> Observation:
    """Return the observation of a simulator that is no MuJoCo model: all its state columns, in order."""
    return Observation(
        columns=tuple(range(num_columns)),
        labels=tuple(f"state[{i}]" for i in range(num_columns)),
        log_columns=tuple(range(num_columns)),
        log_width=num_columns,
        default_state=(0.0,) * num_columns,
        units=("-",) * num_columns,
    )


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or ``joint3`` where it has none."""
    return model.joint(joint).name or f"joint{joint}"


def _joints(model: mujoco.MjModel) -> list[_Joint]:
    def columns(stem: str, labels: _Labels, first: int) -> dict[int, tuple[str, str]]:
        return {first + i: (f"{stem}{suffix}", unit) for i, (suffix, unit) in enumerate(labels)}

    found = []
    for j in range(model.njnt):
        name, (positions, velocities) = joint_name(model, j), _KINDS[int(model.jnt_type[j])]
        place = columns(f"{name}.position", positions, int(model.jnt_qposadr[j]))
        found.append(_Joint(name, place, columns(f"{name}.velocity", velocities, model.nq + int(model.jnt_dofadr[j]))))
    return found


def _is_at_rest(joint: _Joint, columns: set[int]) -> bool:
    """Whether a position of a joint is observed and its velocity is not; a quaternion's is that about three axes."""
    positions, velocities = list(joint.positions), list(joint.velocities)
    turned = positions[-4:] if len(positions) >= 4 else []
    pairs = [([p], [v]) for p, v in zip(positions[: len(positions) - len(turned)], velocities, strict=False)]
    if turned:
        pairs.append((turned, velocities[-3:]))
    return any(not columns.isdisjoint(own) and not columns.issuperset(rates) for own, rates in pairs)


def _reckoned(model: mujoco.MjModel, joints: Sequence[_Joint], columns: Sequence[int]) -> tuple[Reckoned, ...]:
    """The positions that are not among the observed columns although their velocities are."""
    found = []
    for j, joint in enumerate(joints):
        low, high = model.jnt_range[j] if model.jnt_limited[j] else (-np.inf, np.inf)
        for position, velocity in zip(joint.positions, joint.velocities, strict=False):  # a quaternion has one more
            integrates = joint.positions[position][1] in ("m", "rad")
            if integrates and position not in columns and velocity in columns:
                found.append(Reckoned(position, columns.index(velocity), float(low), float(high)))
    return tuple(found)


def _entry_columns(
    model: mujoco.MjModel, joints: Sequence[_Joint], sensors: Sequence[Sensor], entry: str
) -> list[int] | list[None]:
    """State columns of one entry; ``None`` for each log column to skip."""
    skip = re.fullmatch(r"skip(?:\[(\d+)\])?", entry)
    if skip:
        return [None] * int(skip[1] or 1)
    if _SENSOR.fullmatch(entry):
        return _sensor_columns(sensors, entry)
    match = re.fullmatch(r"(.+)\.(position|velocity)|(qpos|qvel)(?:\[(.*)\])?", entry)
    if match is None:
        raise InputError(
            f"observation: {entry!r} is not understood; expected qpos, qvel, a slice qpos[1:], a joint "
            "qpos[elbow] or elbow.position, sensor[imu], or skip" + choices(entry, ["qpos", "qvel", "sensor", "skip"])
        )
    name, side, whole, inside = match.groups()
    of_position = side == "position" or whole == "qpos"
    every = range(model.nq) if of_position else range(model.nq, model.nq + model.nv)
    if whole and inside is None:
        return list(every)
    if whole and (found := _sliced(every, inside, entry, whole)):
        return found
    named = {joint.name: joint for joint in joints}
    wanted = name or inside
    if wanted not in named:
        raise InputError(f"observation: {entry}: the model has no joint {wanted!r}" + choices(wanted, named))
    return list(named[wanted].positions if of_position else named[wanted].velocities)


def _sensor_columns(sensors: Sequence[Sensor], entry: str) -> list[int]:
    """Columns of one entry that names sensors."""
    match = _SENSOR.fullmatch(entry)
    assert match is not None
    inside, part = match.groups()
    every = [(c, sensor) for sensor in sensors for c in sensor.columns]
    named = {sensor.name: sensor for sensor in sensors}
    if inside in named:
        found = list(named[inside].columns)
        if part is not None:
            found = _sliced(found, part, entry, f"sensor[{inside}]") or []
            if not found:
                raise InputError(f"observation: {entry}: {part!r} is no number or slice; expected sensor[{inside}][0]")
    elif part is None and (inside is None or _SLICE.fullmatch(inside)):
        columns = [c for c, _ in every]
        found = columns if inside is None else _sliced(columns, inside, entry, "sensor") or []
    else:
        raise InputError(f"observation: {entry}: the model has no sensor {inside!r}" + choices(inside or "", named))
    if not found:
        raise InputError(f"observation: {entry}: the model has no sensors")
    for sensor in {sensor.name: sensor for c, sensor in every if c in found}.values():
        sensor.check()
    return found


def _sliced(every: Sequence[int], inside: str, entry: str, whole: str) -> list[int] | None:
    """The columns that a number or a slice names; ``None`` where it is neither."""
    part = _SLICE.fullmatch(inside)
    if not part:
        return None
    index, *bounds = (int(p) if p else None for p in part.groups())
    if index is not None:
        bounds = [index, index + 1 or None, None]
    if bounds[2] == 0:
        raise InputError(f"observation: {entry} has step 0; expected a step such as 1 or -1")
    found = list(every[slice(*bounds)])
    if not found:
        why = f"is empty; {whole}" if index is None else f"is outside {whole}, which"
        raise InputError(f"observation: {entry} {why} has {len(every)} entries")
    return found


def _complete_quaternions(
    joints: Sequence[_Joint], sensors: Sequence[Sensor], columns: list[int]
) -> tuple[tuple[int, int, int, int], ...]:
    blocks = [(f"joint {j.name!r}", list(j.positions)[-4:]) for j in joints if len(j.positions) >= 4]
    known = {block[0] for _, block in blocks}
    own = [(f"sensor {s.name!r}", list(s.columns)) for s in sensors if s.is_quaternion]
    found = []
    for name, block in blocks + [(n, b) for n, b in own if b[0] not in known]:
        present = [columns.index(c) for c in block if c in columns]
        if not present:
            continue
        if len(present) != 4:
            raise InputError(
                f"observation: only {len(present)} of the 4 quaternion columns of {name} are named; "
                "name all four or none"
            )
        w, x, y, z = present
        found.append((w, x, y, z))
    return tuple(found)
