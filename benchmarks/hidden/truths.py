"""Logs of a system in which effects are hidden: explicit forces, signal filters and added bodies, finely stepped.

The truth is integrated by an explicit midpoint rule of second order, twenty or more steps to a logged
transition, in which ``mj_step1`` and ``mj_forwardSkip`` give the accelerations at the predicted midpoint and
every hidden force is evaluated there too. A few effects have no force of their own and change the model of
the truth: ``armature``, ``center_of_mass``, ``joint_limit``, ``ground_slope`` and the contact's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from benchmarks.hidden.systems import DT, System, load
from dropo_torch.data.observation import Observation, parse_observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.parameters import ParameterSpace

#: Logged steps for which an episode runs, at its first command, before the log sets in.
PREROLL = 5
#: Typical standard deviations of the measurement: positions, velocities.
POSITION_NOISE, VELOCITY_NOISE = 2e-5, 5e-4
#: Noises that differ much: standard deviations of positions and velocities; and by how much one sensor is worse.
UNEQUAL = {"fine_positions": (2e-5, 5e-4), "rough_positions": (1e-3, 1e-4), "coarse_velocities": (5e-6, 3e-3)}
ONE_ROUGH, ROUGHER = "one_rough", 20.0


@dataclass(frozen=True)
class Effect:
    """A hidden effect: its name, what carries it (``None`` for the world) and its parameters."""

    name: str
    target: str | None
    parameters: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Before:
    """What was before a log that begins in motion, and is not in it.

    Attributes:
        seconds: range of how long it was.
        quiet: whether the commands of that time were zero; otherwise they were like those of the log.
    """

    seconds: tuple[float, float] = (0.3, 1.0)
    quiet: bool = False


@dataclass(frozen=True)
class Case:
    """A log in which effects are hidden, and what is needed to judge an answer.

    Attributes:
        name: what the case is called.
        kind: ``null``, ``single``, ``double`` or ``outside``.
        system: the system's name.
        model: the MJCF that a user has.
        config: the project's config of it.
        trajectories: the log.
        effects: what is hidden.
        equivalents: for each effect, the (effect, target) pairs that are as right an answer.
        ties: for each effect, those of them that are exactly the same thing on this log, each of which is to be told.
        declared: the true values of the declared parameters.
        noise: standard deviation of each column of the log.
        gap_ratio: the gap beside the noise, once the declared parameters are at their best; see ``cases.py``.
        trait: what is unusual about the case; empty for the plain ones.
    """

    name: str
    kind: str
    system: str
    model: str
    config: Mapping[str, Any]
    trajectories: Trajectories
    effects: tuple[Effect, ...] = ()
    equivalents: tuple[tuple[tuple[str, str | None], ...], ...] = ()
    ties: tuple[tuple[tuple[str, str | None], ...], ...] = ()
    declared: Mapping[str, float] = field(default_factory=dict)
    noise: tuple[float, ...] = ()
    gap_ratio: float = 0.0
    trait: str = ""

    def write(self, folder: str | Path) -> Path:
        """Write model, log and config into a folder; return the config's path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "model.xml").write_text(self.model, encoding="utf-8")
        log = self.trajectories
        np.savez(
            folder / "log.npz",
            observations=log.observations,
            next_observations=log.next_observations,
            actions=log.actions,
            terminals=log.terminals,
            dt=DT,
        )
        path = folder / "config.yaml"
        path.write_text(yaml.safe_dump(dict(self.config), sort_keys=False), encoding="utf-8")
        return path


Force = Callable[["Plant"], None]


# --- the plant ------------------------------------------------------------------------------------------------


