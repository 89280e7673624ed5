"""A scripted push: the rod's tip moves straight ahead, at its height and upright, by velocities of the joints."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

#: Joints at which the rod stands upright before the box, its tip at (0.43, 0, 0.03) m.
START = np.array([0.0, 0.2010, 0.0, -2.6236, 0.0, 2.8247, 0.0])
#: Proportional gain on height, heading and uprightness, 1/s; damping of the inverse, and the fastest joint, rad/s.
GAIN, DAMPING, FASTEST = 5.0, 1e-3, 1.5


@dataclass(frozen=True)
class Push:
    """How the tip moves.

    Attributes:
        height: of the tip, m.
        side: y of the line that the tip follows where it crosses the box's front, m.
        heading: angle of that line to x, rad.
        speed: m/s, reached after ``ramp`` seconds.
        ramp: s.
    """

    height: float = 0.03
    side: float = 0.0
    heading: float = 0.0
    speed: float = 0.3
    ramp: float = 0.1


class Pusher:
    """Joint velocities that carry out a push.

    Args:
        model: the arm, as the controller knows it.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._tip = model.site("tip").id

    def start(self, push: Push) -> np.ndarray:
        """Return joint positions ``(7,)`` with the tip on the line of a push, before the box, rad."""
        qpos = START.copy()
        for _ in range(100):
            qpos += 0.1 * self.velocities(qpos, push, 0.0)
        return qpos

    def velocities(self, qpos: np.ndarray, push: Push, time: float) -> np.ndarray:
        """Return joint velocities ``(7,)`` at joint positions ``(7,)`` and a time since the push began, rad/s."""
        model, data = self._model, self._data
        data.qpos[:7] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, linear, angular, self._tip)
        jacobian = np.concatenate([linear, angular])[:, :7]
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING * np.eye(6))
        found = inverse @ self._twist(push, time)
        return found / max(1.0, np.abs(found).max() / FASTEST)

    def _twist(self, push: Push, time: float) -> np.ndarray:
        """The tip's velocity that is wanted: along the line, back onto it, and upright, ``(6,)``."""
        tip, turn = self._data.site_xpos[self._tip], self._data.site_xmat[self._tip].reshape(3, 3)
        along, across = (np.array([np.cos(a), np.sin(a), 0.0]) for a in (push.heading, push.heading + np.pi / 2))
        off = (tip - np.array([0.46, push.side, 0.0])) @ across
        velocity = push.speed * min(1.0, time / push.ramp) * along - GAIN * off * across
        velocity[2] = GAIN * (push.height - tip[2])
        upright = np.cross(turn[:, 2], [0.0, 0.0, -1.0])
        ahead = np.cross(turn[:, 0], [1.0, 0.0, 0.0])
        return np.concatenate([velocity, GAIN * (upright + ahead * [0.0, 0.0, 1.0])])
