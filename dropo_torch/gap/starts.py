"""Initial states of windows in which the simulation bends: found step by step, not by one linear step from the log.

Beside contacts, the noise of a measured initial state may move an impact by a logged step, and what one linear step
corrects is then no noise any more. Such windows are simulated from where their misfit is least, by a damped
Gauss-Newton method on the initial state; the measurement there stays one more noisy observation. Others begin where
they were measured, as they would fit no better from elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dropo_torch.effects.engine import Variant
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.twin import Windows

#: Gauss-Newton steps, at most; shares of a step that are tried; the difference step, in units of the noise.
STEPS, SHARES, DIFFERENCE = 12, (1.0, 0.5, 0.2), 0.3
#: A window bends if a linear step leaves more or less than it promises by this factor; a step helps if it gains this
#: share.
BENDS, GAINS = 1.05, 0.01


def straightened(evidence: Evidence, variant: Variant) -> Windows | None:
    """Return the windows with the starts from which they are to be simulated; ``None`` where none of them bends.

    Args:
        evidence: windows, each with its measured start or one that was found before.
        variant: the hypothesis under which they are simulated.
    """
    if evidence.rough or not evidence.twin.setting.has_impacts:
        return None
    starts, active = evidence.windows.begins.copy(), np.arange(len(evidence.windows))
    found = starts.copy()
    for number in range(STEPS):
        part = evidence.select(active)
        part = replace(part, windows=replace(part.windows, starts=found[active]))
        moved, better = _step(part, variant, bent=number > 0)
        active = active[better]
        if not active.size:
            break
        found[active] = moved[better]
    return None if np.array_equal(found, starts) else replace(evidence.windows, starts=found)


def _step(part: Evidence, variant: Variant, *, bent: bool) -> tuple[np.ndarray, np.ndarray]:
    """Starts one step nearer to the least misfit ``(W, n)``, and which windows gain by it ``(W,)``.

    Args:
        part: windows that begin where they begin so far.
        variant: the hypothesis.
        bent: whether they are known to bend; those that do not gain nothing.
    """
    m = part.chart.size
    found, _ = part.residuals([variant])
    usable = np.isfinite(found[0]).all(-1)
    here = np.where(usable[:, None], found[0], 0.0)
    changes = part.changes(variant, found[0], [variant] * m, DIFFERENCE * np.eye(m)[:, None]) / DIFFERENCE
    slope = np.moveaxis(np.where(np.isfinite(changes) & usable[:, None], changes, 0.0), 0, -1)
    step = -np.einsum("wmn,wn->wm", np.linalg.pinv(slope, rcond=1e-10), here)
    promised = ((here + np.einsum("wnm,wm->wn", slope, step)) ** 2).sum(-1)
    trials = np.reshape(SHARES, (-1, 1, 1)) * step
    left = (np.nan_to_num(part.residuals([variant] * len(SHARES), trials)[0], nan=np.inf) ** 2).sum(-1)
    bends = np.maximum(left[0], promised) > BENDS * np.minimum(left[0], promised)
    better = usable & (bends | bent) & (left.min(0) < (1 - GAINS) * (here**2).sum(-1))
    best = trials[left.argmin(0), np.arange(len(step))]
    return part.chart.move(part.windows.begins, best * part.noises[:, 0]), better


def table_of(windows: Windows) -> np.ndarray | None:
    """Return the starts of windows that do not begin as measured: episode, step and columns, ``(k, 2 + n)``."""
    if windows.starts is None:
        return None
    rows = (windows.starts != windows.usual).any(-1)
    return np.column_stack([windows.episodes, windows.steps, windows.starts])[rows]


def merged(older: np.ndarray | None, newer: np.ndarray | None) -> np.ndarray | None:
    """Return one :func:`table_of` two, of which the newer one counts where both know a window."""
    if older is None or newer is None:
        return older if newer is None else newer
    known = {(row[0], row[1]): row for row in (*older, *newer)}
    return np.array(list(known.values()))


def begun(windows: Windows, table: np.ndarray | None) -> np.ndarray | None:
    """Return the starts of windows ``(W, n)`` by a :func:`table_of` some of them; ``None`` without one."""
    if table is None:
        return None
    known = {(int(episode), int(step)): columns for episode, step, *columns in table}
    own = zip(windows.episodes, windows.steps, windows.usual, strict=True)
    return np.array([known.get((int(e), int(s)), columns) for e, s, columns in own])
