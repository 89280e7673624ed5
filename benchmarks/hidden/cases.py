"""The list of cases, and how strong what is hidden in each is.

A seed decides systems, targets and strengths. A strength is drawn by the gap that it makes: the misfit of
the user's model to the log, one transition at a time and with the declared parameters at their best, is
some 8 to 80 times the noise.
"""

from __future__ import annotations

import fnmatch
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from benchmarks.hidden.systems import CORE, SYSTEMS, System, fine, load
from benchmarks.hidden.ties import exact_ties
from benchmarks.hidden.truths import DT, Before, Case, Effect, Recording, make_case, make_recording, observed
from dropo_torch.parameters import ParameterSpace

#: The gap that a single effect is given, in units of the noise; and the least with which a case is kept.
GAP, LEAST_GAP = (8.0, 80.0), 3.0
#: Size of a draw, from hardly there to as much as makes sense.
SIZES = (1e-4, 1.0)
#: The least size of effects which sensitive systems would show when too small to matter.
LEAST_SIZE = {
    "actuator_delay": 0.06, "actuator_lag": 0.06, "actuator_backlash": 0.02, "actuator_deadband": 0.02,
    "sensor_delay": 0.1, "sensor_scale": 0.05, "sensor_bias": 0.05, "ground_slope": 0.02, "contact_margin": 0.02,
    "contact_friction": 0.05, "payload": 0.03, "joint_friction": 0.02,
}  # fmt: skip

