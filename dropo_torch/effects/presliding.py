"""Dry friction that gives elastically before it slides: a force that remembers how far the joint has moved."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from dropo_torch.effects.base import Placed, Quantity, Setting, find_effect
from dropo_torch.effects.drive import Drive
from dropo_torch.effects.joint import JointEffect, JointStribeck, unit

#: Seconds for which a joint has moved with the velocity that it has where nothing tells what was before.
PAST = 0.1
#: Seconds before a simulation from which the bristles are replayed.
REPLAYED = 0.5
#: Shares of the typical force, with factors of a displacement, from which a search begins.
STARTS = ((0.01, 1.0), (0.2, 1.0), (0.2, 10.0))
#: Highest frequency at which the bristles may let the joint oscillate, in radians of a physics step.
STIFFEST = 0.5


def bristle_after(
    bristle: np.ndarray, moved: np.ndarray, displacement: np.ndarray | float, level: np.ndarray | float = 1.0
) -> np.ndarray:
    """Return the share of the friction that is built up after a motion in one direction, exactly.

    Args:
        bristle: the share before, from -level to level.
        moved: how far the joint has moved since, with its sign.
        displacement: the motion in which all but 1/e of the friction builds up, where the level is 1.
        level: what the share builds up to at the velocity of the motion: 1 (Dahl), or more when slow (LuGre).
    """
    toward = level * np.sign(moved)
    return np.asarray(toward + (bristle - toward) * np.exp(-np.abs(moved) / (displacement * level)))


class JointPresliding(JointEffect):
    """Dry friction that gives elastically before it slides (Dahl).

    The friction is ``coulomb·z``. The deflection z of the bristles, -1 to 1, follows a small motion dq by
    ``(dq - |dq|·z)/displacement``: at rest it is a spring of ``coulomb/displacement``, at most as stiff as a physics
    step can hold. The bristles follow the motion before a simulation where it is known; elsewhere it begins as if the
    joint had moved for a tenth of a second at the velocity that it has.
    """

    name = "joint_presliding"
    contains: ClassVar[tuple[str, ...]] = ("joint_friction", "joint_soft_friction", "joint_stribeck")
    sentence = "dry friction in {target} that gives elastically before it slides (presliding)"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        low, high = setting.signals.position[setting.coordinate(target)]
        span = float(high - low) if np.isfinite(high - low) and high > low else 1.0
        scale = float(setting.signals.force[setting.dof(target)])
        return (
            Quantity("coulomb", unit(setting, target, "N·m", "N"), 0.0, 0.0, 10 * scale, scale),
            Quantity("displacement", unit(setting, target, "rad", "m"), 3e-3 * span, 0.0, 0.2 * span, 0.01 * span),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        force, displacement = self.quantities(setting, target)[:2]
        return [np.array([share * force.scale, far * displacement.neutral]) for share, far in STARTS]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        if simpler.effect.name not in self.contains or simpler.values[0] <= 0:
            return []
        return [np.array([simpler.values[0], self.quantities(setting, simpler.target)[1].neutral])]

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Shorten the displacement by its factor, not by its difference: no step takes it to nothing at once."""
        shorter = values[1] < start[1]
        return np.array([values[0], start[1] * np.exp(values[1] / start[1] - 1)]) if shorter else values

    @staticmethod
    def softened(setting: Setting, target: str | None, values: np.ndarray) -> np.ndarray:
        """Return displacements ``(R,)`` at which the joint does not oscillate faster than a physics step can follow."""
        model, dof = setting.model, setting.dof(target)
        least = values[:, 0] * model.dof_invweight0[dof] * (model.opt.timestep / STIFFEST) ** 2
        return np.asarray(np.maximum(values[:, 1], np.maximum(least, 1e-12)))

    def level(self, values: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return what the friction builds up to at each velocity, relative to ``coulomb``, ``(R,)``."""
        return np.ones(np.broadcast_shapes(values.shape[:1], speed.shape))

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        speed, displacement = velocity[:, setting.dof(target)], self.softened(setting, target, values)
        bristle = bristle_after(np.zeros_like(speed), PAST * speed, displacement, self.level(values, speed))
        return np.stack([bristle, position[:, setting.coordinate(target)]], 1)

    def memory(self, values: np.ndarray) -> float:
        return REPLAYED

    def replay(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        drive: Drive,
    ) -> np.ndarray:  # fmt: skip
        """Return :meth:`recall` after the motion before: its velocities tell small ones better than its positions."""
        recalled = self.recall(setting, target, values, position[:, -1], velocity[:, -1])
        displacement, speed = self.softened(setting, target, values), velocity[..., setting.dof(target)]
        seen, speed = np.isfinite(speed[:, :-1]), np.nan_to_num(speed)
        bristle, known = recalled[:, 0], np.zeros(len(seen), dtype=bool)
        for row in range(seen.shape[1]):
            here = seen[:, row]
            level = self.level(values, speed[:, row])
            begin = bristle_after(np.zeros(len(seen)), PAST * speed[:, row], displacement, level)
            bristle, known = np.where(here & ~known, begin, bristle), known | here
            mean = 0.5 * (speed[:, row] + speed[:, row + 1])
            after = bristle_after(bristle, drive.step * mean, displacement, self.level(values, mean))
            bristle = np.where(here, after, bristle)
        return np.stack([bristle, recalled[:, 1]], 1)

    def force_after(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        dof, now, out = setting.dof(target), position[:, setting.coordinate(target)], np.zeros_like(velocity)
        displacement, level = self.softened(setting, target, values), self.level(values, velocity[:, dof])
        bristle = bristle_after(memory[:, 0], now - memory[:, 1], displacement, level)
        out[:, dof] = -values[:, 0] * bristle
        return out, np.stack([bristle, now], 1)

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the forces where a simulation begins; later ones are those of :meth:`force_after`."""
        memory = self.recall(setting, target, values, position, velocity)
        return self.force_after(setting, target, values, position, velocity, memory)[0]


class JointLuGre(JointPresliding):
    """Dry friction that gives elastically before it slides, and is larger when slow than in motion (LuGre).

    The bristles of :class:`JointPresliding`, with the same stiffness of ``coulomb/displacement``; at speed v they hold
    up to ``coulomb + (static - coulomb)·exp(-(v/velocity)²)``, as :class:`~dropo_torch.effects.joint.JointStribeck`
    does (Canudas de Wit et al. 1995, without the damping of the bristles).
    """

    name = "joint_lugre"
    alone = False
    contains = (JointPresliding.name, JointStribeck.name)
    sentence = "dry friction in {target} that gives before it slides and is larger when slow than in motion (LuGre)"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        _, static, velocity = find_effect(JointStribeck.name).quantities(setting, target)
        return *super().quantities(setting, target), static, velocity

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        falls = find_effect(JointStribeck.name).starts(setting, target)
        return [np.array([*a, 2 * a[0], b[2]]) for a in super().starts(setting, target) for b in falls]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        if simpler.effect.name not in self.contains or simpler.values[0] <= 0:
            return []
        _, displacement, _, velocity = self.quantities(setting, simpler.target)
        if simpler.effect.name == JointStribeck.name:
            coulomb, static, speed = simpler.values
            return [np.array([coulomb, far * displacement.neutral, static, speed]) for far in (0.1, 1.0)]
        coulomb, far = simpler.values
        return [np.array([0.95 * coulomb, far, 1.5 * coulomb, share * velocity.scale]) for share in (0.05, 0.15, 0.4)]

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.concatenate([super().settle(start[:2], values[:2]), values[2:]])

    def level(self, values: np.ndarray, speed: np.ndarray) -> np.ndarray:
        coulomb, _, static, velocity = values.T
        return 1 + np.maximum(static / np.maximum(coulomb, 1e-12) - 1, 0.0) * np.exp(-((speed / velocity) ** 2))
