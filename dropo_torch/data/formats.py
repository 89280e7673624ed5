"""The file formats of logs.

=================================  ===============================================================
``.npz``                           arrays ``observations``, ``next_observations``, ``actions``, ``terminals``
folder, ``*_observations.npy``     the same with ``*_nextobservations``, ``*_actions``, ``*_terminals``
``.h5``, ``.hdf5``                 data sets in the layout of D4RL, or any others by a column map
``.csv``, ``.txt``, ``.parquet``   and the like, by a column map
``.jsonl``                         an object a line, by a column map
``.mat``                           MATLAB variables (all versions), by a column map
``.feather``, ``.arrow``           as Parquet
``.bag``, ``.mcap``, ``.db3``      ROS bags, as a ROS 2 bag's folder: fields of messages by a column map
LeRobot's folder                   states and actions, or what a column map picks
``mujoco.sysid``'s ``.npz``        time series, by a column map
``minari:ID``, a Minari folder     a local Minari dataset
=================================  ===============================================================

A new one is a function that opens such a file as tables, and an entry of :data:`FORMATS`.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from dropo_torch.data.bags import is_bag, open_bag
from dropo_torch.data.lerobot import is_lerobot, open_lerobot
from dropo_torch.data.sysid import is_sysid, sysid_table
from dropo_torch.data.tables import Table, frame_table
from dropo_torch.data.text import TEXT, open_text
from dropo_torch.errors import InputError, choices
from dropo_torch.support.child import read_in_child
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_size, reading

if TYPE_CHECKING:
    pass


_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def open_npz(path: Path, _: str | None) -> list[Table]:
    """An archive of plain arrays."""
    with reading(path, ".npz of plain arrays"), _npz(path) as archive:
        names = tuple(archive.files)

    def read(name: str) -> np.ndarray:
        with reading(f"{path}: {name}", "a plain array"), _npz(path) as archive:
            member = name if name in archive.zip.namelist() else f"{name}.npy"
            with archive.zip.open(member) as stream:
                _check_npy(stream, f"{path}: {name}")
            return np.asarray(archive[name])

    return [sysid_table(str(path), names, read) if is_sysid(names) else Table(str(path), names, read)]


def open_npy(path: Path, _: str | None) -> list[Table]:
    """``PREFIX_observations.npy``, or the folder with the only one, and the files beside it of the same prefix."""
    first = _only_log(path) if path.is_dir() else path
    folder, prefix = first.parent, first.name.removesuffix("observations.npy")
    names = ("observations", "next_observations", "actions", "terminals")
    files = {name: folder / f"{prefix}{name.replace('_', '')}.npy" for name in names}
    for name in ("next_observations", "actions"):
        if not files[name].exists():
            raise InputError(f"{folder}: there is no {files[name].name} beside {first.name}")

    def read(name: str) -> np.ndarray:
        with reading(files[name], "a plain .npy array"), files[name].open("rb") as stream:
            _check_npy(stream, files[name])
            stream.seek(0)
            return np.asarray(np.load(stream, allow_pickle=False))

    return [Table(str(folder), tuple(name for name, file in files.items() if file.exists()), read)]


def open_json_lines(path: Path, _: str | None) -> list[Table]:
    """An object in each line, one a sample; what is nested is called ``elbow.position``."""
    with extra("formats", str(path)):
        import pandas as pd
    with reading(path, "an object of JSON in each line"), path.open(encoding="utf-8-sig") as file:
        rows = [json.loads(line) for line in file if line.strip()]
        frame = pd.json_normalize(rows)
    return [frame_table(str(path), frame)]


def open_parquet(path: Path, _: str | None) -> list[Table]:
    """A data frame with its index."""
    with extra("formats", str(path)):
        import pandas as pd
        from pyarrow import parquet
    with reading(path, "Parquet"):
        with parquet.ParquetFile(path) as file:
            check_size(file.metadata.num_rows * file.metadata.num_columns, 8, path)
        frame = pd.read_parquet(path, engine="pyarrow")
    return [frame_table(str(path), frame)]


def open_feather(path: Path, _: str | None) -> list[Table]:
    """A data frame with its index, in Arrow's file format."""
    with extra("formats", str(path)):
        import pandas as pd
        from pyarrow import dataset
    with reading(path, "Feather"):
        file = dataset.dataset(path, format="feather")
        check_size(file.count_rows() * len(file.schema), 8, path)
        frame = pd.read_feather(path)
    return [frame_table(str(path), frame)]