class Plant:
    """A robot: the model with everything hidden in it, stepped finely.

    Attributes:
        model, data: MuJoCo's; ``data`` holds the predicted midpoint while forces are evaluated.
        q, v, a: state at the start of the fine step, and the last step's acceleration.
        middle_q, middle_v: the predicted midpoint.
        t: seconds since the episode's start; ``h`` the fine step.
        force: generalized force of the effects, to which each adds.
        commands: the logged commands of the episode so far.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.substeps, self.h = substeps, DT / substeps
        model.opt.timestep = self.h
        self.forces: list[Force] = []
        self.memories: list[Callable[[], None]] = []
        self.watch: Callable[[Plant], None] | None = None
        self._scalar = bool(np.isin(model.jnt_type, (2, 3)).all())
        self.force = self.data.qfrc_applied
        self.middle_q, self.middle_v = self.data.qpos, self.data.qvel
        self.commands: list[np.ndarray] = []

    def reset(self, q: np.ndarray, v: np.ndarray, command: np.ndarray) -> None:
        """Start an episode; ``command`` was held for long."""
        mujoco.mj_resetData(self.model, self.data)
        self.q, self.v, self.a = q.copy(), v.copy(), np.zeros(self.model.nv)
        self.t, self.commands = 0.0, [command]
        for forget in self.memories:
            forget()

    def advance(self, command: np.ndarray, constant: np.ndarray | None) -> None:
        """One logged transition."""
        self.commands.append(command)
        model, data, h = self.model, self.data, self.h
        half = 0.5 * h
        data.ctrl[:] = command
        if constant is not None:
            data.xfrc_applied[:] = constant
        forces, qpos, qvel, qacc, warmstart = self.forces, data.qpos, data.qvel, data.qacc, data.qacc_warmstart
        q, v, a = self.q, self.v, self.a
        for _ in range(self.substeps):
            self._drift(qpos, q, v, half)
            np.multiply(a, half, out=qvel)
            qvel += v
            if forces:
                mujoco.mj_step1(model, data)
                self.force.fill(0.0)
                for force in forces:
                    force(self)
                mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_VEL, 1)
            else:
                mujoco.mj_forward(model, data)
            a[:] = qacc
            warmstart[:] = qacc
            v += half * a
            self._drift(q, q, v, h)
            v += half * a
            self.t += h
            if self.watch is not None:
                self.watch(self)
        self.q, self.v = q, v

    def _drift(self, out: np.ndarray, q: np.ndarray, v: np.ndarray, seconds: float) -> None:
        if self._scalar:
            np.add(q, seconds * v, out=out)
        else:
            out[:] = q
            mujoco.mj_integratePos(self.model, out, v, seconds)

    def dof(self, joint: str) -> int:
        """The degree of freedom of a hinge or slide."""
        return int(self.model.joint(joint).dofadr[0])

    def address(self, joint: str) -> int:
        """The position entry of a hinge or slide."""
        return int(self.model.joint(joint).qposadr[0])


# --- forces at joints -----------------------------------------------------------------------------------------


def _velocity_force(law: Callable[[float], float]) -> Callable[[Plant, str], Force]:
    def make(plant: Plant, joint: str) -> Force:
        i = plant.dof(joint)

        def force(p: Plant) -> None:
            p.force[i] += law(float(p.middle_v[i]))

        return force

    return make


def _position_force(law: Callable[[float], float]) -> Callable[[Plant, str], Force]:
    def make(plant: Plant, joint: str) -> Force:
        i, j = plant.dof(joint), plant.address(joint)

        def force(p: Plant) -> None:
            p.force[i] += law(float(p.middle_q[j]))

        return force

    return make


def _dry_friction(plant: Plant, joint: str, level: Callable[[float, float], float]) -> Force:
    """Friction that sticks: it stops the joint within one fine step where the level (of q, |v|) suffices.

    It has to come after all other forces: what it must balance is their acceleration.
    """
    i, j = plant.dof(joint), plant.address(joint)
    unit = np.zeros((1, plant.model.nv))
    unit[0, i] = 1.0
    column = np.zeros_like(unit)

    def force(p: Plant) -> None:
        v = float(p.v[i])
        mujoco.mj_forwardSkip(p.model, p.data, mujoco.mjtStage.mjSTAGE_VEL, 1)
        limit = level(float(p.middle_q[j]), abs(v))
        mujoco.mj_solveM(p.model, p.data, column, unit)
        stopping = -(v / p.h + float(p.data.qacc[i])) / column[0, i]
        p.force[i] += min(max(stopping, -limit), limit)

    return force


def neighbor(model: mujoco.MjModel, joint: str) -> str:
    """The nearest hinge or slide above a joint in the kinematic chain; below it, for the first."""
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] in (2, 3)]
    number = model.joint(joint).id
    body = int(model.jnt_bodyid[number])
    above = [j for j in scalar if j < number and int(model.jnt_bodyid[j]) in (body, *_ancestors(model, body))]
    if above:
        return model.joint(max(above)).name
    below = [j for j in scalar if j > number and body in (b := int(model.jnt_bodyid[j]), *_ancestors(model, b))]
    return model.joint(min(below)).name


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found


def _coupling(plant: Plant, joint: str, stiffness: float) -> Force:
    other = neighbor(plant.model, joint)
    i, j = plant.dof(joint), plant.dof(other)
    a, b = plant.address(joint), plant.address(other)

    def force(p: Plant) -> None:
        pull = stiffness * float(p.middle_q[a] - p.middle_q[b])
        p.force[i] -= pull
        p.force[j] += pull

    return force


def _load_friction(plant: Plant, joint: str, coefficient: float) -> Force:
    i = plant.dof(joint)
    return _dry_friction(plant, joint, lambda _q, _v: coefficient * abs(float(plant.data.qfrc_actuator[i])))


#: Steps of a rotor, and of bristles, in a fine step.
_ROTOR_STEPS, _BRISTLE_STEPS = 8, 8


def _elasticity(plant: Plant, joint: str, stiffness: float, damping: float, inertia: float) -> Force:
    """A rotor of its own, which the joint's actuator drives in place of the joint, and a spring between the two."""
    i, j, model = plant.dof(joint), plant.address(joint), plant.model
    own = [a for a in range(model.nu) if model.actuator_trnid[a, 0] == model.joint(joint).id]
    gear, rotor = model.actuator_gear[own, 0], np.full(2, np.nan)
    stiff, damp = ((gear**2 * model.actuator_biasprm[own, k]).sum() for k in (1, 2))

    def forget() -> None:
        rotor[:] = np.nan

    def force(p: Plant) -> None:
        mujoco.mj_fwdActuation(p.model, p.data)
        given, q, v = float(p.data.qfrc_actuator[i]), float(p.middle_q[j]), float(p.middle_v[i])
        if np.isnan(rotor[0]):
            rotor[:] = q + given / (stiffness - stiff), v
        h, pull = p.h / _ROTOR_STEPS, 0.0
        for _ in range(_ROTOR_STEPS):
            spring = stiffness * (rotor[0] - q) + damping * (rotor[1] - v)
            rotor[1] += h * (given + stiff * (rotor[0] - q) + damp * (rotor[1] - v) - spring) / inertia
            rotor[0] += h * rotor[1]
            pull += spring / _ROTOR_STEPS
        p.force[i] += pull - given

    plant.memories.append(forget)
    return force


def _presliding(plant: Plant, joint: str, coulomb: float, displacement: float) -> Force:
    """Dahl's friction: a spring that yields, and remembers."""
    i = plant.dof(joint)
    memory = {"z": 0.0}

    def forget() -> None:
        memory["z"] = 0.0

    def force(p: Plant) -> None:
        v, z = float(p.middle_v[i]), memory["z"]
        toward, share = math.copysign(1.0, v), math.exp(-abs(v) * p.h / displacement)
        memory["z"] = toward + (z - toward) * share
        p.force[i] -= 0.5 * coulomb * (z + memory["z"])

    plant.memories.append(forget)
    return force


