"""A transmission that gives: a spring between the rotor and the joint, whose deflection no column of a log shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from dropo_torch.effects.base import Quantity, Setting, object_number
from dropo_torch.effects.drive import Drive, detach, driven_joints
from dropo_torch.effects.joint import JointEffect, unit

#: Highest frequency at which the joint may oscillate on the spring, in radians of a physics step.
STIFFEST = 0.5
#: Least inertia of the rotor, relative to the joint's.
LEAST_ROTOR = 0.01
#: Frequencies from which a search begins, in radians of a logged step; the rotor's inertia there, relative to the
#: joint's, and the spring's damping, relative to the critical one.
FREQUENCIES, ROTOR, DAMPED = (0.05, 0.15, 0.4), 0.2, 0.1
#: Steps of the rotor from one row of the log to the next.
STEPS = 2


class JointElasticity(JointEffect):
    """A gear, belt or cable that gives: the actuators drive a rotor, which pulls the joint through a spring.

    The log shows the joint, behind the spring; servos see the rotor, where their encoders are. Of the joint's armature
    the rotor's ``inertia`` no longer moves with it. What the log shows before a simulation tells how the rotor moves
    where it begins; where nothing does, it is as fast as the joint there, and the spring as far deflected as what the
    actuators give holds it.
    """

    name = "joint_elasticity"
    positional = True
    sentence = "the transmission of {target} gives: a spring between its motor and the joint"

    def targets(self, setting: Setting) -> list[str | None]:
        """Return every such joint that is driven, by actuators whose forces follow from command and state."""
        driven = driven_joints(setting.model)
        return [t for t in super().targets(setting) if setting.joint(t) in driven]

    @staticmethod
    def own_inertia(setting: Setting, target: str | None) -> float:
        """Return the inertia that the joint moves, without the rotor's, at the typical configuration."""
        dof = setting.dof(target)
        return float(max(setting.signals.inertia[dof] - setting.model.dof_armature[dof], 1e-12))

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        dof, inertia = setting.dof(target), self.own_inertia(setting, target)
        stiffest = STIFFEST**2 / (setting.model.dof_invweight0[dof] * setting.model.opt.timestep**2)
        middle = inertia * (FREQUENCIES[1] / setting.signals.timestep) ** 2
        most = max(float(stiffest), 2 * middle)
        damping = 2 * np.sqrt(middle * inertia)
        return (
            Quantity("stiffness", unit(setting, target, "N·m/rad", "N/m"), most, 1e-3 * middle, most, middle),
            Quantity("damping", unit(setting, target, "N·m·s/rad", "N·s/m"), 0.0, 0.0, 10 * damping, damping),
            Quantity("inertia", unit(setting, target, "kg·m²", "kg"), 0.0, 0.0, 20 * inertia, inertia),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        inertia, most = self.own_inertia(setting, target), self.quantities(setting, target)[0].high
        rotor = float(setting.model.dof_armature[setting.dof(target)]) or ROTOR * inertia
        stiffnesses = [inertia * (f / setting.signals.timestep) ** 2 for f in FREQUENCIES]
        return [np.array([k, 2 * DAMPED * np.sqrt(k * inertia), rotor]) for k in stiffnesses if k < 0.9 * most]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        joint = object_number(model, "jnt", target)
        dof = model.jnt_dofadr[joint]
        model.dof_armature[dof] = max(model.dof_armature[dof] - values[2], 0.0)
        detach(model, joint)  # its actuators drive the rotor alone

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the forces where nothing drives the rotor: none."""
        return np.zeros_like(velocity)

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return what is not known yet, for it depends on the actuators: position and velocity of the rotor, NaN."""
        return np.full((len(position), 2), np.nan)

    def replay(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        drives: Sequence[Drive],
    ) -> np.ndarray:  # fmt: skip
        """Return the rotor's position and velocity, which turned under the commands while the joint moved as logged."""
        q, v = position[..., setting.coordinate(target)], velocity[..., setting.dof(target)]
        rotor = np.full((len(q), 2), np.nan)
        for row, drive in enumerate(drives):
            for a in (np.arange(STEPS) + 0.5) / STEPS:  # the joint's motion between two rows is a line
                q_now, v_now = ((1 - a) * x[:, row] + a * x[:, row + 1] for x in (q, v))
                short = replace(drive, step=drive.step / STEPS)
                rotor = self._turned(setting, target, values, q_now, v_now, rotor, short)[1]
        return rotor

    def force_under(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray, drive: Drive,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        dof, out = setting.dof(target), np.zeros_like(velocity)
        q, v = position[:, setting.coordinate(target)], velocity[:, dof]
        out[:, dof], rotor = self._turned(setting, target, values, q, v, memory, drive)
        return out, rotor

    def _turned(
        self, setting: Setting, target: str | None, values: np.ndarray, q: np.ndarray, v: np.ndarray,
        rotor: np.ndarray, drive: Drive,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """The spring's force on the joint in a step at whose middle that is at ``q`` with ``v``; the rotor after it.

        By the implicit midpoint rule, which is stable however stiff spring and servo are.
        """
        dof, step = setting.dof(target), drive.step
        stiffness, damping, inertia = values.T
        inertia = np.maximum(inertia, LEAST_ROTOR * self.own_inertia(setting, target))
        angle, speed = rotor.T
        if (begins := np.isnan(angle)).any():
            given, stiff, _ = drive.given(dof, q, v)
            angle, speed = np.where(begins, q + given / (stiffness + stiff), angle), np.where(begins, v, speed)
        given, stiff, damp = drive.given(dof, angle, speed)
        half = 0.5 * step
        pull = given + damp * speed + stiffness * (q - angle) + damping * v
        mean = (inertia * speed + half * pull) / (inertia + half * (damp + damping) + half**2 * (stiff + stiffness))
        force = stiffness * (angle + half * mean - q) + damping * (mean - v)
        return force, np.stack([angle + step * mean, 2 * mean - speed], 1)
