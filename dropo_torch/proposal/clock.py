"""When the rows of a log were taken: its time column and unit, its rate, and where it begins anew."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dropo_torch.data.readers import are_dates, dates_in_seconds
from dropo_torch.errors import InputError
from dropo_torch.proposal.columns import Column, Columns
from dropo_torch.proposal.evenly import Evenly, evenly
from dropo_torch.proposal.words import TIME_UNITS, split, time_unit

#: Units of time stamps, the likeliest first, and seconds between rows that a robot's log may have.
UNITS = (1.0, 1e-3, 1e-9, 1e-6)
FASTEST, SLOWEST = 1.5e-4, 0.6
#: Steps between stamps beyond which another episode begins: what was commanded there is unknown. Fewer, if most rows
#: (which share) are then in pieces that are long enough to compare (of how many rows).
GAP, SHORT_GAP, MOST, PIECE = 12.0, 3.5, 0.7, 40
#: Seconds of a nanosecond.
NANO = 1e-9
#: How dates and times of day begin.
_DATED = re.compile(r"\s*(\d{4}-\d\d-\d\d[T ]?|\d{1,2}:\d\d:\d\d)")
#: Relative deviation of a spacing up to which stamps count as even; and spacing from which on a row is missing.
EVEN, MISSING = 0.05, 1.5


@dataclass(frozen=True)
class Clock:
    """When the rows were taken.

    Attributes:
        column: the time column, or ``None``.
        unit: seconds of its unit.
        dt: seconds between rows, the median; ``None`` where nothing says it.
        even: whether spacings differ by no more than a reader takes.
        jitter: standard deviation of the spacings, gaps aside, relative to ``dt``.
        episode: a column that tells episodes apart, or ``None``.
        terminals: columns of flags that end episodes.
        breaks: rows at which stamps begin anew or leave a gap, where no column says so.
        why: how unit and episodes were found, in words.
        summed: the two columns, of whole seconds and of their nanoseconds, of which ``column`` is the sum; empty for
            one of its own.
        missing: rows that are missing between others, episodes aside.
        by_rows: whether rows were taken evenly, by what was measured, although stamps jitter: these are not read then.
    """

    column: Column | None
    unit: float
    dt: float | None
    even: bool
    jitter: float
    episode: Column | None
    terminals: tuple[Column, ...]
    breaks: tuple[int, ...]
    why: tuple[str, ...]
    summed: tuple[Column, ...] = ()
    missing: int = 0
    by_rows: bool = False

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of the log that tell the time."""
        return self.summed or ((self.column,) if self.column is not None else ())

    @property
    def seconds(self) -> np.ndarray | None:
        """When the rows were taken, dates too, ``(N,)``; ``None`` without stamps."""
        return None if self.column is None else _stamps(self.column) * self.unit

    @property
    def entry(self) -> str | dict[str, Any] | list[str | dict[str, Any]]:
        """The entry ``time`` of a config, in seconds."""
        *whole, last = self.columns
        fine = last.entry if self.unit == 1.0 else {"signal": last.entry, "scale": self.unit}
        return [*(c.entry for c in whole), fine] if whole else fine

    def starts(self, rows: int, parts: Sequence[int]) -> np.ndarray:
        """Return at which rows an episode begins, ``(N,)`` bool."""
        start = np.zeros(rows, dtype=bool)
        start[list(parts)] = True
        start[list(self.breaks)] = True
        if self.episode is not None:
            start[1:] |= self.episode.labels[1:] != self.episode.labels[:-1]
        for flag in self.terminals:
            start[1:] |= flag.values[:-1] == 1
        return start


