"""Which other effects are the same thing as a hidden one: found by fitting each in its place to the truth itself.

Two effects without memory are the same on a log if, with the declared parameters at their best in both, they give
the same accelerations and the same rates of the sensed positions in all of its states. Every effect of the
vocabulary at every place of the model is fitted to those of the truth, without noise. What then leaves nothing is an
exact tie, with more numbers or fewer. Effects with memory (of commands, or of measurements) tie with none of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from benchmarks.hidden.systems import DT, Scale, System, fine, load
from benchmarks.hidden.truths import Effect, Recording, constant_forces, make_plant, neighbor, observed
from dropo_torch.parameters import ParameterSpace

#: Effects that depend on the past, and one that is none of the system's.
MEMORY = frozenset({"actuator_delay", "actuator_lag", "actuator_backlash", "sensor_delay", "integration"})
#: What a rival may leave of what the effect does, to be the same thing; and as whose special case it does not count.
EXACT, SPECIAL = 1e-4, {"joint_friction": "joint_stribeck"}
#: States that are compared: spread over the log, and those where the effect shows most.
SPREAD, STRONGEST, SEARCHED = 25, 25, 500
#: Fine steps of a logged one.
SUBSTEPS = 20
#: Steps of least squares: at first, and until convergence; what must be gone after the first ones.
FIRST, LAST, PROMISING = 3, 40, 0.6

Pair = tuple[str, str | None]


@dataclass(frozen=True)
class Rival:
    """An effect in the place of another: where a fit begins, the sizes of its numbers, and their least values."""

    effect: str
    target: str | None
    start: Mapping[str, float]
    size: Mapping[str, float]
    least: Mapping[str, float]

    def at(self, values: np.ndarray) -> Effect:
        """The effect with values."""
        return Effect(self.effect, self.target, dict(zip(self.start, values.tolist(), strict=True)))


@dataclass(frozen=True)
class Samples:
    """States of a log as sensed, and the commands in them, at which effects are compared."""

    system: System
    states: np.ndarray
    commands: np.ndarray
    weight: np.ndarray

    def at(self, rows: np.ndarray) -> Samples:
        """Some of the states."""
        return replace(self, states=self.states[rows], commands=self.commands[rows])

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The model that a user has."""
        return load(self.system.xml)

    def response(self, declared: Mapping[str, float], effects: Sequence[Effect]) -> np.ndarray:
        """Rates of sensed positions, and of velocities, in noises of a logged step ``(M, 2 nv)``."""
        plant = make_plant(self.system, declared, [e for e in effects if e.name != "integration"], SUBSTEPS)
        plant.substeps = 1
        bias, factor = self._sensors(effects)
        nq, nv = self.model.nq, self.model.nv
        out = np.empty((len(self.states), 2 * nv))
        constant = constant_forces(plant.model, effects)
        for n, (sensed, command) in enumerate(zip(self.states, self.commands, strict=True)):
            state = (sensed - bias) / factor
            q, v = state[:nq], state[nq:]
            plant.reset(q, v, command)
            plant.advance(command, constant)
            out[n, :nv], out[n, nv:] = v, (plant.v - v) / plant.h
        return out * DT * self._rates(factor) / self.weight

    def _sensors(self, effects: Sequence[Effect]) -> tuple[np.ndarray, np.ndarray]:
        """What is added to each column of the state, and what multiplies it before."""
        observation = observed(self.system)
        place = dict(zip(observation.labels, observation.columns, strict=True))
        bias, factor = np.zeros(self.model.nq + self.model.nv), np.ones(self.model.nq + self.model.nv)
        for e in effects:
            if e.name == "sensor_bias":
                bias[place[str(e.target)]] = e.parameters["bias"]
            elif e.name == "sensor_scale":
                factor[place[str(e.target)]] = e.parameters["factor"]
        return bias, factor

    def _rates(self, factor: np.ndarray) -> np.ndarray:
        """Factors of the rates, as sensed: of scalar positions, and of velocities."""
        model, positions = self.model, np.ones(self.model.nv)
        for j in np.flatnonzero(np.isin(model.jnt_type, (2, 3))):
            positions[model.jnt_dofadr[j]] = factor[model.jnt_qposadr[j]]
        return np.concatenate([positions, factor[model.nq :]])


