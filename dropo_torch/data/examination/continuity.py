"""Rows that do not follow one another: episodes that were joined, angles that wrap, next observations of other rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dropo_torch.data.examination.finding import Finding, confidence, first_rows
from dropo_torch.data.examination.record import Coordinate, Record
from dropo_torch.data.examination.rules import Rules

TURN = 2 * np.pi


def continuous(record: Record, rules: Rules) -> tuple[Record, list[Finding]]:
    """Return the record with the episodes' ends and turns that the log hides, and what was found."""
    record, found = _misplaced(record, rules)
    jumps = _jumps(record, rules)
    record, turned = _turned(record, jumps, rules)
    record, joined = _joined(record, jumps, rules)
    return record, found + turned + joined


def _misplaced(record: Record, rules: Rules) -> tuple[Record, list[Finding]]:
    """Where the next row is not what was observed after a transition."""
    if len(record.log) < 3:
        return record, []
    other = _other_row(record)
    if other is not None:
        return record, [other]
    if _unordered(record):
        what = (
            "what was observed after a row is not the next row, anywhere: the rows are in no order. A fit of single "
            "transitions takes them; whatever looks at longer stretches does not"
        )
        advice = "terminals that are true in every row say so"
        every = np.ones(len(record.log), dtype=bool)
        found = Finding("unordered", (), what, "doubtful", advice=advice)
        return record.with_breaks(~every, every), [found]
    off = _unlike(record.before[1:], record.after[:-1], rules) & ~record.log.terminals[:-1]
    rows = np.flatnonzero(off)
    if rows.size == 0:
        return record, []
    record = record.with_breaks(np.zeros(len(record.log), dtype=bool), np.append(off, True))
    return record, [_breaks(record, rows, rows + 1, True, "what was observed after a row is not the next row")]


def _unordered(record: Record) -> bool:
    """Whether from one row to the next there is far more than what a transition changes."""
    inside = ~record.log.terminals[:-1]
    if inside.sum() < 10:
        return False
    between = np.median(np.abs(record.before[1:] - record.after[:-1])[inside], axis=0)
    within = np.median(np.abs(record.after - record.before), axis=0)
    moving = within > 0
    return bool(moving.any() and np.median(between[moving] / within[moving]) > 3)


def _other_row(record: Record) -> Finding | None:
    """The finding of next observations that are those of the same row, or of one too far on."""
    rows = np.flatnonzero(~record.log.terminals[:-2] & ~record.log.terminals[1:-1])
    scale = np.maximum(np.ptp(record.before, axis=0), 1e-12)
    if len(rows) < 10:
        return None
    off = {s: float(np.mean(np.abs(record.before[rows + s] - record.after[rows]) / scale)) for s in (0, 1, 2)}
    best = min(off, key=lambda s: off[s])
    if best == 1 or not off[best] < 0.1 * off[1]:
        return None
    words = {0: "the observations of the same row", 2: "the observations two rows further on"}[best]
    what = f"next_observations are {words}; they must be those of the next row"
    names = [record.signal(i) for i in range(record.observation.size)]
    cure = {"data": {"observations": names}} if record.observation.log_width == len(names) else {}
    return Finding(
        "next_observations", (), what, "sure", evidence={"off": off[best], "off_next_row": off[1]}, cure=cure,
        advice="without the array the next row's observations are taken",
    )  # fmt: skip


def _unlike(first: np.ndarray, second: np.ndarray, rules: Rules) -> np.ndarray:
    """Rows ``(T,)`` in which two tables differ by more than the noise by which they differ everywhere."""
    difference = np.abs(first - second)
    spread = first.max(0) - first.min(0)
    usual = np.median(difference, axis=0)
    return np.asarray((difference > rules.linked * 1.4826 * usual + 0.02 * spread).any(axis=1))