def _lugre(plant: Plant, joint: str, coulomb: float, displacement: float, static: float, velocity: float) -> Force:
    """LuGre friction without bristle damping: the deflection of the bristles, in meters or radians, by Euler steps."""
    i, stiffness, level = plant.dof(joint), coulomb / displacement, _stribeck_level(coulomb, static, velocity)
    memory = {"z": 0.0}

    def forget() -> None:
        memory["z"] = 0.0

    def force(p: Plant) -> None:
        v, before = float(p.middle_v[i]), memory["z"]
        for _ in range(_BRISTLE_STEPS):
            memory["z"] += p.h / _BRISTLE_STEPS * (v - stiffness * abs(v) / level(0.0, v) * memory["z"])
        p.force[i] -= 0.5 * stiffness * (before + memory["z"])

    plant.memories.append(forget)
    return force


def _stribeck_level(coulomb: float, static: float, velocity: float) -> Callable[[float, float], float]:
    return lambda _q, speed: coulomb + (static - coulomb) * math.exp(-((speed / velocity) ** 2))


#: Effects on a joint: (plant, joint, parameters) → force.
JOINT_FORCES: dict[str, Callable[[Plant, str, Mapping[str, float]], Force]] = {
    "joint_damping": lambda p, j, x: _velocity_force(lambda v: -x["damping"] * v)(p, j),
    "joint_quadratic_damping": lambda p, j, x: _velocity_force(lambda v: -x["coefficient"] * v * abs(v))(p, j),
    "joint_stiffness": lambda p, j, x: _position_force(lambda q: -x["stiffness"] * (q - x["reference"]))(p, j),
    "joint_cogging": lambda p, j, x: _position_force(lambda q: x["amplitude"] * math.sin(x["poles"] * q + x["phase"]))(
        p, j
    ),
    "joint_friction": lambda p, j, x: _dry_friction(p, j, lambda _q, _v: x["friction"]),
    "joint_stribeck": lambda p, j, x: _dry_friction(p, j, _stribeck_level(x["coulomb"], x["static"], x["velocity"])),
    "joint_load_friction": lambda p, j, x: _load_friction(p, j, x["coefficient"]),
    "joint_presliding": lambda p, j, x: _presliding(p, j, x["coulomb"], x["displacement"]),
    "joint_lugre": lambda p, j, x: _lugre(p, j, x["coulomb"], x["displacement"], x["static"], x["velocity"]),
    "joint_elasticity": lambda p, j, x: _elasticity(p, j, 1 / x["compliance"], x["damping"], x["inertia"]),
    "joint_coupling": lambda p, j, x: _coupling(p, j, x["stiffness"]),
}
#: Those with sticking, which are evaluated last; and the one of them that no vocabulary knows.
DRY, UNEVEN = ("joint_friction", "joint_stribeck", "joint_load_friction"), "uneven_friction"


# --- forces on bodies -----------------------------------------------------------------------------------------


def largest_geom(model: mujoco.MjModel, body: int) -> int:
    """The geom of a body with the largest bounding sphere."""
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    return first + int(np.argmax(model.geom_rbound[first : first + count]))


