"""What a motion must keep: ranges, speeds, accelerations, forces, a workspace, and what may touch what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from dropo_torch.data.observation import joint_name
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import object_names
from dropo_torch.planning.drives import Drive
from dropo_torch.planning.motion import Reach
from dropo_torch.planning.settings import PlanSettings
from dropo_torch.simulators.hidden import control_range, filters_of
from dropo_torch.support.rows import evenly

#: Speed of hinges (rad/s) and slides (m/s) where neither config nor log tell one, and positions around the start.
SPEED, AWAY = {"rad": 2.0, "m": 0.5}, {"rad": np.pi / 2, "m": 0.25}
#: Seconds in which a joint reaches its largest speed where no acceleration is given.
RISE = 0.1
#: Share of a log's speeds that counts as what it showed, and by how much its positions are widened, of their range.
SHOWN, WIDER = 0.999, 0.5
#: Share of its range by which a joint that rests on a stop may go beyond it.
STOP = 0.02
#: Depth in m to which bodies that must not touch may be found in each other: rounding.
TOUCH = 1e-6

Kind = Literal["position", "velocity", "acceleration", "command", "force", "workspace", "contact"]


@dataclass(frozen=True)
class Limit:
    """An interval that a number must stay in.

    Attributes:
        kind: what is limited.
        name: of the joint, actuator, site or body, with the axis of a workspace.
        unit: of its ends.
        low, high: its ends.
        source: who says so, in words.
        column: where the number stands: a state's or command's column, or the number of the object.
    """

    kind: Kind
    name: str
    unit: str
    low: float
    high: float
    source: str
    column: int

    @property
    def size(self) -> float:
        """What an excess is relative to."""
        wide = self.high - self.low
        return wide if np.isfinite(wide) else max(abs(x) for x in (self.low, self.high) if np.isfinite(x))


@dataclass(frozen=True)
class Kept:
    """How far motions go in their limits.

    Attributes:
        lowest, highest: what each of n limits met, ``(P, n)`` each; NaN where nothing was measured.
        excess: by how much each is exceeded, relative to its size, ``(P, n)``; negative where it is kept.
        touching: bodies that touch and must not, of each motion.
        depth: how deep in m, ``(P,)``.
    """

    lowest: np.ndarray
    highest: np.ndarray
    excess: np.ndarray
    touching: tuple[tuple[str, str] | None, ...]
    depth: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Sum of what is exceeded, ``(P,)``; 0 where all is kept."""
        return np.asarray(np.maximum(np.nan_to_num(self.excess, nan=0.0), 0).sum(1) + self.depth / 0.01)


