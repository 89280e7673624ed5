"""Effects of joints: friction, damping, springs, inertia, stops."""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np

from dropo_torch.data.observation import joint_name
from dropo_torch.effects.base import Effect, Placed, Quantity, Setting, Signals, by_product, object_number
from dropo_torch.effects.drive import Drive, driven_joints

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def unit(setting: Setting, target: str | None, hinge: str, slide: str) -> str:
    """Return the unit of a joint's quantity."""
    return slide if setting.is_slide(target) else hinge


class JointEffect(Effect):
    """An effect of one hinge or slide joint.

    Attributes:
        positional: whether it depends on the joint's position, which the log must then show.
    """

    kind = "joint"
    positional: ClassVar[bool] = False

    def targets(self, setting: Setting) -> list[str | None]:
        """Return every hinge and slide joint that moves in the log, and whose position is seen where that matters."""
        m, signals = setting.model, setting.signals
        moving = np.isin(m.jnt_type, (_HINGE, _SLIDE)) & (signals.speed[m.jnt_dofadr] > 0)
        seen = np.isfinite(signals.position[m.jnt_qposadr]).all(-1) | (not self.positional)
        return [joint_name(m, int(j)) for j in np.flatnonzero(moving & seen)]

    @staticmethod
    def dof(model: mujoco.MjModel, target: str | None) -> int:
        """Return the joint's degree of freedom."""
        return int(model.jnt_dofadr[object_number(model, "jnt", target)])


