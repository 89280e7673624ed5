"""Scripted hits: the stick comes to the puck's back, strikes along a line, follows through and returns."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from ..reaching import Reach

#: Joints at which the stick stands upright, its tip at (0.45, 0, 0.0125) m.
HOME = np.array([0.0, -0.45874728, 0.0, 1.9079149, 0.0, -0.77493048, 0.0])
#: Where the puck lies, m, and the height at which the tip strikes it.
PUCK, HEIGHT = np.array([0.6, 0.0]), 0.0125
#: How far behind the puck's middle a strike begins, and how long it is, m.
BEHIND, LENGTH = 0.13, 0.24
#: Seconds until a strike begins, from its end until the return, and of the return.
APPROACH, REST, RETURN = 1.5, 1.0, 1.5
#: Gain that holds the tip on its path, 1/s, and the fastest joint, rad/s: the slowest ones may turn by 110 degrees/s.
GAIN, FASTEST = 8.0, 1.9
#: Seconds between two targets.
STEP = 0.01


@dataclass(frozen=True)
class Hit:
    """How the puck is struck.

    Attributes:
        heading: angle of the stick's line to x, rad.
        side: how far beside the puck's middle the line runs, m.
        speed: of the tip at the middle of the strike, m/s.
    """

    heading: float = 0.0
    side: float = 0.0
    speed: float = 0.8


def hit_targets(model: mujoco.MjModel, hit: Hit, steps: int) -> np.ndarray:
    """Return the positions that the joints' servos are given, ``(steps, 7)``, one every :data:`STEP`, rad."""
    reach, qpos, found = Reach(model, fastest=FASTEST, forward=-1.0), HOME.copy(), []
    home = reach.tip(qpos)
    for step in range(steps):
        wanted, before = (_path(home, hit, max(0.0, t)) for t in (STEP * (step + 1), STEP * step))
        velocity = (wanted - before) / STEP + GAIN * (before - reach.tip(qpos))
        qpos = qpos + STEP * reach.velocities(qpos, velocity)
        found.append(qpos)
    return np.stack(found)


def _path(home: np.ndarray, hit: Hit, time: float) -> np.ndarray:
    """Where the tip is to be at a time, ``(3,)``: minimum-jerk moves between home, the strike's begin and its end."""
    along = np.array([np.cos(hit.heading), np.sin(hit.heading), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    begin = np.append(PUCK, HEIGHT) + hit.side * across - BEHIND * along
    end, strike = begin + LENGTH * along, 1.875 * LENGTH / hit.speed  # which is the peak of a minimum-jerk move
    legs = ((home, begin, APPROACH), (begin, end, strike), (end, end, REST), (end, home, RETURN))
    for start, stop, seconds in legs:
        if time < seconds:
            return start + (stop - start) * _minimum_jerk(time / seconds)
        time -= seconds
    return home


def _minimum_jerk(share: float) -> float:
    """The share of a move's way that is done after a share of its time."""
    return share**3 * (10 - 15 * share + 6 * share**2)
