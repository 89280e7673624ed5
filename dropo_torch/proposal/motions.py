"""Which velocity belongs to which position: by what its integral explains of the position's changes."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

#: Shares of motion that a velocity must explain to be its position's, and to be so whatever it is called.
LIKE, SAME = 0.5, 0.9
#: Part of what velocities leave of the motion that they must leave along other axes to be along these.
CLEARLY = 0.5
#: Rows over which motion is compared with velocities: noise of positions drowns it over one.
SPANS = (1, 4, 16)


def turning(quaternion: np.ndarray, rates: np.ndarray, starts: np.ndarray) -> tuple[float, float]:
    """Do what :func:`motion` does, of orientations ``(N, 4)`` and angular velocities in the body's frame, ``(N, 3)``.

    Return which share of the turns over some rows the velocities explain, and their factor.
    """
    best = (0.0, math.nan)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rates[1:] + rates[:-1]), axis=0)])
    runs = np.cumsum(starts)
    for span in SPANS:
        if len(quaternion) < 4 * span + 8:
            continue
        start, end, told = quaternion[:-span], quaternion[span:], total[span:] - total[:-span]
        w = np.sum(start * end, axis=1)
        turned = start[:, :1] * end[:, 1:] - end[:, :1] * start[:, 1:] - np.cross(start[:, 1:], end[:, 1:])
        turned *= 2 * np.where(w < 0, -1.0, 1.0)[:, None]
        good = (runs[span:] == runs[:-span]) & np.isfinite(turned).all(1) & np.isfinite(told).all(1)
        turned, told = turned[good].ravel(), told[good].ravel()
        size = float(told @ told)
        if size > 0 and (all_of := float(turned @ turned)) > 0:
            slope = float(turned @ told) / size
            share = 1 - float(((turned - slope * told) ** 2).sum()) / all_of
            best = max(best, (share, slope), key=lambda x: x[0])
    return best


def motion(position: np.ndarray, velocity: np.ndarray, starts: np.ndarray) -> tuple[float, float]:
    """Return which share of a position's changes a velocity explains, and its factor: seconds a row times its unit."""
    best = (0.0, math.nan)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]))])
    runs = np.cumsum(starts)
    for span in SPANS:
        if len(position) < 4 * span + 8:
            continue
        with np.errstate(all="ignore"):
            change, told = position[span:] - position[:-span], total[span:] - total[:-span]
            good = (runs[span:] == runs[:-span]) & np.isfinite(change) & np.isfinite(told)
            change, told = change[good], told[good]
            if len(change) < 8 or not told.any() or not change.any():
                continue
            kept = np.abs(change) <= np.quantile(np.abs(change), 0.995)  # without turns and joints of episodes
            change, told = change[kept], told[kept]
            size = float(told @ told)
            if size == 0 or not change.any():
                continue
            slope = float(change @ told) / size
            share = 1 - float(((change - slope * told) ** 2).sum()) / float(change @ change)
        if share > best[0]:
            best = (share, slope)
    return best


def told_otherwise(path: np.ndarray, rates: np.ndarray, quaternion: np.ndarray, starts: np.ndarray) -> bool:
    """Return whether velocities of a free body are along the axes along which the model does not have them.

    They explain clearly more of the motion if they are turned so.

    Args:
        path: positions ``(N, 3)``, for velocities that the model has along the world's axes; or orientations
            ``(N, 4)``, for angular ones, which it has about the body's.
        rates: the velocities, ``(N, 3)``.
        quaternion: the orientations, ``(N, 4)``.
        starts: rows at which an episode begins, ``(N,)`` bool.
    """
    known = (np.linalg.norm(quaternion, axis=1) > 1e-6) & np.isfinite(rates).all(1)
    if not known.any():
        return False
    turns = Rotation.from_quat(quaternion[known], scalar_first=True)
    turned, angular = rates.copy(), path.shape[1] == 4
    turned[known] = (turns.inv() if angular else turns).apply(rates[known])

    def share(told: np.ndarray) -> float:
        if angular:
            return turning(path, told, starts)[0]
        begins = starts.copy()
        begins[:1] = True
        return motion(path.T.ravel(), told.T.ravel(), np.tile(begins, 3))[0]

    return share(turned) > LIKE and 1 - share(turned) < CLEARLY * (1 - share(rates))
