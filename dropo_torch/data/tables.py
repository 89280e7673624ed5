"""A log file as named arrays, and the column map that picks signals out of them.

A column map is what a config writes after ``observations``, ``actions`` or ``time``. Each entry is

============================================  ===================================================
``q``                                         the column or variable ``q``, every column of a matrix
``q[2]``, ``q[0:3]``                          one column, a slice of the columns of a matrix
``{signal: vir, scale: 35.15, name: force}``  ``scale · signal + offset``, renamed
============================================  ===================================================

and a map is one entry, a list of entries, or a mapping from names to entries such as
``{force: {signal: vir, scale: 35.15}}``. ``scale`` may also name a scalar variable of the file, and
``transpose: true`` reads a matrix that has one column a sample.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dropo_torch.data.trajectory import column_names
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_keys, number

ColumnMap = str | int | Mapping[str, Any] | Sequence[Any]


@dataclass(frozen=True)
class Signal:
    """One entry of a column map.

    Attributes:
        signal: a column or variable of the file, with an optional ``[index]`` or ``[from:to]``.
        name: what the signal is called from here on; by default as in the file.
        scale: factor, or the name of a scalar variable of the file that holds it.
        offset: added after scaling.
        transpose: whether the file holds one column a sample rather than one row.
    """

    signal: str
    name: str = ""
    scale: float | str = 1.0
    offset: float = 0.0
    transpose: bool = False


@dataclass(frozen=True)
class Table:
    """The named arrays of one log, read when asked for.

    Attributes:
        source: the file, for messages.
        names: the columns or variables that there are.
        read: gives the array of a name, of whatever dtype the file holds.
    """

    source: str
    names: tuple[str, ...]
    read: Callable[[str], np.ndarray]

    def matrix(self, columns: ColumnMap, what: str, rows: int | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the float64 matrix ``(N, k)`` that a column map picks, and the ``k`` names.

        Args:
            columns: the column map.
            what: what is picked, for messages.
            rows: the number of samples N, where the observations have said it.

        Raises:
            InputError: a name that is not there, something not numeric, lengths that differ.
        """
        parts = [self._signal(signal, what) for signal in parse_columns(columns, f"{self.source}: {what}")]
        if not parts:
            return np.empty((rows or 0, 0)), ()
        first, names = parts[0]
        for values, labels in parts:
            if len(values) != len(first):
                raise InputError(
                    f"{self.source}: {what}: {labels[0]} has {len(values)} rows and {names[0]} has {len(first)}; "
                    "both need one row a sample (transpose: true where a sample is a column)"
                )
        if rows is not None:
            self.check_rows(what, len(first), rows)
        return np.concatenate([values for values, _ in parts], axis=1), tuple(n for _, labels in parts for n in labels)

    def check_rows(self, what: str, found: int, rows: int) -> None:
        """Raise an :class:`InputError` for something with other than one row a sample."""
        if found != rows:
            raise InputError(
                f"{self.source}: {what} has {found} rows and observations has {rows}; both need one row a sample"
            )

    def array(self, name: str, what: str) -> np.ndarray:
        """Return one array as the file holds it.

        Raises:
            InputError: a name that is not there.
        """
        if name not in self.names:
            raise InputError(f"{self.source}: {what}: there is no {name!r}{choices(name, self.names)}")
        return self.read(name)

    def _signal(self, signal: Signal, what: str) -> tuple[np.ndarray, list[str]]:
        name, index = self._locate(signal.signal)
        values = numbers(self.array(name, what), f"{self.source}: {name}")
        if values.ndim == 1:
            values = values[:, None]
        if values.ndim != 2:
            raise InputError(f"{self.source}: {what}: {name} has shape {values.shape}; expected (samples, columns)")
        if signal.transpose:
            values = values.T
        width = values.shape[1]
        labels = column_names(signal.name or name, width)
        if index is not None:
            low, high = index.start or 0, width if index.stop is None else index.stop
            inside = -width <= low < width and -width <= high <= width
            picked = np.arange(width)[index if inside else slice(0)]
            if picked.size == 0:
                raise InputError(f"{self.source}: {what}: {signal.signal} is outside {name}, which has {width} columns")
            values, labels = values[:, picked], [labels[i] for i in picked]
            if signal.name and len(labels) == 1:
                labels = [signal.name]
        return self._scale(signal, what) * values + signal.offset, labels

    def _locate(self, text: str) -> tuple[str, slice | None]:
        """The array that an entry names and, where it has an index, its columns."""
        match = re.fullmatch(r"(.+)\[(-?\d+|-?\d*:-?\d*)\]", text)
        if text in self.names or match is None:
            return text, None
        if ":" in match[2]:
            low, high = (int(bound) if bound else None for bound in match[2].split(":"))
            return match[1], slice(low, high)
        column = int(match[2])
        return match[1], slice(column, column + 1 or None)

    def _scale(self, signal: Signal, what: str) -> float:
        if not isinstance(signal.scale, str):
            return signal.scale
        factor = numbers(self.array(signal.scale, f"{what}: scale"), f"{self.source}: {signal.scale}")
        if factor.size != 1:
            raise InputError(
                f"{self.source}: {what}: scale {signal.scale!r} has shape {factor.shape}; expected a scalar"
            )
        return float(factor.reshape(()))


