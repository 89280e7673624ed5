"""Signals with time stamps of their own, brought to the rows of one table: NaN where a signal has no sample.

Preprocessing, which takes every signal's own samples, puts them on one grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dropo_torch.data.tables import Table
from dropo_torch.errors import InputError

#: What the table of streams calls its column of time stamps.
TIME = "(time)"


@dataclass(frozen=True)
class Stream:
    """The samples of one column.

    Attributes:
        time: time stamps, rising, ``(N,)``: seconds, or whole nanoseconds, alike in all columns.
        values: ``(N,)``.
    """

    time: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Matrix:
    """Columns that are called by one name.

    Attributes:
        columns: the columns by their names, in order.
        keyed: whether they are joints, whose order is the writer's.
        quaternions: first columns of unit quaternions.
    """

    columns: Mapping[str, Stream]
    keyed: bool = False
    quaternions: tuple[int, ...] = ()


def aligned(source: str, matrices: Mapping[str, Matrix], *, unit: float = 1.0, joints: Sequence[str] = ()) -> Table:
    """Return a table with a row for every time at which a column has a sample.

    Args:
        source: the file, for messages.
        matrices: what there is, by name.
        unit: seconds of one unit of the time stamps.
        joints: of keyed matrices, the columns that are meant where an entry names none.
    """
    streams = [stream for matrix in matrices.values() for stream in matrix.columns.values()]
    times = np.unique(np.concatenate([stream.time for stream in streams])) if streams else np.empty(0)
    arrays = {name: _filled(list(matrix.columns.values()), times) for name, matrix in matrices.items()}
    arrays[TIME] = (times - times[0]) * unit if len(times) else times
    return Table(
        source,
        tuple(arrays),
        arrays.__getitem__,
        labels={name: tuple(matrix.columns) for name, matrix in matrices.items()},
        joints=tuple(joints),
        keyed=frozenset(name for name, matrix in matrices.items() if matrix.keyed),
        defaults={"time": TIME},
        quaternions={name: matrix.quaternions for name, matrix in matrices.items() if matrix.quaternions},
        sparse=any(len(stream.time) < len(times) for stream in streams),
    )


def check_finite(where: str, stream: Stream, unit: float, *, missing_allowed: bool) -> None:
    """Raise an :class:`InputError` for a value that is infinite or, unless that counts as no sample, NaN."""
    bad = np.flatnonzero(~(np.isfinite(stream.values) | (missing_allowed & np.isnan(stream.values))))
    if bad.size:
        after = (stream.time[bad[0]] - stream.time[0]) * unit
        hint = "; preprocess: {max_gap: SECONDS} leaves such samples out" if np.isnan(stream.values[bad[0]]) else ""
        raise InputError(
            f"{where} is {stream.values[bad[0]]:g} in sample {bad[0]} (counted from 0, {after:.6g} s after its "
            f"first); expected a finite number{hint}"
        )


def _filled(columns: Sequence[Stream], times: np.ndarray) -> np.ndarray:
    """The columns at all times, ``(N, k)``."""
    out = np.full((len(times), len(columns)), np.nan)
    for i, stream in enumerate(columns):
        out[np.searchsorted(times, stream.time), i] = stream.values
    return out
