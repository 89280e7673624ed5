"""Velocities of an arm's joints that move its tip: damped least squares, for scripted policies."""

from __future__ import annotations

import mujoco
import numpy as np

#: Damping of the inverse: near a singular pose the tip falls behind, and joints stay slow.
DAMPING = 1e-3


class Reach:
    """The tip of an arm, a site of the name ``tip`` that looks down along its z axis.

    Args:
        model: the arm, as the controller knows it; its joints come first.
        joints: how many it has.
        fastest: of a joint, rad/s; where one would be faster, all are slowed.
        gain: by which the tip is kept upright, 1/s.
        forward: where the tip's x axis is to point, along x or against it.
    """

    def __init__(
        self, model: mujoco.MjModel, joints: int = 7, fastest: float = 1.5, gain: float = 5.0, forward: float = 1.0
    ) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._forward = np.array([forward, 0.0, 0.0])
        self._site, self._joints, self._fastest, self._gain = model.site("tip").id, joints, fastest, gain

    def tip(self, qpos: np.ndarray) -> np.ndarray:
        """Return where the tip is at joint positions ``(n,)``, m."""
        self._place(qpos)
        return np.array(self._data.site_xpos[self._site])

    def velocities(self, qpos: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return joint velocities ``(n,)``, rad/s, that move the tip by ``velocity`` ``(3,)``, upright and ahead."""
        self._place(qpos)
        turn = self._data.site_xmat[self._site].reshape(3, 3)
        upright = np.cross(turn[:, 2], [0.0, 0.0, -1.0])
        ahead = np.cross(turn[:, 0], self._forward)
        twist = np.concatenate([velocity, self._gain * (upright + ahead * [0.0, 0.0, 1.0])])
        linear, angular = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, linear, angular, self._site)
        jacobian = np.concatenate([linear, angular])[:, : self._joints]
        found = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING * np.eye(6), twist)
        return found / max(1.0, np.abs(found).max() / self._fastest)

    def _place(self, qpos: np.ndarray) -> None:
        self._data.qpos[: self._joints] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