def parse_columns(columns: ColumnMap, where: str) -> tuple[Signal, ...]:
    """Read a column map; the forms stand in this module's documentation.

    Raises:
        InputError: an entry that is none of them.
    """
    if isinstance(columns, str) or (isinstance(columns, int) and not isinstance(columns, bool)):
        return (Signal(str(columns)),)
    if isinstance(columns, Mapping):
        if "signal" in columns:
            return (_parse_signal(columns, where),)
        if all(isinstance(entry, str | int | Mapping) for entry in columns.values()):
            return tuple(
                replace(signal, name=str(name))
                for name, entry in columns.items()
                for signal in parse_columns(entry, f"{where}: {name}")
            )
    if isinstance(columns, Sequence):
        return tuple(signal for entry in columns for signal in parse_columns(entry, where))
    raise InputError(
        f"{where}: {columns!r} is not understood; expected a column's name, a list of names, "
        "or a mapping such as {force: {signal: u, scale: 2.0}}"
    )


def numbers(array: np.ndarray, where: str) -> np.ndarray:
    """Return ``array`` as float64, NaN where a table has no value; a column of lists becomes a matrix.

    Raises:
        InputError: something that is no number, naming its row.
    """
    array = np.asarray(array)
    if array.dtype.kind in "biuf":
        return array.astype(np.float64)
    if array.ndim != 1 or array.dtype.kind not in "OUS":
        raise InputError(f"{where} holds {array.dtype} values of shape {array.shape}; numbers are expected")
    if len(array) and isinstance(array[0], list | np.ndarray):
        try:
            return np.stack([np.asarray(row, dtype=np.float64) for row in array])
        except (TypeError, ValueError) as error:
            raise InputError(f"{where} is not a list of numbers of one length in every row ({error})") from None
    with extra("formats", where):
        import pandas as pd
    values = np.asarray(pd.to_numeric(pd.Series(array), errors="coerce"), dtype=np.float64)
    bad = np.flatnonzero(np.isnan(values) & ~missing(array))
    if bad.size:
        raise InputError(f"{where} is {str(array[bad[0]])!r} at row {bad[0]} (counted from 0); a number is expected")
    return values


def missing(array: np.ndarray) -> np.ndarray:
    """Return which entries of a column ``(N,)`` have no value, ``(N,)`` bool."""
    if array.dtype.kind in "biuf":
        return np.isnan(array)
    if array.dtype.kind in "US":
        return np.zeros(len(array), dtype=bool)
    with extra("formats", "a column that holds no plain numbers"):
        import pandas as pd
    return np.asarray(pd.isna(array))


def _parse_signal(entry: Mapping[str, Any], where: str) -> Signal:
    check_keys(entry, [field.name for field in fields(Signal)], where)
    signal = Signal(**{**entry, "signal": str(entry["signal"]), "name": str(entry.get("name", ""))})
    if not isinstance(signal.transpose, bool):
        raise InputError(f"{where}: transpose is {signal.transpose!r}; expected true or false")
    scale = signal.scale
    try:
        scale = number(scale, f"{where}: scale")
    except InputError:
        if not isinstance(scale, str) or not scale:  # text that is no number names a variable
            raise
    return replace(signal, scale=scale, offset=number(signal.offset, f"{where}: offset"))
