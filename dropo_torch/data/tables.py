"""A log file as named arrays, and the column map that picks signals out of them.

A column map is what a config writes after ``observations``, ``actions`` or ``time``. Each entry is

============================================  ===================================================
``q``                                         the column or variable ``q``, every column of a matrix
``q[2]``, ``q[0:3]``                          one column, a slice of the columns of a matrix
``q[elbow]``, ``q[elbow, wrist]``             columns by their names, where the file has them
``{signal: vir, scale: 35.15, name: force}``  ``scale · signal + offset``, renamed
============================================  ===================================================

and a map is one entry, a list of entries, or a mapping from names to entries such as
``{force: {signal: vir, scale: 35.15}}``. ``scale`` may also name a scalar variable of the file, and
``transpose: true`` reads a matrix that has one column a sample.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dropo_torch.data.trajectory import column_names
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_keys, number

if TYPE_CHECKING:
    import pandas as pd

ColumnMap = str | int | Mapping[str, Any] | Sequence[Any]
Index = slice | tuple[str, ...]


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
class Choice:
    """What is read of a log whose signals have time stamps of their own.

    Attributes:
        entries: what column maps name, with indices.
        joints: the joints that are meant where an entry names none.
        missing_allowed: whether NaN counts as no sample.
        every: whether all joints are meant where neither does.
    """

    entries: tuple[str, ...]
    joints: tuple[str, ...] = ()
    missing_allowed: bool = False
    every: bool = False


@dataclass(frozen=True)
class Table:
    """The named arrays of one log, read when asked for.

    Attributes:
        source: the file, for messages.
        names: the columns or variables that there are.
        read: gives the array of a name, of whatever dtype the file holds.
        labels: the names of a matrix' columns, where the file has them.
        joints: of the matrices whose columns are joints, the columns that are meant where an entry names none.
        keyed: those matrices.
        defaults: what is meant by ``observations``, ``actions``, ``time`` or ``episode`` where the config does not say.
        quaternions: first columns of the unit quaternions in a matrix.
        sparse: whether NaN says only that another signal has a sample there.
        choose: reads what some entries name, of a log whose signals have time stamps of their own.
        lenient: whether text in a few cells of a column of numbers counts as no sample.
    """

    source: str
    names: tuple[str, ...]
    read: Callable[[str], np.ndarray]
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    keyed: frozenset[str] = frozenset()
    defaults: Mapping[str, str] = field(default_factory=dict)
    quaternions: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    sparse: bool = False
    choose: Callable[[Choice], Table] | None = None
    lenient: bool = False

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
        values = numbers(self.array(name, what), f"{self.source}: {name}", lenient=self.lenient)
        if values.ndim == 1:
            values = values[:, None]
        if values.ndim != 2:
            raise InputError(f"{self.source}: {what}: {name} has shape {values.shape}; expected (samples, columns)")
        if signal.transpose:
            values = values.T
        stem = signal.name or name
        labels, picked = self._picked(name, stem, index, values.shape[1], f"{self.source}: {what}: {signal.signal}")
        if index is not None and signal.name and len(picked) == 1:
            labels = [signal.name]
        return self._scale(signal, what) * values[:, picked] + signal.offset, labels

    def _picked(
        self, name: str, stem: str, index: Index | None, width: int, where: str
    ) -> tuple[list[str], Sequence[int]]:
        """The chosen columns of a matrix of some width, by their names and numbers."""
        known = self.labels.get(name)
        labels = column_names(stem, width) if known is None else [f"{stem}[{label}]" for label in known]
        if index is None and name in self.keyed and self.joints:
            index = self.joints
        if index is None:
            return labels, range(width)
        if isinstance(index, tuple):
            if known is None:
                raise InputError(f"{where}: the columns of {name} have no names; choose by number, as in {name}[0]")
            picked = [column for wanted in index for column in pick(wanted, known, where)]
        else:
            low, high = index.start or 0, width if index.stop is None else index.stop
            inside = -width <= low < width and -width <= high <= width
            picked = list(range(width)[index if inside else slice(0)])
            if not picked:
                raise InputError(f"{where} is outside {name}, which has {width} columns")
        return [labels[i] for i in picked], picked

    def orientations(self, columns: ColumnMap, what: str) -> list[tuple[str, ...]]:
        """Return the names that :meth:`matrix` gives the columns of each unit quaternion that it picks whole."""
        found = []
        for signal in parse_columns(columns, f"{self.source}: {what}"):
            name, index = self._locate(signal.signal)
            if name in self.quaternions:
                width = len(self.labels[name])
                labels, picked = self._picked(name, signal.name or name, index, width, self.source)
                named = dict(zip(picked, labels, strict=True))
                groups = [range(first, first + 4) for first in self.quaternions[name]]
                found += [tuple(named[c] for c in group) for group in groups if named.keys() >= set(group)]
        return found

    def _locate(self, text: str) -> tuple[str, Index | None]:
        """The array that an entry names and, where it has an index, its columns."""
        return (text, None) if text in self.names else split_index(text)

    def _scale(self, signal: Signal, what: str) -> float:
        if not isinstance(signal.scale, str):
            return signal.scale
        factor = numbers(self.array(signal.scale, f"{what}: scale"), f"{self.source}: {signal.scale}")
        if factor.size != 1:
            raise InputError(
                f"{self.source}: {what}: scale {signal.scale!r} has shape {factor.shape}; expected a scalar"
            )
        return float(factor.reshape(()))


def frame_table(source: str, frame: pd.DataFrame) -> Table:
    """Return the columns of a data frame, and of its index where that has names."""
    if any(name is not None for name in frame.index.names):
        frame = frame.reset_index()
    columns = {str(name): i for i, name in enumerate(frame.columns)}
    if len(columns) < frame.shape[1]:
        name = next(str(n) for i, n in enumerate(frame.columns) if columns[str(n)] != i)
        raise InputError(f"{source}: two columns are named {name!r}; give each a name of its own")
    return Table(source, tuple(columns), lambda name: frame.iloc[:, columns[name]].to_numpy())


def split_index(text: str) -> tuple[str, Index | None]:
    """Return the name and the index of an entry ``name[index]``: a slice of its columns, or their names."""
    match = re.fullmatch(r"(.+?)\[([^\[\]]+)\]", text)
    if match is None:
        return text, None
    name, inside = match[1], match[2].strip()
    if re.fullmatch(r"-?\d+", inside):
        return name, slice(int(inside), int(inside) + 1 or None)
    if re.fullmatch(r"-?\d*:-?\d*", inside):
        low, high = (int(bound) if bound else None for bound in inside.split(":"))
        return name, slice(low, high)
    return name, tuple(part.strip() for part in inside.split(","))


def pick(wanted: str, labels: Sequence[str], where: str) -> list[int]:
    """Return the columns of a name; that of a group such as ``hand`` stands for ``hand.x``, ``hand.y``, ... too.

    Raises:
        InputError: a name that no column has.
    """
    found = [i for i, label in enumerate(labels) if label == wanted or label.startswith(f"{wanted}.")]
    if not found:
        raise InputError(f"{where}: there is no {wanted!r}{choices(wanted, labels)}")
    return found


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


#: Cells of text, as a share of those with numbers, up to which a column is one of numbers.
FEW = 0.1


def numbers(array: np.ndarray, where: str, *, lenient: bool = False) -> np.ndarray:
    """Return ``array`` as float64, NaN where a table has no value; a column of lists becomes a matrix.

    Args:
        array: the column.
        where: it, for messages.
        lenient: whether text in a few cells, such as ``ERR``, is NaN, too.

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
    if bad.size and not (lenient and bad.size <= FEW * np.isfinite(values).sum()):
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
