"""The error of a prediction that no parameter of its model makes: how large it is, and what it grows with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: m that a push counts for at least.
LEAST = 1e-4
#: Powers of the pushed distance that an error may grow with, and the axes that have one in common.
POWERS, TOGETHER = (0.0, 0.5, 1.0), ((0, 1), (2,))
#: Draws of a prediction, and batches of them, whose scatter says how exact an energy score is.
SAMPLES, BATCHES = 200_000, 10
#: m from the center at which an angle counts as a distance.
ARM = 0.025
Groups = Sequence[tuple[str, int]]


@dataclass(frozen=True)
class ErrorTerm:
    """An error of three independent axes: scale · distance^power · Student's t.

    Attributes:
        scale: of each axis after a meter, ``(3,)``.
        power: of the distance in meters, of each axis, ``(3,)``.
        free: degrees of freedom of t; infinite for a normal.
    """

    scale: np.ndarray
    power: np.ndarray
    free: float

    def scales(self, distance: float) -> np.ndarray:
        """Return the scale of each axis after a distance in m, ``(3,)``."""
        return np.asarray(self.scale * distance**self.power)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return draws in units of the scales, ``(SAMPLES, 3)``."""
        shape = (SAMPLES, len(self.scale))
        return rng.standard_t(self.free, shape) if np.isfinite(self.free) else rng.normal(size=shape)


def point(epsilon: Sequence[float] | np.ndarray) -> ErrorTerm:
    """Return the error of a prediction that is a point with ε, ``(3,)``."""
    return ErrorTerm(np.asarray(epsilon, float), np.zeros(len(epsilon)), np.inf)


def error_term(off: np.ndarray, groups: Groups, distance: np.ndarray) -> ErrorTerm:
    """Return the error of a push that was not seen, from those of pushes that were.

    What repeats of a push have in common is no noise: it is the model's own error. So a group of repeats is one draw of
    it, and what differs between them is the second part. So few groups say nothing of how the axes go together, and of
    each axis' size no more than Student's t of as many degrees of freedom.

    Args:
        off: errors, ``(P, 3)``.
        groups: which push each of them is a repeat of.
        distance: m that each of them went, ``(P,)``.
    """
    distance = np.maximum(distance, LEAST)
    power = likeliest_power(off, groups, distance)
    parts = _grouped(off / distance[:, None] ** power, groups)
    means = np.array([part.mean(0) for part in parts])
    within = np.concatenate([part - part.mean(0) for part in parts])
    free = max(len(within) - len(parts), 1)
    return ErrorTerm(np.sqrt((means**2).mean(0) + (within**2).sum(0) / free), power, len(parts))


def likeliest_power(off: np.ndarray, groups: Groups, distance: np.ndarray) -> np.ndarray:
    """Return the power of the distance under which normal errors are likeliest, ``(3,)``; each group counts once."""
    further = np.mean([part.mean() for part in _grouped(np.log(distance), groups)])
    found = np.array([
        np.log(np.mean([(part**2).mean(0) for part in _grouped(off / distance[:, None] ** power, groups)], axis=0))
        + 2 * power * further
        for power in POWERS
    ])  # fmt: skip
    chosen = np.zeros(off.shape[1])
    for axes in map(list, TOGETHER):
        chosen[axes] = POWERS[int(found[:, axes].sum(1).argmin())]
    return chosen


def holds(draws: np.ndarray, off: np.ndarray) -> bool:
    """Return whether an error ``(3,)`` lies in the ellipsoid of 90 % of draws, both in units of their scales."""
    return bool((off**2).sum() <= np.quantile((draws**2).sum(1), 0.9))


def energy_scores(samples: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return energy scores of each batch of errors drawn, ``(N, 3)``, for one that came: in mm, an angle by its arc."""
    scale = 1e3 * np.array([1.0, 1.0, ARM])
    near = np.linalg.norm((samples - off) * scale, axis=1).reshape(BATCHES, -1).mean(1)
    apart = (samples - np.roll(samples, 1, axis=0)) * scale
    return np.asarray(near - 0.5 * np.linalg.norm(apart, axis=1).reshape(BATCHES, -1).mean(1))


def _grouped(values: np.ndarray, groups: Groups) -> list[np.ndarray]:
    """The values of each group."""
    return [values[[g == name for g in groups]] for name in sorted(set(groups))]