def find_clock(columns: Columns, timestep: float, dt: float | None = None) -> Clock:
    """Return the clock of a log.

    Args:
        columns: the log.
        timestep: the model's, seconds.
        dt: seconds between rows, where they are given.

    Raises:
        InputError: time stamps that fall from row to row.
    """
    episode, flags = _episode(columns), _flags(columns)
    if columns.apart is not None:
        own = f"every signal has time stamps of its own; the fastest is sampled every {columns.apart:.4g} s"
        return Clock(None, 1.0, dt or columns.apart, False, 0.0, None, (), (), (own,))
    given = dt is not None
    empty = Clock(None, 1.0, dt, True, 0.0, episode, () if episode else flags, (), ())
    known = empty.starts(len(columns), columns.parts)
    column = None if given else _time_column(columns, known)
    if column is None:
        said = f"rows are {dt:g} s apart, as given" if given else "the log has no time stamps"
        return Clock(None, 1.0, dt, True, 0.0, episode, empty.terminals, (), (said,))
    summed = _with_seconds(columns, column)
    column = column if summed is None else _sum(*summed)
    stamps = _stamps(column)
    spacing = np.diff(stamps)
    usual = spacing[(spacing > 0) & ~known[1:]]
    median = float(np.median(usual)) if usual.size else 1.0
    unit, told = _unit_of(column, median, timestep)
    gap = SHORT_GAP if _leaves_enough(spacing, known, SHORT_GAP * median) else GAP
    breaks = tuple(_breaks(spacing, known, gap * median).tolist())
    within = usual[usual <= gap * median] / median
    even = bool((np.abs(within - 1) <= EVEN).all())
    why = [f"time stamps of {column.entry} {told}"]
    if episode is not None:
        why.append(f"{episode.entry} parts the rows into {1 + int(known[1:].sum())} episodes")
    if breaks:
        why.append(f"they begin anew, or leave a gap, at {len(breaks)} rows: an episode begins there")
    near = within < MISSING
    jitter = float(np.std(within[near])) if near.any() else 0.0
    clock = Clock(
        column, unit, float(within.mean()) * median * unit if even else median * unit, even, jitter, episode,
        empty.terminals, breaks, tuple(why), summed or (), int((np.round(within[~near]) - 1).sum()),
    )  # fmt: skip
    rows = None if even else _rows(columns, clock, stamps, median)
    return clock if rows is None else _by_rows(clock, rows, unit)


def _rows(columns: Columns, clock: Clock, stamps: np.ndarray, median: float) -> Evenly | None:
    """How rows are evenly spaced, if they are although their stamps are not; and none or few of them are missing."""
    starts = clock.starts(len(columns), columns.parts)
    taken = [c.values for c in columns.numeric if c.words.role not in ("time", "episode", "flag")]
    signals = [v for v in taken if np.isfinite(v).all() and not _goes_one_way(v, starts)]
    found = evenly(stamps, starts, np.stack(signals, 1), median) if signals else None
    if found is None:
        return None
    starts[found.missing] = True
    return found if _are_long(np.flatnonzero(starts), len(columns)) else None


def _goes_one_way(values: np.ndarray, starts: np.ndarray) -> bool:
    """Whether a column only rises or only falls within an episode, as a counter or another clock does."""
    change = np.diff(values)[~starts[1:]]
    return bool((change >= 0).all() or (change <= 0).all())


def _by_rows(clock: Clock, rows: Evenly, unit: float) -> Clock:
    """The clock by which rows are even whatever their stamps, and begin anew where some are missing."""
    told = (
        f"they jitter by {clock.jitter:.0%}, but what was measured is the smoother if rows are even: they are taken to "
        f"be {rows.dt * unit:.4g} s apart"
    )
    breaks = tuple(sorted({*clock.breaks, *rows.missing.tolist()}))
    more = (f"rows are missing at {len(rows.missing)} places: an episode begins there",) if len(rows.missing) else ()
    return replace(
        clock, dt=rows.dt * unit, even=True, breaks=breaks, why=(*clock.why, told, *more), missing=0, by_rows=True
    )


def _breaks(spacing: np.ndarray, known: np.ndarray, gap: float) -> np.ndarray:
    """Rows before which stamps begin anew or leave a gap, where no episode is known to begin."""
    return np.flatnonzero(((spacing < 0) | (spacing > gap)) & ~known[1:]) + 1


def _leaves_enough(spacing: np.ndarray, known: np.ndarray, gap: float) -> bool:
    """Whether most rows are in long pieces between gaps."""
    return _are_long(np.union1d(np.flatnonzero(known), _breaks(spacing, known, gap)), len(known))


def _are_long(starts: np.ndarray, rows: int) -> bool:
    """Whether most rows are in pieces that are long enough to compare."""
    sizes = np.diff(np.append(starts, rows))
    return bool(sizes[sizes >= PIECE].sum() >= MOST * sizes.sum())


def _stamps(column: Column) -> np.ndarray:
    """A time column's stamps, ``(N,)``, in its own unit; dates in seconds."""
    return column.values if column.values.size else dates_in_seconds(column.labels, column.entry)