def samples(system: System, recording: Recording) -> Samples:
    """Return up to :data:`SEARCHED` states of a log."""
    states = np.concatenate([s[:-1] for s in recording.log.states])
    rows = np.unique(np.linspace(0, len(states) - 1, SEARCHED).astype(int))
    commands = np.concatenate(recording.log.commands)
    return Samples(fine(system), states[rows], commands[rows], _weights(fine(system), recording.noise))


def _weights(system: System, noise: np.ndarray) -> np.ndarray:
    """The noise of each rate ``(2 nv,)``; infinite where nothing is sensed."""
    model, observation = load(system.xml), observed(system)
    level = np.full(model.nq + model.nv, np.inf)
    level[observation.index] = noise
    position = np.empty(model.nv)
    for j in range(model.njnt):
        q, i = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        position[i : i + {0: 6, 1: 3}.get(int(model.jnt_type[j]), 1)] = level[q]
    return np.concatenate([position, level[model.nq :]])


# --- rivals ---------------------------------------------------------------------------------------------------


def rivals(system: System) -> Iterator[Rival]:
    """Every effect without memory at every place of a system."""
    model = load(system.xml)
    for j in np.flatnonzero(np.isin(model.jnt_type, (2, 3))):
        yield from _joint_rivals(system, model, int(j))
    for b in range(1, model.nbody):
        if model.body_mass[b] > 0:
            yield from _body_rivals(model, b)
    yield Rival("gravity_tilt", None, {"roll": 0.0, "pitch": 0.0}, {"roll": 0.1, "pitch": 0.1}, {})
    yield from _actuator_rivals(system, model)
    yield from _sensor_rivals(system, model)
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity) if model.ngeom > 1 else []
    if np.isin(model.geom_type, mujoco.mjtGeom.mjGEOM_PLANE).any():
        yield Rival("ground_slope", None, {"roll": 0.0, "pitch": 0.0}, {"roll": 0.1, "pitch": 0.1}, {})
        for g in touching:
            yield from _contact_rivals(model, int(g))


def _one(effect: str, target: str | None, key: str, start: float, size: float, least: float = -np.inf) -> Rival:
    return Rival(effect, target, {key: start}, {key: size}, {key: least})


def _joint_rivals(system: System, model: mujoco.MjModel, joint: int) -> Iterator[Rival]:
    own = model.joint(joint)
    name, scale = own.name, system.scales.get(own.name, Scale(1.0, 1.0, 1.0))
    t, v = scale.torque, scale.velocity
    yield _one("joint_damping", name, "damping", 0.0, t / v, -float(own.damping[0]))
    yield _one("joint_quadratic_damping", name, "coefficient", 0.0, t / v**2, 0.0)
    yield _one("joint_friction", name, "friction", 0.01 * t, t, 0.0)
    yield _one("armature", name, "armature", 0.0, scale.inertia, -float(own.armature[0]))
    if np.isin(model.jnt_type, (2, 3)).sum() > 1 and model.joint(neighbor(model, name)).id < joint:  # else its synonym
        yield _one("joint_coupling", name, "stiffness", 0.0, t)
    yield Rival(
        "joint_stribeck", name, {"coulomb": 0.05 * t, "static": 0.08 * t, "velocity": 0.1 * v},
        {"coulomb": t, "static": t, "velocity": v}, {"coulomb": 0.0, "static": 0.0, "velocity": 0.01 * v},
    )  # fmt: skip
    yield Rival(
        "joint_stiffness", name, {"stiffness": 0.1 * t, "reference": 0.0}, {"stiffness": t, "reference": 1.0},
        {"stiffness": -float(own.stiffness[0])},
    )  # fmt: skip
    for phase in (0.0, 0.5 * np.pi):
        start = {"amplitude": 0.1 * t, "poles": 1.0, "phase": phase}
        yield Rival("joint_cogging", name, start, {"amplitude": t, "poles": 1.0, "phase": 1.0}, {"poles": 0.1})
    if model.jnt_limited[joint]:
        yield Rival("joint_limit", name, {"lower": 0.0, "upper": 0.0}, {"lower": 0.3, "upper": 0.3}, {})