def semi_axes(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The half-lengths of the ellipsoid that stands for a geom in a medium."""
    kind, (a, b, c) = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.array([a, a, a])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([a, a, a + b])
    return np.array([a, a, b]) if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else np.array([a, b, c])


def _drag(plant: Plant, body: str, x: Mapping[str, float]) -> Force:
    """Drag against a geom's motion with the area that faces it, 1 for the broadest side; none against its rotation."""
    number = plant.model.body(body).id
    geom = largest_geom(plant.model, number)
    axes = semi_axes(plant.model, geom)
    facing = axes.prod() / axes
    facing /= facing.max()
    twist, torque = np.zeros(6), np.zeros(3)

    def force(p: Plant) -> None:
        mujoco.mj_objectVelocity(p.model, p.data, mujoco.mjtObj.mjOBJ_GEOM, geom, twist, 0)
        velocity = twist[3:]
        along = p.data.geom_xmat[geom].reshape(3, 3).T @ velocity
        least = max(float(((facing * along) ** 2).sum()), 1e-300)
        area = math.sqrt(float((facing**4 * along**2).sum()) / least)
        push = -x["coefficient"] * area * math.sqrt(float(velocity @ velocity)) * velocity
        mujoco.mj_applyFT(p.model, p.data, push, torque, p.data.geom_xpos[geom], number, p.force)

    return force


def tilt(roll: float, pitch: float) -> np.ndarray:
    """The rotation about world x by ``roll``, then about world y by ``pitch``."""
    c, s, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ about_x


def constant_forces(model: mujoco.MjModel, effects: Sequence[Effect]) -> np.ndarray | None:
    """Forces at the bodies' centers of mass, ``(nbody, 6)``: external forces, and gravity's change when tilted."""
    wrench = np.zeros((model.nbody, 6))
    for e in effects:
        x = e.parameters
        if e.name == "external_force":
            wrench[model.body(e.target).id, :3] += (x["x"], x["y"], x["z"])
        elif e.name == "gravity_tilt":
            change = tilt(x["roll"], x["pitch"]) @ model.opt.gravity - model.opt.gravity
            wrench[1:, :3] += model.body_mass[1:, None] * change
    return wrench if wrench.any() else None


# --- commands and actuators -----------------------------------------------------------------------------------

#: Effects of an actuator, whose force is then computed by hand.
DRIVE = frozenset({
    "actuator_gain", "actuator_stiffness", "actuator_bias", "actuator_damping", "actuator_saturation",
    "actuator_delay", "actuator_lag", "actuator_deadband", "actuator_backlash", "dropout", "gain_drift",
})  # fmt: skip
#: Effects of a geom's contacts.
CONTACT = ("contact_friction", "contact_stiffness", "contact_margin")


def _held(plant: Plant, actuator: int, delay: float) -> float:
    """The mean of the command, delayed, over the fine step that begins; before the log it is the first one."""
    commands = plant.commands  # the first entry was held before the log
    start, end = (plant.t - delay) / DT, (plant.t - delay + plant.h) / DT
    a, b = math.floor(start + 1e-9), math.floor(end - 1e-9)
    first = float(commands[min(max(a + 1, 0), len(commands) - 1)][actuator])
    if a >= b:
        return first
    second = float(commands[min(max(b + 1, 0), len(commands) - 1)][actuator])
    share = (b - start) / (end - start)
    return share * first + (1.0 - share) * second


class CommandPath:
    """From the logged command of one actuator to what drives it: delay, lag, dead band, backlash."""

    def __init__(self, plant: Plant, actuator: int, effects: Sequence[Effect]) -> None:
        x = {e.name: e.parameters for e in effects}
        self.delay = x.get("actuator_delay", {}).get("delay", 0.0)
        self.time_constant = x.get("actuator_lag", {}).get("time_constant", 0.0)
        self.band = x.get("actuator_deadband", {}).get("width", 0.0)
        self.play = 0.5 * x.get("actuator_backlash", {}).get("width", 0.0)
        self.actuator, self.plant = actuator, plant
        self.forget()
        plant.memories.append(self.forget)

    def forget(self) -> None:
        """Settle at the first command."""
        self.state = float(self.plant.commands[0][self.actuator]) if self.plant.commands else 0.0
        self.output = self.state

    def __call__(self, plant: Plant) -> float:
        """The command at the middle of the fine step."""
        u = _held(plant, self.actuator, self.delay)
        if self.time_constant > 0:
            decay = math.exp(-0.5 * plant.h / self.time_constant)
            middle = u + (self.state - u) * decay
            self.state = u + (middle - u) * decay
            u = middle
        if self.band > 0:
            u = math.copysign(max(abs(u) - self.band, 0.0), u)
        if self.play > 0:
            self.output = min(max(self.output, u - self.play), u + self.play)
            u = self.output
        return u


def _drive(plant: Plant, actuator: str, effects: Sequence[Effect]) -> Force:
    """An actuator of the truth: its force by hand, in place of MuJoCo's."""
    model = plant.model
    number = model.actuator(actuator).id
    joint = int(model.actuator_trnid[number, 0])
    i, j = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
    gear = float(model.actuator_gear[number, 0])
    gain, bias = float(model.actuator_gainprm[number, 0]), model.actuator_biasprm[number, :3].copy()
    low, high = model.actuator_ctrlrange[number] if model.actuator_ctrllimited[number] else (-np.inf, np.inf)
    model.actuator_gainprm[number, :3] = 0.0
    model.actuator_biasprm[number, :3] = 0.0
    path = CommandPath(plant, number, effects)
    x = {e.name: e.parameters for e in effects}
    factor = x.get("actuator_gain", {}).get("gain", 1.0)
    kp = x.get("actuator_stiffness", {}).get("factor", 1.0)
    constant = x.get("actuator_bias", {}).get("force", 0.0)
    damping = x.get("actuator_damping", {}).get("damping", 0.0)
    limit = x.get("actuator_saturation", {}).get("limit", np.inf)
    dropouts = x.get("dropout", {})
    drift = x.get("gain_drift", {})

    def force(p: Plant) -> None:
        u = min(max(path(p), low), high)
        length, speed = gear * float(p.middle_q[j]), gear * float(p.middle_v[i])
        f = factor * (kp * (gain * u + bias[1] * length) + bias[0] + bias[2] * speed) + constant - damping * speed
        if dropouts and _dropped(p.t, dropouts):
            f = 0.0
        if drift:
            f *= 1.0 - drift["loss"] * (1.0 - math.exp(-p.t / drift["seconds"]))
        p.force[i] += gear * min(max(f, -limit), limit)

    return force


def _dropped(t: float, x: Mapping[str, float]) -> bool:
    """Whether the actuator is out: once in a period, for a while, at an instant that changes with every period."""
    count, within = divmod(t, x["period"])
    start = (0.5 + 0.5 * math.sin(12.9898 * (count + 1) + x["phase"])) * (x["period"] - x["duration"])
    return start <= within < start + x["duration"]


# --- what no vocabulary knows ---------------------------------------------------------------------------------


def _ripple(plant: Plant, joint: str, x: Mapping[str, float]) -> Force:
    """A torque that is periodic in time."""
    i = plant.dof(joint)

    def force(p: Plant) -> None:
        p.force[i] += x["amplitude"] * math.sin(2 * math.pi * x["frequency"] * (p.t + 0.5 * p.h) + x["phase"])

    return force


def _uneven_friction(plant: Plant, joint: str, x: Mapping[str, float]) -> Force:
    """Dry friction that changes with the position."""
    return _dry_friction(plant, joint, lambda q, _v: x["friction"] * (1 + math.sin(x["waves"] * q + x["phase"])))


def _far_spring(plant: Plant, body: str, x: Mapping[str, float]) -> Force:
    """A spring from a point of a body to a point fixed in the world."""
    number = plant.model.body(body).id
    anchor, torque = np.array([x["x"], x["y"], x["z"]]), np.zeros(3)

    def force(p: Plant) -> None:
        point = p.data.xipos[number]
        line = anchor - point
        length = math.sqrt(float(line @ line)) + 1e-12
        pull = x["stiffness"] * (length - x["rest"]) / length * line
        mujoco.mj_applyFT(p.model, p.data, pull, torque, point, number, p.force)

    return force


#: Forces outside the vocabulary: (plant, target, parameters) → force.
OUTSIDE_FORCES: dict[str, Callable[[Plant, str, Mapping[str, float]], Force]] = {
    "torque_ripple": _ripple,
    "far_spring": _far_spring,
}


# --- what has to change the model -----------------------------------------------------------------------------


#: Effects for which a model is compiled anew.
BUILT = frozenset({"payload", "inertia", "slosh", "center_of_mass"})


def _added_bodies(spec: mujoco.MjSpec, base: mujoco.MjModel, effects: Sequence[Effect]) -> None:
    """Weld or hang further bodies: payloads, rotational inertia, a mass that slides on a spring."""
    for n, e in enumerate(effects):
        x = e.parameters
        if e.name == "center_of_mass":
            spec.body(e.target).simple = False  # or MuJoCo takes its center for its frame's origin
        elif e.name == "payload" and x["mass"] > 0:
            _weld(spec, e.target, f"payload{n}", [x["x"], x["y"], x["z"]], x["mass"], [1e-9] * 3)
        elif e.name == "inertia" and x["factor"] > 1:
            own = base.body(e.target)
            inertia = (x["factor"] - 1) * own.inertia
            largest = int(inertia.argmax())  # of a flat body the sum of the others, which rounding may make too little
            inertia[largest] = min(inertia[largest], (1 - 1e-12) * (inertia.sum() - inertia[largest]))
            _weld(spec, e.target, f"inertia{n}", own.ipos, 1e-9, inertia, quat=own.iquat)
        elif e.name == "slosh":
            place = [x["x"], x["y"], x["z"]]
            body = _weld(spec, e.target, f"slosh{n}", place, x["mass"], [1e-9] * 3)
            body.add_joint(
                name=f"slosh{n}",
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=[x["axis_x"], x["axis_y"], x["axis_z"]],
                stiffness=[x["mass"] * (2 * math.pi * x["frequency"]) ** 2, 0, 0],
                damping=[2 * x["damping_ratio"] * x["mass"] * 2 * math.pi * x["frequency"], 0, 0],
            )


def _weld(
    spec: mujoco.MjSpec, parent: str | None, name: str, pos: Any, mass: float, inertia: Any, quat: Any = (1, 0, 0, 0)
) -> Any:
    return spec.body(parent).add_body(
        name=name, pos=pos, quat=quat, mass=mass, inertia=inertia, ipos=[0, 0, 0], explicitinertial=True
    )


def _change_model(model: mujoco.MjModel, e: Effect) -> None:
    x = e.parameters
    if e.name == "armature":
        model.dof_armature[model.joint(e.target).dofadr[0]] += x["armature"]
    elif e.name == "joint_elasticity":
        dof = model.joint(e.target).dofadr[0]
        model.dof_armature[dof] = max(model.dof_armature[dof] - x["inertia"], 0.0)
    elif e.name == "center_of_mass":
        model.body(e.target).ipos[:] += (x["x"], x["y"], x["z"])
    elif e.name == "inertia" and x["factor"] < 1:
        model.body(e.target).inertia[:] *= x["factor"]
    elif e.name == "joint_limit":
        model.joint(e.target).range[:] += (x["lower"], x["upper"])
    elif e.name == "ground_slope":
        for g in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, model.geom_quat[g])
            mujoco.mju_mat2Quat(model.geom_quat[g], (tilt(x["roll"], x["pitch"]) @ own.reshape(3, 3)).reshape(-1))
    elif e.name in CONTACT:
        _change_contact(model, model.geom(e.target).id, e)


