"""Initial states of windows by the rows around them, where single rows bend the simulation by their noise.

A foot that a camera sees 1 mm too low is pressed into the ground by as much. A cubic through the rows beside it is
nearer to where it was, as long as nothing happened between these that a cubic cannot follow.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.gap.log import episode_bounds
from dropo_torch.gap.twin import Windows

#: Rows on each side that are tried, the fewest first, and the degree of the polynomial through them.
WIDTHS, DEGREE = (2, 3, 4, 6, 8), 3
#: By how much more the rows may depart from it than from the one through the fewest, in variances.
AGREE = 1.3
#: Median of χ² with one degree of freedom.
MEDIAN = 0.4549
#: How many standard deviations of the noise a row may be from the polynomial at most.
NEAR = 2.5


def half_widths(log: Trajectories, observation: Observation, columns: Collection[int]) -> dict[int, tuple[int, float]]:
    """Return the rows on each side by which observed columns can be smoothed, and the noise that this takes off.

    They are as many as follow a cubic but for noise.

    Args:
        log: the log.
        observation: its columns.
        columns: the observed columns.
    """
    found = {}
    paths = [path for path in _paths(log, observation) if len(path) > 2 * WIDTHS[-1]]
    for column in columns if paths else ():
        variances = [_variance([path[:, column] for path in paths], width) for width in WIDTHS]
        agree = [width for width, v in zip(WIDTHS, variances, strict=True) if v <= AGREE * variances[0]]
        found[column] = agree[-1], variances[0] ** 0.5
    return found


def _variance(paths: list[np.ndarray], width: int) -> float:
    """The variance of the noise of a column by what most rows depart from a polynomial through those around them."""
    own = savgol_coeffs(2 * width + 1, DEGREE)[width]
    rest = np.concatenate([path - savgol_filter(path, 2 * width + 1, DEGREE, mode="interp") for path in paths])
    return float(np.median(rest**2)) / (1 - own) / MEDIAN


def begun_smoothly(
    windows: Windows, log: Trajectories, observation: Observation, widths: Mapping[int, tuple[int, float]]
) -> Windows:  # fmt: skip
    """Return windows that begin where the rows around their starts say.

    Where a row is further from that than noise takes it, something happened, and it begins at the row.

    Args:
        windows: cut from the log.
        log: the log.
        observation: its columns.
        widths: see :func:`half_widths`.
    """
    if not widths or not len(windows):
        return windows
    starts = windows.measured[:, 0].copy()
    for episode, path in enumerate(_paths(log, observation)):
        rows = np.flatnonzero(windows.episodes == episode)
        for column, (width, noise) in widths.items():
            if len(path) > 2 * width:
                smooth = savgol_filter(path[:, column], 2 * width + 1, DEGREE, mode="interp")[windows.steps[rows]]
                near = np.abs(smooth - starts[rows, column]) < NEAR * noise
                starts[rows[near], column] = smooth[near]
    for quaternion in observation.quaternions:
        turned = starts[:, list(quaternion)]
        starts[:, list(quaternion)] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return replace(windows, smooth=starts)


def _paths(log: Trajectories, observation: Observation) -> list[np.ndarray]:
    """Observed columns of each episode at all its instants."""
    observed, following = observation.observed(log.observations), observation.observed(log.next_observations)
    return [np.concatenate([observed[a : a + 1], following[a:b]]) for a, b in episode_bounds(log)]
