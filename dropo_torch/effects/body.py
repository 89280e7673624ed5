"""Effects of bodies: mass that the model lacks, forces from outside, air."""

from __future__ import annotations

import itertools
from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dropo_torch.effects.base import Effect, Placed, Quantity, Setting, by_product, object_number


def body_number(model: mujoco.MjModel, target: str | None) -> int:
    """Return the number of a body by its name, or ``body3`` for an unnamed one."""
    return object_number(model, "body", target)


class BodyEffect(Effect):
    """An effect of one moving body.

    Attributes:
        turning: whether it also shows in a body that only turns about its center.
    """

    kind = "body"
    turning: ClassVar[bool] = True

    def targets(self, setting: Setting) -> list[str | None]:
        """Return every body with mass that moves in the log."""
        signals = setting.signals
        speed = signals.linear_speed + (signals.angular_speed if self.turning else 0.0)
        moving = (setting.model.body_mass > 0) & (speed > 0)
        return [n for n, moves in zip(setting.names("body")[1:], moving[1:], strict=True) if moves]

    @staticmethod
    def extent(setting: Setting, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box around a body's geoms, in its frame, ``(3,)`` each."""
        m = setting.model
        low, high = m.body_ipos[body] - 0.02, m.body_ipos[body] + 0.02
        for g in range(m.body_geomadr[body], m.body_geomadr[body] + m.body_geomnum[body]):
            turn = _rotation(m.geom_quat[g])
            reach, center = np.abs(turn) @ m.geom_aabb[g, 3:], m.geom_pos[g] + turn @ m.geom_aabb[g, :3]
            low, high = np.minimum(low, center - reach), np.maximum(high, center + reach)
        return low, high


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, quaternion)
    return turn.reshape(3, 3)


def add_point_mass(model: mujoco.MjModel, body: int, mass: float, position: np.ndarray) -> None:
    """Weld a point mass at ``position`` in a body's frame: its mass, center and inertia follow."""
    own, center = float(model.body_mass[body]), model.body_ipos[body].copy()
    axes = _rotation(model.body_iquat[body])
    total = own + mass
    shared = (own * center + mass * position) / total
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    for m, at in ((own, center), (mass, position)):
        arm = at - shared
        inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    model.body_mass[body], model.body_ipos[body] = total, shared
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(axes).reshape(9))
    model.body_inertia[body], model.body_iquat[body] = moments, quaternion
    unmark_simple(model, body)


def unmark_simple(model: mujoco.MjModel, body: int) -> None:
    """Tell MuJoCo that a body's center and axes are no longer those of its frame."""
    model.body_sameframe[body] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


class Payload(BodyEffect):
    """A mass fixed to a body, within its own size of it: a tool, a gripped object, a battery."""

    name = "payload"
    sentence = "a mass on {target} that the model lacks, such as a tool or a gripped object"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        body = body_number(setting.model, target)
        own = float(setting.model.body_mass[body])
        low, high = self.extent(setting, body)
        size = float(np.linalg.norm(high - low))
        center = setting.model.body_ipos[body]
        ends = zip("xyz", center.tolist(), (low - size).tolist(), (high + size).tolist(), strict=True)
        places = [Quantity(n, "m", at, least, most, 0.5 * size) for n, at, least, most in ends]
        return (Quantity("mass", "kg", 0.0, 0.0, 5 * own, own), *places)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Begin with a small mass at the body's center and at the ends of its longest side, or with a large one there.

        Where a fit follows mass × distance, a large mass far from where it sits is many small steps from a small one.
        """
        body = body_number(setting.model, target)
        low, high = self.extent(setting, body)
        longest, own = int(np.argmax(high - low)), float(setting.model.body_mass[body])
        starts = np.tile([0.05 * own, *setting.model.body_ipos[body]], (4, 1))
        starts[1:3, 1 + longest] = low[longest], high[longest]
        starts[3, 0] = 0.2 * own
        return list(starts)

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        return by_product(start, values)

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        """Begin with masses, where they are in reach, that shift the center of mass as far."""
        if simpler.effect.name != CenterOfMass.name:
            return []
        body = body_number(setting.model, simpler.target)
        own, center = float(setting.model.body_mass[body]), setting.model.body_ipos[body]
        quantities = self.quantities(setting, simpler.target)[1:]
        low, high = (np.array([getattr(q, end) for q in quantities]) for end in ("low", "high"))
        masses = own * np.array([0.03, 0.1, 0.3, 1.0, 3.0])
        places = [center + np.array(simpler.values) * (own + mass) / mass for mass in masses]
        return [np.concatenate([[m], np.clip(p, low, high)]) for m, p in zip(masses, places, strict=True)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        if values[0] != 0:
            add_point_mass(model, body_number(model, target), float(values[0]), np.asarray(values[1:]))


class CenterOfMass(BodyEffect):
    """A center of mass that sits elsewhere than in the model."""

    name = "center_of_mass"
    sentence = "the center of mass of {target} sits elsewhere than in the model"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = self.extent(setting, body_number(setting.model, target))
        size = float(np.linalg.norm(high - low))
        return tuple(Quantity(n, "m", 0.0, -size, size, 0.2 * size) for n in "xyz")

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        body = body_number(model, target)
        model.body_ipos[body] += values
        unmark_simple(model, body)


class Inertia(BodyEffect):
    """Moments of inertia that differ from the model's in proportion."""

    name = "inertia"
    sentence = "the moments of inertia of {target} are not the model's"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        return [t for t in super().targets(setting) if m.body_inertia[body_number(m, t)].max() > 1e-12]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("factor", "-", 1.0, 0.02, 30.0, 0.5),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.body_inertia[body_number(model, target)] *= values[0]