class AddedToJoint(JointEffect):
    """A number of a degree of freedom that is added to the model's own.

    Attributes:
        field: where the model has it.
        quantity: its name, its units for a hinge and a slide, and how many scales it may reach.
        power: of the speed in the force that it makes.
    """

    field: ClassVar[str]
    quantity: ClassVar[tuple[str, str, str, float]]
    power: ClassVar[int] = 0

    def scale(self, signals: Signals, dof: int) -> float:
        """Return a size that matters, by which it makes the typical force at the typical speed."""
        return float(signals.force[dof] / signals.speed[dof] ** self.power)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        name, hinge, slide, reach = self.quantity
        scale = self.scale(setting.signals, setting.dof(target))
        own = float(self.own(setting.model, target)[0])
        return (Quantity(name, unit(setting, target, hinge, slide), 0.0, -own, reach * scale, scale),)

    def own(self, model: mujoco.MjModel, target: str | None) -> np.ndarray:
        """Return the model's numbers of the degree of freedom, a view."""
        return np.reshape(getattr(model, self.field), (model.nv, -1))[self.dof(model, target)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        self.own(model, target)[0] += values[0]


class JointDamping(AddedToJoint):
    """Viscous friction: a torque against the velocity, in proportion to it."""

    name = "joint_damping"
    sentence = "viscous friction in {target}: a force against the velocity, in proportion to it"
    field = "dof_damping"
    quantity = ("damping", "N·m·s/rad", "N·s/m", 30.0)
    power = 1


class JointQuadraticDamping(AddedToJoint):
    """Friction that grows with the square of the velocity."""

    name = "joint_quadratic_damping"
    sentence = "friction in {target} that grows with the square of the velocity"
    field = "dof_dampingpoly"
    quantity = ("coefficient", "N·m·s²/rad²", "N·s²/m²", 30.0)
    power = 2


#: Impedance of dry friction that hardly creeps, and its time constant in physics steps.
STUCK, STEPS = (0.999, 0.9999, 0.001, 0.5, 2.0), 2.0


def add_friction(model: mujoco.MjModel, dof: int, friction: float) -> None:
    """Add dry friction; where the model has none, with a constraint that hardly creeps while it sticks."""
    if model.dof_frictionloss[dof] == 0 and friction != 0:
        model.dof_solimp[dof] = STUCK
        model.dof_solref[dof] = (STEPS * model.opt.timestep, 1.0)
    model.dof_frictionloss[dof] += friction


class JointFriction(AddedToJoint):
    """Coulomb friction: a constant force against the motion, which also holds at rest."""

    name = "joint_friction"
    sentence = "dry (Coulomb) friction in {target}: a constant force against any motion"
    shares = (0.001, 0.02, 0.2)
    field = "dof_frictionloss"
    quantity = ("friction", "N·m", "N", 10.0)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        add_friction(model, self.dof(model, target), values[0])


class JointSoftFriction(JointFriction):
    """Coulomb friction with the model's own ``solreffriction`` and ``solimpfriction``: by default, what holds creeps.

    Simulated logs have it wherever ``frictionloss`` stands in an MJCF without more. Near rest it is viscous, up to a
    speed that falls with the joint's inertia.
    """

    name = "joint_soft_friction"
    known_as = JointFriction.name
    alone = False
    contains = (JointFriction.name,)
    sentence = "dry (Coulomb) friction in {target}, which creeps at rest as MuJoCo's does by default"

    def targets(self, setting: Setting) -> list[str | None]:
        """Return the joints in which the model has no dry friction; where it has, more of it is of the same kind."""
        m = setting.model
        return [t for t in super().targets(setting) if m.dof_frictionloss[self.dof(m, t)] == 0]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        """Stand in the place of friction that holds, also of what imitates this where that leaves less."""
        dry = simpler.effect.name in (JointFriction.name, "joint_stribeck") and simpler.target in self.targets(setting)
        return [np.array(simpler.values[:1])] if dry and simpler.values[0] > 0 else []

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.dof_frictionloss[self.dof(model, target)] += values[0]


class JointStribeck(JointEffect):
    """Dry friction that is larger at rest than in motion.

    At speed v the friction is ``coulomb + (static - coulomb)·exp(-(v/velocity)²)``: MuJoCo's dry friction holds up to
    ``static``, and a smooth force gives back the difference in motion.
    """

    name = "joint_stribeck"
    contains = (JointFriction.name,)
    sentence = "dry friction in {target} that is larger at rest than in motion (Stribeck)"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        dof = setting.dof(target)
        scale, speed = float(setting.signals.force[dof]), float(setting.signals.speed[dof])
        force = unit(setting, target, "N·m", "N")
        return (
            Quantity("coulomb", force, 0.0, 0.0, 10 * scale, scale),
            Quantity("static", force, 0.0, 0.0, 10 * scale, scale),
            Quantity("velocity", unit(setting, target, "rad/s", "m/s"), 0.2 * speed, 0.01 * speed, 3 * speed, speed),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        force, _, speed = (q.scale for q in self.quantities(setting, target))
        return [np.array([0.1 * force, 0.2 * force, share * speed]) for share in (0.1, 0.4)]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        if simpler.effect.name != JointFriction.name or simpler.values[0] <= 0:
            return []
        friction, speed = simpler.values[0], self.quantities(setting, simpler.target)[2].scale
        return [np.array([0.95 * friction, 1.5 * friction, share * speed]) for share in (0.05, 0.15, 0.4)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        add_friction(model, self.dof(model, target), max(values[0], values[1], 0.0))

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        dof, out = setting.dof(target), np.zeros_like(velocity)
        v, (coulomb, static, speed) = velocity[:, dof], values.T
        out[:, dof] = np.maximum(static - coulomb, 0.0) * -np.expm1(-((v / speed) ** 2)) * np.sign(v)
        return out


class JointFrictionSlope(JointEffect):
    """Dry friction that is larger at one end of a joint's range than at the other, as where a linkage drives it.

    On top of the dry friction that the joint has otherwise, which is that at the middle of its range (at ``qpos0``
    where it has none), slope·(q − middle) acts against the motion. Near rest this part is no larger than what stops the
    joint within a few physics steps; what holds it there is its other dry friction.
    """

    name = "joint_friction_slope"
    positional = True
    alone = False
    sentence = "dry friction in {target} that changes along its range"
    #: Physics steps in which this part, a force and no constraint, stops a joint that is slow.
    STOPS = 4.0

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = setting.signals.position[setting.coordinate(target)]
        scale = float(setting.signals.force[setting.dof(target)] / max(high - low, 1e-9))
        return (Quantity("slope", unit(setting, target, "N·m/rad", "N/m"), 0.0, -10 * scale, 10 * scale, scale),)

    @staticmethod
    def middle(model: mujoco.MjModel, target: str | None) -> float:
        """Return the position at which it is nothing."""
        joint = object_number(model, "jnt", target)
        if model.jnt_limited[joint]:
            return float(model.jnt_range[joint].mean())
        return float(model.qpos0[model.jnt_qposadr[joint]])

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        m, dof, out = setting.model, setting.dof(target), np.zeros_like(velocity)
        level = values[:, 0] * (position[:, setting.coordinate(target)] - self.middle(m, target))
        most = m.dof_M0[dof] * np.abs(velocity[:, dof]) / (self.STOPS * m.opt.timestep)
        out[:, dof] = -np.sign(velocity[:, dof]) * np.sign(level) * np.minimum(np.abs(level), most)
        return out


class DrivenJointEffect(JointEffect):
    """An effect at a joint that acts through what its actuators give, and does nothing without."""

    def targets(self, setting: Setting) -> list[str | None]:
        """Return every such joint that is driven, by actuators whose forces follow from command and state."""
        driven = driven_joints(setting.model)
        return [t for t in super().targets(setting) if setting.joint(t) in driven]

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the forces without actuators: none."""
        return np.zeros_like(velocity)


class JointLoadFriction(DrivenJointEffect):
    """Dry friction that grows with the load, as of a gear whose teeth press harder on each other.

    On top of the dry friction that the joint has otherwise, a share of the size of what its actuators give acts against
    the motion, and holds the joint at rest: there it is what stops the joint in a physics step, beside all else that
    acted in the step before.
    """

    name = "joint_load_friction"
    sentence = "dry friction in {target} that grows with the force that drives it"
    #: Share of the joint's inertia in the model's first configuration that it surely has in others.
    SURE = 0.5

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("coefficient", "-", 0.0, 0.0, 0.9, 0.2),)

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the force, none, and the velocity of the step before, ``(R, 2)``."""
        now = velocity[:, setting.dof(target)]
        return np.stack([np.zeros_like(now), now], 1)

    def force_under(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray, drive: Drive,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        dof, out = setting.dof(target), np.zeros_like(velocity)
        given, _, _ = drive.given(dof, position[:, setting.coordinate(target)], velocity[:, dof])
        level, (last, before), now = values[:, 0] * np.abs(given), memory.T, velocity[:, dof]
        inertia = self.SURE / setting.model.dof_invweight0[dof]
        out[:, dof] = np.clip(last - inertia * (2 * now - before) / drive.step, -level, level)
        return out, np.stack([out[:, dof], now], 1)


class JointStiffness(JointEffect):
    """A spring, such as a cable harness, that pulls the joint towards a rest position."""

    name = "joint_stiffness"
    positional = True
    sentence = "a spring at {target}, such as a cable harness, that pulls it towards a rest position"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        dof, coordinate = setting.dof(target), setting.coordinate(target)
        low, high = setting.signals.position[coordinate]
        span = max(high - low, 1e-9)
        scale = setting.signals.force[dof] / span
        own = float(setting.model.jnt_stiffness[setting.joint(target)])
        rest = float(setting.model.qpos_spring[coordinate])
        angle = unit(setting, target, "rad", "m")
        return (
            Quantity("stiffness", unit(setting, target, "N·m/rad", "N/m"), 0.0, -own, 30 * scale, scale),
            Quantity("reference", angle, rest, low - 10 * span, high + 10 * span, span),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        stiffness, reference = self.quantities(setting, target)
        rest, middle = reference.neutral, float(np.mean(setting.signals.position[setting.coordinate(target)]))
        begin = [rest] if abs(rest - middle) < 0.2 * reference.scale else [rest, middle]
        return [np.array([0.05 * stiffness.scale, at]) for at in begin]

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        return by_product(start, values)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        joint = object_number(model, "jnt", target)
        own, at = float(model.jnt_stiffness[joint]), model.jnt_qposadr[joint]
        total = own + values[0]
        if total > 0:
            model.qpos_spring[at] = (own * model.qpos_spring[at] + values[0] * values[1]) / total
        model.jnt_stiffness[joint] = total


class JointCogging(JointEffect):
    """A force that ripples with the position, as of a motor's magnets or a gear's teeth."""

    name = "joint_cogging"
    positional = True
    sentence = "a force at {target} that ripples with its position, as of a motor's magnets or a gear's teeth"
    #: Ripples of a turn that are tried, and how many of a slide, each half a wave more over the measured range; beside
    #: what the log shows.
    WAVES = 40
    POLES = (2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 24)
    #: Amplitude to begin with, relative to its scale: a large one bends what the screening takes for a line.
    SMALL = 0.01

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        scale, (low, high) = self._scale(setting, target), setting.signals.position[setting.coordinate(target)]
        fewest = float(np.pi / max(high - low, 1e-3))  # half a wave over the measured range: less is no ripple
        return (
            Quantity("amplitude", unit(setting, target, "N·m", "N"), 0.0, -10 * scale, 10 * scale, scale),
            Quantity("poles", unit(setting, target, "1/rad", "1/m"), max(1.0, 2 * fewest), fewest, 1e4, 1.0),
            Quantity("phase", "rad", 0.0, -20.0, 20.0, 1.0),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        low, high = setting.signals.position[setting.coordinate(target)]
        amplitude = self.SMALL * self._scale(setting, target)
        if setting.is_slide(target):  # so dense that no ripple is half a wave off over the whole range
            poles = [float(np.pi * n / max(high - low, 1e-9)) for n in range(2, 2 + self.WAVES)]
        else:
            poles = [float(n) for n in self.POLES if n * (high - low) > 2 * np.pi]
        shown = setting.signals.ripples.get(setting.coordinate(target), ())
        return [np.array([amplitude, n, 0.0]) for n in (*poles, *shown)]

    @staticmethod
    def _scale(setting: Setting, target: str | None) -> float:
        return float(setting.signals.force[setting.dof(target)])

    def screened(self) -> list[int]:
        """Return amplitude and phase: the force is linear in their sine and cosine parts."""
        return [0, 2]

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        sine, cosine = values[0], start[0] * (values[2] - start[2])
        return np.array([np.hypot(sine, cosine), values[1], start[2] + np.arctan2(cosine, sine)])

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        out = np.zeros_like(velocity)
        amplitude, poles, phase = values.T
        out[:, setting.dof(target)] = amplitude * np.sin(poles * position[:, setting.coordinate(target)] + phase)
        return out


class Armature(AddedToJoint):
    """Inertia of a rotor or gear, seen at the joint."""

    name = "armature"
    sentence = "a rotor's or gear's inertia at {target}, on top of the links'"
    field = "dof_armature"
    quantity = ("armature", "kg·m²", "kg", 20.0)
    shares = (0.0, 0.2)  # where a rotor is most of the inertia, what a small one would change misleads

    def scale(self, signals: Signals, dof: int) -> float:
        return float(signals.inertia[dof])


class JointLimit(JointEffect):
    """A stop that sits elsewhere than in the model."""

    name = "joint_limit"
    positional = True
    sentence = "the stops of {target} sit elsewhere than in the model"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        return [t for t in super().targets(setting) if m.jnt_limited[setting.joint(str(t))]]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = setting.model.jnt_range[setting.joint(target)]
        width, angle = float(high - low), unit(setting, target, "rad", "m")
        return tuple(Quantity(n, angle, 0.0, -0.45 * width, 0.45 * width, 0.1 * width) for n in ("lower", "upper"))

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Begin at the model's stops and at the ends of the measured motion."""
        low, high = ends = setting.model.jnt_range[setting.joint(target)]
        out, inwards = 0.2 * (high - low), 0.4 * (high - low)
        seen = setting.signals.position[setting.coordinate(target)]
        lower, upper = np.clip(seen - ends, (-out, -inwards), (inwards, out)).tolist()
        return [np.array(s) for s in ((0.0, 0.0), (lower, 0.0), (0.0, upper), (lower, upper))]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.jnt_range[object_number(model, "jnt", target)] += values


class JointStop(JointEffect):
    """Stops of a joint that the model lets turn or slide without end, as soft as the model's stops are."""

    name = "joint_stop"
    known_as = JointLimit.name
    positional = True
    sentence = "{target} has stops, where the model lets it move without end"

    #: Shares of the measured range by which stops lie beyond it where they are absent, and at most.
    ABSENT, FARTHEST = 0.5, 2.0

    def targets(self, setting: Setting) -> list[str | None]:
        m, seen = setting.model, setting.signals.position
        free = [t for t in super().targets(setting) if not m.jnt_limited[setting.joint(str(t))]]
        return [t for t in free if np.ptp(seen[setting.coordinate(t)]) > 0]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = (float(end) for end in setting.signals.position[setting.coordinate(target)])
        width, middle, kind = high - low, 0.5 * (low + high), unit(setting, target, "rad", "m")
        out, most = self.ABSENT * width, self.FARTHEST * width
        return (
            Quantity("lower", kind, low - out, low - most, middle, 0.1 * width),
            Quantity("upper", kind, high + out, middle, high + most, 0.1 * width),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Begin at the ends of the measured motion."""
        none = tuple(q.neutral for q in self.quantities(setting, target))
        low, high = setting.signals.position[setting.coordinate(target)]
        return [np.array(s) for s in ((low, none[1]), (none[0], high), (low, high))]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        joint = object_number(model, "jnt", target)
        model.jnt_limited[joint], model.jnt_range[joint] = 1, values


class JointCoupling(JointEffect):
    """A spring between a joint and the one before it in the chain, as of a tendon or a belt."""

    name = "joint_coupling"
    positional = True
    sentence = "a spring between {target} and the joint before it in the chain, as of a tendon or belt"

    def targets(self, setting: Setting) -> list[str | None]:
        """Return every such joint that has a partner whose position is seen, too."""
        seen = np.isfinite(setting.signals.position[setting.model.jnt_qposadr]).all(-1)
        partners = {t: self.partner(setting, t) for t in super().targets(setting)}
        return [t for t, partner in partners.items() if partner is not None and seen[partner]]

    @staticmethod
    def partner(setting: Setting, target: str | None) -> int | None:
        """Return the nearest hinge or slide joint above, of the same kind."""
        m, joint = setting.model, setting.joint(target)
        before = [j for j in range(joint) if m.jnt_bodyid[j] == m.jnt_bodyid[joint]]
        body = int(m.body_parentid[m.jnt_bodyid[joint]])
        while not before and body > 0:
            before = [int(m.body_jntadr[body]) + i for i in range(int(m.body_jntnum[body]))]
            body = int(m.body_parentid[body])
        return before[-1] if before and m.jnt_type[before[-1]] == m.jnt_type[joint] else None

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = setting.signals.position[setting.coordinate(target)]
        scale = float(setting.signals.force[setting.dof(target)] / max(high - low, 1e-9))
        return (Quantity("stiffness", unit(setting, target, "N·m/rad", "N/m"), 0.0, 0.0, 30 * scale, scale),)

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        m, other = setting.model, self.partner(setting, target)
        assert other is not None
        stretch = position[:, setting.coordinate(target)] - position[:, m.jnt_qposadr[other]]
        out = np.zeros_like(velocity)
        out[:, setting.dof(target)] = -values[:, 0] * stretch
        out[:, m.jnt_dofadr[other]] += values[:, 0] * stretch
        return out
