"""The best chain of initial states of several that were tried: each window takes its own choice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dropo_torch.shooting.equations import Point, Residuals, Scales, huber, residuals
from dropo_torch.shooting.windows import Windows

#: What a window costs that diverges.
LOST = 1e30


def fused(
    windows: Windows, mean: np.ndarray, tried: Sequence[np.ndarray], scales: Scales
) -> tuple[Point, Residuals, np.ndarray]:
    """Return the chain of least cost at given parameters, its residuals, and which states each window takes.

    A step may serve most windows and take a few over a contact. What a window costs depends on its own state and on
    the end of the window before, so that the best choice is found by dynamic programming.

    Args:
        windows: the log.
        mean: parameters in coordinates, ``(d,)``.
        tried: several initial states, ``(W, nq + nv)`` each.
        scales: by which residuals are weighed.
    """
    found = [residuals(windows, Point(mean, states)) for states in tried]
    own = np.array([np.minimum(r.costs(scales)[0], LOST) for r in found])  # (O, W)
    joins = np.array([[_joins(windows, states, r.ends, scales) for states in tried] for r in found])  # (O, O, W)
    begins, back = _begins(windows, found, scales), np.zeros((len(windows), len(tried)), dtype=int)
    total = own[:, 0] + begins[:, 0]
    for w in range(1, len(windows)):
        if windows.follows[w]:
            each = total[:, None] + joins[:, :, w]
            back[w] = each.argmin(0)
            total = each.min(0) + own[:, w]
        else:
            back[w], total = total.argmin(), total.min() + begins[:, w] + own[:, w]
    choice = np.empty(len(windows), dtype=int)
    choice[-1] = total.argmin()
    for w in range(len(windows) - 1, 0, -1):
        choice[w - 1] = back[w, choice[w]]
    picked = choice, np.arange(len(windows))
    states, ends = np.array(tried)[picked], np.array([r.ends for r in found])[picked]
    measured, lost = (np.array([getattr(r, name) for r in found])[picked] for name in ("measured", "lost"))
    return Point(mean, states), Residuals.of(windows, states, measured, ends, lost), choice


def _joins(windows: Windows, states: np.ndarray, ends: np.ndarray, scales: Scales) -> np.ndarray:
    """Costs of links from other states' ends, ``(W,)``."""
    return huber(windows.between(states, np.roll(ends, 1, axis=0)) / scales.link).sum(1)


def _begins(windows: Windows, found: Sequence[Residuals], scales: Scales) -> np.ndarray:
    """Costs of the links of windows that follow on none, ``(O, W)``."""
    return np.array([np.where(windows.follows, 0.0, r.costs(scales)[1]) for r in found])