@dataclass(frozen=True)
class Limits:
    """All limits of a motion.

    Attributes:
        limits: the intervals.
        reach: how far each drive may go.
        force: largest force of each actuator, ``(nu,)``.
        touch: pairs of bodies that may touch.
    """

    limits: tuple[Limit, ...]
    reach: Reach
    force: np.ndarray
    touch: frozenset[frozenset[int]]

    def kept(
        self, models: Sequence[mujoco.MjModel], states: np.ndarray, commands: np.ndarray, timestep: float, *,
        per: int = 1, every: int | None = 1, share: float = 1.0,
    ) -> Kept:  # fmt: skip
        """Return how far motions go, whatever the model.

        Args:
            models: K models.
            states: simulated, ``(P, K, N + 1, nq + nv)``.
            commands: that act from each state on, ``(P, N, nu)``.
            timestep: seconds from a state to the next.
            per: states of a command, over which accelerations are taken.
            every: positions in space, forces and contacts are looked at in one state of so many; ``None`` for in none.
            share: of the limits that is allowed.
        """
        columns = np.array([x.column for x in self.limits], dtype=int)
        low, high = np.full((2, len(states), len(columns)), np.nan)
        kinds = np.array([x.kind for x in self.limits])
        speeds = np.diff(states[:, :, ::per], axis=2) / (per * timestep)
        for kind, values in (("position", states), ("velocity", states), ("acceleration", speeds)):
            own = np.flatnonzero(kinds == kind)
            low[:, own], high[:, own] = (f(values[..., columns[own]], axis=(1, 2)) for f in (np.min, np.max))
        own = np.flatnonzero(kinds == "command")
        low[:, own], high[:, own] = commands[..., columns[own]].min(1), commands[..., columns[own]].max(1)
        touching: tuple[tuple[str, str] | None, ...] = (None,) * len(states)
        depth = np.zeros(len(states))
        if every is not None:
            touching, depth = self._in_space(models, states, commands, every, low, high)
        return Kept(low, high, self._excess(low, high, share), touching, depth)

    def room(self, kept: Kept, start: np.ndarray) -> np.ndarray:
        """Return by what amplitudes ``(P,)`` can be multiplied, about, until a limit is met.

        Args:
            kept: how far the motions go.
            start: states and places from which they go.
        """
        found = np.full(len(kept.depth), np.inf)
        for i, limit in enumerate(self.limits):
            if limit.kind not in ("position", "velocity", "acceleration", "force"):
                continue
            at = start[limit.column] if limit.kind == "position" else 0.0
            for end, reached in ((limit.low, kept.lowest[:, i]), (limit.high, kept.highest[:, i])):
                gone, room = np.abs(reached - at), abs(end - at)
                with np.errstate(divide="ignore", invalid="ignore"):
                    found = np.fmin(found, np.where(gone > 1e-9, room / gone, np.inf))
        return found

    def _excess(self, low: np.ndarray, high: np.ndarray, share: float) -> np.ndarray:
        """By how much intervals are left, relative to their size."""
        size, ends = np.array([x.size for x in self.limits]), np.array([[x.low, x.high] for x in self.limits]).T
        held = np.where([x.kind == "command" for x in self.limits], -1e-9, 0.5 * (1 - share))
        return np.asarray(np.maximum(ends[0] - low, high - ends[1]) / size + held)

    def _in_space(
        self, models: Sequence[mujoco.MjModel], states: np.ndarray, commands: np.ndarray, every: int, low: np.ndarray,
        high: np.ndarray,
    ) -> tuple[tuple[tuple[str, str] | None, ...], np.ndarray]:  # fmt: skip
        """Fill in forces and positions in space, and return what touches."""
        forces = [i for i, x in enumerate(self.limits) if x.kind == "force"]
        places = [i for i, x in enumerate(self.limits) if x.kind == "workspace"]
        pairs: list[tuple[str, str] | None] = [None] * len(states)
        depth = np.zeros(len(states))
        if not (forces or places or touchable(models[0])):
            return tuple(pairs), depth
        for k, model in enumerate(models):
            data, filters = mujoco.MjData(model), filters_of(model)
            for p, n in np.ndindex(len(states), -(-states.shape[2] // every)):
                state, command = states[p, k, n * every], commands[p, min(n * every, commands.shape[1] - 1)]
                if not np.isfinite(state).all():
                    continue
                data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], command[: model.nu]
                if len(filters):
                    data.act[filters.activations] = filters.settled(model, command)
                mujoco.mj_forward(model, data)
                for i in forces:
                    _widen(low, high, p, i, float(data.actuator_force[self.limits[i].column]))
                for i in places:
                    _widen(low, high, p, i, _place(data, self.limits[i].column))
                found, deep = self._deepest(model, data)
                if deep > depth[p]:
                    pairs[p], depth[p] = found, deep
        return tuple(pairs), depth

    def _deepest(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[tuple[str, str] | None, float]:
        """The bodies that are deepest in each other of those that must not touch, and how deep."""
        found, deep = None, TOUCH
        for bodies, dist in contacts(model, data):
            if -dist > deep and bodies not in self.touch:
                names = sorted(body_name(model, b) for b in bodies)
                found, deep = (names[0], names[-1]), -dist
        return found, deep if found else 0.0


def _widen(low: np.ndarray, high: np.ndarray, p: int, i: int, value: float) -> None:
    low[p, i], high[p, i] = np.fmin(low[p, i], value), np.fmax(high[p, i], value)


def _place(data: mujoco.MjData, column: int) -> float:
    """A coordinate of a body, or of a site counted after all bodies."""
    where, axis = divmod(column, 3)
    bodies = len(data.xpos)
    return float(data.xpos[where, axis] if where < bodies else data.site_xpos[where - bodies, axis])


def touchable(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of a model may touch."""
    return model.ngeom > 1 and bool(model.geom_contype.any() or model.geom_conaffinity.any() or model.npair)


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> Iterable[tuple[frozenset[int], float]]:
    """Yield the bodies of every contact, and its distance; bodies fixed to each other count as one."""
    for i in range(data.ncon):
        geoms = data.contact.geom[i]
        if (geoms >= 0).all():
            yield frozenset(model.body_weldid[model.geom_bodyid[geoms]].tolist()), float(data.contact.dist[i])


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Return what a body is called."""
    return model.body(body).name or f"body{body}"


def make_limits(
    model: mujoco.MjModel, drives: Sequence[Drive], settings: PlanSettings, start: np.ndarray,
    states: np.ndarray | None, commands: np.ndarray | None,
) -> Limits:  # fmt: skip
    """Return the limits of a model's motions: as given, else as the model has them, else as the log shows.

    Args:
        model: the model.
        drives: what moves it.
        settings: limits that are given.
        start: where the motion starts, ``(nq + nv,)``.
        states, commands: of a log, ``(T, nq + nv)`` and ``(T, nu)``; ``None`` without one.

    Raises:
        InputError: limits of something that the model does not have.
    """
    found: list[Limit] = []
    for drive in drives:
        found += _of_drive(model, drive, settings, start, states)
    force, sources = _forces(model, drives, settings, commands)
    low, high = control_range(model)
    for a, name in enumerate(object_names(model, "actuator")):
        if np.isfinite(low[a]) or np.isfinite(high[a]):
            found.append(Limit("command", name, "", float(low[a]), float(high[a]), "ctrlrange", a))
        if np.isfinite(force[a]):
            found.append(Limit("force", name, "", -float(force[a]), float(force[a]), sources[a], a))
    for name, box in settings.workspace.items():
        first = 3 * _frame(model, name)
        for axis, (least, most) in enumerate(box):
            place = f"{name}.{'xyz'[axis]}"
            found.append(Limit("workspace", place, "m", least, most, "plan.workspace", first + axis))
    driven = {drive.joint for drive in drives}
    found += [
        _range(model, j, start)
        for j in range(model.njnt)
        if model.jnt_limited[j] and j not in driven and _single(model, j)
    ]
    touch = {frozenset(int(model.body_weldid[_body(model, b)]) for b in pair) for pair in settings.touch}
    touch |= _touching(model, start[None]) | (set() if states is None else _touching(model, states))
    return Limits(tuple(found), _reach(drives, found, low, high), force, frozenset(touch))


def _range(model: mujoco.MjModel, joint: int, start: np.ndarray) -> Limit:
    """The range of a joint that nothing drives, but which moves along; it may rest on a stop."""
    low, high = (float(x) for x in model.jnt_range[joint])
    column = int(model.jnt_qposadr[joint])
    low, high, source = _yielding(low, high, float(start[column]), "range")
    return Limit("position", joint_name(model, joint), _unit(model, joint), low, high, source, column)


def _yielding(low: float, high: float, at: float, source: str) -> tuple[float, float, str]:
    """Limits of a position, moved a little where a joint rests on its stop, which is soft, and who says so."""
    gives = STOP * (high - low)
    if low < at < high:
        return low, high, source
    return low - gives * (at <= low), high + gives * (at >= high), f"{source}, and what its stop gives"


def _single(model: mujoco.MjModel, joint: int) -> bool:
    return int(model.jnt_type[joint]) in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def _of_drive(
    model: mujoco.MjModel, drive: Drive, settings: PlanSettings, start: np.ndarray, states: np.ndarray | None
) -> list[Limit]:
    """Position, velocity and acceleration of a driven joint."""
    if drive.joint < 0:
        return []
    unit, name = _unit(model, drive.joint), drive.name
    low, high, source = _interval(model, drive, settings, float(start[drive.position]), states)
    at = float(start[drive.position])
    if not low - STOP * (high - low) <= at <= high + STOP * (high - low):
        raise InputError(
            f"plan: {name} starts at {at:.4g} {unit}, outside its limits from {low:.4g} to {high:.4g} ({source}); "
            f"set plan.start or plan.position of {name}"
        )
    low, high, source = _yielding(low, high, at, source)
    speed, said = _given(settings.velocity, name), "plan.velocity"
    if speed is None and states is not None and np.ptp(states[:, drive.velocity]) > 0:
        speed, said = float(np.quantile(np.abs(states[:, drive.velocity]), SHOWN)), "what the log showed"
    if speed is None:
        speed, said = SPEED[unit], "no velocity given and no log"
    rise, why = _given(settings.acceleration, name), "plan.acceleration"
    if rise is None:
        rise, why = speed / RISE, f"the largest velocity within {RISE:g} s"
    return [
        Limit("position", name, unit, float(low), float(high), source, drive.position),
        Limit("velocity", name, f"{unit}/s", -speed, speed, said, drive.velocity),
        Limit("acceleration", name, f"{unit}/s²", -rise, rise, why, drive.velocity),
    ]


def _interval(
    model: mujoco.MjModel, drive: Drive, settings: PlanSettings, at: float, states: np.ndarray | None
) -> tuple[float, float, str]:
    """Lowest and highest position of a driven joint, and who says so."""
    if drive.name in settings.position:
        return *settings.position[drive.name], "plan.position"
    if model.jnt_limited[drive.joint]:
        low, high = (float(x) for x in model.jnt_range[drive.joint])
        return low, high, "range"
    if states is not None and np.ptp(states[:, drive.position]) > 0:
        low, high = float(states[:, drive.position].min()), float(states[:, drive.position].max())
        wide = WIDER * (high - low)
        return min(low - wide, at), max(high + wide, at), "what the log showed, half as far again to each side"
    away = AWAY[_unit(model, drive.joint)]
    return at - away, at + away, "no range and no log: around the start"


def _given(value: float | Mapping[str, float] | None, name: str) -> float | None:
    return value.get(name) if isinstance(value, Mapping) else value


def _forces(
    model: mujoco.MjModel, drives: Sequence[Drive], settings: PlanSettings, commands: np.ndarray | None
) -> tuple[np.ndarray, list[str]]:
    """Largest force of each actuator, and who says so."""
    force, sources = np.full(model.nu, np.inf), [""] * model.nu
    efforts = {a for d in drives for a, kind in zip(d.actuators, d.takes, strict=True) if kind == "effort"}
    for a, name in enumerate(object_names(model, "actuator")):
        if (given := _given(settings.force, name)) is not None:
            force[a], sources[a] = given, "plan.force"
        elif model.actuator_forcelimited[a]:
            force[a], sources[a] = np.abs(model.actuator_forcerange[a]).min(), "forcerange"
        elif a in efforts and not model.actuator_ctrllimited[a] and commands is not None:
            shown = np.abs(commands[:, a]).max() * abs(model.actuator_gainprm[a, 0])
            if shown > 0:
                force[a], sources[a] = shown, "what the log showed"
    return force, sources


def _reach(drives: Sequence[Drive], limits: Sequence[Limit], low: np.ndarray, high: np.ndarray) -> Reach:
    """How far each drive may go."""
    ends = {(x.kind, x.name): (x.low, x.high) for x in limits}
    columns = []
    for d in drives:
        if d.joint < 0:
            a = d.actuators[0]
            if not np.isfinite([low[a], high[a]]).all():
                raise InputError(
                    f"model: actuator {d.name} moves no single joint, and has no ctrlrange; give it one, so that the "
                    "plan knows how far its command may go"
                )
            columns.append((low[a], high[a], np.inf, np.inf))
        else:
            speed, rise = ends["velocity", d.name][1], ends["acceleration", d.name][1]
            columns.append((*ends["position", d.name], speed, rise))
    return Reach(*np.array(columns).T)


def _touching(model: mujoco.MjModel, states: np.ndarray, most: int = 400) -> set[frozenset[int]]:
    """Pairs of bodies that touch in some states."""
    data, found = mujoco.MjData(model), set[frozenset[int]]()
    if not touchable(model):
        return found
    for row in evenly(len(states), most):
        data.qpos[:] = states[row, : model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        found |= {bodies for bodies, _ in contacts(model, data)}
    return found


def _unit(model: mujoco.MjModel, joint: int) -> str:
    return "rad" if int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_HINGE else "m"


def check_names(model: mujoco.MjModel, drives: Sequence[Drive], settings: PlanSettings) -> None:
    """Raise an :class:`InputError` for a limit, or a start, of what is not there."""
    joints, actuators = [d.name for d in drives if d.joint >= 0], object_names(model, "actuator")
    every = [joint_name(model, j) for j in range(model.njnt) if _single(model, j)]
    for key, known in (("velocity", joints), ("acceleration", joints), ("position", joints), ("force", actuators),
                       ("start", every)):  # fmt: skip
        given = getattr(settings, key)
        for name in given if isinstance(given, Mapping) else ():
            if name not in known:
                what = {"force": "actuator", "start": "hinge or slide"}.get(key, "joint that an actuator moves")
                raise InputError(f"plan.{key}: no {what} {name!r}" + choices(name, known))


def _frame(model: mujoco.MjModel, name: str) -> int:
    """Number of a site, counted after all bodies, or of a body."""
    sites, bodies = object_names(model, "site"), object_names(model, "body")
    if name in sites:
        return model.nbody + sites.index(name)
    if name in bodies:
        return bodies.index(name)
    raise InputError(f"plan.workspace: no site and no body {name!r}" + choices(name, [*sites, *bodies]))


def _body(model: mujoco.MjModel, name: str) -> int:
    bodies = object_names(model, "body")
    if name not in bodies:
        raise InputError(f"plan.touch: no body {name!r}" + choices(name, bodies))
    return bodies.index(name)
