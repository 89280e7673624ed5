"""From the tables of a robot's log to :class:`~dropo_torch.data.trajectory.Trajectories`: columns, episodes, time.

File formats, and how to add one, are in :mod:`dropo_torch.data.formats`. The column map is described in
:mod:`dropo_torch.data.tables`. Where a log has no next observations, they are the observations of the next row of the
same episode.
"""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.corrections import Corrections, break_rows, corrected
from dropo_torch.data.formats import missing_file, open_tables
from dropo_torch.data.minari import PREFIX, read_minari
from dropo_torch.data.preprocess import Preprocess, preprocess
from dropo_torch.data.recording import TOLERANCE, Recording
from dropo_torch.data.tables import ColumnMap, Table, missing, parse_columns
from dropo_torch.data.trajectory import Trajectories, check_values, concatenate
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_keys, number, reading, user_path

Source = str | Path | Mapping[str, Any] | Sequence["Source"]


@dataclass(frozen=True)
class ReadOptions:
    """How a log is read; :func:`read_trajectories` explains each, and takes them in this order."""

    observations: ColumnMap | None = None
    next_observations: ColumnMap | None = None
    actions: ColumnMap | None = None
    time: ColumnMap | None = None
    episode: str | None = None
    terminals: ColumnMap | None = None
    dt: float | None = None
    tolerance: float = TOLERANCE
    group: str | None = None
    separator: str | None = None
    preprocess: Preprocess | Mapping[str, Any] | None = None
    scale: Mapping[str, float] | None = None
    unwrap: Sequence[str] | None = None
    shift: int = 0
    breaks: Sequence[int] | None = None

    @property
    def corrections(self) -> Corrections:
        """What is corrected in the values."""
        return Corrections.of(self.scale, self.unwrap, self.shift)

    def __post_init__(self) -> None:
        Corrections.of(self.scale, self.unwrap, self.shift)
        for name in ("dt", "tolerance"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, number(value, f"data: {name}", above=0))
        for name in ("episode", "group", "separator"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                raise InputError(f"data: {name} is {value!r}; expected text")
        if isinstance(self.preprocess, Mapping):
            object.__setattr__(self, "preprocess", Preprocess.from_mapping(self.preprocess))
        elif self.preprocess is not None and not isinstance(self.preprocess, Preprocess):
            raise InputError(f"data: preprocess is {self.preprocess!r}; expected options such as dt and cutoff")


def read_trajectories(
    source: Source,
    *,
    observations: ColumnMap | None = None,
    next_observations: ColumnMap | None = None,
    actions: ColumnMap | None = None,
    time: ColumnMap | None = None,
    episode: str | None = None,
    terminals: ColumnMap | None = None,
    dt: float | None = None,
    tolerance: float = TOLERANCE,
    group: str | None = None,
    separator: str | None = None,
    preprocess: Preprocess | Mapping[str, Any] | None = None,
    scale: Mapping[str, float] | None = None,
    unwrap: Sequence[str] | None = None,
    shift: int = 0,
    breaks: Sequence[int] | None = None,
    base: str | Path | None = None,
) -> Trajectories:
    """Read one or more logs.

    Args:
        source: a path, a pattern such as ``logs/*.csv``, ``minari:ID``, a mapping with ``path`` and any
            of the options below (which then count for it), or a list of those, joined in its order.
        observations: the columns observed; by default the array ``observations``.
        next_observations: the columns observed after the transition. By default the array
            ``next_observations`` where there is one and ``observations`` is not given; otherwise the next
            row of the same episode.
        actions: the columns commanded, by default the array ``actions``; ``[]`` for a passive system.
        time: the column of time stamps in seconds, as dates, or in any unit with ``{signal: stamp_ns, scale: 1e-9}``.
        episode: a column whose value differs from one episode to the next.
        terminals: columns of flags that are true at an episode's last row, any of them; by default the
            arrays ``terminals`` and ``timeouts``, one of which must be there unless ``observations`` is given;
            ``[]`` for a log that is one episode.
        dt: seconds between rows, for a log without time stamps.
        tolerance: fraction by which the spacing of time stamps may differ from its median.
        group: pattern of HDF5 groups with an episode each, such as ``data/demo_*``.
        separator: what separates the columns of a text file.
        preprocess: how to synchronise, filter and resample; see :class:`~dropo_torch.data.preprocess.Preprocess`.
        scale: signal → factor by which its values are multiplied: 0.0174532925 for degrees, -1 for a sign.
        unwrap: angles in rad that wrap at ±π or at 2π, which become continuous in each episode.
        shift: rows by which the commands stand too late; each row takes the command of so many rows further on.
        breaks: rows, counted from 0, at which an episode begins, for a log that does not say.
        base: folder from which relative paths start, by default the current one.

    Raises:
        InputError: a file, name or value that cannot be used; its one line says which.
    """
    options = ReadOptions(
        observations, next_observations, actions, time, episode, terminals, dt, tolerance, group, separator, preprocess,
        scale, unwrap, shift, breaks,
    )  # fmt: skip
    return concatenate(_read(source, options, Path(base or ".")))


def read_recording(
    path: str | Path,
    *,
    observations: ColumnMap | None = None,
    actions: ColumnMap | None = None,
    time: ColumnMap | None = None,
    episode: str | None = None,
    terminals: ColumnMap | None = None,
    dt: float | None = None,
    separator: str | None = None,
) -> Recording:
    """Read one log as samples in time; the arguments are those of :func:`read_trajectories`.

    Raises:
        InputError: a file, name or value that cannot be used; its one line says which.
    """
    options = ReadOptions(observations, None, actions, time, episode, terminals, dt)
    return _recording(open_tables(Path(path), separator=separator)[0], options)


def _read(source: Source, options: ReadOptions, base: Path) -> list[Trajectories]:
    if isinstance(source, Mapping):
        if "path" not in source:
            raise InputError(f"data: there is no key 'path'{choices('path', source)}")
        rest = {key: value for key, value in source.items() if key != "path"}
        check_keys(rest, [field.name for field in fields(ReadOptions)], "data")
        return _read(source["path"], replace(options, **rest), base)
    if isinstance(source, str) and source.startswith(PREFIX):
        return [_read_minari(source.removeprefix(PREFIX), options)]
    if isinstance(source, str | Path):
        return [log for path in _paths(source, base) for log in _read_path(path, options)]
    if isinstance(source, Sequence) and source:
        return [log for entry in source for log in _read(entry, options, base)]
    raise InputError(f"data: {source!r} given; expected a path, a list of paths, or a mapping with 'path'")


def _paths(source: str | Path, base: Path) -> list[Path]:
    """The path meant, or those that a pattern matches."""
    path = user_path(base, source)
    if path.exists() or not glob.has_magic(str(source)):
        return [path]
    found = sorted(Path(match) for match in glob.glob(str(path), recursive=True))
    if not found:
        raise InputError(f"{path}: no file matches this pattern")
    return found


def _read_path(path: Path, options: ReadOptions) -> list[Trajectories]:
    for folder in (path, path / "data"):
        if (folder / "metadata.json").exists():
            return [_read_minari(folder, options)]
    if not path.exists() and not path.suffix and "-v" in path.name:
        raise InputError(f"{missing_file(path)}; a local Minari dataset is written minari:{path.name}")
    tables = open_tables(path, group=options.group, separator=options.separator)
    return [_read_table(table, options) for table in tables]


def _read_table(table: Table, options: ReadOptions) -> Trajectories:
    if isinstance(options.preprocess, Preprocess):
        if options.next_observations is not None:
            raise InputError(
                f"{table.source}: preprocess works on samples in time; leave next_observations out, they are resampled"
            )
        samples, _ = corrected(_recording(table, options), None, options.corrections)
        return preprocess(samples, options.preprocess)
    following = options.next_observations
    if following is None and options.observations is None and "next_observations" in table.names:
        following = "next_observations"
    rows = _recording(table, options)
    if following is None:
        return corrected(rows, None, options.corrections)[0].trajectories(tolerance=options.tolerance)
    found, next_names = table.matrix(following, "next_observations", len(rows))
    rows, next_observations = corrected(rows, found, options.corrections)
    assert next_observations is not None
    check_values(rows.observations, rows.observation_names, f"{rows.source}: observations")
    check_values(next_observations, next_names, f"{rows.source}: next_observations")
    check_values(rows.actions, rows.action_names, f"{rows.source}: actions")
    return Trajectories(
        observations=rows.observations,
        next_observations=next_observations,
        actions=rows.actions,
        terminals=np.append(np.diff(rows.episodes) != 0, True),
        dt=rows.interval(options.tolerance) or options.dt,
        source=rows.source,
        origin=rows.origin(np.arange(len(rows))),
    )


def _recording(table: Table, options: ReadOptions) -> Recording:
    observations, names = table.matrix(_wanted(table, options.observations, "observations"), "observations")
    if not names:
        raise InputError(f"{table.source}: observations: the list is empty; name at least one column")
    if len(observations) == 0:
        raise InputError(f"{table.source}: the log has no row; at least two samples are needed")
    infers = isinstance(options.preprocess, Preprocess) and options.preprocess.infers_actions
    wanted = [] if infers and options.actions is None else _wanted(table, options.actions, "actions")
    actions, action_names = table.matrix(wanted, "actions", len(observations))
    episodes = _episodes(table, options, len(observations))
    return Recording(
        observations, actions, _time(table, options, episodes), episodes, names, action_names, source=table.source
    )


def _wanted(table: Table, columns: ColumnMap | None, default: str) -> ColumnMap:
    if columns is not None:
        return columns
    if default in table.names:
        return default
    empty = " ([] for a system without)" if default == "actions" else ""
    raise InputError(
        f"{table.source}: there is no {default!r}; say which columns are the {default} with "
        f"{default}: [NAME, ...]{empty}{choices(default, table.names)}"
    )


def _episodes(table: Table, options: ReadOptions, rows: int) -> np.ndarray:
    """The episode of each row, counted from 0, by flags and by the episode column, ``(rows,)``."""
    start = np.zeros(rows, dtype=bool)
    flags = options.terminals
    if flags is None:
        flags = [name for name in ("terminals", "timeouts") if name in table.names]
        if not flags and options.observations is None and options.episode is None and options.group is None:
            raise InputError(
                f"{table.source}: there is no 'terminals'; say where episodes end with terminals: NAME "
                f"(or terminals: [] if all of it is one episode){choices('terminals', table.names)}"
            )
    values, names = table.matrix(flags, "terminals", rows)
    bad = np.argwhere(~np.isin(values, (0, 1)))
    if bad.size:
        row, column = bad[0]
        raise InputError(
            f"{table.source}: terminals: {names[column]} is {values[row, column]:g} at row {row} (counted from 0); "
            "expected true/false or 0/1"
        )
    start[1:] |= values[:-1].any(axis=1)
    if options.episode is not None:
        label = table.array(options.episode, "episode").reshape(-1)
        table.check_rows(options.episode, len(label), rows)
        empty = np.flatnonzero(missing(label))
        if empty.size:
            raise InputError(f"{table.source}: {options.episode} has no value at row {empty[0]} (counted from 0)")
        start[1:] |= label[1:] != label[:-1]
    start[break_rows(options.breaks, rows, table.source)] = True
    return np.cumsum(start)


def _time(table: Table, options: ReadOptions, episodes: np.ndarray) -> np.ndarray | None:
    """Time stamps in seconds since the log's first, ``(rows,)``."""
    if options.time is None:
        if options.dt is None:
            return None
        first = np.searchsorted(episodes, episodes)
        return (np.arange(len(episodes)) - first) * options.dt
    if options.dt is not None:
        raise InputError(f"{table.source}: both time and dt are given; dt is for a log without time stamps")
    signals = parse_columns(options.time, f"{table.source}: time")
    if len(signals) == 1 and signals[0].signal in table.names:
        stamps = table.array(signals[0].signal, "time")
        if _are_dates(stamps):
            import pandas as pd

            with reading(f"{table.source}: {signals[0].signal}", "dates such as 2024-05-01T12:00:00.125"):
                dates = pd.to_datetime(pd.Series(stamps), format="ISO8601", utc=True)
            return np.asarray((dates - dates.iloc[0]) / pd.Timedelta(seconds=1), dtype=np.float64)
    values, names = table.matrix(options.time, "time", len(episodes))
    if len(names) != 1:
        raise InputError(f"{table.source}: time has {len(names)} columns; expected one")
    return values[:, 0]


def _are_dates(stamps: np.ndarray) -> bool:
    """Whether a column holds dates, or text that does not start with a number."""
    if stamps.ndim != 1 or stamps.dtype.kind in "biuf":
        return False
    with extra("formats", "a column that holds no plain numbers"):
        import pandas as pd
    if pd.api.types.infer_dtype(stamps) not in ("string", "datetime", "datetime64", "date"):
        return False
    return stamps.dtype.kind == "M" or bool(np.isnan(pd.to_numeric(stamps[:1], errors="coerce"))[0])


def _read_minari(dataset: str | Path, options: ReadOptions) -> Trajectories:
    for name in (
        "next_observations",
        "time",
        "episode",
        "terminals",
        "group",
        "separator",
        "preprocess",
        "scale",
        "unwrap",
        "shift",
        "breaks",
    ):
        if getattr(options, name):
            source = f"{PREFIX}{dataset}" if isinstance(dataset, str) else dataset
            raise InputError(
                f"{source}: {name} has no meaning for a Minari dataset, which holds transitions; leave it out"
            )
    return read_minari(dataset, observations=options.observations, actions=options.actions, dt=options.dt)