class ExternalForce(BodyEffect):
    """A constant force on a body, in the world's directions: a hanging cable, a counterweight."""

    name = "external_force"
    turning = False
    sentence = "a constant force on {target} from outside, such as a hanging cable"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m = setting.model
        weight = float(m.body_subtreemass[body_number(m, target)])
        scale = max(weight * float(np.linalg.norm(m.opt.gravity)), weight)
        return tuple(Quantity(n, "N", 0.0, -5 * scale, 5 * scale, 0.1 * scale) for n in "xyz")

    def wrench(self, setting: Setting, target: str | None, values: np.ndarray) -> np.ndarray:
        out = np.zeros((setting.model.nbody, 6))
        out[body_number(setting.model, target), :3] = values
        return out


class FluidDrag(BodyEffect):
    """Drag of air or water on a body, with the square of its speed.

    It is MuJoCo's drag of the ellipsoid that stands for the body's largest geom, by the area that faces the motion: the
    coefficient is that of motion with the broadest side ahead. The coefficients that also brake rotation are zero, and
    the medium is so thin that the mass of it that moves along does not count.
    """

    name = "fluid_drag"
    turning = False
    sentence = "drag of air or water on {target}, with the square of its speed"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        if m.opt.density > 0 or m.opt.viscosity > 0:
            return []
        return [t for t in super().targets(setting) if self.geom(m, t) is not None]

    #: Density of the medium, kg/m³.
    DENSITY = 1e-6

    @staticmethod
    def geom(model: mujoco.MjModel, target: str | None) -> int | None:
        """Return the body's largest geom."""
        body = body_number(model, target)
        own = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        return max(own, key=lambda g: float(np.prod(model.geom_aabb[g, 3:])), default=None)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        body = body_number(setting.model, target)
        weight = float(setting.model.body_mass[body]) * 10.0
        scale = 0.1 * weight / float(setting.signals.linear_speed[body]) ** 2
        return (Quantity("coefficient", "N·s²/m²", 0.0, 0.0, 300 * scale, scale),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        geom = self.geom(model, target)
        if geom is None or values[0] == 0:
            return
        area = _largest_section(model, geom)
        model.opt.density = self.DENSITY
        for g in range(model.ngeom):  # a body whose geoms all have coefficient zero feels nothing
            if model.geom_fluid[g, 0] == 0:
                model.geom_fluid[g] = 0.0
                model.geom_fluid[g, 0] = 1.0
        model.geom_fluid[geom, 1] = values[0] / (area * self.DENSITY)


class FloatingEffect(BodyEffect):
    """An effect of what no carriage holds: a free body, or one that slides in a plane or in space on its own joints."""

    turning = False

    def targets(self, setting: Setting) -> list[str | None]:
        return [t for t in super().targets(setting) if len(self.moving(setting.model, t))]

    @staticmethod
    def moving(model: mujoco.MjModel, target: str | None) -> np.ndarray:
        """Return the degrees of freedom of a body's frame: three, two in a plane, or none of a body that is held.

        The velocities along them are those of the frame along axes at right angles.
        """
        body = body_number(model, target)
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        kinds = model.jnt_type[first : first + count].tolist()
        begin = int(model.body_dofadr[body])
        if kinds[:1] == [mujoco.mjtJoint.mjJNT_FREE]:
            return np.arange(begin, begin + 3)
        slides = sum(1 for _ in itertools.takewhile(lambda kind: kind == mujoco.mjtJoint.mjJNT_SLIDE, kinds))
        axes = model.jnt_axis[first : first + slides]
        held = slides < 2 or model.body_weldid[model.body_parentid[body]] != 0
        is_skew = not np.allclose(axes @ axes.T, np.eye(slides), atol=1e-6)
        return np.arange(0 if held or is_skew else slides) + begin


class LinearDrag(FloatingEffect):
    """Drag of air or water in proportion to the speed of a floating body: of what is slow, small, or driven by rotors.

    It is damping of the degrees of freedom in which the body's frame moves.
    """

    name = "linear_drag"
    sentence = "drag of air or water on {target}, in proportion to its speed"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, body = setting.model, body_number(setting.model, target)
        scale = float(m.body_subtreemass[body]) / float(setting.signals.linear_speed[body])
        own = float(self._damping(m)[self.moving(m, target)].min())
        return (Quantity("coefficient", "N·s/m", 0.0, -own, 100 * scale, scale),)

    @staticmethod
    def _damping(model: mujoco.MjModel) -> np.ndarray:
        """The damping of each degree of freedom ``(nv,)``, a view."""
        return np.asarray(np.reshape(model.dof_damping, (model.nv, -1))[:, 0])

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        self._damping(model)[self.moving(model, target)] += values[0]

    @property
    def in_mjcf(self) -> bool:
        """No: there, a free joint has one damping, which slows its turning, too."""
        return False


class QuadraticDrag(FloatingEffect):
    """Drag on a floating body with the square of its speed, alike in all directions: −coefficient·|v|·v of its frame.

    Nothing of it turns the body.
    """

    name = "quadratic_drag"
    known_as = FluidDrag.name
    sentence = "drag of air or water on {target}, with the square of its speed, alike in all directions"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return FluidDrag().quantities(setting, target)

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        own, out = self.moving(setting.model, target), np.zeros_like(velocity)
        along = velocity[:, own]
        out[:, own] = -values[..., :1] * np.linalg.norm(along, axis=1, keepdims=True) * along
        return out


class AxisDrag(FloatingEffect):
    """Drag on a free body with the square of its speed along each axis of its frame, as a hull or a wing has it.

    Along each axis it is −coefficient·|v|·v of the velocity along that axis (Fossen 2011, eq. 6.72, its diagonal).
    """

    name = "axis_drag"
    known_as = FluidDrag.name
    sentence = "drag of air or water on {target}, with the square of its speed along each of its axes"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        free = {b for b in range(m.nbody) if m.body_dofnum[b] == 6 and m.body_jntnum[b] == 1}
        return [t for t in super().targets(setting) if body_number(m, t) in free]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        (one,) = FluidDrag().quantities(setting, target)
        return tuple(Quantity(axis, one.unit, one.neutral, one.low, one.high, one.scale) for axis in "xyz")

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        m, body = setting.model, body_number(setting.model, target)
        first, place = int(m.body_dofadr[body]), int(m.jnt_qposadr[m.body_jntadr[body]]) + 3
        turn, out = Rotation.from_quat(position[:, place : place + 4], scalar_first=True), np.zeros_like(velocity)
        along = turn.apply(velocity[:, first : first + 3], inverse=True)
        out[:, first : first + 3] = turn.apply(-values * np.abs(along) * along)
        return out


def _largest_section(model: mujoco.MjModel, geom: int) -> float:
    """Return the largest section of the ellipsoid by which MuJoCo computes a geom's drag, in m²."""
    radius, length, _ = size = model.geom_size[geom]
    axes = {
        int(mujoco.mjtGeom.mjGEOM_SPHERE): (radius, radius, radius),
        int(mujoco.mjtGeom.mjGEOM_CAPSULE): (radius, radius, length + radius),
        int(mujoco.mjtGeom.mjGEOM_CYLINDER): (radius, radius, length),
    }.get(int(model.geom_type[geom]), size)
    _, middle, largest = np.sort(axes)
    return float(np.pi * middle * largest)