def _change_contact(model: mujoco.MjModel, geom: int, e: Effect) -> None:
    x = e.parameters
    if e.name == "contact_friction":
        model.geom_friction[geom, 0] = x["friction"]
        model.geom_priority[geom], model.geom_condim[geom] = 1, model.geom_condim.max()  # whatever it touches
    elif e.name == "contact_stiffness":
        model.geom_solref[geom] = (x["time_constant"], x["damping_ratio"])
        model.geom_solmix[geom] = 1e9  # its solref rules whatever it touches
    elif e.name == "contact_margin" and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:  # it rises
        normal = np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
        model.geom_pos[geom] += x["margin"] * normal
    elif e.name == "contact_margin":  # the geom grows; mass and inertia stay
        thickness = {int(mujoco.mjtGeom.mjGEOM_CYLINDER): 1, int(mujoco.mjtGeom.mjGEOM_BOX): 2}
        model.geom_size[geom, thickness.get(int(model.geom_type[geom]), 0)] += x["margin"]
        model.geom_rbound[geom] += x["margin"]
        model.geom_aabb[geom, 3:] += x["margin"]


# --- putting it together --------------------------------------------------------------------------------------


def true_model(system: System, declared: Mapping[str, float], effects: Sequence[Effect] = ()) -> mujoco.MjModel:
    """Return the system's model with the true declared values and whatever effects must change it."""
    space = ParameterSpace(load(system.xml), system.declared)  # type: ignore[arg-type]
    model = space.apply(declared)
    if any(e.name in BUILT for e in effects):
        spec = mujoco.MjSpec.from_string(system.xml)
        _added_bodies(spec, model, effects)
        model = ParameterSpace(spec.compile(), system.declared).apply(declared)  # type: ignore[arg-type]
    for e in effects:
        _change_model(model, e)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for e in effects:
        if e.name in ("payload", "inertia"):
            _touch_as_one(model, model.body(e.target).id)
    return model


def _touch_as_one(model: mujoco.MjModel, body: int) -> None:
    """Make a body's contacts as stiff as those of one rigid body with all that is welded to it.

    A contact's stiffness grows with the inertia of the bodies that touch, which MuJoCo takes at the center of mass of
    each; two bodies that are welded together are to it not what one with the mass of both is.
    """
    data, whole = mujoco.MjData(model), [body]
    whole += [b for b in range(model.nbody) if model.body_parentid[b] == body and model.body_jntnum[b] == 0]
    mujoco.mj_forward(model, data)
    center = np.average(data.xipos[whole], axis=0, weights=model.body_mass[whole])
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, center, body)
    solved = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, solved, jacobian)
    model.body_invweight0[body, 0] = (jacobian * solved).sum() / 3