def open_hdf5(path: Path, group: str | None) -> list[Table]:
    """The data sets of a file, by their paths; with a pattern, those of each group that it matches."""
    with extra("formats", str(path)):
        import h5py
    groups: list[str] = []
    datasets: list[str] = []

    def visit(name: str | bytes, item: object) -> None:
        if isinstance(name, str):  # a name that is no UTF-8 comes as bytes
            (datasets if isinstance(item, h5py.Dataset) else groups).append(name)

    def read(name: str, below: str = "") -> np.ndarray:
        with reading(f"{path}: {below}{name}", "an HDF5 data set"), h5py.File(path, "r") as file:
            check_size(file[below + name].size or 0, file[below + name].dtype.itemsize, f"{path}: {below}{name}")
            return np.asarray(file[below + name][()])

    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        file.visititems(visit)
    if group is None:
        return [Table(str(path), tuple(datasets), read)]
    pattern = f"/{group.strip('/')}"
    matched = sorted((g for g in groups if PurePosixPath(f"/{g}").match(pattern)), key=_natural)
    if not matched:
        raise InputError(f"{path}: group: no group matches {group!r}{choices(group, groups)}")
    below = {g: tuple(n.removeprefix(f"{g}/") for n in datasets if n.startswith(f"{g}/")) for g in matched}
    return [Table(f"{path}: {g}", names, partial(read, below=f"{g}/")) for g, names in below.items()]


def open_mat(path: Path, _: str | None) -> list[Table]:
    """MATLAB variables; the fields of a struct ``log`` are called ``log.q``, vectors are ``(N,)``."""
    with path.open("rb") as file:
        if _HDF5_SIGNATURE in file.read(1024):
            return [_mat73(open_hdf5(path, None)[0])]
    # a damaged file crashes scipy's reader
    content = read_in_child(f"{__name__}:mat_arrays", path, where=path, kind="a MATLAB file")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        names = json.loads(str(archive["names"]))
        arrays = {name: archive[f"{number}"] for number, name in enumerate(names)}
    return [Table(str(path), tuple(names), arrays.__getitem__)]


