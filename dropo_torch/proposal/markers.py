"""Columns that are the track of a marker: which site, geom or body of the model they follow, in which axes and unit."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.data.observation import parse_observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.export import read_spec
from dropo_torch.proposal.clock import Clock
from dropo_torch.proposal.columns import Column, Columns
from dropo_torch.proposal.matches import LENGTHS, Match, Matching
from dropo_torch.proposal.places import Place
from dropo_torch.proposal.words import object_words
from dropo_torch.shooting.posing import posed_log
from dropo_torch.support.files import write_atomically

#: What a marker may sit on, as MuJoCo's sensors call it: what is there for that first.
_KINDS = {
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_XBODY,
}
#: Rows by which things are compared, those of most motion.
ROWS = 240
#: Times by which a thing may miss a track more than the nearest one, to be where the marker may sit.
CLEAR = 3.0


@dataclass(frozen=True)
class Track:
    """Columns of one marker.

    Attributes:
        columns: axis as the column has it → column.
    """

    columns: dict[str, Column]

    @property
    def words(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Words and numbers by which the marker is called."""
        first = next(iter(self.columns.values())).words
        return first.objects, first.numbers

    @property
    def names(self) -> str:
        """Its columns, for people."""
        return ", ".join(c.entry for c in self.columns.values())


@dataclass(frozen=True)
class Seat:
    """Where a marker sits: a thing of the model, and by what its columns are multiplied."""

    kind: str
    name: str
    scale: float

    @property
    def sensor(self) -> str:
        """The name of the sensor that shows it."""
        return f"{self.name}_marker"


def tracks_of(columns: Sequence[Column]) -> list[Track]:
    """Return the markers of which a log has two or three coordinates."""
    groups: dict[tuple, dict[str, Column]] = {}
    for c in columns:
        w = c.words
        if w.axis in ("x", "y", "z") and not w.quaternion and not w.angular and w.role in ("", "position"):
            groups.setdefault((w.objects, w.numbers), {}).setdefault(w.axis, c)
    return [Track(own) for own in groups.values() if len(own) > 1]


def with_markers(
    model: mujoco.MjModel, path: Path, out: Path, columns: Columns, matching: Matching, clock: Clock
) -> tuple[Matching, Path]:
    """Return a matching in which columns are markers' coordinates, and the model that has sensors for them.

    The model is a copy beside the config, ``…_markers.xml``, unless it has the sensors already. Its step is one of
    which the log's rows are a whole number apart, for resampling would blur the markers' noise.

    Args:
        model: the model.
        path: its file.
        out: the config.
        columns: the log.
        matching: what else the columns are.
        clock: when the rows were taken.

    Raises:
        InputError: columns that follow nothing of the model, or things of which none is the nearest by far.
    """
    tracks = tracks_of(matching.unused)
    if not tracks or clock.dt is None or path.suffix == ".mjb":
        return matching, path
    seats = _seats(model, path, columns, tracks, clock)
    spec, changed = _sensed_spec(path, list(seats.values()))
    skip = max(1, round(clock.dt / model.opt.timestep))
    if clock.even and abs(clock.dt / skip / model.opt.timestep - 1) > 1e-4:
        spec.option.timestep, changed = clock.dt / skip, True
    if changed:
        path = out.resolve().parent / f"{out.stem}_markers.xml"
        spec.compile()
        write_atomically(path, spec.to_xml().encode())
    found = []
    names = _sensor_names(spec)
    for track, seat in zip(tracks, seats.values(), strict=True):
        for axis, column in sorted(track.columns.items()):
            name, number = names[seat.kind, seat.name], "xyz".index(axis)
            place = Place(
                f"{name}[{axis}]", "marker", "length", f"sensor[{name}][{number}]", number, -1, (), (), axis=axis
            )
            found.append(Match(place, column, seat.scale, "likely", f"the way of {seat.kind} {seat.name}"))
    used = [m.column for m in found]
    unused = tuple(c for c in matching.unused if all(c is not u for u in used))
    return replace(matching, matches=(*matching.matches, *found), unused=unused), path


def _sensor_names(spec: mujoco.MjSpec) -> dict[tuple[str, str], str]:
    """The position sensors of things that a model has, by kind and name."""
    kinds = {int(v): k for k, v in _KINDS.items()}
    return {
        (kinds[int(s.objtype)], s.objname): s.name
        for s in spec.sensors
        if s.type == mujoco.mjtSensor.mjSENS_FRAMEPOS and int(s.objtype) in kinds and s.name and not s.refname
    }


def _sensed_spec(path: Path, seats: Sequence[Seat]) -> tuple[mujoco.MjSpec, bool]:
    """A model with a position sensor for each of some things, and whether any had to be added."""
    spec = read_spec(path)
    there, changed = _sensor_names(spec), False
    for seat in seats:
        if (seat.kind, seat.name) not in there:
            changed = True
            spec.add_sensor(
                name=seat.sensor, type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=_KINDS[seat.kind], objname=seat.name
            )
    return spec, changed