def make_plant(system: System, declared: Mapping[str, float], effects: Sequence[Effect], substeps: int) -> Plant:
    """Return the robot."""
    model = true_model(system, declared, effects)
    model.opt.tolerance = 1e-10
    plant = Plant(model, substeps)
    driven: dict[str, list[Effect]] = {}
    for e in effects:
        if e.name in DRIVE:
            driven.setdefault(str(e.target), []).append(e)
        elif e.name in JOINT_FORCES and e.name not in DRY:
            plant.forces.append(JOINT_FORCES[e.name](plant, str(e.target), e.parameters))
        elif e.name in OUTSIDE_FORCES:
            plant.forces.append(OUTSIDE_FORCES[e.name](plant, str(e.target), e.parameters))
        elif e.name == "fluid_drag":
            plant.forces.append(_drag(plant, str(e.target), e.parameters))
    plant.forces += [_drive(plant, actuator, of) for actuator, of in driven.items()]
    dry = [JOINT_FORCES[e.name](plant, str(e.target), e.parameters) for e in effects if e.name in DRY]
    plant.forces += dry + [_uneven_friction(plant, str(e.target), e.parameters) for e in effects if e.name == UNEVEN]
    return plant


@dataclass(frozen=True)
class Log:
    """Episodes as they were sensed without noise.

    Attributes:
        states: of each episode, ``(steps + 1, nq + nv)``.
        commands: of each episode, ``(steps, m)``.
        unlogged: commands from before each episode's first row, the last of them last; what was before them was
            their first.
    """

    states: tuple[np.ndarray, ...]
    commands: tuple[np.ndarray, ...]
    unlogged: tuple[np.ndarray, ...]


