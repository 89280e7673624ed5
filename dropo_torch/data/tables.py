"""Log files of every format as named arrays, and the column map that picks signals out of them.

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
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.io

from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra

if TYPE_CHECKING:
    import pandas as pd

ColumnMap = str | int | Mapping[str, Any] | Sequence[Any]

_NPY_NAMES = {
    "observations": "observations",
    "nextobservations": "next_observations",
    "actions": "actions",
    "terminals": "terminals",
}


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

    def matrix(self, columns: ColumnMap, what: str) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the float64 matrix ``(N, k)`` that a column map picks, and the ``k`` names.

        Raises:
            InputError: a name that is not there, something not numeric, lengths that differ.
        """
        parts: list[np.ndarray] = []
        names: list[str] = []
        for signal in parse_columns(columns, f"{self.source}: {what}"):
            values, labels = self._signal(signal, what)
            if parts and len(values) != len(parts[0]):
                raise InputError(
                    f"{self.source}: {what}: {labels[0]} has {len(values)} rows and {names[0]} has {len(parts[0])}; "
                    "both need one row a sample (transpose: true where a sample is a column)"
                )
            parts.append(values)
            names += labels
        return (np.concatenate(parts, axis=1) if parts else np.empty((0, 0))), tuple(names)

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
        label = signal.name or name
        width = values.shape[1]
        labels = [label] if width == 1 else [f"{label}[{i}]" for i in range(width)]
        if index is not None:
            picked = np.arange(width)[index] if _inside(index, width) else np.empty(0, dtype=np.int64)
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
            return (_signal(columns, where),)
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
    if array.dtype.kind == "O" and array.ndim == 1 and len(array) and isinstance(array[0], list | np.ndarray):
        try:
            return np.stack([np.asarray(row, dtype=np.float64) for row in array])
        except (TypeError, ValueError) as error:
            raise InputError(f"{where} is not a list of numbers of one length in every row ({error})") from None
    if array.dtype.kind in "OUS" and array.ndim == 1:
        with extra("formats", where):
            import pandas as pd
        values = np.asarray(pd.to_numeric(pd.Series(array), errors="coerce"), dtype=np.float64)
        bad = np.flatnonzero(np.isnan(values) & ~missing(array))
        if bad.size == 0:
            return values
        raise InputError(f"{where} is {str(array[bad[0]])!r} at row {bad[0]} (counted from 0); a number is expected")
    raise InputError(f"{where} holds {array.dtype} values of shape {array.shape}; numbers are expected")


def missing(array: np.ndarray) -> np.ndarray:
    """Return where a column has no value."""
    if array.dtype.kind in "biufUS":
        return array != array
    with extra("formats", "a column that holds no plain numbers"):
        import pandas as pd
    return np.asarray(pd.isna(array))


def open_tables(path: Path, *, group: str | None = None, separator: str | None = None) -> list[Table]:
    """Return the logs in a file or folder: one, or one for each HDF5 group that ``group`` matches.

    Args:
        path: ``.npz``, ``*_observations.npy`` or a folder with one, ``.csv``, ``.tsv``, ``.txt``,
            ``.parquet``, ``.h5``, ``.hdf5`` or ``.mat``.
        group: pattern of the HDF5 groups that hold an episode each, such as ``data/demo_*``.
        separator: what separates the columns of a text file; a comma by default, a tab in ``.tsv``.

    Raises:
        InputError: a file that is missing, unreadable or of an unknown kind.
    """
    suffix = path.suffix.lower()
    if not path.exists():
        raise InputError(missing_file(path))
    if group is not None and suffix not in (".h5", ".hdf5"):
        raise InputError(f"{path}: group is an option of HDF5 files (.h5, .hdf5); leave it out here")
    if separator is not None and suffix not in (".csv", ".tsv", ".txt"):
        raise InputError(f"{path}: separator is an option of text files (.csv, .tsv, .txt); leave it out here")
    if path.is_dir():
        return [_open_npy(_single_log(path))]
    if suffix == ".npz":
        return [_open_npz(path)]
    if path.name.endswith("_observations.npy"):
        return [_open_npy(path)]
    if suffix in (".csv", ".tsv", ".txt"):
        return [_open_text(path, separator or ("\t" if suffix == ".tsv" else ","))]
    if suffix in (".parquet", ".pq"):
        with extra("formats", str(path)):
            import pandas as pd
            import pyarrow  # noqa: F401  # what pandas reads it with
        with reading(path, "Parquet"):
            return [_frame_table(path, pd.read_parquet(path, engine="pyarrow"))]
    if suffix in (".h5", ".hdf5"):
        return _open_hdf5(path, group)
    if suffix == ".mat":
        return [_open_mat(path)]
    raise InputError(
        f"{path}: unknown kind of log; expected .npz, *_observations.npy or a folder with it, "
        ".csv, .parquet, .h5, .hdf5, .mat or a Minari dataset"
    )


