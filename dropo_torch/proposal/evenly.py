"""Whether rows were taken evenly although their stamps jitter: a logger often stamps a row when it receives it.

A motion is smooth in the time at which it was measured. So a row that lies nearer to what its neighbours say if all
are evenly spaced than if their stamps are right was taken evenly, and so are all where most rows say so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

#: Rows of a span by which the time between rows is found, and how often what is near it is looked for anew.
SPAN, TIMES = 15, 4
#: Steps by which stamps may become later, jitter aside, where no row is missing.
LEVEL = 0.5
#: Rows that are numbered at once; and how many such pieces tell the time between rows.
LONG, MOST_PIECES = 5000, 8
#: Steps by which stamps must be late in all to count as much as a missing row; and missing rows, at most.
JUMP, MANY = 2.0, 2000
#: Rows on either side from which one is interpolated.
SIDE = 2
#: Share of rows that must say so, and in how many standard deviations of chance; and rows that tell, at least.
MOST, SIGMAS, ENOUGH = 0.55, 6.0, 100


@dataclass(frozen=True)
class Evenly:
    """Rows that are evenly spaced.

    Attributes:
        dt: time between rows, in the unit of the stamps.
        missing: rows before which others are missing, ``(G,)``.
    """

    dt: float
    missing: np.ndarray


def evenly(stamps: np.ndarray, starts: np.ndarray, signals: np.ndarray, dt: float) -> Evenly | None:
    """Return how rows are spaced if the signals say that they are evenly, whatever their stamps; ``None`` otherwise.

    Args:
        stamps: of the rows, ``(N,)``.
        starts: whether an episode begins at a row, ``(N,)`` bool.
        signals: what was measured, ``(N, C)``.
        dt: roughly the time between rows.
    """
    episodes = np.split(np.arange(len(stamps)), np.flatnonzero(starts[1:]) + 1)
    pieces = [e[at : at + LONG + SPAN] for e in episodes for at in range(0, len(e), LONG)]  # each reaches into the next
    pieces = [p for p in pieces if len(p) > 2 * SPAN]
    if not pieces:
        return None
    times = [stamps[p] - stamps[p[0]] for p in pieces]
    few = times[:: -(-len(times) // MOST_PIECES)]
    dt = _rate_of_least_delay(few, _rate(few, dt))
    numbers = _all_numbers(times, dt)[0]
    dt = _spacing(times, numbers, [np.zeros(len(n)) for n in numbers])
    nearer = np.concatenate([_nearer(stamps[p], dt * n, signals[p]) for p, n in zip(pieces, numbers, strict=True)])
    told = nearer[np.isfinite(nearer)]
    share = float(told.mean()) if told.size else 0.0
    if told.size < ENOUGH or share < MOST or (share - 0.5) * 2 * np.sqrt(told.size) < SIGMAS:
        return None
    missing = [p[1:][np.diff(n) > 1] for p, n in zip(pieces, numbers, strict=True)]
    return Evenly(dt, np.unique(np.concatenate(missing)))


def _rate_of_least_delay(times: list[np.ndarray], dt: float) -> float:
    """The time between rows for which stamps are the least late, from near that on.

    With a wrong one, rows seem to be missing now and then. What stretches without a missing row say is not misled by
    that, but by late stamps beside one that is.
    """
    numbers, least = _all_numbers(times, dt)
    for _ in range(TIMES):
        ones = [np.zeros(len(n)) for n in numbers]
        gaps = [np.cumsum(np.diff(n, prepend=n[0] - 1) != 1) for n in numbers]
        rates = (_spacing(times, numbers, parts) for parts in (gaps, ones))
        trials = [(d, *_all_numbers(times, d)) for d in rates]
        best, found, late = min(trials, key=lambda trial: trial[2])
        if late >= least:
            break
        dt, numbers, least = best, found, late
    return dt


def _all_numbers(times: list[np.ndarray], dt: float) -> tuple[list[np.ndarray], float]:
    """The numbers of the rows of all pieces, and how late their stamps are in all."""
    found = [_numbers(t / dt) for t in times]
    return [numbers for numbers, _ in found], sum(late for _, late in found)


def _numbers(stamps: np.ndarray) -> tuple[np.ndarray, float]:
    """The rows' numbers ``(N,)``, of which those of missing rows are left out, by stamps in steps; how late these are.

    A stamp that is late is followed by one that is less so; where a row is missing, all that follow are later. So the
    number of rows that are missing so far never falls, and each row is about as many steps late (dynamic programming).
    """
    row = np.arange(len(stamps))
    late = stamps - row
    counts = np.arange(np.floor(late.min()), np.ceil(late.max()) + 1)
    if len(counts) > MANY:
        return row.astype(float), np.inf
    if np.ptp(ndimage.median_filter(late, SPAN)) < LEVEL:  # none is missing
        return row.astype(float), float(np.minimum(np.abs(late[:, None] - counts), 1.0).sum(0).min())
    best, came = np.minimum(np.abs(late[0] - counts), 1.0), np.zeros((len(stamps), len(counts)), dtype=np.int16)
    for index in row[1:]:
        fewer = np.minimum.accumulate(best)
        first = np.maximum.accumulate(np.where(best == fewer, np.arange(len(counts)), 0))
        jumps = fewer + JUMP < best
        came[index] = np.where(jumps, first, np.arange(len(counts)))
        best = np.where(jumps, fewer + JUMP, best) + np.minimum(np.abs(late[index] - counts), 1.0)
    numbers, at, least = row.astype(float), int(best.argmin()), float(best.min())
    for index in row[::-1]:
        numbers[index] += counts[at]
        at = int(came[index, at])
    return numbers - numbers[0], least


def _rate(stamps: list[np.ndarray], dt: float) -> float:
    """Time between rows by spans of several without a missing one, whose spread jitter hardly widens."""
    spans = np.concatenate([t[SPAN:] - t[:-SPAN] for t in stamps]) / SPAN
    for _ in range(TIMES):
        near = spans[np.abs(spans / dt - 1) < 0.5 / SPAN]
        dt = float(np.median(near)) if near.size else dt
    return dt


def _spacing(times: list[np.ndarray], numbers: list[np.ndarray], parts: list[np.ndarray]) -> float:
    """Time between rows by least squares, with one offset in each part of each piece."""
    number, stamp = list[np.ndarray](), list[np.ndarray]()
    for t, n, part in zip(times, numbers, parts, strict=True):
        for rows in np.split(np.arange(len(t)), np.flatnonzero(np.diff(part)) + 1):
            number.append(n[rows] - n[rows].mean())
            stamp.append(t[rows] - t[rows].mean())
    x, y = np.concatenate(number), np.concatenate(stamp)
    return float(x @ y / (x @ x))


def _nearer(stamps: np.ndarray, even: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Whether each row is nearer to what its neighbours say by even times than by stamps; NaN where both say the same.

    Of several signals that with the largest difference counts, in units of what it deviates as a rule: noise of slow
    ones says nothing.
    """
    by_stamps, by_rows = (_deviation(times, signals) for times in (stamps, even))
    usual = np.sqrt(np.median(np.minimum(by_stamps**2, by_rows**2), axis=0))
    gain = (np.abs(by_stamps) - np.abs(by_rows)) / np.where(usual > 0, usual, np.inf)
    gain = np.take_along_axis(gain, np.abs(gain).argmax(1)[:, None], 1)[:, 0]
    return np.where(gain == 0, np.nan, gain > 0)


def _deviation(times: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Deviation of rows ``(N − 2 SIDE, C)`` from the cubic through their neighbours, relative to white noise in it."""
    middle, around = np.arange(SIDE, len(times) - SIDE), np.delete(np.arange(-SIDE, SIDE + 1), SIDE)
    rows = middle[:, None] + around
    away = times[rows] - times[middle][:, None]
    weights = np.ones(away.shape)
    for own in range(len(around)):
        for other in np.delete(np.arange(len(around)), own):
            weights[:, own] *= away[:, other] / (away[:, other] - away[:, own])
    found = signals[middle] - np.einsum("nk,nkc->nc", weights, signals[rows])
    return np.asarray(found / np.sqrt(1 + (weights**2).sum(1, keepdims=True)))
