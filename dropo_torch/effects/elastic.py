"""A transmission that gives: a spring between the rotor and the joint, whose deflection no column of a log shows."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from dropo_torch.effects.base import Quantity, Setting, object_number
from dropo_torch.effects.drive import Drive, detach
from dropo_torch.effects.joint import DrivenJointEffect, unit

#: Highest frequency at which the joint may oscillate on the spring, in radians of a physics step.
STIFFEST = 0.5
#: Least inertia of the rotor, relative to the joint's.
LEAST_ROTOR = 0.01
#: Frequencies from which a search begins, in radians of a logged step; the rotor's inertia there, relative to the
#: joint's, and the spring's damping, relative to the critical one.
FREQUENCIES, ROTOR, DAMPED = (0.05, 0.15, 0.4), 0.2, 0.1


#: Steps of the rotor between two rows of the log.
STEPS = 2


def _between(position: np.ndarray, velocity: np.ndarray, step: float, share: float) -> np.ndarray:
    """Positions ``(R, P)`` at a share of the way from each row to the next, by a cubic (Hermite)."""
    a, (q, after), (v, later) = share, (position[:, :-1], position[:, 1:]), (velocity[:, :-1], velocity[:, 1:])
    return q + (after - q) * a**2 * (3 - 2 * a) + step * a * (1 - a) * ((1 - a) * v - a * later)


def _by_row(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Values of the shape ``(R, P)``, row by row ``(P, R)``."""
    return np.ascontiguousarray(np.broadcast_to(values, like.shape).T)


