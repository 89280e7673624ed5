"""A log as named columns of numbers, before anybody has said what they are."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dropo_torch.data.bags import unstamped
from dropo_torch.data.formats import open_tables
from dropo_torch.data.readers import matching_paths
from dropo_torch.data.streams import TIME
from dropo_torch.data.tables import Choice, Table, missing, numbers
from dropo_torch.data.text import TEXT, find_separator, first_lines
from dropo_torch.errors import InputError
from dropo_torch.proposal.words import Words, actual, body_rates, by_family, desired, read_name

if TYPE_CHECKING:
    from dropo_torch.proposal.angles import Angles

#: Columns of a matrix beyond which it is a picture or a cloud of points, and no state.
WIDEST = 200
#: Correlation from which on a column called after another one is what was commanded of it, and no derivative.
ALIKE = 0.5
#: Arrays that hold what is observed, and commanded, of a whole robot.
STATES = ("observations", "observation", "obs", "state", "states")
ACTIONS = ("actions", "action", "ctrl", "control", "controls", "u", "commands")

#: A name with a number at its end.
_NUMBERED = re.compile(r"(.*?[A-Za-z_])\[?(\d+)\]?")


@dataclass(frozen=True)
class Column:
    """One column of a log.

    Attributes:
        entry: what a config calls it, such as ``q1`` or ``position[2]``.
        array: the array that it belongs to.
        index: its place in that array, or ``None`` where the array is this column alone.
        values: its numbers, ``(N,)``, NaN where there is none; empty where it holds text.
        labels: what it holds as it stands, ``(N,)``.
        transposed: whether the array holds a sample in each column.
        words: what its name says.
        label: what the file calls it in its array; empty where that has no names.
        made_of: the columns that it was made of, in words; empty for one that the file has.
    """

    entry: str
    array: str
    index: int | None
    values: np.ndarray
    labels: np.ndarray
    transposed: bool
    words: Words = field(default_factory=Words)
    label: str = ""
    made_of: str = ""

    @property
    def moves(self) -> bool:
        """Whether it holds numbers that change."""
        finite = self.values[np.isfinite(self.values)]
        return bool(finite.size and np.ptp(finite) > 0)

    @property
    def text(self) -> tuple[int, str] | None:
        """The first row at which a column of numbers holds text, and that; ``None`` where it does nowhere."""
        if not self.values.size or self.labels.dtype.kind in "biuf":
            return None
        rows = np.flatnonzero(np.isnan(self.values) & ~missing(self.labels))
        return (int(rows[0]), str(self.labels[rows[0]])) if rows.size else None

    def as_map(self, scale: float = 1.0, offset: float = 0.0) -> str | dict[str, Any]:
        """Return it as an entry of a column map, in units of the model."""
        options: dict[str, Any] = {"scale": scale} if scale != 1.0 else {}
        options |= ({"offset": offset} if offset else {}) | ({"transpose": True} if self.transposed else {})
        return {"signal": self.entry, **options} if options else self.entry


@dataclass(frozen=True)
class Columns:
    """The columns of a log.

    Attributes:
        paths: the files, or the folder.
        source: they, for messages.
        columns: their columns, in the first file's order.
        parts: first row of each file, and of each part that one itself keeps apart, such as HDF5 groups.
        group: pattern of these, as a config has it.
        separator: of a text file, where it is no comma.
        stamps: of a bag, as a config has them.
        apart: seconds between samples, where each signal has time stamps of its own: those of the fastest that is no
            command, at whose stamps columns are then interpolated.
        orientations: those that are told by angles, in the place of whose columns quaternions are.
    """

    paths: tuple[Path, ...]
    source: str
    columns: tuple[Column, ...]
    parts: tuple[int, ...] = (0,)
    group: str | None = None
    separator: str | None = None
    stamps: Mapping[str, str] = field(default_factory=dict)
    apart: float | None = None
    orientations: tuple[Angles, ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.columns[0].labels) if self.columns else 0

    @property
    def numeric(self) -> tuple[Column, ...]:
        """Columns of numbers."""
        return tuple(c for c in self.columns if c.values.size)

    def named(self, entry: str) -> Column | None:
        """Return the column of an entry, or ``None``."""
        return next((c for c in self.columns if c.entry == entry), None)

    def matrix(self, names: tuple[str, ...]) -> tuple[Column, ...]:
        """Return the columns of the first array of one of these names, by the last part of its path."""
        for name in names:
            found = tuple(c for c in self.columns if last_part(c.array) == name)
            if (len(found) > 1 or (found and found[0].index is not None)) and not any(c.label for c in found):
                return found
        return ()


def last_part(array: str) -> str:
    """Return the last part of the path of an array, in small letters."""
    return re.split(r"[./]", array.lower())[-1]


def read_columns(log: str | Path | Sequence[str | Path], known: Sequence[str] = ()) -> Columns:
    """Read all columns of a log.

    Args:
        log: the log, or a pattern of its files; or several.
        known: names of the model's objects, which may have words that otherwise tell a column's kind.

    Raises:
        InputError: a file that cannot be read, in which nothing has a row a sample, or that has other columns.
    """
    given = [log] if isinstance(log, str | Path) else list(log)
    paths = tuple(path for entry in given for path in matching_paths(entry, Path(".")))
    separator = _separator(paths[0])
    tables = open_tables(paths[0], separator=separator)
    if tables[0].choose is None:
        found = _read(paths, tables, separator)
        return replace(found, columns=tuple(_understood(found.columns, known)))
    if len(paths) > 1:
        raise InputError(f"{paths[0]}: of files with streams, such as bags, init takes one; it got {len(paths)}")
    return _of_streams(paths[0], known)


def _understood(columns: Sequence[Column], known: Sequence[str]) -> list[Column]:
    """The columns with what their names say."""
    names = [f"{c.array} {c.label}" if c.label else c.entry for c in columns]

    def alike(i: int, j: int) -> bool:
        one, other = columns[i].values, columns[j].values
        known = np.isfinite(one) & np.isfinite(other) if len(one) == len(other) else np.zeros(0, dtype=bool)
        if known.sum() < 3 or not np.ptp(one[known]) or not np.ptp(other[known]):
            return False
        return bool(np.corrcoef(one[known], other[known])[0, 1] > ALIKE)

    names = of_joints(columns, names)
    names = by_family(body_rates(desired(names, alike), known), known)
    names = actual(names, [read_name(name, known) for name in names])
    return [replace(c, words=read_name(name, known)) for c, name in zip(columns, names, strict=True)]


def of_joints(columns: Sequence[Column], names: Sequence[str]) -> list[str]:
    """Return names in which numbers are those joints that a log's own columns of text name: ``name0``, ``name[0]``.

    Args:
        columns: the columns.
        names: their names.
    """
    told: dict[tuple[str, str], str] = {}
    for c in columns:
        found = _NUMBERED.fullmatch(c.entry)
        if found and not c.values.size and last_part(found[1]).endswith("name") and len(set(c.labels.tolist())) == 1:
            told[found[1][: -len("name")], found[2]] = str(c.labels[0])
    out = list(names)
    for i, c in enumerate(columns):
        found = _NUMBERED.fullmatch(c.entry)
        stem = next((s for s, number in told if found and found[2] == number and found[1].startswith(s)), None)
        if found is not None and stem is not None and c.values.size:
            out[i] = f"{found[1]} {told[stem, found[2]]}"
    return out


def _read(paths: tuple[Path, ...], tables: list[Table], separator: str | None) -> Columns:
    group = _group(tables[0].names)
    if group is not None:
        tables = open_tables(paths[0], group=group)
    for path in paths[1:]:
        tables = [*tables, *open_tables(path, separator=separator, group=group)]
    parts = [_of_table(table) for table in tables]
    source = str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
    names = [c.entry for c in parts[0] if all(any(c.entry == d.entry for d in other) for other in parts[1:])]
    starts = np.cumsum([0, *(len(p[0].labels) if p else 0 for p in parts)])[:-1]
    joined = [_joined([next(c for c in p if c.entry == name) for p in parts]) for name in names]
    if not joined:
        raise InputError(
            f"{source}: nothing in {'it' if len(paths) == 1 else 'all of them'} has a number a sample; expected "
            "columns of positions and commands"
        )
    return Columns(paths, source, tuple(joined), tuple(int(s) for s in starts), group, separator)


def _of_streams(path: Path, known: Sequence[str]) -> Columns:
    """The columns of a bag, interpolated at the stamps of the fastest signal that is measured."""
    stamps = unstamped(path)
    (table,) = open_tables(path, stamps=stamps or None)
    assert table.choose is not None
    usable = []
    for name in table.names:
        with contextlib.suppress(InputError):  # what holds no numbers
            table.choose(Choice((name,), missing_allowed=True, every=True))
            usable.append(name)
    if not usable:
        raise InputError(f"{path}: no topic of it has numbers; expected joint states, poses or commands")
    found = table.choose(Choice(tuple(usable), missing_allowed=True, every=True))
    columns = [
        c for name in usable for c in _of_array(name, np.asarray(found.read(name)), len(found.read(TIME)), found)
    ]
    columns, time = _understood(columns, known), np.asarray(found.read(TIME))
    measured = [c for c in columns if c.words.role in ("position", "velocity", "effort", "")] or columns
    fastest = max(measured, key=lambda c: int(np.isfinite(c.values).sum()))
    rows = np.isfinite(fastest.values)
    kept = [_interpolated(c, time, time[rows]) for c in columns if np.isfinite(c.values).sum() > 1]
    used = {name: whence for name, whence in stamps.items() if any(c.array.startswith(f"{name}.") for c in kept)}
    apart = float(np.median(np.diff(time[rows])))
    return Columns((path,), str(path), tuple(kept), stamps=used, apart=apart)


def _interpolated(column: Column, time: np.ndarray, at: np.ndarray) -> Column:
    known = np.isfinite(column.values)
    values = np.interp(at, time[known], column.values[known])
    return replace(column, values=values, labels=values)


def _separator(path: Path) -> str | None:
    """What separates the columns of a text file, where it is not what readers expect; ``None`` where it is."""
    if not path.name.lower().endswith(TEXT) or not path.is_file():
        return None
    found = find_separator(first_lines(path))
    return None if found == ("\t" if ".tsv" in path.suffixes else ",") else found


def _of_table(table: Table) -> list[Column]:
    """The columns of a table that have as many rows as most have."""
    arrays = {}
    for name in table.names:
        try:
            array = np.asarray(table.read(name))
        except InputError:
            continue  # what a column map could not take either
        if array.ndim in (1, 2) and array.size > 1:
            arrays[name] = array
    counts = Counter(n for a in arrays.values() for n in {max(a.shape) if a.ndim == 2 else len(a)})
    if not counts:
        return []
    rows = max(counts, key=lambda n: (counts[n], n))
    return [column for name, array in arrays.items() for column in _of_array(name, array, rows, table)]


def _of_array(name: str, array: np.ndarray, rows: int, table: Table) -> list[Column]:
    labels = table.labels.get(name, ())
    if array.ndim == 2 and array.shape[0] != rows and array.shape[1] == rows:
        return [] if len(array) > WIDEST else _of_matrix(name, array.T, labels, transposed=True)
    if len(array) != rows:
        return []
    if array.ndim == 2:
        return [] if array.shape[1] > WIDEST else _of_matrix(name, array, labels, transposed=False)
    try:
        values = numbers(array, name, lenient=True)
    except InputError:
        return [Column(name, name, None, np.empty(0), array, False)]
    if values.ndim == 2:
        return [] if values.shape[1] > WIDEST else _of_matrix(name, values, labels, transposed=False)
    if array.dtype.kind == "O" and missing(array).all():
        return []
    return [Column(name, name, None, values, array, False)]


def _of_matrix(name: str, matrix: np.ndarray, labels: Sequence[str], *, transposed: bool) -> list[Column]:
    try:
        values = matrix.astype(np.float64)
    except (TypeError, ValueError):
        return []
    if len(labels) == values.shape[1]:
        return [
            Column(f"{name}[{label}]", name, i, values[:, i], values[:, i], transposed, label=label)
            for i, label in enumerate(labels)
        ]
    if values.shape[1] == 1 and not transposed:
        return [Column(name, name, None, values[:, 0], values[:, 0], False)]
    entries = [f"{name}[{i}]" for i in range(values.shape[1])]
    return [Column(entry, name, i, values[:, i], values[:, i], transposed) for i, entry in enumerate(entries)]


def _joined(parts: list[Column]) -> Column:
    if len(parts) == 1:
        return parts[0]
    return replace(
        parts[0], values=np.concatenate([p.values for p in parts]), labels=np.concatenate([p.labels for p in parts])
    )


def _group(names: tuple[str, ...]) -> str | None:
    """Pattern of numbered groups that hold the same data sets, such as ``data/demo_*``; ``None`` for none."""
    found: dict[str, dict[str, set[str]]] = {}
    for name in names:
        match = re.fullmatch(r"((?:[^/]+/)*[^/\d]*)(\d+)/(.+)", name)
        if match:
            found.setdefault(match[1], {}).setdefault(match[2], set()).add(match[3])
    for stem, groups in found.items():
        if len(groups) > 1 and set.intersection(*groups.values()):
            return f"{stem}*"
    return None
