"""Effects of the whole world: gravity's direction, the ground's, and the simulator's own step."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from dropo_torch.effects.base import Effect, Placed, Quantity, Setting


def _turn(roll: float, pitch: float) -> np.ndarray:
    """Return the rotation about the world's x by ``roll`` and then about its y by ``pitch``."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return about_y @ about_x


class WorldEffect(Effect):
    """An effect of the world as a whole."""

    kind = "world"

    def targets(self, setting: Setting) -> list[str | None]:
        return [None]


class TiltEffect(WorldEffect):
    """Something that is turned about the world's x and y axes."""

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return tuple(Quantity(name, "rad", 0.0, -0.7, 0.7, 0.1) for name in ("roll", "pitch"))


class GravityTilt(TiltEffect):
    """A base that does not stand level: gravity is turned about the world's x and y axes."""

    name = "gravity_tilt"
    sentence = "the base does not stand level: gravity is tilted"

    def targets(self, setting: Setting) -> list[str | None]:
        return [None] if np.linalg.norm(setting.model.opt.gravity) > 0 else []

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.opt.gravity = _turn(*values) @ model.opt.gravity


class GroundSlope(TiltEffect):
    """A ground that is not level: every plane of the world is turned about the world's x and y axes."""

    name = "ground_slope"
    sentence = "the ground is not level"

    def targets(self, setting: Setting) -> list[str | None]:
        return [None] if any(setting.signals.contacts[g] for g in _planes(setting.model)) else []

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        turned = np.empty(4)
        mujoco.mju_mat2Quat(turned, np.ascontiguousarray(_turn(*values)).reshape(9))
        for g in _planes(model):
            mujoco.mju_mulQuat(model.geom_quat[g], turned, model.geom_quat[g].copy())
            model.geom_sameframe[g] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


def _planes(model: mujoco.MjModel) -> list[int]:
    planes = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0)
    return [int(g) for g in np.flatnonzero(planes)]


class FluidMedium(WorldEffect):
    """Water or another medium around what swims or flies, as MuJoCo simulates it: lift and drag by its density."""

    name = "fluid_medium"
    sentence = "the robot moves in a medium, such as water, that the model lacks"
    #: Of air, of what is thin, and of water.
    shares = (0.0012, 0.1, 1.0)

    #: Density of water, kg/m³, and the largest as a multiple of it.
    WATER, DENSEST = 1000.0, 1.5

    def targets(self, setting: Setting) -> list[str | None]:
        free = setting.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        moves = setting.signals.linear_speed[setting.model.jnt_bodyid[free]] > 0
        return [None] if moves.any() else []

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        own = float(setting.model.opt.density)
        return (Quantity("density", "kg/m³", 0.0, -own, self.DENSEST * self.WATER, self.WATER),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.opt.density += values[0]


class Integration(WorldEffect):
    """The simulator's own step is too coarse: a finer one, with a better integrator, gives other motion."""

    name = "integration"
    sentence = "the simulator's own integration step is too coarse for this motion"

    #: How many times finer the step becomes, and its integrator.
    FINER = 8
    #: How many times finer a step serves for differences, with the better integrator.
    EASED = 2
    shares = (1 / FINER, 0.25, 0.5)
    steps = True
    #: How many times finer the step may be where the integrator stays, whose error a log then has by its own step.
    RATIOS: tuple[int, ...] = (2, 3, 4, 5, 8)

    def keeps_integrator(self, setting: Setting) -> bool:
        """Return whether the integrator stays the model's."""
        finer = copy.copy(setting.model)
        Integration().apply(finer, None, np.array([setting.model.opt.timestep / self.FINER]))
        return bool(finer.opt.integrator == setting.model.opt.integrator)

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        """Return other steps of an integrator that stays."""
        if simpler.effect.name != self.name or not self.keeps_integrator(setting):
            return []
        own, step = simpler.values[0], float(setting.model.opt.timestep)
        return [np.array([step / ratio]) for ratio in self.RATIOS if not np.isclose(step / ratio, own)]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        step = float(setting.model.opt.timestep)
        return (Quantity("timestep", "s", step, step / self.FINER, step, step, discrete=True),)

    def eased(self, setting: Setting, values: tuple[float, ...]) -> tuple[float, ...]:
        step = float(setting.model.opt.timestep)
        return values if round(step / values[0]) % self.EASED else (step / self.EASED,)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        if values[0] == model.opt.timestep:
            return
        model.opt.timestep = values[0]
        if not _has_stiff_damping(model):
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4


class OwnIntegration(Integration):
    """A log that was simulated by the model's own integrator with a finer step, and so has an error of its own."""

    name = "integration_own"
    known_as = Integration.name
    sentence = "the simulator's own integration step is coarser than the one that the log was made with"

    #: How many times finer the step may become, and with which numbers a search begins.
    FINER = 16
    RATIOS = (2, 3, 4, 5, 8, 10)

    def targets(self, setting: Setting) -> list[str | None]:
        """Return the world, unless :class:`Integration` keeps the model's integrator, too."""
        return [] if self.keeps_integrator(setting) else [None]

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([float(setting.model.opt.timestep) / ratio]) for ratio in self.RATIOS]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        there = simpler.effect.name == Integration.name and self.targets(setting)
        return self.starts(setting, None) if there else []

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.opt.timestep = values[0]


def _has_stiff_damping(model: mujoco.MjModel) -> bool:
    """Whether contacts or servo damping make an explicit integrator a worse choice."""
    return model.opt.integrator in (
        mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    ) and bool((model.actuator_biasprm[:, 2] < 0).any())  # fmt: skip