class JointElasticity(DrivenJointEffect):
    """A gear, belt or cable that gives: the actuators drive a rotor, which pulls the joint through a spring.

    The log shows the joint, behind the spring; servos see the rotor, where their encoders are. Of the joint's armature
    the rotor's ``inertia`` no longer moves with it. What the log shows before a simulation tells how the rotor moves
    where it begins; where nothing does, it is as fast as the joint there, and the spring as far deflected as what the
    actuators give holds it.
    """

    name = "joint_elasticity"
    positional = True
    #: What is left of the rotor's state where it is taken for forgotten.
    FORGOTTEN = 0.01
    #: Share of its compliance to which a step of a fit may stiffen it.
    SHORTEST = 0.25
    sentence = "the transmission of {target} gives: a spring between its motor and the joint"

    @staticmethod
    def own_inertia(setting: Setting, target: str | None) -> float:
        """Return the inertia that the joint moves, without the rotor's, at the typical configuration."""
        dof = setting.dof(target)
        return float(max(setting.signals.inertia[dof] - setting.model.dof_armature[dof], 1e-12))

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        inertia = self.own_inertia(setting, target)
        stiffness = inertia * (FREQUENCIES[1] / setting.signals.timestep) ** 2
        damping = 2 * np.sqrt(stiffness * inertia)
        return (
            Quantity("compliance", unit(setting, target, "rad/(N·m)", "m/N"), 0.0, 0.0, 1e3 / stiffness, 1 / stiffness),
            Quantity("damping", unit(setting, target, "N·m·s/rad", "N·s/m"), 0.0, 0.0, 10 * damping, damping),
            Quantity("inertia", unit(setting, target, "kg·m²", "kg"), 0.0, 0.0, 20 * inertia, inertia),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        inertia, stiffest = self.own_inertia(setting, target), self.stiffest(setting, target)
        rotor = float(setting.model.dof_armature[setting.dof(target)]) or ROTOR * inertia
        stiffnesses = [inertia * (f / setting.signals.timestep) ** 2 for f in FREQUENCIES]
        return [np.array([1 / k, 2 * DAMPED * np.sqrt(k * inertia), rotor]) for k in stiffnesses if k < 0.9 * stiffest]

    @staticmethod
    def stiffest(setting: Setting, target: str | None) -> float:
        """Return the largest stiffness that a physics step can follow."""
        invweight = setting.model.dof_invweight0[setting.dof(target)]
        return float(STIFFEST**2 / (invweight * setting.model.opt.timestep**2))

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Move in the compliance and in its products with damping and inertia, which are what acts.

        Far below the resonance, the link shows these products alone: a spring twice as soft with half of both is nearly
        the same.
        """
        if start[0] <= 0:
            return values
        compliance = max(values[0], self.SHORTEST * start[0])
        products = start[0] * values[1:] + start[1:] * (values[0] - start[0])
        return np.concatenate([[compliance], np.maximum(products, 0.0) / compliance])

    def directions(self, values: np.ndarray) -> np.ndarray:
        """Return the move of the compliance in which its products with damping and inertia stay, and those of these."""
        found = np.eye(len(values))
        if values[0] > 0:
            found[0, 1:] = -values[1:] / values[0]
        return found

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        if values[0] == 0:
            return
        joint = object_number(model, "jnt", target)
        dof = model.jnt_dofadr[joint]
        model.dof_armature[dof] = max(model.dof_armature[dof] - values[2], 0.0)
        detach(model, joint)  # its actuators drive the rotor alone

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the rotor's position and velocity, and whether they are known, ``(R, 3)``: the drive decides."""
        q, v = position[:, setting.coordinate(target)], velocity[:, setting.dof(target)]
        return np.stack([q, v, np.zeros_like(q)], 1)

    def memory(self, values: np.ndarray) -> float:
        """Return the time in which what the rotor was before decays to :attr:`FORGOTTEN`, were it not driven."""
        compliance, damping, inertia = (float(x) for x in values)
        if compliance == 0:
            return 0.0
        if damping == 0:
            return math.inf
        slow = max(2 * inertia / damping, damping * compliance)  # that of an oscillation, or of a creeping spring
        return float(slow * -math.log(self.FORGOTTEN))

    def replay(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        drive: Drive,
    ) -> np.ndarray:  # fmt: skip
        """Return :meth:`recall` of a rotor that turned under the commands while the joint moved as the log shows."""
        dof, step = setting.dof(target), drive.step / STEPS
        q, v = position[..., setting.coordinate(target)], velocity[..., dof]
        seen = np.isfinite(q[:, :-1])
        q, v = np.where(np.isfinite(q), q, 0.0), np.where(np.isfinite(v), v, 0.0)
        stiffness, damping, inertia = (x[:, None] for x in self._numbers(setting, target, values))
        given, stiff, damp = drive.given(dof, q[:, :-1], v[:, :-1])
        held = q[:, :-1] + given / (stiffness + stiff)
        constant = given + stiff * q[:, :-1] + damp * v[:, :-1]
        half = 0.5 * step
        whole = inertia + half * (damp + damping) + half**2 * (stiff + stiffness)
        keeps, pulls = (_by_row(x, q[:, :-1]) for x in (inertia / whole, half * (stiff + stiffness) / whole))
        drives = []
        for share in (np.arange(STEPS) + 0.5) / STEPS:
            there = stiffness * _between(q, v, drive.step, share) + damping * (
                (1 - share) * v[:, :-1] + share * v[:, 1:]
            )
            drives.append(_by_row(half * (constant + there) / whole, q[:, :-1]))
        angle, speed, known = q[:, 0].copy(), v[:, 0].copy(), np.zeros(len(q), dtype=bool)
        for row in range(seen.shape[1]):  # the implicit midpoint rule, as in a simulation
            begins = seen[:, row] & ~known
            if begins.any():
                angle[begins], speed[begins], known = held[begins, row], v[begins, row], known | begins
            for driven in drives:
                mean = keeps[row] * speed - pulls[row] * angle + driven[row]
                angle, speed = angle + step * mean, 2 * mean - speed
        recalled = self.recall(setting, target, values, position[:, -1], velocity[:, -1])
        return np.where(known[:, None], np.stack([angle, speed, np.ones_like(angle)], 1), recalled)

    def force_under(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray, drive: Drive,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        dof, out, half = setting.dof(target), np.zeros_like(velocity), 0.5 * drive.step
        q, v = position[:, setting.coordinate(target)], velocity[:, dof]
        stiffness, damping, inertia = self._numbers(setting, target, values)
        angle, speed, known = memory.T
        if not known.all():
            given, stiff, _ = drive.given(dof, q, v)
            angle, speed = np.where(known, angle, q + given / (stiffness + stiff)), np.where(known, speed, v)
        given, stiff, damp = drive.given(dof, angle, speed)
        pull = given + damp * speed + stiffness * (q - angle) + damping * v
        whole = inertia + half * (damp + damping) + half**2 * (stiff + stiffness)
        mean = (inertia * speed + half * pull) / whole  # the implicit midpoint rule: stable, however stiff
        spring = stiffness * (angle + half * mean - q) + damping * (mean - v)
        out[:, dof] = np.where(values[:, 0] > 0, spring, 0.0)
        return out, np.stack([angle + drive.step * mean, 2 * mean - speed, np.ones_like(angle)], 1)

    def _numbers(self, setting: Setting, target: str | None, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Stiffness, damping, and an inertia of the rotor that is not nothing, ``(R,)`` each."""
        compliance, damping, inertia = values.T
        stiffness = 1 / np.maximum(compliance, 1 / self.stiffest(setting, target))
        return stiffness, damping, np.maximum(inertia, LEAST_ROTOR * self.own_inertia(setting, target))
