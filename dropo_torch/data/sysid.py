"""Time series of ``mujoco.sysid``: a ``TimeSeries``, or a ``SystemTrajectory`` of controls, sensors and states.

Both are read from the ``.npz`` that their ``save_to_disk`` writes, or taken from memory. A signal is called as in the
series' own mapping (``elbow_pos``, ``elbow_servo_ctrl``), all of a series ``data``, or ``control``, ``sensordata`` and
``state``; signals of a state are called ``state.elbow_qpos``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from dropo_torch.data.streams import Matrix, Stream, aligned, check_finite
from dropo_torch.data.tables import Choice, Table, numbers, pick, split_index
from dropo_torch.errors import InputError, choices
from dropo_torch.support.given import reading

_PARTS = ("control", "sensordata", "state")


def is_sysid(names: Iterable[str]) -> bool:
    """Return whether arrays of these names are a time series, or a trajectory of several."""
    return set(names) in (
        {"times", "data"},
        {"times", "data", "signal_mapping"},
    ) or {"control_times", "control_data", "sensordata_times", "sensordata_data"} <= set(names)


def in_memory(source: Any) -> dict[str, np.ndarray] | None:
    """Return a ``TimeSeries`` or ``SystemTrajectory`` as its file holds it; ``None`` for anything else."""
    if all(hasattr(source, name) for name in ("times", "data", "signal_mapping")):
        return _series(source, "")
    if all(hasattr(source, name) for name in _PARTS):
        given = [(getattr(source, name), f"{name}_") for name in _PARTS]
        return {name: array for part, stem in given if part is not None for name, array in _series(part, stem).items()}
    return None


def sysid_table(source: str, names: Iterable[str], read: Callable[[str], np.ndarray]) -> Table:
    """Return the signals of a time series, or of a trajectory's.

    Args:
        source: the file, for messages.
        names: the arrays of the file.
        read: gives one.

    Raises:
        InputError: arrays that do not fit together.
    """
    names = set(names)
    found = [""] if "times" in names else [part for part in _PARTS if f"{part}_data" in names]
    matrices: dict[str, Matrix] = {}
    for part in found:
        stem = f"{part}_" if part else ""
        mapping = str(read(f"{stem}signal_mapping")) if f"{stem}signal_mapping" in names else "{}"
        times, data = (numbers(read(f"{stem}{name}"), f"{source}: {stem}{name}") for name in ("times", "data"))
        matrices |= _signals(f"{source}: {stem}data", part or "data", times, data, mapping)
    defaults = {"actions": "control"} if "control" in matrices else {}
    return Table(source, tuple(matrices), _unread, defaults=defaults, choose=partial(_choose, source, matrices))


def _choose(source: str, matrices: Mapping[str, Matrix], choice: Choice) -> Table:
    """Return the signals that entries name, with a row for every time stamp."""
    kept: dict[str, Matrix] = {}
    for entry in choice.entries:
        name, index = (entry, None) if entry in matrices else split_index(entry)
        if name not in matrices:
            raise InputError(f"{source}: there is no signal {name!r}{choices(name, matrices)}")
        labels = list(matrices[name].columns)
        if isinstance(index, tuple):
            labels = [labels[c] for wanted in index for c in pick(wanted, labels, f"{source}: {name}")]
        for label in labels:
            check_finite(
                f"{source}: {name}[{label}]", matrices[name].columns[label], 1.0, missing_allowed=choice.missing_allowed
            )
        kept[name] = matrices[name]
    return aligned(source, kept, joints=choice.joints)


def _signals(where: str, name: str, times: np.ndarray, data: np.ndarray, mapping: str) -> dict[str, Matrix]:
    """The signals of a series, and all of it under one name."""
    if times.ndim != 1 or data.ndim != 2 or len(times) != len(data) or not (np.diff(times) > 0).all():
        raise InputError(
            f"{where} has shape {data.shape} and its times {times.shape}; expected (N, columns) and N rising times"
        )
    with reading(where, "a mujoco.sysid time series"):
        indices = {str(signal): [int(i) for i in columns] for signal, (_, columns) in json.loads(mapping).items()}
    offset = int(name == "state")  # whose first column is the time, which the mapping does not count
    labels = [str(i) for i in range(data.shape[1])]
    for signal, columns in indices.items():
        for number, column in enumerate(columns):
            if not 0 <= column + offset < len(labels):
                raise InputError(f"{where}: {signal} is column {column}, but there are {len(labels)}")
            labels[column + offset] = signal if len(columns) == 1 else f"{signal}.{number}"
    streams = {label: Stream(times, data[:, i]) for i, label in enumerate(labels)}
    below = "state." if name == "state" else ""
    of = {
        f"{below}{signal}": Matrix({labels[c + offset]: streams[labels[c + offset]] for c in columns})
        for signal, columns in indices.items()
    }
    return {name: Matrix(streams), **of}


def _series(series: Any, stem: str) -> dict[str, np.ndarray]:
    mapping = {name: (kind.value, np.asarray(i).tolist()) for name, (kind, i) in (series.signal_mapping or {}).items()}
    arrays = {f"{stem}times": np.asarray(series.times), f"{stem}data": np.asarray(series.data)}
    return arrays | ({f"{stem}signal_mapping": np.asarray(json.dumps(mapping))} if mapping else {})


def _unread(name: str) -> np.ndarray:
    raise AssertionError(f"{name} is read by choice")
