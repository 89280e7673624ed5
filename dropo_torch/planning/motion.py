"""Families of motions: for each drive a few sines about an offset, faded in and out, as far as its limits let it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.planning.drives import Drive

#: Share of a motion in which it is faded in, and out, and seconds of that at most.
FADE, LONGEST_FADE = 0.2, 1.5
#: Smallest amplitude of a drive, relative to the largest that its limits allow, and of all together.
LEAST_LEVEL, LEAST_SHARE = 0.05, 0.2


@dataclass(frozen=True)
class Reach:
    """How far drives may go, ``(D,)`` each.

    Attributes:
        low, high: lowest and highest position.
        velocity, acceleration: largest ones.
    """

    low: np.ndarray
    high: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True)
class Paths:
    """What drives are to follow, ``(..., N, D)`` each.

    Attributes:
        position: at the begin of every command.
        rate, curvature: its first and second derivatives in time.
    """

    position: np.ndarray
    rate: np.ndarray
    curvature: np.ndarray


class Family:
    """Motions by numbers in [0, 1].

    The first is the share of the amplitude that limits allow. A drive has an offset from where it starts, a level, and
    for each of its sines a weight, a frequency and a phase. The sines are made as large as the limits of position,
    velocity and acceleration allow, times the level, so that every number gives a path within them.

    Args:
        drives: D of them.
        reach: how far they may go.
        start: where they start and end, ``(D,)``.
        steps: commands N of a motion.
        timestep: seconds of a command.
        waves: sines of a drive.
        frequency: lowest and highest frequency in Hz.
    """

    def __init__(
        self, drives: tuple[Drive, ...], reach: Reach, start: np.ndarray, *, steps: int, timestep: float, waves: int,
        frequency: tuple[float, float],
    ) -> None:  # fmt: skip
        self._reach, self._start, self._waves, self._frequency = reach, start, waves, frequency
        self._count, self._step = len(drives), timestep
        self._time = timestep * np.arange(steps)
        self._fade_time = max(min(FADE * steps * timestep, LONGEST_FADE), 4 * timestep)
        self._fade = _faded(self._time, self._fade_time, steps * timestep)

    @property
    def dimensions(self) -> int:
        """Numbers of a motion."""
        return 1 + self._count * (2 + 3 * self._waves)

    def multisines(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return motions of sines as large as each other, spread over all frequencies, with phases at random.

        They are about where the drives start, and as large as limits allow, ``(count, dimensions)``.
        """
        each = np.empty((count, self._count, 2 + 3 * self._waves))
        each[..., 0], each[..., 1], each[..., 2::3] = 0.5, 1.0, 1.0
        each[..., 3::3] = (np.arange(self._waves) + 0.5) / self._waves
        each[..., 4::3] = rng.random((count, self._count, self._waves))
        return np.concatenate([np.ones((count, 1)), each.reshape(count, -1)], 1)

    def share(self, numbers: np.ndarray) -> np.ndarray:
        """Return the share of the amplitude that limits allow that motions ``(P, dimensions)`` have, ``(P,)``."""
        return np.asarray(LEAST_SHARE ** (1 - numbers[:, 0]))

    def paths(self, numbers: np.ndarray, scale: np.ndarray | float = 1.0) -> Paths:
        """Return the paths of motions, each ``(P, N, D)``.

        Args:
            numbers: of the motions, ``(P, dimensions)``.
            scale: by which amplitudes are scaled, ``(P,)`` or for all; beyond 1, positions still keep their limits.
        """
        each = numbers[:, 1:].reshape(len(numbers), self._count, -1)
        waves = each[..., 2:].reshape(*each.shape[:2], self._waves, 3)
        low, high = np.log(self._frequency)
        omega = 2 * np.pi * np.exp(low + (high - low) * waves[..., 1])
        angle = omega[:, None] * self._time[:, None, None] + 2 * np.pi * waves[:, None, ..., 2]
        shape = (waves[:, None, ..., 0] * np.sin(angle)).sum(-1)  # (P, N, D)
        offset = self._offsets(each[..., 0])
        about = self._derived(self._fade[:, None] * offset[:, None])
        sines = self._derived(self._fade[:, None] * shape)
        size = (LEAST_LEVEL + (1 - LEAST_LEVEL) * each[..., 1]) * self._largest(about, sines)
        whole = [a + size[:, None] * s for a, s in zip(about, sines, strict=True)]
        most = self._room(whole[0])
        factor = np.minimum(np.reshape(scale, (-1, 1)), np.where(most > 1, most, 1.0))[:, None]
        return Paths(self._start + factor * whole[0], factor * whole[1], factor * whole[2])

    def _room(self, path: np.ndarray) -> np.ndarray:
        """By what paths from the start can be multiplied within the limits of position, ``(P, D)``."""
        room = np.where(path > 0, self._reach.high - self._start, self._start - self._reach.low)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(np.abs(path) > 1e-12, room / np.abs(path), np.inf).min(1))

    def _offsets(self, numbers: np.ndarray) -> np.ndarray:
        """Offsets that a drive can reach while it is faded in, ``(P, D)``."""
        reach, fade = self._reach, self._fade_time
        most = np.minimum(reach.velocity * fade / 2.0, reach.acceleration * fade**2 / 6.0)
        down, up = np.maximum(reach.low - self._start, -most), np.minimum(reach.high - self._start, most)
        away = 2 * numbers - 1
        return np.where(away < 0, -away * np.nan_to_num(down, neginf=0.0), away * np.nan_to_num(up, posinf=0.0))

    def _largest(self, about: list[np.ndarray], sines: list[np.ndarray]) -> np.ndarray:
        """Largest amplitude within the limits, ``(P, D)``."""
        reach = self._reach
        intervals = (
            (reach.low - self._start, reach.high - self._start), (-reach.velocity, reach.velocity),
            (-reach.acceleration, reach.acceleration),
        )  # fmt: skip
        found = np.full(sines[0].shape[::2], np.inf)
        for base, wave, (low, high) in zip(about, sines, intervals, strict=True):
            room = np.where(wave > 0, high - base, base - low)
            with np.errstate(divide="ignore", invalid="ignore"):
                found = np.minimum(found, np.where(np.abs(wave) > 1e-12, room / np.abs(wave), np.inf).min(1))
        return np.maximum(np.where(np.isfinite(found), found, 0.0), 0.0)

    def _derived(self, path: np.ndarray) -> list[np.ndarray]:
        """A path with its first and second derivatives."""
        rate = np.gradient(path, self._step, axis=1)
        return [path, rate, np.gradient(rate, self._step, axis=1)]


def _faded(time: np.ndarray, fade: float, length: float) -> np.ndarray:
    """A factor that rises from 0 to 1, with its first two derivatives 0 at both, and falls likewise at the end."""
    x = np.clip(np.minimum(time, length - time - (time[1] - time[0])) / fade, 0, 1)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))