def missing_file(path: Path) -> str:
    """Return the message for a path that does not exist, with the nearest name beside it."""
    if path.parent.is_dir():
        return f"{path}: no such file or folder{choices(path.name, sorted(p.name for p in path.parent.iterdir()))}"
    return f"{path}: no such file or folder (nor is there a folder {path.parent})"


@contextmanager
def reading(path: Path | str, kind: str) -> Iterator[None]:
    """Turn what a library raises on a file that it cannot read into an :class:`InputError` of one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # on a corrupt file these libraries raise whatever comes up
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read as {kind} ({reason})") from None


def _open_npz(path: Path) -> Table:
    # the file is opened here because numpy leaves it open where it is corrupt
    with reading(path, ".npz of plain arrays"), path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        names = tuple(archive.files)

    def read(name: str) -> np.ndarray:
        where = f"{path}: {name}"
        with reading(where, "a plain array"), path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return np.asarray(archive[name])

    return Table(str(path), names, read)


def _open_npy(observations: Path) -> Table:
    """The ``.npy`` files beside ``PREFIX_observations.npy`` that share its prefix."""
    prefix = observations.name.removesuffix("observations.npy")
    files = {name: observations.with_name(f"{prefix}{stem}.npy") for stem, name in _NPY_NAMES.items()}
    files = {name: file for name, file in files.items() if file.exists()}
    for name in ("next_observations", "actions"):
        if name not in files:
            raise InputError(
                f"{observations.parent}: there is no {prefix}{name.replace('_', '')}.npy beside {observations.name}"
            )

    def read(name: str) -> np.ndarray:
        with reading(files[name], "a plain .npy array"):
            return np.asarray(np.load(files[name], allow_pickle=False))

    return Table(str(observations.parent), tuple(files), read)


def _single_log(folder: Path) -> Path:
    found = sorted(folder.glob("*_observations.npy"))
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(f"{folder}: {len(found)} logs are in this folder; name one, such as {found[0]}")
    raise InputError(
        f"{folder}: no *_observations.npy in this folder and it is no Minari dataset"
        f"{choices('observations.npy', sorted(p.name for p in folder.iterdir()))}"
    )


def _open_text(path: Path, separator: str) -> Table:
    with extra("formats", str(path)):
        import pandas as pd
    with (
        reading(path, "a table of text"),
        warnings.catch_warnings(action="error", category=pd.errors.ParserWarning),  # rows longer than the header
    ):
        frame = pd.read_csv(path, sep=separator, skipinitialspace=True, index_col=False, low_memory=False)
    frame.columns = frame.columns.str.strip()
    only = str(frame.columns[0])
    other = next((mark for mark in (";", "\t", ",") if mark != separator and mark in only), None)
    if len(frame.columns) == 1 and other is not None:
        raise InputError(f"{path}: its one column is {only!r}; separator: {other!r} may be what is meant")
    return _frame_table(path, frame)


def _frame_table(path: Path, frame: pd.DataFrame) -> Table:
    if any(name is not None for name in frame.index.names):
        frame = frame.reset_index()
    columns = {str(name): i for i, name in enumerate(frame.columns)}
    return Table(str(path), tuple(columns), lambda name: frame.iloc[:, columns[name]].to_numpy())


def _open_hdf5(path: Path, group: str | None) -> list[Table]:
    with extra("formats", str(path)):
        import h5py
    groups: list[str] = []
    datasets: list[str] = []

    def visit(name: str | bytes, item: object) -> None:
        if isinstance(name, str):  # a name that is no UTF-8 comes as bytes
            (datasets if isinstance(item, h5py.Dataset) else groups).append(name)

    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        file.visititems(visit)
    if group is None:
        return [_hdf5_table(path, "", datasets)]
    pattern = f"/{group.strip('/')}"
    matched = sorted((g for g in groups if PurePosixPath(f"/{g}").match(pattern)), key=_natural)
    if not matched:
        raise InputError(f"{path}: group: no group matches {group!r}{choices(group, groups)}")
    return [_hdf5_table(path, f"{g}/", datasets) for g in matched]


def _hdf5_table(path: Path, prefix: str, datasets: list[str]) -> Table:
    import h5py

    def read(name: str) -> np.ndarray:
        with reading(f"{path}: {name}", "an HDF5 data set"), h5py.File(path, "r") as file:
            return np.asarray(file[prefix + name][()])

    names = tuple(d.removeprefix(prefix) for d in datasets if d.startswith(prefix))
    return Table(f"{path}: {prefix.rstrip('/')}" if prefix else str(path), names, read)


def _open_mat(path: Path) -> Table:
    """A MATLAB file; the fields of a struct ``log`` are called ``log.q``, vectors are ``(N,)``."""
    with path.open("rb") as file:
        head = file.read(520)
    if b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:]):  # version 7.3 is HDF5, behind a block of MATLAB's own
        return _open_mat73(path)
    with reading(path, "a MATLAB file"):
        arrays = flatten(scipy.io.loadmat(path, simplify_cells=True), ".")
    arrays = {name: array for name, array in arrays.items() if not name.startswith("__")}
    return Table(str(path), tuple(arrays), arrays.__getitem__)


def _open_mat73(path: Path) -> Table:
    table = _open_hdf5(path, None)[0]
    names = {name.replace("/", "."): name for name in table.names if not name.startswith("#")}

    def read(name: str) -> np.ndarray:
        array = table.read(names[name]).T
        return array.reshape(-1) if array.ndim == 2 and 1 in array.shape else array

    return Table(str(path), tuple(names), read)


def flatten(nested: object, joint: str, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the leaves of nested mappings, lists and tuples, their keys joined by ``joint``."""
    if isinstance(nested, Mapping):
        items = list(nested.items())
    elif isinstance(nested, list | tuple):
        items = list(enumerate(nested))
    else:
        return {prefix: np.asarray(nested)}
    leaves: dict[str, np.ndarray] = {}
    for key, value in items:
        leaves |= flatten(value, joint, f"{prefix}{joint}{key}" if prefix else str(key))
    return leaves