def _things(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of the things of a kind that move."""
    if kind == "body":
        return [model.body(b).name for b in range(model.nbody) if model.body_weldid[b] and model.body(b).name]
    count, of = (model.nsite, model.site_bodyid) if kind == "site" else (model.ngeom, model.geom_bodyid)
    named = (getattr(model, kind)(i).name for i in range(count) if model.body_weldid[of[i]])
    return [name for name in named if name]


def _seats(
    model: mujoco.MjModel, path: Path, columns: Columns, tracks: Sequence[Track], clock: Clock
) -> dict[str, Seat]:
    """Where markers sit, by their columns: as they are called, or else where the model can follow a single one."""
    found: dict[str, Seat] = {}
    for track in tracks:
        called = [(k, n) for k in _KINDS for n in _things(model, k) if _is_called(track, n)]
        scales = _scales(track)
        options = [Seat(k, n, s) for k, n in called[:1] for s in scales]
        if len(tracks) > 1 and not options:
            raise InputError(
                f"{columns.source}: {track.names} may be a marker's track, but nothing of the model is called so; "
                f"rename one (the model has {_listed(model)})"
            )
        if len(tracks) > 1 and len(options) > 1:  # alone, it need not tell where the model is
            options = options[:1]
        if len(tracks) == 1:
            options = _nearest(path, columns, track, clock, options or list(_anything(model, scales)))
        found[track.names] = options[0]
    return found


def _is_called(track: Track, name: str) -> bool:
    words, numbers = object_words(name)
    own, count = track.words
    return bool(own or count) and set(own) == set(words) and count == numbers


def _scales(track: Track) -> list[float]:
    """Factors that a track's columns may need: their unit's, or those of all lengths."""
    told = {c.words.scale for c in track.columns.values()} - {None}
    return [float(s) for s in told if s is not None][:1] or list(LENGTHS)


def _anything(model: mujoco.MjModel, scales: Sequence[float]) -> Iterator[Seat]:
    for kind, scale in itertools.product(_KINDS, scales):
        yield from (Seat(kind, name, scale) for name in _things(model, kind))


def _listed(model: mujoco.MjModel) -> str:
    named = [f"{kind} {name}" for kind in _KINDS for name in _things(model, kind)]
    return ", ".join(named[:8]) or "no site, geom or body with a name"


def _nearest(path: Path, columns: Columns, track: Track, clock: Clock, options: Sequence[Seat]) -> list[Seat]:
    """The things that can follow a track, but for those that are further off by far."""
    misses, reasons = [], list[str]()
    for seat in options:
        try:
            misses.append((_miss(path, columns, track, clock, seat), seat))
        except InputError as error:
            reasons.append(f"{seat.kind} {seat.name}: {str(error).removeprefix('observation: ')}")
    if not misses:
        why = f" ({reasons[0]})" if reasons else ""
        raise InputError(
            f"{columns.source}: {track.names} may be a marker's track, but nothing of the model can follow it: put a "
            f"named site where the marker sits, and name columns by the world's axes, from its origin{why}"
        )
    least = min(miss for miss, _ in misses)
    return [seat for miss, seat in misses if miss <= CLEAR * least]


def _miss(path: Path, columns: Columns, track: Track, clock: Clock, seat: Seat) -> float:
    """By how much the model misses a track that a thing of it follows, m.

    Raises:
        InputError: it cannot follow, or the track does not tell its pose.
    """
    spec, _ = _sensed_spec(path, [seat])
    model, name = spec.compile(), _sensor_names(spec)[seat.kind, seat.name]
    axes = sorted(track.columns)
    rows = _moving(columns, track, clock)
    values = seat.scale * np.stack([track.columns[a].values[rows] for a in axes], axis=1)
    values = values[np.isfinite(values).all(1)]
    observation = parse_observation(model, [f"sensor[{name}][{'xyz'.index(a)}]" for a in axes], len(axes))
    log = Trajectories.of_samples(
        values, np.zeros((len(values) - 1, model.nu)), dt=clock.dt, source=columns.source
    )  # fmt: skip
    _, told = posed_log(model, observation, log, clock.dt or 1.0)
    return max(told.missed.values())


def _moving(columns: Columns, track: Track, clock: Clock) -> slice:
    """The rows of one episode over which a track moves most."""
    starts = np.append(np.flatnonzero(clock.starts(len(columns), columns.parts)), len(columns))
    best, most = slice(0, min(ROWS, len(columns))), -1.0
    for a, b in itertools.pairwise(starts.tolist()):
        for first in range(a, max(a + 1, b - ROWS + 1), ROWS):
            rows = slice(first, min(first + ROWS, b))
            moved = sum(float(np.nanstd(c.values[rows])) for c in track.columns.values())
            if rows.stop - rows.start > 8 and moved > most:
                best, most = rows, moved
    return best