def _body_rivals(model: mujoco.MjModel, body: int) -> Iterator[Rival]:
    name, mass = model.body(body).name, float(model.body_mass[body])
    reach = max(float(np.linalg.norm(model.body_ipos[body])), 0.1)
    nowhere, size = dict.fromkeys("xyz", 0.0), dict.fromkeys("xyz", reach)
    for way in (0.0, *_ends(model, body)):  # at the center, and at the ends of what is longest
        place = dict(zip("xyz", (model.body_ipos[body] + way).tolist(), strict=True))
        yield Rival("payload", name, {"mass": 0.1 * mass, **place}, {"mass": mass, **size}, {"mass": 1e-6 * mass})
    yield Rival("center_of_mass", name, nowhere, size, {})
    yield _one("inertia", name, "factor", 1.2, 0.5, 0.02)
    yield Rival("external_force", name, nowhere, dict.fromkeys("xyz", 3.0 * mass), {})
    if model.body_geomnum[body]:
        yield _one("fluid_drag", name, "coefficient", 0.0, mass, 0.0)


def _ends(model: mujoco.MjModel, body: int) -> list[np.ndarray]:
    """From a body's center of mass to the two ends of its mass."""
    turn, moments = np.zeros(9), model.body_inertia[body]
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    long = int(np.argmin(moments))
    half = 1.7 * np.sqrt(max(moments.max() / model.body_mass[body], 1e-9)) * turn.reshape(3, 3)[:, long]
    return [half, -half]


def _actuator_rivals(system: System, model: mujoco.MjModel) -> Iterator[Rival]:
    for number in range(model.nu):
        joint = int(model.actuator_trnid[number, 0])
        if model.jnt_type[joint] not in (2, 3):
            continue
        name, gear = model.actuator(number).name, float(model.actuator_gear[number, 0])
        scale = system.scales.get(model.joint(joint).name, Scale(1.0, 1.0, 1.0))
        force, speed = scale.torque / gear, scale.velocity * gear
        largest = system.commands[number].amplitude
        yield _one("actuator_gain", name, "gain", 1.0, 0.5, 0.05)
        if _motor_damping(model, number):
            yield _one("actuator_stiffness", name, "factor", 1.0, 0.5, 0.05)
        yield _one("actuator_bias", name, "force", 0.0, force)
        yield _one("actuator_damping", name, "damping", 0.0, force / speed, -_motor_damping(model, number))
        yield _one("actuator_deadband", name, "width", 0.05 * largest, largest, 0.0)
        yield _one("actuator_saturation", name, "limit", 0.5 * force, force, 0.02 * force)


def _motor_damping(model: mujoco.MjModel, number: int) -> float:
    return max(-float(model.actuator_biasprm[number, 2]), 0.0)


def _sensor_rivals(system: System, model: mujoco.MjModel) -> Iterator[Rival]:
    observation = observed(system)
    turning = {c for q in observation.quaternions for c in q}
    for c, label in enumerate(observation.labels):
        if c not in turning:
            yield _one("sensor_bias", label, "bias", 0.0, 0.1)
            yield _one("sensor_scale", label, "factor", 1.0, 0.2, 0.2)


def _contact_rivals(model: mujoco.MjModel, geom: int) -> Iterator[Rival]:
    name, friction = model.geom(geom).name, float(model.geom_friction[geom, 0])
    time, ratio = model.geom_solref[geom].tolist()
    yield _one("contact_friction", name, "friction", friction, 0.3, 0.0)
    yield Rival(
        "contact_stiffness", name, {"time_constant": time, "damping_ratio": ratio},
        {"time_constant": time, "damping_ratio": ratio}, {"time_constant": 0.3 * time, "damping_ratio": 0.05},
    )  # fmt: skip
    yield _one("contact_margin", name, "margin", 0.0, 0.01)


# --- fits -----------------------------------------------------------------------------------------------------

Residual = Callable[[np.ndarray], np.ndarray]


