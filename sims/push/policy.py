"""A scripted push: the rod's tip moves straight ahead, at its height and upright, by velocities of the joints."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from ..reaching import Reach

#: Joints at which the rod stands upright before the box, its tip at (0.43, 0, 0.03) m.
START = np.array([0.0, 0.2010, 0.0, -2.6236, 0.0, 2.8247, 0.0])
#: Proportional gain on height, line and uprightness, 1/s, and the fastest joint, rad/s.
GAIN, FASTEST = 5.0, 1.5


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
        self._reach = Reach(model, fastest=FASTEST, gain=GAIN)

    def start(self, push: Push) -> np.ndarray:
        """Return joint positions ``(7,)`` with the tip on the line of a push, before the box, rad."""
        qpos = START.copy()
        for _ in range(100):
            qpos += 0.1 * self.velocities(qpos, push, 0.0)
        return qpos

    def velocities(self, qpos: np.ndarray, push: Push, time: float) -> np.ndarray:
        """Return joint velocities ``(7,)`` at joint positions ``(7,)`` and a time since the push began, rad/s."""
        tip = self._reach.tip(qpos)
        along, across = (np.array([np.cos(a), np.sin(a), 0.0]) for a in (push.heading, push.heading + np.pi / 2))
        off = (tip - np.array([0.46, push.side, 0.0])) @ across
        velocity = push.speed * min(1.0, time / push.ramp) * along - GAIN * off * across
        velocity[2] = GAIN * (push.height - tip[2])
        return self._reach.velocities(qpos, velocity)