def _time_column(columns: Columns, known: np.ndarray) -> Column | None:
    """The column of time stamps: by its name, or as the only one that rises evenly."""
    called = [c for c in columns.columns if c.words.role == "time" or split(c.entry)[-1:] == ["time"]]
    named = [c for c in called if _rises(c, known)]
    for c in () if named else called:
        if c.values.size and _rises(replace(c, values=-c.values), known):
            raise InputError(
                f"{columns.source}: {c.entry} falls from row to row; sort the rows by it, or name another column"
            )
    named = named or [c for c in columns.numeric if not c.words.role and _by_unit(c) and _rises(c, known)]
    if named:
        return max(named, key=lambda c: _steps(_stamps(c)))
    dates = [c for c in columns.columns if not c.values.size and len(c.labels) and _DATED.match(str(c.labels[0]))]
    if dates:
        return dates[0]
    rising = [c for c in columns.numeric if not c.words.role and _rises(c, known) and _evenly(c.values, known)]
    return rising[0] if len(rising) == 1 else None


def _by_unit(column: Column) -> bool:
    """Whether a name tells a unit of time, and one that is nothing else: ``log_ms``, but not ``x_s``."""
    return (time_unit(column.entry) or 1.0) < 1.0


def _with_seconds(columns: Columns, fine: Column) -> tuple[Column, Column] | None:
    """A column of whole seconds and the one of their parts, as a message's header has them; ``None`` without."""
    unit = time_unit(fine.entry) or 1.0
    if unit == 1.0 or not fine.values.size or not (fine.values.min() >= 0 and np.ptp(fine.values) < 1 / unit):
        return None
    own = [word for word in split(fine.entry) if word not in TIME_UNITS]
    for c in columns.numeric:
        words = split(c.entry)
        whole = words != own and [w for w in words if w not in TIME_UNITS] == own and c is not fine
        if whole and time_unit(c.entry) in (1.0, None) and np.isin(np.diff(c.values), (0, 1)).mean() > 0.9:
            return c, fine
    return None


def _sum(seconds: Column, fine: Column) -> Column:
    """A column of time since the first whole second, in the unit of the finer one."""
    values = (seconds.values - seconds.values[0]) / (time_unit(fine.entry) or NANO) + fine.values
    return replace(fine, values=values, labels=values)


def _rises(column: Column, known: np.ndarray) -> bool:
    if not column.values.size:
        return are_dates(column.labels)
    spacing = np.diff(column.values)[~known[1:]]
    return bool(spacing.size and np.isfinite(spacing).all() and (spacing > 0).mean() > 0.9)


def _evenly(values: np.ndarray, known: np.ndarray) -> bool:
    spacing = np.diff(values)[~known[1:]]
    whole = bool((values == np.round(values)).all() and np.median(spacing) == 1)  # that is a number of the row
    return not whole and bool((np.abs(spacing / np.median(spacing) - 1) < 0.5).mean() > 0.95)


def _steps(stamps: np.ndarray) -> int:
    """Different values of a column: of seconds and nanoseconds the finer ones tell the time."""
    return len(np.unique(stamps[:1000]))


def _unit_of(column: Column, median: float, timestep: float) -> tuple[float, str]:
    """Seconds of the unit of time stamps, and how it is known."""
    if not column.values.size:
        return 1.0, "are dates"
    named = time_unit(column.entry)
    likely = [u for u in UNITS if FASTEST <= median * u <= SLOWEST]
    whole = [u for u in likely if _is_whole(median * u / timestep)]
    if named is not None and (not likely or named in likely):
        return named, f"are in {_name(named)}, as its name says"
    if not likely:
        return 1.0, "are taken as seconds"
    unit = (whole or likely)[0]
    return unit, f"are in {_name(unit)}: rows are then {median * unit:.4g} s apart"


def _is_whole(ratio: float) -> bool:
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 0.02 * ratio


def _name(unit: float) -> str:
    return {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}[unit]


def _episode(columns: Columns) -> Column | None:
    """A column that keeps its value for long and is called an episode's."""
    for c in columns.columns:
        if c.words.role != "episode" or len(c.labels) < 2:
            continue
        changes = int((c.labels[1:] != c.labels[:-1]).sum())
        if 1 <= changes <= len(c.labels) / 5:
            return c
    return None


def _flags(columns: Columns) -> tuple[Column, ...]:
    found = [c for c in columns.numeric if c.words.role == "flag" and np.isin(c.values, (0, 1)).all()]
    return tuple(c for c in found if c.values.any())