def excitation(system: System, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Smooth commands, ``(steps, m)``: multi-sines, now and then a chirp."""
    t = DT * np.arange(steps)
    out = np.empty((steps, len(system.commands)))
    for column, c in enumerate(system.commands):
        low, high = c.band
        if rng.uniform() < 0.25:
            sweep = low + (high - low) * t / t[-1]
            wave = np.sin(2 * np.pi * np.cumsum(sweep) * DT + rng.uniform(0, 2 * np.pi))
        else:
            frequency = np.exp(rng.uniform(np.log(low), np.log(high), 6))
            wave = np.sin(2 * np.pi * np.outer(t, frequency) + rng.uniform(0, 2 * np.pi, 6)).sum(1)
            wave /= np.abs(wave).max()
        out[:, column] = c.amplitude * rng.uniform(0.7, 1.0) * wave
    return out


def start_state(system: System, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random start, ``qpos`` and ``qvel`` of the user's model."""
    model = load(system.xml)
    q, v = model.qpos0.copy(), np.zeros(model.nv)
    for joint, (position, velocity) in system.start.items():
        j = model.joint(joint)
        if joint == system.free:
            if system.height:
                _stand(q, v, system.height, position, velocity, rng)
            else:
                (_throw if system.airborne else _slide_off)(model, q, v, velocity, rng)
            continue
        q[j.qposadr[0]] = system.start_mean.get(joint, q[j.qposadr[0]]) + rng.uniform(-position, position)
        v[j.dofadr[0]] = rng.uniform(-velocity, velocity)
    return q, v


def _slide_off(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, velocity: float, rng: np.random.Generator) -> None:
    """A body that lies on the table, with a velocity along it and a spin."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    q[:2], q[2] = rng.uniform(-0.3, 0.3, 2), data.qpos[2]
    turn = rng.uniform(-np.pi, np.pi)
    q[3:7] = (np.cos(turn / 2), 0, 0, np.sin(turn / 2))
    heading = rng.uniform(-np.pi, np.pi)
    v[:2] = velocity * rng.uniform(0.4, 1.0) * np.array([np.cos(heading), np.sin(heading)])
    v[5] = rng.uniform(-4, 4)


def _stand(
    q: np.ndarray, v: np.ndarray, height: float, position: float, velocity: float, rng: np.random.Generator
) -> None:
    """A body upright on its feet, or a little above, that moves a little."""
    turn = rng.uniform(-np.pi, np.pi)
    q[:2], q[2] = rng.uniform(-position, position, 2), height + rng.uniform(0.0, 0.02)
    q[3:7] = (np.cos(turn / 2), 0, 0, np.sin(turn / 2))
    v[:3], v[3:6] = rng.uniform(-velocity, velocity, 3), rng.uniform(-velocity, velocity, 3)


def _throw(_model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, velocity: float, rng: np.random.Generator) -> None:
    """A body in the air that flies and tumbles."""
    turn = rng.standard_normal(4)
    q[:3], q[3:7] = rng.uniform(-0.5, 0.5, 3), turn / np.linalg.norm(turn)
    v[:3], v[3:6] = rng.uniform(-velocity, velocity, 3), rng.uniform(-6, 6, 3)


def record(
    system: System,
    declared: Mapping[str, float],
    effects: Sequence[Effect],
    rng: np.random.Generator,
    *,
    episodes: int | None = None,
    transitions: int | None = None,
    substeps: int | None = None,
    before: Before | None = None,
) -> Log:
    """Simulate a log without noise; sensor effects are in it."""
    plant = make_plant(system, declared, effects, substeps or system.substeps)
    states, commands, unlogged = [], [], []
    for _ in range(episodes or system.episodes):
        steps = transitions or int(rng.integers(system.transitions[0], system.transitions[1] + 1))
        lead = 0 if before is None else round(rng.uniform(*before.seconds) / DT)
        wave = excitation(system, lead + steps, rng)
        quiet = before is not None and before.quiet
        sensed, given = _episode(system, plant, effects, wave, *start_state(system, rng), lead=lead, quiet=quiet)
        states.append(sensed)
        commands.append(given)
        unlogged.append(np.array(plant.commands[: len(plant.commands) - steps]))
    return Log(tuple(states), tuple(commands), tuple(unlogged))


def repeat(
    system: System,
    declared: Mapping[str, float],
    effects: Sequence[Effect],
    log: Log,
    vary: Callable[[np.ndarray], np.ndarray] = lambda commands: commands,
    faster: float = 1.0,
) -> Log:
    """Record the motions of a log again, with its commands varied and without feedback, or started faster."""
    plant, v = make_plant(system, declared, effects, system.substeps), load(system.xml).nq
    free = tuple(replace(c, offset=0.0, hold=(0.0, 0.0), joint="") for c in system.commands)
    states, commands, unlogged = [], [], []
    for logged, given in zip(log.states, log.commands, strict=True):
        start = logged[0, :v], faster * logged[0, v:]
        sensed, held = _episode(replace(system, commands=free), plant, effects, vary(given[None])[0], *start)
        states.append(sensed)
        commands.append(held)
        unlogged.append(np.array(plant.commands[:1]))
    return Log(tuple(states), tuple(commands), tuple(unlogged))


def _episode(
    system: System,
    plant: Plant,
    effects: Sequence[Effect],
    wave: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    *,
    lead: int = 0,
    quiet: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """States as sensed ``(steps + 1, nq + nv)`` and commands ``(steps, m)`` of one episode.

    Of the wave the first ``lead`` steps are not logged, and zero if they are ``quiet``. Without them the first
    command was held for long.
    """
    user = load(system.xml)
    q_index, v_index = _indices(user, plant.model)
    q, v = plant.model.qpos0.copy(), np.zeros(plant.model.nv)
    q[q_index], v[v_index] = qpos, qvel
    constant = constant_forces(plant.model, effects)
    hold = _hold(system, user)
    first = np.zeros(wave.shape[1]) if quiet else hold(wave[0], qpos, qvel)
    plant.reset(q, v, first)
    sensors = Sensors(system, effects, q_index, v_index)
    plant.watch = sensors.see if sensors.delays else None
    sensors.start(plant)
    if lead:
        for excited in wave[:lead]:
            plant.advance(first if quiet else hold(excited, plant.q[q_index], plant.v[v_index]), constant)
    else:
        for _ in range(PREROLL):
            plant.advance(first, constant)
        plant.commands, plant.t = [first], 0.0
    states, commands = [sensors.read(plant)], []  # the log sets in
    for step, excited in enumerate(wave[lead:]):
        command = first if step == lead == 0 else hold(excited, plant.q[q_index], plant.v[v_index])
        plant.advance(command, constant)
        commands.append(command)
        states.append(sensors.read(plant))
    return np.array(states), np.array(commands)


def _hold(system: System, model: mujoco.MjModel) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """The command's law: excitation, and a weak feedback of the actuators that have one."""
    offset = np.array([0.0 if c.joint else c.offset for c in system.commands])
    limit = np.array([c.limit for c in system.commands])
    fed = [(n, c, model.joint(c.joint)) for n, c in enumerate(system.commands) if c.joint]
    places = [(n, c, int(j.qposadr[0]), int(j.dofadr[0])) for n, c, j in fed]

    def law(wave: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        command = wave + offset
        for n, c, a, i in places:
            command[n] -= c.hold[0] * (q[a] - c.offset) + c.hold[1] * v[i]
        return np.clip(command, -limit, limit)

    return law


def _indices(user: mujoco.MjModel, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Where the user's positions and velocities stand in the truth's."""
    q, v = [], []
    for j in range(user.njnt):
        own, there = user.joint(j), model.joint(user.joint(j).name)
        q += range(there.qposadr[0], there.qposadr[0] + len(own.qpos0))
        v += range(there.dofadr[0], there.dofadr[0] + {0: 6, 1: 3}.get(int(user.jnt_type[j]), 1))
    return np.array(q), np.array(v)


class Sensors:
    """What the log says of the state: biases, scales, delays of single columns."""

    def __init__(self, system: System, effects: Sequence[Effect], q_index: np.ndarray, v_index: np.ndarray) -> None:
        observation = observed(system)
        place = dict(zip(observation.labels, observation.columns, strict=True))
        self.q_index, self.v_index = q_index, v_index
        self.bias = {place[str(e.target)]: e.parameters["bias"] for e in effects if e.name == "sensor_bias"}
        self.scale = {place[str(e.target)]: e.parameters["factor"] for e in effects if e.name == "sensor_scale"}
        self.delays = {place[str(e.target)]: e.parameters["delay"] for e in effects if e.name == "sensor_delay"}

    def start(self, plant: Plant) -> None:
        """Forget what was seen."""
        self.seen: list[np.ndarray] = []
        if self.delays:
            self.see(plant)

    def see(self, plant: Plant) -> None:
        """Keep the state of a fine step."""
        self.seen.append(self._state(plant))

    def _state(self, plant: Plant) -> np.ndarray:
        return np.concatenate([plant.q[self.q_index], plant.v[self.v_index]])

    def read(self, plant: Plant) -> np.ndarray:
        """The state as sensed."""
        state = self._state(plant)
        for column, delay in self.delays.items():
            back = delay / plant.h
            whole = math.floor(back)
            newer, older = self.seen[-1 - whole], self.seen[-2 - whole]
            state[column] = newer[column] + (back - whole) * (older[column] - newer[column])
        for column, factor in self.scale.items():
            state[column] *= factor
        for column, bias in self.bias.items():
            state[column] += bias
        return state


def observed(system: System) -> Observation:
    """The columns of a system's log."""
    return parse_observation(load(system.xml), system.observation)


def noise_levels(system: System, rng: np.random.Generator, noise: str = "") -> np.ndarray:
    """Standard deviation of each column, of a size that no user knows beforehand; or of an unequal ``noise``."""
    model, observation = load(system.xml), observed(system)
    position, velocity = POSITION_NOISE * rng.uniform(0.5, 3.0), VELOCITY_NOISE * rng.uniform(0.5, 3.0)
    position, velocity = UNEQUAL.get(noise, (position, velocity))
    levels = np.where(observation.index < model.nq, position, velocity)
    if noise == ONE_ROUGH:
        levels[rng.integers(len(levels))] *= ROUGHER
    return levels


def measured(system: System, log: Log, noise: np.ndarray, rng: np.random.Generator) -> Trajectories:
    """The log as it is written: the observed columns, with noise."""
    observation = observed(system)
    seen = [s[:, observation.index] for s in log.states]
    seen = [s + noise * rng.standard_normal(s.shape) for s in seen]
    return Trajectories(
        observations=np.concatenate([s[:-1] for s in seen]),
        next_observations=np.concatenate([s[1:] for s in seen]),
        actions=np.concatenate(log.commands),
        terminals=np.concatenate([np.arange(len(c)) == len(c) - 1 for c in log.commands]),
        dt=DT,
        source="hidden truth",
    )


def equivalents(system: System, effect: Effect) -> tuple[tuple[str, str | None], ...]:
    """The (effect, target) pairs that are the same thing as an effect on a system."""
    found = {p for group in system.equivalents if (effect.name, effect.target) in group for p in group}
    model = load(system.xml)
    for number in range(model.nactuator):
        actuator, trn = model.actuator(number).name, int(model.actuator_trnid[number, 0])
        pair = {("joint_damping", model.joint(trn).name), ("actuator_damping", actuator)}
        if (effect.name, effect.target) in pair:
            found |= pair
    x = effect.parameters
    if effect.name == "joint_stribeck" and x["static"] < 1.1 * x["coulomb"]:
        found.add(("joint_friction", effect.target))
    if effect.name == "joint_coupling":
        found |= _same_coupling(model, str(effect.target))
    return tuple(sorted(found - {(effect.name, effect.target)}, key=str))


def _same_coupling(model: mujoco.MjModel, joint: str) -> set[tuple[str, str | None]]:
    """A spring between two joints is named by either, where each is the other's neighbor."""
    other = neighbor(model, joint)
    return {("joint_coupling", other)} if neighbor(model, other) == joint else set()


def true_declared(system: System, rng: np.random.Generator) -> dict[str, float]:
    """True values of the declared parameters: 5 to 20 % off the model's."""
    space = ParameterSpace(load(system.xml), system.declared)  # type: ignore[arg-type]
    off = rng.uniform(0.05, 0.2, len(space)) * rng.choice([-1, 1], len(space))
    return {n: float(v) for n, v in zip(space.names, space.nominal * (1 + off), strict=True)}


def config_of(system: System) -> dict[str, Any]:
    """The project's config of a system's log."""
    return {
        "model": "model.xml",
        "data": "log.npz",
        "frame_skip": system.frame_skip,
        "observation": list(system.observation),
        "parameters": {k: dict(v) for k, v in system.declared.items()},
        "seed": 0,
    }


@dataclass(frozen=True)
class Recording:
    """What a seed makes of a system before the noise.

    Attributes:
        declared: true values of the declared parameters.
        noise: standard deviation of each column.
        log: the log without noise.
        rng: the generator, from which the noise is to come.
    """

    declared: Mapping[str, float]
    noise: np.ndarray
    log: Log
    rng: np.random.Generator


def make_recording(
    system: System,
    effects: Sequence[Effect],
    seed: int | Sequence[int],
    *,
    noise: str = "",
    before: Before | None = None,
    **size: int,
) -> Recording:
    """Draw declared values and noise levels, and record; ``size`` is that of :func:`record`."""
    rng = np.random.default_rng(seed)
    declared, levels = true_declared(system, rng), noise_levels(system, rng, noise)
    return Recording(declared, levels, record(system, declared, effects, rng, before=before, **size), rng)


def simulate_truth(
    system: System,
    effects: Sequence[Effect],
    seed: int | Sequence[int],
    *,
    name: str = "",
    kind: str = "single",
    noise: float = 1.0,
    **size: int,
) -> Case:
    """Record a log with effects hidden in it.

    Args:
        system: the system.
        effects: what is hidden.
        seed: decides declared values, starts, commands and noise.
        name, kind: see :class:`Case`.
        noise: factor of the noise; 0 for none.
        size: ``episodes``, ``transitions`` and ``substeps``; the system's own, where not given.
    """
    return make_case(system, effects, make_recording(system, effects, seed, **size), name=name, kind=kind, noise=noise)


def make_case(
    system: System,
    effects: Sequence[Effect],
    recording: Recording,
    *,
    name: str = "",
    kind: str = "single",
    noise: float = 1.0,
    gap_ratio: float = 0.0,
    trait: str = "",
    ties: Sequence[tuple[tuple[str, str | None], ...]] = (),
) -> Case:
    """Return the case of a recording; its generator advances."""
    same = [*ties] or [()] * len(effects)
    levels = noise * recording.noise
    return Case(
        name=name or system.name,
        kind=kind,
        system=system.name,
        model=system.xml,
        config=config_of(system),
        trajectories=measured(system, recording.log, levels, recording.rng),
        effects=tuple(effects),
        equivalents=tuple(
            tuple(sorted({*equivalents(system, e), *found}, key=str)) for e, found in zip(effects, same, strict=True)
        ),
        ties=tuple(same),
        declared=recording.declared,
        noise=tuple(levels.tolist()),
        gap_ratio=gap_ratio,
        trait=trait,
    )
