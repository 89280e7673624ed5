"""What the columns of a log are: the map between observations and simulator states.

A simulator state is ``[qpos, qvel]``, ``(nq + nv,)``. An observation is a list of state columns, in
any order, some of which may be missing or of no interest. It is written as a list of entries:

=============================  ==================================================================
``qpos``, ``qvel``             every generalized position, every generalized velocity
``qpos[1:]``, ``qvel[0:3]``    a slice
``qpos[2]``                    one column
``qpos[elbow]``                every position column of the joint ``elbow``
``elbow.position``             the same, and ``elbow.velocity`` for its velocity columns
``skip``, ``skip[3]``          one column, three columns of the log which are no state
=============================  ==================================================================
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.errors import InputError, choices

_QPOS_WIDTH = {0: 7, 1: 4, 2: 1, 3: 1}  # free, ball, slide, hinge
_DOF_WIDTH = {0: 6, 1: 3, 2: 1, 3: 1}
_POSITION_SUFFIX = {
    7: ("[x]", "[y]", "[z]", "[qw]", "[qx]", "[qy]", "[qz]"),
    4: ("[qw]", "[qx]", "[qy]", "[qz]"),
    1: ("",),
}
_VELOCITY_SUFFIX = {
    6: ("[vx]", "[vy]", "[vz]", "[wx]", "[wy]", "[wz]"),
    3: ("[wx]", "[wy]", "[wz]"),
    1: ("",),
}


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
        at_rest: joints whose position is observed and whose velocity is not: every window starts with them at rest.
    """

    columns: tuple[int, ...]
    labels: tuple[str, ...]
    log_columns: tuple[int, ...]
    log_width: int
    default_state: tuple[float, ...]
    units: tuple[str, ...]
    quaternions: tuple[tuple[int, int, int, int], ...] = ()
    at_rest: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of observed columns ``n``."""
        return len(self.columns)

    @cached_property
    def index(self) -> np.ndarray:
        """``columns`` as an integer array, ``(n,)``."""
        return np.asarray(self.columns, dtype=np.int64)

    def states(self, observations: np.ndarray) -> np.ndarray:
        """Return full states ``(T, nq + nv)`` of logged observations ``(T, log_width)``."""
        observations = np.asarray(observations, dtype=np.float64)
        states = np.tile(np.asarray(self.default_state), (len(observations), 1))
        states[:, self.index] = observations[:, list(self.log_columns)]
        for quaternion in self.quaternions:
            block = self.index[list(quaternion)]
            norm = np.linalg.norm(states[:, block], axis=1, keepdims=True)
            bad = np.flatnonzero(norm[:, 0] < 1e-6)
            if bad.size:
                raise InputError(
                    f"log: row {bad[0]} has a zero quaternion in {self.labels[quaternion[0]]}; "
                    "a unit quaternion (w, x, y, z) is expected"
                )
            states[:, block] = states[:, block] / norm
        return states

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
    labels, units = _state_labels(model)
    columns: list[int] = []
    log_columns: list[int] = []
    width = 0
    for entry in ("qpos", "qvel") if entries is None else entries:
        found = _entry_columns(model, str(entry).strip())
        if isinstance(found, int):
            width += found
            continue
        columns += found
        log_columns += range(width, width + len(found))
        width += len(found)
    twice = {c for c in columns if columns.count(c) > 1}
    if twice:
        raise InputError(f"observation: {labels[min(twice)]} stands there twice; name each state column once")
    if not columns:
        raise InputError("observation: no state column is named; expected entries such as 'qpos[1:]' and 'qvel'")
    if log_width is not None and log_width != width:
        described = "[qpos, qvel]" if entries is None else str(list(entries)).replace("'", "")
        raise InputError(
            f"observation: {described} has {width} columns and the log has {log_width}; "
            f"list what each of the log's columns is (the model has nq={model.nq}, nv={model.nv}), 'skip' for none; "
            "velocities that it lacks are derived by data: preprocess"
        )
    default = np.concatenate([model.qpos0, np.zeros(model.nv)])
    return Observation(
        columns=tuple(columns),
        labels=tuple(labels[c] for c in columns),
        log_columns=tuple(log_columns),
        log_width=width,
        default_state=tuple(default.tolist()),
        units=tuple(units[c] for c in columns),
        quaternions=_complete_quaternions(model, columns),
        at_rest=_at_rest(model, set(columns)),
    )


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


def _state_labels(model: mujoco.MjModel) -> tuple[list[str], list[str]]:
    """Names and units of every state column, ``nq + nv`` of each."""
    position_labels: list[str] = []
    velocity_labels: list[str] = []
    position_units: list[str] = []
    velocity_units: list[str] = []
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), joint_name(model, j)
        nq, nv = _QPOS_WIDTH[kind], _DOF_WIDTH[kind]
        position_labels += [f"{name}.position{s}" for s in _POSITION_SUFFIX[nq]]
        velocity_labels += [f"{name}.velocity{s}" for s in _VELOCITY_SUFFIX[nv]]
        position_units += {0: ["m"] * 3 + ["-"] * 4, 1: ["-"] * 4, 2: ["m"], 3: ["rad"]}[kind]
        velocity_units += {0: ["m/s"] * 3 + ["rad/s"] * 3, 1: ["rad/s"] * 3, 2: ["m/s"], 3: ["rad/s"]}[kind]
    return position_labels + velocity_labels, position_units + velocity_units


def _entry_columns(model: mujoco.MjModel, entry: str) -> list[int] | int:
    """State columns of one entry, or the number of log columns to skip."""
    skip = re.fullmatch(r"skip(?:\[(\d+)\])?", entry)
    if skip:
        return int(skip[1] or 1)
    dotted = re.fullmatch(r"(.+)\.(position|velocity)", entry)
    if dotted:
        return _joint_columns(model, dotted[1], dotted[2] == "position", entry)
    match = re.fullmatch(r"(qpos|qvel)(?:\[(.*)\])?", entry)
    if match is None:
        raise InputError(
            f"observation: {entry!r} is not understood; expected qpos, qvel, a slice qpos[1:], a joint "
            "qpos[elbow] or elbow.position, or skip" + choices(entry, ["qpos", "qvel", "skip"])
        )
    size, offset = (model.nq, 0) if match[1] == "qpos" else (model.nv, model.nq)
    inside = match[2]
    if inside is None:
        return list(range(offset, offset + size))
    if re.fullmatch(r"-?\d+", inside):
        index = int(inside)
        if not -size <= index < size:
            raise InputError(f"observation: {entry} is outside {match[1]}, which has {size} entries")
        return [offset + index % size]
    part = re.fullmatch(r"(-?\d*):(-?\d*)(?::(-?\d+))?", inside)
    if part:
        bounds = [int(p) if p else None for p in part.groups()]
        if bounds[2] == 0:
            raise InputError(f"observation: {entry} has step 0; expected a step such as 1 or -1")
        found = list(range(offset, offset + size))[slice(*bounds)]
        if not found:
            raise InputError(f"observation: {entry} is empty; {match[1]} has {size} entries")
        return found
    return _joint_columns(model, inside, match[1] == "qpos", entry)


def _joint_columns(model: mujoco.MjModel, name: str, position: bool, entry: str) -> list[int]:
    names = [joint_name(model, j) for j in range(model.njnt)]
    if name not in names:
        raise InputError(f"observation: {entry}: the model has no joint {name!r}" + choices(name, names))
    j = names.index(name)
    kind = int(model.jnt_type[j])
    if position:
        start, width = int(model.jnt_qposadr[j]), _QPOS_WIDTH[kind]
    else:
        start, width = model.nq + int(model.jnt_dofadr[j]), _DOF_WIDTH[kind]
    return list(range(start, start + width))


def _at_rest(model: mujoco.MjModel, columns: set[int]) -> tuple[str, ...]:
    """Joints of which a position is observed, and not every velocity."""
    found = []
    for joint in range(model.njnt):
        kind = int(model.jnt_type[joint])
        nq, nv = _QPOS_WIDTH[kind], _DOF_WIDTH[kind]
        first, begin = int(model.jnt_qposadr[joint]), model.nq + int(model.jnt_dofadr[joint])
        if columns.intersection(range(first, first + nq)) and not columns.issuperset(range(begin, begin + nv)):
            found.append(joint_name(model, joint))
    return tuple(found)


def _complete_quaternions(model: mujoco.MjModel, columns: list[int]) -> tuple[tuple[int, int, int, int], ...]:
    found = []
    for j in range(model.njnt):
        kind = int(model.jnt_type[j])
        if kind > 1:
            continue
        start = int(model.jnt_qposadr[j]) + (3 if kind == 0 else 0)
        wanted = list(range(start, start + 4))
        present = [c for c in wanted if c in columns]
        if len(present) == 4:
            a, b, c, d = (columns.index(w) for w in wanted)
            found.append((a, b, c, d))
        elif present:
            raise InputError(
                f"observation: only {len(present)} of the 4 quaternion columns of joint "
                f"{joint_name(model, j)!r} are named; name all four or none"
            )
    return tuple(found)