_ARM, _SERVO, _CART, _FURUTA = (
    ("yaw", "shoulder", "elbow"), ("shoulder", "elbow", "wrist"), ("rail", "hinge"), ("turn", "swing"),
)  # fmt: skip
_LEG = ("thigh_joint", "leg_joint", "foot_joint")
_JOINTS = {"torque_arm": _ARM, "servo_arm": _SERVO, "cart_pole": _CART, "furuta": _FURUTA}
_ACTUATORS: dict[str, tuple[str | None, ...]] = {
    "torque_arm": ("yaw_motor", "shoulder_motor", "elbow_motor"),
    "servo_arm": ("shoulder_servo", "elbow_servo", "wrist_servo"),
    "cart_pole": ("push",),
    "furuta": ("drive",),
}
_MOTORS = {**_ACTUATORS, "hopper": ("thigh_motor", "leg_motor", "foot_motor")}
_COLUMNS: dict[str, tuple[str | None, ...]] = {
    "torque_arm": ("shoulder.position", "elbow.position", "shoulder.velocity", "elbow.velocity"),
    "servo_arm": ("shoulder.position", "elbow.position", "wrist.position", "elbow.velocity"),
    "cart_pole": ("hinge.position", "hinge.velocity", "rail.velocity"),
    "furuta": ("swing.position", "swing.velocity", "turn.velocity"),
}
_CONTACTS: dict[str, tuple[str | None, ...]] = {"puck": ("puck",), "hopper": ("foot_geom",)}
#: Effect → system → what can carry it there, such that it shows.
OPTIONS: dict[str, Mapping[str, tuple[str | None, ...]]] = {
    "joint_damping": {**_JOINTS, "hopper": _LEG},
    "joint_quadratic_damping": _JOINTS,
    "joint_friction": _JOINTS,
    "joint_stribeck": _JOINTS,
    "joint_presliding": _JOINTS,
    "joint_lugre": _JOINTS,
    "joint_load_friction": {"torque_arm": _ARM, "servo_arm": _SERVO[:2], "cart_pole": ("rail",), "furuta": ("turn",)},
    "joint_elasticity": {"torque_arm": _ARM, "servo_arm": _SERVO[:2], "cart_pole": ("rail",), "furuta": ("turn",)},
    "joint_stiffness": {**_JOINTS, "hopper": _LEG},
    "joint_cogging": _JOINTS,
    "armature": {**_JOINTS, "hopper": _LEG},
    "joint_limit": {"torque_arm": ("elbow",)},
    "joint_coupling": {"torque_arm": ("shoulder", "elbow"), "servo_arm": ("elbow", "wrist"), "furuta": ("swing",)},
    "payload": {
        "torque_arm": ("upper", "fore"), "servo_arm": ("fore", "hand"), "cart_pole": ("pole",),
        "furuta": ("pendulum",), "hopper": ("torso", "foot"),
    },
    "center_of_mass": {
        "torque_arm": ("upper", "fore"), "servo_arm": ("fore", "hand"), "cart_pole": ("pole",),
        "furuta": ("pendulum",), "hopper": ("torso",),
    },
    "inertia": {
        "torque_arm": ("upper", "fore"), "servo_arm": ("fore",), "cart_pole": ("pole",), "furuta": ("pendulum",),
        "puck": ("puck",), "hopper": ("torso",),
    },
    "external_force": {
        "torque_arm": ("upper", "fore"), "servo_arm": ("fore", "hand"), "cart_pole": ("cart", "pole"),
        "furuta": ("pendulum",), "puck": ("puck",), "hopper": ("torso",),
    },
    "fluid_drag": {
        "torque_arm": ("upper", "fore"), "servo_arm": ("upper", "fore"), "cart_pole": ("cart", "pole"),
        "furuta": ("pendulum",), "puck": ("puck",),
    },
    "gravity_tilt": dict.fromkeys(("torque_arm", "servo_arm", "cart_pole", "furuta", "puck", "hopper"), (None,)),
    "ground_slope": {"puck": (None,), "hopper": (None,)},
    "integration": {s.name: (None,) for s in CORE if s.coarse},
    "actuator_gain": _MOTORS,
    "actuator_stiffness": {"servo_arm": ("shoulder_servo", "elbow_servo")},
    "actuator_bias": _ACTUATORS,
    "actuator_damping": _ACTUATORS,
    "actuator_delay": _MOTORS,
    "actuator_lag": _MOTORS,
    "actuator_deadband": _ACTUATORS,
    "actuator_backlash": _ACTUATORS,
    "actuator_saturation": _ACTUATORS,
    "sensor_bias": _COLUMNS,
    "sensor_scale": {k: (*v, "rail.position") if k == "cart_pole" else v for k, v in _COLUMNS.items()},
    "sensor_delay": _COLUMNS,
    "contact_friction": _CONTACTS,
    "contact_stiffness": _CONTACTS,
    "contact_margin": _CONTACTS,
    "torque_ripple": {"torque_arm": _ARM, "furuta": _FURUTA, "puck": ("root",)},
    "uneven_friction": {"servo_arm": ("elbow",), "furuta": ("turn",), "cart_pole": ("rail",)},
    "far_spring": {"torque_arm": ("fore",), "servo_arm": ("fore",)},
    "slosh": {"torque_arm": ("fore",), "cart_pole": ("pole",), "servo_arm": ("hand",)},
    "dropout": {"torque_arm": _ACTUATORS["torque_arm"], "cart_pole": ("push",)},
    "gain_drift": {"torque_arm": _ACTUATORS["torque_arm"], "furuta": ("drive",)},
}  # fmt: skip
OUTSIDE = ("torque_ripple", "uneven_friction", "far_spring", "slosh", "dropout", "gain_drift")
VOCABULARY = tuple(e for e in OPTIONS if e not in OUTSIDE)
#: Pairs of effects: system, and what hides in it.
DOUBLES = (
    ("torque_arm", "joint_friction", "payload"),
    ("torque_arm", "joint_damping", "actuator_delay"),
    ("torque_arm", "joint_cogging", "actuator_gain"),
    ("servo_arm", "joint_friction", "actuator_delay"),
    ("servo_arm", "payload", "actuator_backlash"),
    ("servo_arm", "joint_stiffness", "actuator_lag"),
    ("cart_pole", "joint_friction", "fluid_drag"),
    ("cart_pole", "actuator_deadband", "gravity_tilt"),
    ("furuta", "joint_damping", "actuator_gain"),
    ("furuta", "joint_friction", "sensor_delay"),
    ("puck", "contact_friction", "gravity_tilt"),
    ("puck", "fluid_drag", "ground_slope"),
    ("hopper", "joint_damping", "contact_friction"),
    ("hopper", "payload", "actuator_gain"),
)
_PENDULUM, _RUNNER = ("pivot", "knee"), ("back_hip", "back_knee", "front_hip", "front_knee")
#: What can carry an effect on the systems of unusual cases, which the plain list leaves out.
UNUSUAL_OPTIONS: dict[str, Mapping[str, tuple[str | None, ...]]] = {
    "joint_damping": {"double_pendulum": _PENDULUM, "runner": _RUNNER},
    "joint_friction": {"double_pendulum": _PENDULUM, "runner": _RUNNER},
    "gravity_tilt": dict.fromkeys(("double_pendulum", "tumbler", "passive_puck"), (None,)),
    "payload": {
        "double_pendulum": ("upper",),
        "tumbler": ("brick",),
        "passive_puck": ("puck",),
        "carriage_leg": ("shank",),
        "quadruped": ("trunk",),
    },
    "contact_stiffness": {"carriage_leg": ("foot",), "quadruped": ("floor",)},
    "contact_margin": {"carriage_leg": ("floor",), "quadruped": ("floor",)},
    "sensor_delay": {
        "carriage_leg": ("knee.position", "up.velocity"),
        "quadruped": ("root.velocity[vz]", "FR_knee.position", "RL_hip.velocity"),
    },
    "actuator_delay": {"quadruped": ("FL_knee_servo", "RR_hip_servo")},
    "fluid_drag": {"double_pendulum": _PENDULUM, "tumbler": ("brick",), "passive_puck": ("puck",)},
    "contact_friction": {"passive_puck": ("puck",), "carriage_leg": ("foot",), "quadruped": ("floor", "FL_foot")},
    "inertia": {"runner": ("torso",)},
    "integration": dict.fromkeys(("coarse_servo_arm", "coarse_puck"), (None,)),
    "ground_slope": dict.fromkeys(("carriage_leg", "quadruped"), (None,)),
}
#: Effects of the small list, each once.
SMALL = (
    "joint_damping", "joint_friction", "payload", "gravity_tilt", "actuator_delay", "sensor_bias",
    "contact_friction", "torque_ripple",
)  # fmt: skip
#: Systems and bodies that move in the world's x-z plane only: nothing along y, no roll, shows there.
_PLANAR = frozenset({"cart_pole", "hopper", "servo_arm", "double_pendulum", "runner", "carriage_leg"})

