"""Effects of tendons: dry friction of a cable in its sheath or over its pulleys."""

from __future__ import annotations

import mujoco
import numpy as np

from dropo_torch.effects.base import Effect, Quantity, Setting, object_number
from dropo_torch.effects.joint import STEPS, STUCK


class TendonFriction(Effect):
    """Dry friction along a tendon: a constant force against any change of its length, which also holds at rest."""

    name = "tendon_friction"
    kind = "tendon"
    sentence = "dry (Coulomb) friction along tendon {target}, as of a cable in its sheath"
    shares = (0.001, 0.02, 0.2)

    def targets(self, setting: Setting) -> list[str | None]:
        """Return the tendons whose length changes in the log."""
        moves = self.lever_arms(setting.model) @ setting.signals.speed > 0
        return [name for name, moving in zip(setting.names("tendon"), moves, strict=True) if moving]

    @staticmethod
    def lever_arms(model: mujoco.MjModel) -> np.ndarray:
        """Return sizes of the tendons' lever arms at ``qpos0``, ``(ntendon, nv)``."""
        data, arms = mujoco.MjData(model), np.zeros((model.ntendon, model.nv))
        if not model.ntendon:
            return arms
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mju_sparse2dense(arms, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        return np.abs(arms)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, i = setting.model, object_number(setting.model, "tendon", target)
        arms = self.lever_arms(m)[i]
        moved = (arms > 0) & (setting.signals.speed > 0)
        scale = float(np.max(setting.signals.force[moved] / arms[moved]))
        return (Quantity("friction", "N", 0.0, -float(m.tendon_frictionloss[i]), 10 * scale, scale),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "tendon", target)
        if model.tendon_frictionloss[i] == 0 and values[0] != 0:
            model.tendon_solimp_fri[i] = STUCK
            model.tendon_solref_fri[i] = (STEPS * model.opt.timestep, 1.0)
        model.tendon_frictionloss[i] += values[0]