def _signal(entry: Mapping[str, Any], where: str) -> Signal:
    known = [field.name for field in fields(Signal)]
    for key in entry:
        if key not in known:
            raise InputError(f"{where}: unknown key {key!r}{choices(key, known)}")
    signal = Signal(**{**entry, "signal": str(entry["signal"]), "name": str(entry.get("name", ""))})
    if not isinstance(signal.transpose, bool):
        raise InputError(f"{where}: transpose is {signal.transpose!r}; expected true or false")
    return replace(
        signal,
        scale=_factor(signal.scale, f"{where}: scale", name_allowed=True),
        offset=_factor(signal.offset, f"{where}: offset"),
    )


def _factor(value: object, where: str, *, name_allowed: bool = False) -> Any:
    """A finite number (also where YAML reads ``1e-3`` as text), or a name."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        if name_allowed and isinstance(value, str) and value:
            return value
        number = float("nan")
    if isinstance(value, bool) or not np.isfinite(number):
        raise InputError(f"{where} is {value!r}; expected a finite number")
    return number


def _inside(index: slice, width: int) -> bool:
    """Whether the ends of a slice lie within ``width`` columns."""
    low = 0 if index.start is None else index.start
    high = width if index.stop is None else index.stop
    return -width <= low < width and -width <= high <= width


def _natural(name: str) -> list[str | int]:
    """Sort key by which ``demo_10`` comes after ``demo_9``."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