def mat_arrays(path: str) -> bytes:
    """Return the variables of a MATLAB file as an archive: ``names``, and each array by its number.

    What holds neither numbers nor text is left as an array without a number type, which no column map takes.
    """
    import scipy.io

    arrays = flatten(scipy.io.loadmat(path, simplify_cells=True), ".")
    arrays = {name: array for name, array in arrays.items() if not name.startswith("__")}
    plain: dict[str, Any] = {"names": np.array(json.dumps(list(arrays)))}
    plain |= {str(i): a if a.dtype.kind in "biufcUS" else np.empty(0, "V1") for i, a in enumerate(arrays.values())}
    np.savez(buffer := io.BytesIO(), **plain)
    return buffer.getvalue()


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: what it is called in messages.
        suffixes: how its files end.
        open: gives the tables in a file; the second argument is the value of ``option``, or ``None``.
        option: of :func:`~dropo_torch.data.readers.read_trajectories`, which no other format has.
    """

    name: str
    suffixes: tuple[str, ...]
    open: Callable[[Path, Any], list[Table]]
    option: str | None = None


NPY = Format("NumPy", ("_observations.npy",), open_npy)
ROS = Format("ROS bag", (".bag", ".mcap", ".db3"), open_bag, option="stamps")
FORMATS = (
    Format("NumPy archive", (".npz",), open_npz),
    NPY,
    Format("text", TEXT, open_text, option="separator"),
    Format("JSON lines", (".jsonl", ".ndjson"), open_json_lines),
    Format("Parquet", (".parquet", ".pq"), open_parquet),
    Format("Feather", (".feather", ".arrow"), open_feather),
    Format("HDF5", (".h5", ".hdf5"), open_hdf5, option="group"),
    Format("MATLAB", (".mat",), open_mat),
    ROS,
)
#: Folders, by what tells them.
FOLDERS = ((is_bag, ROS), (is_lerobot, Format("LeRobot", (), open_lerobot)), (Path.is_dir, NPY))


def open_tables(
    path: Path, *, group: str | None = None, separator: str | None = None, stamps: Mapping[str, str] | None = None
) -> list[Table]:
    """Return the logs in a file or folder: one, or one for each HDF5 group that ``group`` matches.

    Args:
        path: a file of one of the :data:`FORMATS`, or one of the :data:`FOLDERS`.
        group: pattern of the HDF5 groups that hold an episode each, such as ``data/demo_*``.
        separator: what separates the columns of a text file; a comma by default, a tab in ``.tsv``.
        stamps: of a bag: topics that do not take the time of their headers, and whence they take it.

    Raises:
        InputError: a file that is missing, unreadable or of an unknown kind.
    """
    if not path.exists():
        raise InputError(missing_file(path))
    if path.is_dir():
        kind = next(folder for tells, folder in FOLDERS if tells(path))
    else:
        known = ", ".join(suffix for f in FORMATS for suffix in f.suffixes)
        found = next((f for f in FORMATS if path.name.lower().endswith(f.suffixes)), None)
        if found is None:
            raise InputError(
                f"{path}: unknown kind of log; expected {known}, a folder of .npy files, a ROS 2 bag, a LeRobot or a "
                "Minari dataset"
            )
        kind = found
    given = {"group": group, "separator": separator, "stamps": stamps}
    for option, value in given.items():
        if value is not None and option != kind.option:
            owner = next(f for f in FORMATS if f.option == option)
            raise InputError(
                f"{path}: {option} is an option of {owner.name} files ({', '.join(owner.suffixes)}); leave it out here"
            )
    return kind.open(path, given[kind.option] if kind.option else None)


def missing_file(path: Path) -> str:
    """Return the message for a path that does not exist, with the nearest name beside it."""
    if path.parent.is_dir():
        return f"{path}: no such file or folder{choices(path.name, sorted(p.name for p in path.parent.iterdir()))}"
    return f"{path}: no such file or folder (nor is there a folder {path.parent})"


def flatten(nested: object, joint: str, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the leaves of nested mappings, lists and tuples, their keys joined by ``joint``."""
    if isinstance(nested, list | tuple):
        nested = dict(enumerate(nested))
    if not isinstance(nested, Mapping):
        return {prefix: np.asarray(nested)}
    leaves: dict[str, np.ndarray] = {}
    for key, value in nested.items():
        leaves |= flatten(value, joint, f"{prefix}{joint}{key}" if prefix else str(key))
    return leaves


def _check_npy(stream: IO[bytes], where: object) -> None:
    """Refuse an array in NumPy's own format that declares more than there may be."""
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(stream)
    check_size(math.prod(shape), dtype.itemsize, where)


@contextmanager
def _npz(path: Path) -> Iterator[Any]:
    # the file is opened here because numpy leaves it open where it is corrupt
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        yield archive


def _mat73(table: Table) -> Table:
    """What MATLAB stores as HDF5: by columns, the fields of structs as groups."""
    names = {name.replace("/", "."): name for name in table.names if not name.startswith("#")}

    def read(name: str) -> np.ndarray:
        array = table.read(names[name]).T
        return array.reshape(-1) if array.ndim == 2 and 1 in array.shape else array

    return Table(table.source, tuple(names), read)


def _only_log(folder: Path) -> Path:
    found = sorted(folder.glob("*_observations.npy"))
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(f"{folder}: {len(found)} logs are in this folder; name one, such as {found[0]}")
    raise InputError(
        f"{folder}: no *_observations.npy in this folder and it is no Minari dataset"
        f"{choices('observations.npy', sorted(p.name for p in folder.iterdir()))}"
    )


def _natural(name: str) -> list[str | int]:
    """Sort key by which ``demo_10`` comes after ``demo_9``."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
