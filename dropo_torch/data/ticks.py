"""When commands changed that a controller gives by a clock of its own, between the rows of a log.

A row tells the command in force when it was taken. Where the rows are not a whole number to one command, each change is
told late by up to a row, and by another part of it each time. That the changes lie on the ticks of a clock tells when
they were: all ticks must lie between the row that tells a change and the one before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Changes that show a clock, at least; and rows from one to the next, at least, and by how much no whole number.
ENOUGH, SLOWER, APART = 30, 1.5, 0.03
#: Share of the time between rows by which stamps may contradict the clock.
JITTER = 0.1


@dataclass(frozen=True)
class Ticks:
    """The clock of a controller.

    Attributes:
        period: seconds from one tick to the next.
        rows: those that tell a change, ``(C,)``.
        time: when these changes were, ``(C,)`` in seconds.
    """

    period: float
    rows: np.ndarray
    time: np.ndarray

    def put_back(self, time: np.ndarray) -> np.ndarray:
        """Return the rows' times ``(N,)``, with those that tell a change at its tick."""
        out = np.array(time, dtype=float)
        out[self.rows] = self.time
        return out


def find_ticks(time: np.ndarray, commands: np.ndarray) -> Ticks | None:
    """Return the clock by which commands change, or ``None`` where none shows.

    Args:
        time: of the rows, ``(N,)`` in seconds.
        commands: in force at the rows, ``(N, nu)``.
    """
    from scipy.optimize import linprog  # heavy, and most logs need none

    rows = np.flatnonzero((np.diff(commands, axis=0) != 0).any(1)) + 1
    if len(rows) < ENOUGH:
        return None
    row, apart = float(np.median(np.diff(time))), np.diff(time[rows])
    usual = apart[np.abs(apart - np.median(apart)) < 1.2 * row]
    period = float(usual.mean())
    ratio = period / row
    if ratio < SLOWER or abs(ratio - round(ratio)) < APART:
        return None
    number = np.append(0, np.cumsum(np.maximum(np.round(apart / period), 1)))
    one, before, after = np.ones(len(rows)), time[rows - 1] - time[rows[0]], time[rows] - time[rows[0]]
    # the first tick, the period, and how far inside all ticks lie of the rows around them, which is to be large
    found = linprog(
        [0, 0, -1],
        A_ub=np.concatenate([np.stack([-one, -number, one], 1), np.stack([one, number, one], 1)]),
        b_ub=np.concatenate([-before, after]),
        bounds=[(None, None), (0, None), (None, None)],
    )
    if not found.success or found.x[2] < -JITTER * row:
        return None
    first, period, _ = found.x
    ticks = np.clip(first + number * period, before, after) + time[rows[0]]
    return Ticks(float(period), rows, ticks)
