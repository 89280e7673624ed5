"""Dry friction that gives elastically before it slides: a force that remembers how far the joint has moved."""

from __future__ import annotations

import numpy as np

from dropo_torch.effects.base import Quantity, Setting
from dropo_torch.effects.joint import JointEffect, unit

#: Seconds for which a joint has moved with the velocity that it has where a simulation begins.
PAST = 0.1
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
    step can hold. A simulation begins as if the joint had moved for a tenth of a second at the velocity that it has.
    """

    name = "joint_presliding"
    alone = False
    contains = ("joint_friction",)
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
        return [np.array([0.2 * force.scale, displacement.neutral])]

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