def _jumps(record: Record, rules: Rules) -> np.ndarray:
    """How far the step of each row and position column is beyond what its neighbors allow, ``(T, n)``; 1 is a jump."""
    size = np.abs(record.steps)
    excess = np.zeros_like(size)
    for c, column in record.positions if len(size) >= 5 else ():
        own, spread = size[:, column], float(np.ptp(record.before[:, column]))
        if not own.any():
            continue
        beside = np.max([np.roll(own, s) for s in (-2, -1, 1, 2)], axis=0)
        usual = rules.jump * (beside + float(np.median(own[own > 0]))) + 0.03 * spread
        excess[:, column] = np.where(_released(record, c, own), 0.0, own / usual)
    return excess


def _released(record: Record, c: Coordinate, size: np.ndarray) -> np.ndarray:
    """Rows ``(T,)`` before which a position stood still although its velocity was not zero: it catches up."""
    if c.velocity is None:
        return np.zeros(len(size), dtype=bool)
    stood = (size == 0) & (np.abs(record.before[:, c.velocity]) > 1e-6 * np.abs(record.before[:, c.velocity]).max())
    return np.asarray(np.roll(stood, 1) & np.roll(stood, 2))


def _turned(record: Record, jumps: np.ndarray, rules: Rules) -> tuple[Record, list[Finding]]:
    """Angles that jump by a turn while nothing else jumps."""
    turns = np.zeros_like(jumps)
    for column in [column for c, column in record.positions if c.angle]:
        step, angle = record.steps[:, column], record.before[:, column]
        whole = np.round(step / TURN)
        near = (np.abs(step - TURN * whole) < rules.turn_tolerance * TURN) & (np.abs(whole) == 1)
        turns[:, column] = np.where(near & (np.ptp(angle) < TURN * (1 + 1e-3)), whole, 0.0)
    others = (np.where(turns != 0, 0.0, jumps) > 1).any(axis=1)
    turns[others] = 0.0  # what jumps together with something else is another episode
    wrapped = np.flatnonzero(np.any(turns != 0, axis=0))
    if wrapped.size == 0:
        return record, []
    rows = np.flatnonzero(np.any(turns != 0, axis=1))
    what = (
        f"{record.named(wrapped.tolist())} jumps by a whole turn at {len(rows)} "
        f"{'row' if len(rows) == 1 else 'rows'}: the angle wraps where it leaves its range"
    )
    found = Finding(
        "wraps", tuple(record.label(int(c)) for c in wrapped), what, "sure", rows=first_rows(rows),
        evidence={"jumps": float(np.abs(turns).sum())},
        cure={"data": {"unwrap": [record.signal(int(c)) for c in wrapped]}},
    )  # fmt: skip
    return replace(record, turns=record.turns + turns), [found]


def _joined(record: Record, jumps: np.ndarray, rules: Rules) -> tuple[Record, list[Finding]]:
    """Transitions in which positions jump: they lead from one episode into another."""
    free = np.where(record.turns != 0, 0.0, jumps)
    rows = np.flatnonzero((free > 1).any(axis=1))
    if rows.size == 0:
        return record, []
    cut = np.zeros(len(record.log), dtype=bool)
    cut[rows] = True
    several = (free[rows] > 1).sum(axis=1) > 1
    large = free[rows].max(axis=1) > rules.sure_jump / rules.jump
    record = record.with_breaks(cut, np.zeros_like(cut))
    columns = np.flatnonzero((free[rows] > 1).any(axis=0)).tolist()
    sure = bool((several | large).mean() > 0.5)
    return record, [_breaks(record, rows, rows, sure, f"{record.named(columns)} jumps", float(free.max()))]


def _breaks(record: Record, rows: np.ndarray, at: np.ndarray, sure: bool, words: str, excess: float = 1.0) -> Finding:
    """The finding of episodes that were joined before some rows of the file."""
    begins = [record.file_row(int(r)) + (0 if at is not rows else 1) for r in at]
    what = (
        f"{words} at {len(rows)} {'row' if len(rows) == 1 else 'rows'} inside episodes, the first of them row "
        f"{int(rows[0])}: episodes are joined without an end, or samples are missing"
    )
    return Finding(
        "joined", (), what, confidence(sure), rows=first_rows(rows),
        evidence={"jumps": float(len(rows)), "excess": excess}, cure={"data": {"breaks": begins}},
        advice="or name the column that tells episodes apart with data: episode or terminals",
    )  # fmt: skip