#: Systems on feet that do not slip.
_STANDING = frozenset({"hopper", "carriage_leg", "quadruped"})


@dataclass(frozen=True)
class Wish:
    """What is said of a hidden effect beforehand.

    Attributes:
        target: where it sits; drawn where not given.
        sizes: range of its size in place of a wanted gap.
        draw: key of :data:`DRAWS` in place of the effect's own name.
    """

    target: str | None = None
    sizes: tuple[float, float] | None = None
    draw: str = ""


@dataclass(frozen=True)
class Unusual:
    """What is unusual about a case.

    Attributes:
        trait: what it is called; the beginning of the case's name.
        before: for a log that begins in motion.
        noise: for noise that differs much between columns; see :func:`~benchmarks.hidden.truths.noise_levels`.
        wishes: for some effects, what is said of them.
        note: an addition to the case's name.
    """

    trait: str = ""
    before: Before | None = None
    noise: str = ""
    wishes: Mapping[str, Wish] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class CaseSpec:
    """A case before it is simulated.

    Attributes:
        name: unique in a list.
        kind: ``null``, ``single``, ``double`` or ``outside``.
        system: the system's name.
        effects: names of what is hidden.
        seed: decides targets, strengths and log.
        unusual: what is unusual about it, if anything.
    """

    name: str
    kind: str
    system: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]
    unusual: Unusual = Unusual()

    @property
    def trait(self) -> str:
        """What is unusual, in a word; empty for a plain case."""
        return self.unusual.trait

    def make(self) -> Case:
        """Draw the strengths and simulate the log."""
        system, rng = SYSTEMS[self.system], np.random.default_rng([*self.seed, 1])
        effects = tuple(drawn(system, e, rng, self.seed, self.unusual) for e in self.effects)
        recording = make_recording(system, effects, self.seed, noise=self.unusual.noise, before=self.unusual.before)
        ratio = gap_ratio(system, recording)
        same = () if self.kind == "outside" else exact_ties(system, effects, recording)
        return make_case(
            system, effects, recording,
            name=self.name, kind=self.kind, gap_ratio=ratio, trait=self.trait, ties=same,
        )  # fmt: skip


def cases(seed: int, which: str = "all") -> list[CaseSpec]:
    """Return the list of cases of a seed: ``all`` of them, or a ``small`` list of some ten."""
    if which == "small":
        chosen = [_spec("null", s, (), seed) for s in ("torque_arm", "puck")]
        chosen += [s for e in SMALL for s in _spread(e, seed, 1)]
        return [*chosen, _spec("double", *_pair(DOUBLES[0]), seed)]
    if which != "all":
        raise ValueError(f"which is {which!r}; expected all or small")
    systems = [s.name for s in CORE if not s.coarse]
    found = [_spec("null", s, (), seed, n) for s in systems for n in range(2)]
    found += [s for e in VOCABULARY for s in _spread(e, seed, 2)]
    found += [_spec("double", *_pair(d), seed) for d in DOUBLES]
    found += [s for e in OUTSIDE for s in _spread(e, seed, 1)]
    return found + [_unusual(u, system, effects, seed) for u, system, effects in UNUSUAL_CASES]


def select(specs: Sequence[CaseSpec], pattern: str = "*", kind: str | None = None) -> list[CaseSpec]:
    """Return the cases whose name matches a pattern, of one kind where given."""
    return [s for s in specs if fnmatch.fnmatch(s.name, pattern) and kind in (None, s.kind)]


