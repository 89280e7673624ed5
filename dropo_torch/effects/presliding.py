"""Dry friction that gives elastically before it slides: a force that remembers how far the joint has moved."""

from __future__ import annotations

import numpy as np

from dropo_torch.effects.base import Placed, Quantity, Setting
from dropo_torch.effects.drive import Drive
from dropo_torch.effects.joint import JointEffect, unit

#: Seconds for which a joint has moved with the velocity that it has where nothing tells what was before.
PAST = 0.1
#: Seconds before a simulation from which the bristles are replayed.
REPLAYED = 0.5
#: Highest frequency at which the bristles may let the joint oscillate, in radians of a physics step.
STIFFEST = 0.5


def bristle_after(bristle: np.ndarray, moved: np.ndarray, displacement: np.ndarray | float) -> np.ndarray:
    """Return the share of the friction that is built up after a motion in one direction (Dahl), exactly.

    Args:
        bristle: the share before, -1 to 1.
        moved: how far the joint has moved since, with its sign.
        displacement: the motion in which all but 1/e of the friction builds up.
    """
    toward = np.sign(moved)
    return np.asarray(toward + (bristle - toward) * np.exp(-np.abs(moved) / displacement))


class JointPresliding(JointEffect):
    """Dry friction that gives elastically before it slides (Dahl).

    The friction is ``coulomb·z``. The deflection z of the bristles, -1 to 1, follows a small motion dq by
    ``(dq - |dq|·z)/displacement``: at rest it is a spring of ``coulomb/displacement``, at most as stiff as a physics
    step can hold. The bristles follow the motion before a simulation where it is known; elsewhere it begins as if the
    joint had moved for a tenth of a second at the velocity that it has.
    """

    name = "joint_presliding"
    contains = ("joint_friction", "joint_soft_friction", "joint_stribeck")
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
        force, displacement = self.quantities(setting, target)
        return [np.array([0.2 * force.scale, far * displacement.neutral]) for far in (1.0, 10.0)]

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

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        moved = PAST * velocity[:, setting.dof(target)]
        bristle = bristle_after(np.zeros_like(moved), moved, self.softened(setting, target, values))
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
            begin = bristle_after(np.zeros(len(seen)), PAST * speed[:, row], displacement)
            bristle, known = np.where(here & ~known, begin, bristle), known | here
            moved = 0.5 * drive.step * (speed[:, row] + speed[:, row + 1])
            bristle = np.where(here, bristle_after(bristle, moved, displacement), bristle)
        return np.stack([bristle, recalled[:, 1]], 1)

    def force_after(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        now, out = position[:, setting.coordinate(target)], np.zeros_like(velocity)
        bristle = bristle_after(memory[:, 0], now - memory[:, 1], self.softened(setting, target, values))
        out[:, setting.dof(target)] = -values[:, 0] * bristle
        return out, np.stack([bristle, now], 1)

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the forces where a simulation begins; later ones are those of :meth:`force_after`."""
        memory = self.recall(setting, target, values, position, velocity)
        return self.force_after(setting, target, values, position, velocity, memory)[0]
