"""From the tables of a robot's log to :class:`~dropo_torch.data.trajectory.Trajectories`: columns, episodes, time.

File formats, and how to add one, are in :mod:`dropo_torch.data.formats`. The column map is described in
:mod:`dropo_torch.data.tables`. Where a log has no next observations, they are the observations of the next row of the
same episode.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.angles import check_orientations, with_orientations
from dropo_torch.data.corrections import Corrections, break_rows, corrected
from dropo_torch.data.formats import missing_file, open_tables
from dropo_torch.data.memory import in_memory
from dropo_torch.data.minari import PREFIX, read_minari
from dropo_torch.data.preprocess import Preprocess, preprocess
from dropo_torch.data.recording import TOLERANCE, Recording
from dropo_torch.data.tables import Choice, ColumnMap, Table, missing, parse_columns
from dropo_torch.data.trajectory import Trajectories, check_values, concatenate
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_keys, number, reading, user_path

#: A path, options with one, what is in memory (a data frame, arrays, a time series), or several of these.
Source = str | Path | Mapping[str, Any] | Sequence["Source"] | Any
#: Times of day.
_CLOCK = re.compile(r"\d{1,2}:\d{2}:\d{2}(\.\d+)?")
#: Options that mean nothing for a log whose signals have time stamps of their own.
_OF_ROWS = ("next_observations", "time", "dt", "episode", "terminals", "shift", "breaks")


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
    pause: float | None = None
    joints: Sequence[str] | None = None
    stamps: Mapping[str, str] | None = None
    orientations: Mapping[str, Mapping[str, Any]] | None = None

    @property
    def corrections(self) -> Corrections:
        """What is corrected in the values."""
        return Corrections.of(self.scale, self.unwrap, self.shift)

    def __post_init__(self) -> None:
        Corrections.of(self.scale, self.unwrap, self.shift)
        for name in ("dt", "tolerance", "pause"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, number(value, f"data: {name}", above=0))
        for name in ("episode", "group", "separator"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                raise InputError(f"data: {name} is {value!r}; expected text")
        if isinstance(self.joints, str) or not isinstance(self.joints or [], Sequence):
            raise InputError(f"data: joints is {self.joints!r}; expected a list of names")
        if self.orientations is not None:
            check_orientations(self.orientations)
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
    pause: float | None = None,
    joints: Sequence[str] | None = None,
    stamps: Mapping[str, str] | None = None,
    orientations: Mapping[str, Mapping[str, Any]] | None = None,
    base: str | Path | None = None,
) -> Trajectories:
    """Read one or more logs.

    Args:
        source: a path, a pattern such as ``logs/*.csv``, ``minari:ID``, a pandas ``DataFrame``, a dictionary of
            arrays, a time series or trajectory of ``mujoco.sysid``, a mapping with ``path`` (any of these) and any
            of the options below (which then count for it), or a list of those, joined in its order.
        observations: the columns observed; by default the array ``observations``.
        next_observations: the columns observed after the transition. By default the array
            ``next_observations`` where there is one and ``observations`` is not given; otherwise the next
            row of the same episode.
        actions: the columns commanded, by default the array ``actions``; ``[]`` for a passive system.
        time: the column of time stamps in seconds, as dates, or in any unit with ``{signal: stamp_ns, scale: 1e-9}``;
            two columns are added, such as a header's seconds and nanoseconds.
        episode: a column whose value differs from one episode to the next.
        terminals: columns of flags that are true at an episode's last row, any of them; by default the
            arrays ``terminals`` and ``timeouts``, one of which must be there unless ``observations`` is given;
            ``[]`` for a log that is one episode.
        dt: seconds between rows, for a log without time stamps.
        tolerance: fraction by which the spacing of time stamps may differ from its median.
        group: pattern of HDF5 groups with an episode each, such as ``data/demo_*``.
        separator: what separates the columns of a text file.
        preprocess: how to synchronize, filter and resample; see :class:`~dropo_torch.data.preprocess.Preprocess`.
        scale: signal → factor by which its values are multiplied: 0.0174532925 for degrees, -1 for a sign.
        unwrap: angles in rad that wrap at ±π or at 2π, which become continuous in each episode.
        shift: rows by which the commands stand too late; each row takes the command of so many rows further on.
        breaks: rows, counted from 0, at which an episode begins, for a log that does not say.
        pause: seconds without a measurement after which an episode begins.
        joints: of signals whose columns are joints, those that are meant, in the model's order.
        stamps: of a bag: topic → ``received`` or a clock's topic, whence it takes its time instead of from headers.
        orientations: name → ``{angles: [roll, pitch, yaw], sequence: xyz}``: three columns in rad that are read as a
            quaternion of that name, with columns w, x, y, z. ``sequence`` is that of SciPy's ``Rotation.from_euler``;
            ``xyz``, the default, turns about the fixed axes x, y and z in this order.
        base: folder from which relative paths start, by default the current one.

    Raises:
        InputError: a file, name or value that cannot be used; its one line says which.
    """
    options = ReadOptions(
        observations, next_observations, actions, time, episode, terminals, dt, tolerance, group, separator, preprocess,
        scale, unwrap, shift, breaks, pause, joints, stamps, orientations,
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
    joints: Sequence[str] | None = None,
    stamps: Mapping[str, str] | None = None,
    orientations: Mapping[str, Mapping[str, Any]] | None = None,
) -> Recording:
    """Read one log as samples in time; the arguments are those of :func:`read_trajectories`.

    Raises:
        InputError: a file, name or value that cannot be used; its one line says which.
    """
    options = ReadOptions(
        observations, None, actions, time, episode, terminals, dt, joints=joints, orientations=orientations
    )  # fmt: skip
    table = open_tables(Path(path), separator=separator, stamps=stamps)[0]
    return _recording(with_orientations(table, orientations), options)


def _read(source: Source, options: ReadOptions, base: Path) -> list[Trajectories]:
    table = in_memory(source)
    if table is not None:
        for name in ("group", "separator", "stamps"):
            if getattr(options, name) is not None:
                raise InputError(f"{table.source}: {name} is an option of files; leave it out here")
        return [_read_table(table, options)]
    if isinstance(source, Mapping):
        if "path" not in source:
            raise InputError(f"data: there is no key 'path'{choices('path', source)}")
        rest = {key: value for key, value in source.items() if key != "path"}
        check_keys(rest, [field.name for field in fields(ReadOptions)], "data")
        return _read(source["path"], replace(options, **rest), base)
    if isinstance(source, str) and source.startswith(PREFIX):
        return [_read_minari(source.removeprefix(PREFIX), options)]
    if isinstance(source, str | Path):
        return [log for path in matching_paths(source, base) for log in _read_path(path, options)]
    if isinstance(source, Sequence) and source:
        return [log for entry in source for log in _read(entry, options, base)]
    raise InputError(f"data: {source!r} given; expected a path, a list of paths, or a mapping with 'path'")


def matching_paths(source: str | Path, base: Path) -> list[Path]:
    """Return the path meant, or those that a pattern matches.

    Raises:
        InputError: a pattern that no file matches.
    """
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
    tables = open_tables(path, group=options.group, separator=options.separator, stamps=options.stamps)
    return [_read_table(table, options) for table in tables]


def _read_table(table: Table, options: ReadOptions) -> Trajectories:
    table = with_orientations(table, options.orientations, lenient=_bridges(options))
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
    if rows.sparse:
        raise InputError(
            f"{rows.source}: {rows.names[0]} and other signals have stamps of their own; preprocess: {{dt: SECONDS}} "
            "puts them on one grid"
        )
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
    wanted = _wanted(table, options.observations, "observations")
    infers = isinstance(options.preprocess, Preprocess) and options.preprocess.infers_actions
    commands = [] if infers and options.actions is None else _wanted(table, options.actions, "actions")
    table = _chosen(table, wanted, commands, options)
    bridged = replace(table, lenient=_bridges(options))
    observations, names = bridged.matrix(wanted, "observations")
    if not names:
        raise InputError(f"{table.source}: observations: the list is empty; name at least one column")
    if len(observations) == 0:
        raise InputError(f"{table.source}: the log has no row; at least two samples are needed")
    actions, action_names = bridged.matrix(commands, "actions", len(observations))
    episodes = _episodes(table, options, len(observations))
    time = _time(table, options, episodes)
    if options.pause is not None:
        episodes = _paused(episodes, time, ~np.isnan(observations).all(axis=1), options.pause, table.source)
    kept = np.arange(len(episodes))
    if time is not None and options.next_observations is None and not table.sparse:
        kept = _told_once(observations, actions, time, episodes)
    return Recording(
        observations[kept], actions[kept], None if time is None else time[kept], episodes[kept], names, action_names,
        source=table.source, sparse=table.sparse, quaternions=tuple(table.orientations(wanted, "observations")),
        cut=options.pause is not None or bool(options.breaks), rows=kept,
    )  # fmt: skip


def _told_once(observations: np.ndarray, actions: np.ndarray, time: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Numbers of the rows ``(k,)`` that are not all of the row before them again, stamp and episode, too."""
    every = np.column_stack([observations, actions, time, episodes])
    again = ((every[1:] == every[:-1]) | (np.isnan(every[1:]) & np.isnan(every[:-1]))).all(axis=1)
    return np.flatnonzero(np.append(True, ~again))


def _chosen(table: Table, observations: ColumnMap, actions: ColumnMap, options: ReadOptions) -> Table:
    """The table with what is read of it, where that must be known."""
    joints = tuple(str(name) for name in options.joints or ())
    if table.choose is None:
        if joints and not table.keyed:
            raise InputError(f"{table.source}: joints: no signal of this log has columns with names; leave it out")
        return replace(table, joints=joints)
    for name in _OF_ROWS:
        if getattr(options, name):
            raise InputError(
                f"{table.source}: {name} has no meaning here, as every signal has time stamps of its own; leave it out"
            )
    maps = {"observations": observations, "actions": actions}
    signals = [s for what, given in maps.items() for s in parse_columns(given, f"{table.source}: {what}")]
    for signal in signals:
        if signal.transpose or isinstance(signal.scale, str):
            raise InputError(f"{table.source}: {signal.signal}: scale is a number here, and there is no transpose")
    return table.choose(Choice(tuple(s.signal for s in signals), joints, _bridges(options)))


def _bridges(options: ReadOptions) -> bool:
    """Whether preprocessing bridges what was not measured."""
    return isinstance(options.preprocess, Preprocess) and options.preprocess.max_gap is not None


def _paused(
    episodes: np.ndarray, time: np.ndarray | None, measured: np.ndarray, pause: float, source: str
) -> np.ndarray:
    """The episode of each row, where one begins after a pause, too; ``measured`` says which rows have a measurement."""
    if time is None:
        raise InputError(f"{source}: pause needs time stamps; name their column with time")
    rows = np.flatnonzero(measured)
    begins = np.zeros(len(episodes), dtype=np.int64)
    begins[rows[1:][np.diff(time[rows]) > pause]] = 1
    return episodes + np.cumsum(begins)


def _wanted(table: Table, columns: ColumnMap | None, default: str) -> ColumnMap:
    if columns is not None:
        return columns
    if default in table.defaults:
        return table.defaults[default]
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
        told = options.observations is not None or options.group is not None or table.choose is not None
        if not flags and not told and _episode_column(table, options) is None:
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
    column = _episode_column(table, options)
    if column is not None:
        label = table.array(column, "episode").reshape(-1)
        table.check_rows(column, len(label), rows)
        empty = np.flatnonzero(missing(label))
        if empty.size:
            raise InputError(f"{table.source}: {column} has no value at row {empty[0]} (counted from 0)")
        start[1:] |= label[1:] != label[:-1]
    start[break_rows(options.breaks, rows, table.source)] = True
    return np.cumsum(start)


def _episode_column(table: Table, options: ReadOptions) -> str | None:
    return table.defaults.get("episode") if options.episode is None else options.episode


def _time(table: Table, options: ReadOptions, episodes: np.ndarray) -> np.ndarray | None:
    """Time stamps in seconds since the log's first, ``(rows,)``."""
    column = options.time
    if column is None and options.dt is None:
        column = table.defaults.get("time")
    if column is None:
        if options.dt is None:
            return None
        first = np.searchsorted(episodes, episodes)
        return (np.arange(len(episodes)) - first) * options.dt
    if options.dt is not None:
        raise InputError(f"{table.source}: both time and dt are given; dt is for a log without time stamps")
    signals = parse_columns(column, f"{table.source}: time")
    if len(signals) == 1 and signals[0].signal in table.names:
        stamps = table.array(signals[0].signal, "time")
        if are_dates(stamps):
            return dates_in_seconds(stamps, f"{table.source}: {signals[0].signal}")
    values, names = table.matrix(column, "time", len(episodes))
    if len(names) == 1:
        return values[:, 0]
    if len(names) != 2 or (values[:, 0] != np.round(values[:, 0])).any():
        raise InputError(
            f"{table.source}: time has {len(names)} columns; expected one, or whole seconds and their parts"
        )
    return np.asarray((values - values[:1]).sum(axis=1))


def dates_in_seconds(stamps: np.ndarray, where: str) -> np.ndarray:
    """Return dates ``(N,)`` as seconds since the first.

    Raises:
        InputError: something that is no date.
    """
    import pandas as pd

    texts = [str(stamp).strip().replace(",", ".") for stamp in stamps]
    if all(map(_CLOCK.fullmatch, texts)):
        seconds = np.asarray(pd.to_timedelta(texts) / pd.Timedelta(seconds=1), dtype=np.float64)
        return np.asarray(np.unwrap(seconds - seconds[0], period=86400.0))  # after midnight, it goes on
    with reading(where, "dates such as 2024-05-01T12:00:00.125"):
        dates = pd.to_datetime(pd.Series(stamps), format="ISO8601", utc=True)
    return np.asarray((dates - dates.iloc[0]) / pd.Timedelta(seconds=1), dtype=np.float64)


def are_dates(stamps: np.ndarray) -> bool:
    """Return whether a column holds dates, or text that does not start with a number."""
    if stamps.ndim != 1 or stamps.dtype.kind in "biuf":
        return False
    with extra("formats", "a column that holds no plain numbers"):
        import pandas as pd
    if pd.api.types.infer_dtype(stamps) not in ("string", "datetime", "datetime64", "date"):
        return False
    return stamps.dtype.kind == "M" or bool(np.isnan(pd.to_numeric(stamps[:1], errors="coerce"))[0])


def _read_minari(dataset: str | Path, options: ReadOptions) -> Trajectories:
    for option in fields(ReadOptions):
        given = getattr(options, option.name)
        if given and given != option.default and option.name not in ("observations", "actions", "dt"):
            source = f"{PREFIX}{dataset}" if isinstance(dataset, str) else dataset
            raise InputError(
                f"{source}: {option.name} has no meaning for a Minari dataset, which holds transitions; leave it out"
            )
    return read_minari(dataset, observations=options.observations, actions=options.actions, dt=options.dt)
