"""LeRobot datasets: a folder with ``meta/info.json`` and Parquet files of frames, in which episodes follow each other.

Taken as they are: ``observation.state`` at a frame, and the ``action`` that was commanded then and held until the next.
Images and videos are left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.tables import Table, numbers
from dropo_torch.errors import InputError
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_size, read_text, reading

_DEFAULTS = {
    "observations": "observation.state",
    "actions": "action",
    "time": "timestamp",
    "episode": "episode_index",
}
_NO_NUMBERS = ("image", "video", "string", "language")


def is_lerobot(folder: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (folder / "meta" / "info.json").is_file()


def open_lerobot(folder: Path, _: str | None) -> list[Table]:
    """The features of a dataset, a row a frame.

    Raises:
        InputError: a dataset that is not complete, or is not as its ``info.json`` says.
    """
    with extra("formats", str(folder)):
        import pyarrow.parquet  # noqa: F401
    where = folder / "meta" / "info.json"
    with reading(where, "a LeRobot dataset's description"):
        info = json.loads(read_text(where, "data"))
        features = {str(name): dict(feature) for name, feature in info["features"].items()}
    files = sorted((folder / "data").glob("chunk-*/*.parquet"))
    if not files:
        raise InputError(
            f"{folder}: there are no data/chunk-*/*.parquet beside meta/info.json; download the dataset's data folder"
        )
    data = _Data(folder, tuple(files))
    names = [name for name, feature in features.items() if feature.get("dtype") not in _NO_NUMBERS]
    _check_complete(folder, info, data)
    labels = {name: found for name in names if (found := _labels(features[name]))}
    return [
        Table(
            str(folder), tuple(names), data.column, labels=labels, keyed=frozenset(labels),
            defaults={what: name for what, name in _DEFAULTS.items() if name in names},
        )
    ]  # fmt: skip


@dataclass(frozen=True)
class _Data:
    """The frames of a dataset, in the order of their indices."""

    folder: Path
    files: tuple[Path, ...]

    def column(self, name: str) -> np.ndarray:
        """A feature of all frames: ``(N,)``, of lists where it is a vector."""
        values = self._unordered(name)
        index = numbers(self._unordered("index"), f"{self.folder}: index")
        return values if (np.diff(index) > 0).all() else values[np.argsort(index, kind="stable")]

    def _unordered(self, name: str) -> np.ndarray:
        from pyarrow import parquet

        parts = []
        for path in self.files:
            with reading(path, "Parquet"), parquet.ParquetFile(path) as file:
                if name not in file.schema_arrow.names:
                    raise InputError(f"{path}: there is no column {name!r}, which meta/info.json names")
                check_size(file.metadata.num_rows, 8, path)
                parts.append(file.read(columns=[name])[name].to_pandas().to_numpy())
        return np.concatenate(parts)


def _labels(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of a vector's entries: a list, or such a list as ``motors``; none where they are not as many."""
    names, shape = feature.get("names"), feature.get("shape")
    if isinstance(names, Mapping) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not isinstance(shape, list) or len(shape) != 1 or len(names) != shape[0]:
        return ()
    return tuple(map(str, names)) if len(set(map(str, names))) == len(names) else ()


def _check_complete(folder: Path, info: Mapping[str, Any], data: _Data) -> None:
    """Raise an :class:`InputError` where frames or episodes are missing."""
    episodes = data.column("episode_index")
    if len(episodes) == 0:
        raise InputError(f"{folder}: the dataset has no frames; at least two are needed")
    found = {"total_frames": len(episodes), "total_episodes": len(np.unique(episodes))}
    for key, count in found.items():
        if isinstance(said := info.get(key), int) and said != count:
            raise InputError(
                f"{folder}: meta/info.json says {key}: {said}, and the data files have {count}; download them anew"
            )