def least_squares(residual: Residual, start: np.ndarray, least: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
    """Damped least squares of numbers of size 1 above bounds: the best values and their root sum of squares."""
    at, damping = start.copy(), 1e-4
    here = residual(at)
    for _ in range(steps):
        slope = np.stack([(residual(at + 1e-5 * unit) - here) / 1e-5 for unit in np.eye(len(at))], 1)
        normal, gradient = slope.T @ slope, slope.T @ here
        scale = np.diag(np.maximum(np.diag(normal), 1e-12 * max(np.diag(normal).max(), 1e-300)))
        before = float(here @ here)
        for _ in range(8):
            step = -np.linalg.lstsq(normal + damping * scale, gradient, rcond=None)[0]
            step *= min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-300)) if steps > 1 else 1.0
            moved = np.maximum(at + step, least)
            found = residual(moved)
            if np.isfinite(found).all() and found @ found < before:
                at, here, damping = moved, found, max(0.1 * damping, 1e-12)
                break
            damping *= 10
        else:
            break
        if float(here @ here) > (1 - 1e-6) * before:
            break
    return at, float(np.sqrt(here @ here))


@dataclass(frozen=True)
class _Fit:
    """What every fit is compared with: the truth's response, beside the other hidden effects."""

    sample: Samples
    space: ParameterSpace
    declared: np.ndarray
    others: tuple[Effect, ...]
    truth: np.ndarray

    def left(self, rival: Rival | None, start: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
        """Fit a rival (or none) and the declared parameters: the values, relative to sizes, and what is left."""
        size = np.array([] if rival is None else list(rival.size.values()))
        count = len(size)

        def residual(values: np.ndarray) -> np.ndarray:
            declared = self.declared * (1 + 0.1 * values[count:])
            named = dict(zip(self.space.names, declared.tolist(), strict=True))
            effects = self.others if rival is None else (*self.others, rival.at(values[:count] * size))
            return (self.sample.response(named, effects) - self.truth).reshape(-1)

        low = [] if rival is None else [rival.least.get(k, -np.inf) / rival.size[k] for k in rival.size]
        return least_squares(residual, start, np.array([*low, *[-9.0] * len(self.declared)]), steps)


def exact_ties(system: System, effects: Sequence[Effect], recording: Recording) -> tuple[tuple[Pair, ...], ...]:
    """Return for each hidden effect all others that are the same thing on a log, sorted."""
    sample = samples(system, recording)
    return tuple(
        () if e.name in MEMORY else _ties(fine(system), e, tuple(o for o in effects if o is not e), recording, sample)
        for e in effects
    )


def _ties(
    system: System, effect: Effect, others: tuple[Effect, ...], recording: Recording, sample: Samples
) -> tuple[Pair, ...]:
    truth = sample.response(recording.declared, (*others, effect))
    shown = np.abs(truth - sample.response(recording.declared, others)).max(1)
    spread = np.linspace(0, len(shown) - 1, SPREAD).astype(int)
    rows = np.union1d(spread, np.argsort(-shown)[:STRONGEST])
    space = ParameterSpace(load(system.xml), system.declared)  # type: ignore[arg-type]
    fit = _Fit(sample.at(rows), space, space.vector(recording.declared), others, truth[rows])
    _, whole = fit.left(None, np.zeros(len(space)), LAST)
    own = {(effect.name, effect.target), (SPECIAL.get(effect.name, ""), effect.target)}
    found = set()
    for rival in rivals(system):
        pair = (rival.effect, rival.target)
        if pair not in own | found and _is_same(fit, rival, whole):
            found.add(pair)
    return tuple(sorted(found, key=str))


def _is_same(fit: _Fit, rival: Rival, whole: float) -> bool:
    """Whether a rival leaves nothing of what there is without it."""
    start = np.array([rival.start[k] / rival.size[k] for k in rival.size])
    at, left = fit.left(rival, np.concatenate([start, np.zeros(len(fit.declared))]), FIRST)
    if left > PROMISING * whole:
        return False
    if left > EXACT * whole:
        _, left = fit.left(rival, at, LAST)
    return left <= EXACT * whole