def _pair(double: tuple[str, str, str]) -> tuple[str, tuple[str, ...]]:
    return double[0], double[1:]


def _spec(kind: str, system: str, effects: tuple[str, ...], seed: int, number: int = 0) -> CaseSpec:
    name = f"{kind}-{system}" + "".join(f"-{e}" for e in effects) + (f"-{number}" if number else "")
    return CaseSpec(name, kind, system, effects, (seed, zlib.crc32(name.encode())))


def _unusual(unusual: Unusual, system: str, effects: tuple[str, ...], seed: int) -> CaseSpec:
    words = (unusual.trait, system, *(effects or ("null",)), *filter(None, [unusual.note]))
    name = "-".join(words)
    kind = ("null", "single", "double")[len(effects)]
    return CaseSpec(name, kind, system, effects, (seed, zlib.crc32(name.encode())), unusual)


def _spread(effect: str, seed: int, count: int) -> list[CaseSpec]:
    """One effect on as many different systems as asked for, or on its only one as often."""
    rng = np.random.default_rng([seed, zlib.crc32(effect.encode())])
    systems = list(rng.permutation(sorted(OPTIONS[effect])))
    kind = "outside" if effect in OUTSIDE else "single"
    return [
        _spec(kind, str(systems[n % len(systems)]), (effect,), seed, n // len(systems)) for n in range(count)
    ]  # fmt: skip


# --- strengths ------------------------------------------------------------------------------------------------

Draw = Callable[[float], dict[str, float]]


def drawn(
    system: System, effect: str, rng: np.random.Generator, seed: Sequence[int], unusual: Unusual = Unusual()
) -> Effect:
    """An effect on a target that shows it, of a strength that makes the wanted gap."""
    wish = unusual.wishes.get(effect, Wish())
    if effect == "integration":
        return Effect(effect, None, {"timestep": load(system.xml).opt.timestep})
    system = fine(system)  # what a careless step does besides is no strength of this effect
    best: tuple[float, Effect] | None = None
    for _ in range(4):
        options = (wish.target,) if wish.target else _targets(effect, system)
        target = options[int(rng.integers(len(options)))]
        if wish.sizes is not None:
            draw = DRAWS[wish.draw or effect](system, target, rng)
            return Effect(effect, target, draw(rng.uniform(*wish.sizes)))
        found = _sized(system, effect, target, rng, seed, unusual)
        if best is None or found[0] > best[0]:
            best = found
        if best[0] >= LEAST_GAP:
            break
    assert best is not None
    return best[1]


def _targets(effect: str, system: System) -> tuple[str | None, ...]:
    """What can carry an effect on a system."""
    return OPTIONS[effect].get(system.name) or UNUSUAL_OPTIONS[effect][system.name]


def _sized(
    system: System, effect: str, target: str | None, rng: np.random.Generator, seed: Sequence[int],
    unusual: Unusual = Unusual(),
) -> tuple[float, Effect]:  # fmt: skip
    """The effect whose gap is closest to a random one, and its gap."""
    draw = DRAWS[unusual.wishes.get(effect, Wish()).draw or effect](system, target, rng)
    wanted = math.exp(rng.uniform(*np.log(GAP)))
    least, tried = LEAST_SIZE.get(effect, SIZES[0]), []
    size = max(0.1, least)
    short = {"episodes": 2, "transitions": 150, "substeps": 20}
    for _ in range(5):
        hidden = Effect(effect, target, draw(size))
        recording = make_recording(system, [hidden], seed, noise=unusual.noise, before=unusual.before, **short)
        ratio = gap_ratio(system, recording)
        tried.append((abs(math.log(max(ratio, 1e-9) / wanted)), ratio, hidden))
        step = min(max(wanted / max(ratio, 1e-9), 0.02), 5.0)
        following = min(max(size * step, least), SIZES[1])
        if tried[-1][0] < 0.5 or following == size:
            break
        size = following
    _, ratio, hidden = min(tried, key=lambda t: t[0])
    return ratio, hidden


def gap_ratio(system: System, recording: Recording) -> float:
    """The gap that effects make beside the noise: of the column where it is largest, the ratio of their rms.

    The gap is what is left of the user's model's misfit, one transition from each sensed state without noise,
    after the declared parameters have taken what they can to first order.
    """
    declared, levels, log = recording.declared, recording.noise, recording.log
    states = np.concatenate([s[:-1] for s in log.states])
    after = np.concatenate([s[1:] for s in log.states])[:, observed(system).index]
    commands = np.concatenate(log.commands)
    space = ParameterSpace(load(system.xml), system.declared)  # type: ignore[arg-type]
    truth = space.vector(declared)
    weight = math.sqrt(2.0) * levels
    expected = _predicted(system, space, truth, states, commands)
    misfit = ((after - expected) / weight).reshape(-1)
    columns = []
    for p, step in enumerate(1e-3 * np.abs(truth)):
        moved = truth.copy()
        moved[p] += step
        columns.append(((_predicted(system, space, moved, states, commands) - expected) / weight / step).reshape(-1))
    jacobian = np.stack(columns, 1)
    left = misfit - jacobian @ np.linalg.lstsq(jacobian, misfit, rcond=None)[0]
    return float(np.sqrt((left.reshape(-1, len(levels)) ** 2).mean(0)).max())


def _predicted(
    system: System, space: ParameterSpace, values: np.ndarray, states: np.ndarray, commands: np.ndarray
) -> np.ndarray:
    """What the user's model makes of each state and command, observed columns."""
    model, index = space.apply(values), observed(system).index
    data = mujoco.MjData(model)
    out = np.empty((len(states), model.nq + model.nv))
    for n, (state, command) in enumerate(zip(states, commands, strict=True)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], command
        data.qacc_warmstart[:] = 0
        mujoco.mj_step(model, data, system.frame_skip)
        out[n, : model.nq], out[n, model.nq :] = data.qpos, data.qvel
    return out[:, index]


def _joint_draw(
    make: Callable[[float, float, float, np.random.Generator], Draw],
) -> Callable[[System, str | None, np.random.Generator], Draw]:
    """A draw from a joint's typical torque, velocity and inertia."""

    def draw(system: System, target: str | None, rng: np.random.Generator) -> Draw:
        scale = system.scales[str(target)]
        return make(scale.torque, scale.velocity, scale.inertia, rng)

    return draw


def _actuator_draw(
    make: Callable[[float, float, float, np.random.Generator], Draw],
) -> Callable[[System, str | None, np.random.Generator], Draw]:
    """A draw from an actuator's typical force, velocity and command."""

    def draw(system: System, target: str | None, rng: np.random.Generator) -> Draw:
        model = load(system.xml)
        number = model.actuator(target).id
        gear = float(model.actuator_gear[number, 0])
        scale = system.scales[model.joint(int(model.actuator_trnid[number, 0])).name]
        return make(scale.torque / gear, scale.velocity * gear, system.commands[number].amplitude, rng)

    return draw


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _stiffness(t: float, _v: float, _i: float, rng: np.random.Generator) -> Draw:
    reference = rng.uniform(-0.6, 0.6)
    return lambda s: {"stiffness": s * 1.5 * t, "reference": reference}


def _stribeck(t: float, v: float, _i: float, rng: np.random.Generator) -> Draw:
    ratio, knee = rng.uniform(1.5, 2.2), rng.uniform(0.05, 0.15) * v
    return lambda s: {"coulomb": 0.3 * s * t, "static": 0.3 * s * t * ratio, "velocity": knee}


def _presliding(t: float, _v: float, _i: float, rng: np.random.Generator) -> Draw:
    displacement = 10 ** rng.uniform(-2.5, -1.0)
    return lambda s: {"coulomb": 0.5 * s * t, "displacement": displacement}


def _lugre(t: float, v: float, _i: float, rng: np.random.Generator) -> Draw:
    displacement, ratio, knee = 10 ** rng.uniform(-2.5, -1.5), rng.uniform(1.5, 2.2), rng.uniform(0.05, 0.15) * v
    return lambda s: {
        "coulomb": 0.4 * s * t, "displacement": displacement, "static": 0.4 * s * t * ratio, "velocity": knee,
    }  # fmt: skip


def _cogging(t: float, v: float, _i: float, rng: np.random.Generator) -> Draw:
    poles, phase = int(rng.integers(4, 15)), rng.uniform(-np.pi, np.pi)
    return lambda s: {"amplitude": 0.5 * s * t, "poles": poles, "phase": phase}


def _limit(_t: float, _v: float, _i: float, rng: np.random.Generator) -> Draw:
    lower, upper = _sign(rng) * rng.uniform(0.15, 0.3), _sign(rng) * rng.uniform(0.15, 0.3)
    return lambda s: {"lower": s * lower, "upper": s * upper}


def _gain(_t: float, _v: float, _c: float, rng: np.random.Generator) -> Draw:
    sign = _sign(rng)
    return lambda s: {"gain": 1.0 + 0.5 * sign * s}


def _kp(_t: float, _v: float, _c: float, rng: np.random.Generator) -> Draw:
    sign = _sign(rng)
    return lambda s: {"factor": 1.0 + 0.5 * sign * s}


def _bias(t: float, _v: float, _c: float, rng: np.random.Generator) -> Draw:
    sign = _sign(rng)
    return lambda s: {"force": 0.4 * sign * s * t}


def _place(system: System, target: str | None, rng: np.random.Generator) -> np.ndarray:
    """A point on a body, off its center of mass: further out, and a little aside."""
    body = load(system.xml).body(target)
    out = body.ipos * rng.uniform(1.5, 2.0)
    aside = rng.uniform(0.2, 0.5) * max(float(np.linalg.norm(body.ipos)), 0.05) * rng.standard_normal(3)
    if system.name in _PLANAR and target != "hand":
        aside[1] = 0.0
    return out + aside


def _direction(system: System, target: str | None, rng: np.random.Generator) -> np.ndarray:
    """A random direction in which something shows."""
    way = rng.standard_normal(3)
    if system.name in _PLANAR and target != "hand":
        way[1] = 0.0
    if target == "cart":
        way[1:] = 0.0
    if target == "puck":
        way[2] *= 0.3
    return way / np.linalg.norm(way)


def _body_mass(system: System, target: str | None) -> float:
    return float(load(system.xml).body(target).mass[0])


def _payload(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    place, mass = _place(system, target, rng), _body_mass(system, target)
    return lambda s: {"mass": 0.8 * s * mass, **dict(zip("xyz", map(float, place), strict=True))}


def _payload_on_roll_axis(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    """A payload on the axis of the servo arm's wrist, where it is one of the hand and of the forearm as well."""
    start, mass = {"hand": 0.0, "fore": 0.3}[str(target)], _body_mass(system, target)
    along = start + rng.uniform(0.08, 0.15)
    return lambda s: {"mass": 0.8 * s * mass, "x": along, "y": 0.0, "z": 0.0}


def _shift(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    way = _direction(system, target, rng) * max(float(np.linalg.norm(load(system.xml).body(target).ipos)), 0.1)
    return lambda s: dict(zip("xyz", (0.5 * s * way).tolist(), strict=True))


def _inertia(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    heavier = rng.uniform() < 0.7
    return lambda s: {"factor": 1.0 + 3.0 * s if heavier else 1.0 / (1.0 + 3.0 * s)}


def _external_force(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    way, mass = _direction(system, target, rng), _body_mass(system, target)
    return lambda s: dict(zip("xyz", (3.0 * s * mass * way).tolist(), strict=True))


def _fluid_drag(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    mass = _body_mass(system, target)
    most = 15.0 if target == "puck" else 4.0  # the puck is slow
    return lambda s: {"coefficient": most * s * mass}


def _tilt(system: System, _target: str | None, rng: np.random.Generator) -> Draw:
    angle = rng.uniform(-np.pi, np.pi)
    roll, pitch = math.cos(angle), math.sin(angle)
    if system.name in _PLANAR:
        roll, pitch = 0.0, _sign(rng)
    return lambda s: {"roll": 0.12 * s * roll, "pitch": 0.12 * s * pitch}


def _sensor(key: str, neutral: float, span: float, signed: bool = True) -> Callable[..., Draw]:
    def draw(_system: System, target: str | None, rng: np.random.Generator) -> Draw:
        sign = _sign(rng) if signed else 1.0
        return lambda s: {key: neutral + sign * s * span}

    return draw


def _contact_friction(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    own, sign = float(load(system.xml).geom(target).friction[0]), _sign(rng)
    if system.name in _STANDING:  # what does not slip does not slip more with more friction
        return lambda s: {"friction": own / (1 + 9 * s)}
    return lambda s: {"friction": own * (1 + 0.6 * sign * s)}


def _contact_stiffness(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    own, ratio = float(load(system.xml).geom(target).solref[0]), rng.uniform(0.8, 1.1)
    return lambda s: {"time_constant": own * (1 + s), "damping_ratio": 1 + (ratio - 1) * min(1.0, 5 * s)}


def _contact_margin(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    return lambda s: {"margin": 0.02 * s}


def _ripple(t: float, _v: float, _i: float, rng: np.random.Generator) -> Draw:
    frequency, phase = rng.uniform(2.0, 9.0), rng.uniform(-np.pi, np.pi)
    return lambda s: {"amplitude": 0.5 * s * t, "frequency": frequency, "phase": phase}


def _elasticity(_t: float, _v: float, i: float, rng: np.random.Generator) -> Draw:
    rotor, ratio = i * rng.uniform(0.1, 0.5), rng.uniform(0.05, 0.2)

    def draw(size: float) -> dict[str, float]:
        stiffness = 0.02 * i / (DT**2 * size)
        return {"compliance": 1 / stiffness, "damping": 2 * ratio * math.sqrt(stiffness * rotor), "inertia": rotor}

    return draw


def _uneven(t: float, _v: float, _i: float, rng: np.random.Generator) -> Draw:
    waves, phase = rng.uniform(3.0, 8.0), rng.uniform(-np.pi, np.pi)
    return lambda s: {"friction": 0.3 * s * t, "waves": waves, "phase": phase}


def _far_spring(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    x, y, z = (rng.uniform(-0.5, 0.5, 3) + np.array([0.3, 0.0, 1.0])).tolist()
    weight, rest = 9.81 * _body_mass(system, target), rng.uniform(0.1, 0.3)
    return lambda s: {"stiffness": 8.0 * s * weight, "x": x, "y": y, "z": z, "rest": rest}


def _slosh(system: System, target: str | None, rng: np.random.Generator) -> Draw:
    place, mass = load(system.xml).body(target).ipos * rng.uniform(1.4, 1.8), _body_mass(system, target)
    way = _direction(system, target, rng)
    frequency, ratio = rng.uniform(2.0, 5.0), rng.uniform(0.05, 0.2)
    axis = dict(zip(("axis_x", "axis_y", "axis_z"), way.tolist(), strict=True))
    where = dict(zip("xyz", place.tolist(), strict=True))
    return lambda s: {"mass": 0.5 * s * mass, "frequency": frequency, "damping_ratio": ratio, **axis, **where}


def _dropout(_t: float, _v: float, _c: float, rng: np.random.Generator) -> Draw:
    period, phase = rng.uniform(0.6, 1.2), rng.uniform(-np.pi, np.pi)
    return lambda s: {"period": period, "duration": 0.02 + 0.2 * s, "phase": phase}


def _gain_drift(_t: float, _v: float, _c: float, rng: np.random.Generator) -> Draw:
    seconds = rng.uniform(0.7, 2.0)
    return lambda s: {"loss": 0.6 * s, "seconds": seconds}


#: Effect → (system, target, rng) → (size → parameters).
DRAWS: dict[str, Callable[[System, str | None, np.random.Generator], Draw]] = {
    "joint_damping": _joint_draw(lambda t, v, i, r: lambda s: {"damping": s * t / v}),
    "joint_quadratic_damping": _joint_draw(lambda t, v, i, r: lambda s: {"coefficient": s * t / v**2}),
    "joint_friction": _joint_draw(lambda t, v, i, r: lambda s: {"friction": 0.4 * s * t}),
    "joint_stribeck": _joint_draw(_stribeck),
    "joint_presliding": _joint_draw(_presliding),
    "joint_lugre": _joint_draw(_lugre),
    "joint_load_friction": _joint_draw(lambda t, v, i, r: lambda s: {"coefficient": 0.6 * s}),
    "joint_elasticity": _joint_draw(_elasticity),
    "joint_stiffness": _joint_draw(_stiffness),
    "joint_cogging": _joint_draw(_cogging),
    "armature": _joint_draw(lambda t, v, i, r: lambda s: {"armature": s * i}),
    "joint_limit": _joint_draw(_limit),
    "joint_coupling": _joint_draw(lambda t, v, i, r: lambda s: {"stiffness": s * t}),
    "payload": _payload,
    "payload_on_roll_axis": _payload_on_roll_axis,
    "center_of_mass": _shift,
    "inertia": _inertia,
    "external_force": _external_force,
    "fluid_drag": _fluid_drag,
    "gravity_tilt": _tilt,
    "ground_slope": _tilt,
    "actuator_gain": _actuator_draw(_gain),
    "actuator_stiffness": _actuator_draw(_kp),
    "actuator_bias": _actuator_draw(_bias),
    "actuator_damping": _actuator_draw(lambda f, v, c, r: lambda s: {"damping": s * f / v}),
    "actuator_delay": _actuator_draw(lambda f, v, c, r: lambda s: {"delay": 0.05 * s}),
    "actuator_lag": _actuator_draw(lambda f, v, c, r: lambda s: {"time_constant": 0.08 * s}),
    "actuator_deadband": _actuator_draw(lambda f, v, c, r: lambda s: {"width": 0.4 * s * c}),
    "actuator_backlash": _actuator_draw(lambda f, v, c, r: lambda s: {"width": 0.5 * s * c}),
    "actuator_saturation": _actuator_draw(lambda f, v, c, r: lambda s: {"limit": f / (0.3 + 7 * s)}),
    "sensor_bias": _sensor("bias", 0.0, 0.2),
    "sensor_scale": _sensor("factor", 1.0, 0.2),
    "sensor_delay": _sensor("delay", 0.0, 0.03, signed=False),
    "contact_friction": _contact_friction,
    "contact_stiffness": _contact_stiffness,
    "contact_margin": _contact_margin,
    "torque_ripple": _joint_draw(_ripple),
    "uneven_friction": _joint_draw(_uneven),
    "far_spring": _far_spring,
    "slosh": _slosh,
    "dropout": _actuator_draw(_dropout),
    "gain_drift": _actuator_draw(_gain_drift),
}

# --- unusual cases --------------------------------------------------------------------------------------------

_BUSY, _QUIET = Before(), Before(quiet=True)
_LATE = {"actuator_delay": Wish(sizes=(0.4, 0.6))}  # 20 to 30 ms
_ON_AXIS = "payload_on_roll_axis"


def _motion(before: Before, wishes: Mapping[str, Wish] | None = None) -> Unusual:
    return Unusual("motion", before=before, wishes=wishes or {}, note="quiet" if before.quiet else "")


def _at(trait: str, effect: str, target: str, draw: str = "") -> Unusual:
    return Unusual(trait, wishes={effect: Wish(target, draw=draw)}, note=target)


def _noise(noise: str) -> Unusual:
    return Unusual("unequal", noise=noise, note=noise)


_PASSIVE, _COARSE, _WALKING = Unusual("passive"), Unusual("coarse"), Unusual("walking")
#: What is unusual, the system, and what is hidden.
UNUSUAL_CASES: tuple[tuple[Unusual, str, tuple[str, ...]], ...] = (
    (_motion(_QUIET, _LATE), "cart_pole", ("actuator_delay",)),
    (_motion(_QUIET, _LATE), "torque_arm", ("actuator_delay",)),
    (_motion(_BUSY), "furuta", ("actuator_delay",)),
    (_motion(_BUSY), "servo_arm", ("actuator_lag",)),
    (_motion(_QUIET), "cart_pole", ("actuator_backlash",)),
    (_motion(_BUSY), "torque_arm", ("joint_friction",)),
    (_motion(_QUIET, _LATE), "servo_arm", ("joint_damping", "actuator_delay")),
    (_motion(_QUIET), "furuta", ()),
    (_PASSIVE, "passive_puck", ()),
    (_PASSIVE, "passive_puck", ("contact_friction",)),
    (_PASSIVE, "double_pendulum", ("joint_friction",)),
    (_PASSIVE, "double_pendulum", ("gravity_tilt",)),
    (_PASSIVE, "double_pendulum", ("payload",)),
    (_PASSIVE, "double_pendulum", ("joint_damping", "gravity_tilt")),
    (_PASSIVE, "tumbler", ("fluid_drag",)),
    (_COARSE, "coarse_torque_arm", ("integration", "joint_friction")),
    (_COARSE, "coarse_cart_pole", ("integration", "actuator_delay")),
    (_COARSE, "coarse_servo_arm", ("integration", "payload")),
    (_COARSE, "coarse_puck", ("integration", "contact_friction")),
    (_noise("fine_positions"), "torque_arm", ("joint_stribeck",)),
    (_noise("rough_positions"), "servo_arm", ("joint_damping",)),
    (_noise("coarse_velocities"), "servo_arm", ()),
    (_noise("one_rough"), "furuta", ("joint_quadratic_damping",)),
    (_noise("fine_positions"), "runner", ("joint_damping",)),
    (_at("tie", "external_force", "cart"), "cart_pole", ("external_force",)),
    (_at("tie", "actuator_bias", "push"), "cart_pole", ("actuator_bias",)),
    (_at("tie", "external_force", "cart"), "coarse_cart_pole", ("integration", "external_force")),
    (_at("tie", "actuator_damping", "shoulder_motor"), "torque_arm", ("actuator_damping",)),
    (_at("tie", "payload", "hand", _ON_AXIS), "servo_arm", ("payload",)),
    (_WALKING, "carriage_leg", ()),
    (_WALKING, "carriage_leg", ("contact_friction",)),
    (_WALKING, "carriage_leg", ("contact_stiffness",)),
    (_WALKING, "carriage_leg", ("contact_margin",)),
    (_WALKING, "carriage_leg", ("ground_slope",)),
    (_WALKING, "carriage_leg", ("sensor_delay",)),
    (_WALKING, "carriage_leg", ("payload", "contact_friction")),
    (_WALKING, "quadruped", ()),
    (_WALKING, "quadruped", ("contact_friction",)),
    (_WALKING, "quadruped", ("contact_stiffness",)),
    (_WALKING, "quadruped", ("contact_margin",)),
    (_WALKING, "quadruped", ("ground_slope",)),
    (_WALKING, "quadruped", ("sensor_delay",)),
    (_WALKING, "quadruped", ("payload",)),
    (_WALKING, "quadruped", ("actuator_delay",)),
)
