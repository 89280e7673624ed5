"""What robots are to do, and how those that would fall over are kept upright."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are

GRAVITY = 9.81


@dataclass(frozen=True)
class Waves:
    """Sums of sines with random frequencies and phases, a row each, of at most 1 in size.

    Attributes:
        sizes: amplitudes.
        frequencies: rad/s.
        phases: rad.
    """

    sizes: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, count: int, low: float, high: float, parts: int = 5) -> Waves:
        """Draw ``count`` of them, of some sines each, with frequencies from ``low`` to ``high`` Hz."""
        frequencies = 2 * math.pi * rng.uniform(low, high, (count, parts))
        phases, sizes = rng.uniform(0, 2 * math.pi, (count, parts)), rng.uniform(0.5, 1, (count, parts))
        return cls(sizes / sizes.sum(1, keepdims=True), frequencies, phases)

    def __call__(self, t: float) -> np.ndarray:
        """Return their values ``(count,)``."""
        return (self.sizes * np.sin(self.frequencies * t + self.phases)).sum(1)

    def slope(self, t: float) -> np.ndarray:
        """Return their derivatives by time ``(count,)``, 1/s."""
        return (self.sizes * self.frequencies * np.cos(self.frequencies * t + self.phases)).sum(1)


def roll_pitch_yaw(q: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    """Return the angles of a quaternion, rad."""
    w, x, y, z = (float(c) for c in q)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@dataclass(frozen=True)
class Balanced:
    """A body that stands on a wheel or ball, in the plane.

    Attributes:
        wheel: mass and moment of inertia of what rolls, kg and kg·m².
        radius: m.
        body: mass and moment of inertia of what stands on it.
        height: of its center of mass above the axle, m.
    """

    wheel: tuple[float, float]
    radius: float
    body: tuple[float, float]
    height: float

    def gains(self, costs: Sequence[float], effort: float) -> np.ndarray:
        """Return gains of the torque on the wheel on position, speed, tilt and its rate, by costs of these."""
        (own, spin), (mass, inertia), lever = self.wheel, self.body, self.body[0] * self.height
        coupled = np.array([[own + mass + spin / self.radius**2, lever], [lever, inertia + lever * self.height]])
        a, b = np.zeros((4, 4)), np.zeros((4, 1))
        a[0, 1] = a[2, 3] = 1.0
        a[[1, 3], 2] = np.linalg.solve(coupled, [0.0, lever * GRAVITY])
        b[[1, 3], 0] = np.linalg.solve(coupled, [1 / self.radius, -1.0])
        return -(b.T @ solve_continuous_are(a, b, np.diag(costs), np.array([[effort]])) / effort)[0]
