"""Velocities that come after those of the positions, by any part of a row: filtered, late, or differences backward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs

from dropo_torch.data.examination.finding import Finding, confidence
from dropo_torch.data.examination.record import Pair, Record
from dropo_torch.data.examination.rules import Rules

#: Seconds on each side over which columns are smoothed, rows at least and at most, and the polynomial's degree.
HALF, ROWS, DEGREE = 0.02, (2, 12), 3
#: Change of a velocity's change from row to row, by its standard deviation, from which on rows do not resolve it; and
#: the share of a row by which it must then be late.
BENT, UNRESOLVED = 0.1, 0.6
#: Stretches of the log that count as independent.
BLOCKS = 20


@dataclass(frozen=True)
class Lag:
    """By how much a velocity comes late.

    Attributes:
        seconds: after the position's derivative.
        error: its standard error over stretches of the log.
    """

    seconds: float
    error: float


def find_lag(record: Record, c: Pair) -> Lag | None:
    """Return by how much a velocity comes after its position's derivative; ``None`` where the log is too short.

    Of motion that is slow against the lag τ, v(t) − dq/dt = −τ d²q/dt². Both sides are smoothed by one polynomial. The
    accelerations of positions and of velocities are instruments for each other, for their noises have nothing to do
    with each other; and within a polynomial the noise of an odd derivative has none to do with that of an even one.
    """
    step = record.step
    assert step is not None
    half = int(np.clip(round(HALF / step), *ROWS))
    kernels = [savgol_coeffs(2 * half + 1, DEGREE, deriv=d, delta=step) for d in (0, 1, 2)]
    off, paths = list[np.ndarray](), list[np.ndarray]()
    for rows in np.split(np.arange(len(record.runs)), np.flatnonzero(np.diff(record.runs)) + 1):
        if len(rows) < 2 * half + 2 or record.cut[rows].any():
            continue
        position = np.concatenate([[0.0], np.cumsum(record.steps[rows, c.position])])
        velocity = np.append(record.before[rows, c.velocity], record.after[rows[-1], c.velocity])
        first, second = (np.convolve(position, k, "valid") for k in kernels[1:])
        off.append(np.convolve(velocity, kernels[0], "valid") - first)
        paths.append(np.stack([second, np.convolve(velocity, kernels[1], "valid")]))
    if sum(map(len, off)) < 10 * BLOCKS:
        return None
    late, (bent, turned) = np.concatenate(off), np.concatenate(paths, 1)
    blocks = np.arange(len(late)) * BLOCKS // len(late)
    above, below = (np.bincount(blocks, x) for x in (-late * turned, bent * turned))
    if not below.sum() > 0:
        return None
    seconds = float(above.sum() / below.sum())
    spread = above - seconds * below
    return Lag(seconds, float(np.sqrt(BLOCKS / (BLOCKS - 1) * (spread**2).sum()) / below.sum()))


def _least(record: Record, c: Pair, rules: Rules) -> float:
    """Seconds from which on a velocity may be called late: more than half a row where it bends from row to row.

    A velocity that follows each row's command within the row is that of the row before, half a row late.
    """
    change = np.diff(record.before[:, c.velocity])[~record.parted[:-1]]
    bends = float(np.abs(np.diff(change)).mean()) > BENT * float(record.before[:, c.velocity].std())
    assert record.step is not None
    assert record.model is not None
    return max((UNRESOLVED if bends else rules.lag) * record.step, float(record.model.opt.timestep))


def lagging(record: Record, pairs: Sequence[Pair], rules: Rules) -> list[Finding]:
    """Return the velocities that surely come later than the positions say, by more than a physics step makes."""
    if record.step is None or record.model is None:
        return []
    told = {c: lag for c in pairs if (lag := find_lag(record, c)) is not None}
    late = {
        c: lag for c, lag in told.items() if lag.seconds > max(_least(record, c, rules), rules.significance * lag.error)
    }
    if not late:
        return []
    columns = [c.velocity for c in late]
    times = ", ".join(f"{1e3 * lag.seconds:.3g}" for lag in late.values())
    return [Finding(
        "lag", tuple(record.label(i) for i in columns),
        f"{record.named(columns)}: the velocity comes {times} ms after that of the position", confidence(False),
        evidence={c.name: lag.seconds for c, lag in late.items()},
        advice="it was filtered, or is a difference backward: derive it (data: {preprocess: {velocities: []}})",
    )]  # fmt: skip
