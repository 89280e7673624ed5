"""From matched columns to the keys of a config that read the log: ``data``, ``frame_skip``, ``observation``."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.config import make_config
from dropo_torch.data.corrections import continuous
from dropo_torch.data.examination import Finding
from dropo_torch.data.ticks import find_ticks
from dropo_torch.errors import InputError
from dropo_torch.logged import LoggedData, read_log
from dropo_torch.proposal.clock import GAP, Clock
from dropo_torch.proposal.columns import Columns
from dropo_torch.proposal.matches import Match, Matching
from dropo_torch.proposal.places import Place

#: Relative deviation up to which rows are a whole number of the model's steps apart.
WHOLE = 1e-3
#: Findings of an examination whose cures are taken; others are told.
CURED = (
    "degrees", "motor_side", "units", "sign", "order", "wraps", "quaternion_order", "joined", "frame_skip", "delay",
    "dropouts", "jitter", "next_observations", "joint_sign", "action_sign", "action_order",
)  # fmt: skip
#: Findings for which measured velocities are not used, and what is said of them.
UNFIT = {"angular_frame": "angular velocities are in the world's frame", "lag": "{}"}
#: Examinations at most: each may find what the one before hid.
ROUNDS = 8
#: A power that noise does not have: times that of the highest quarter of frequencies.
ABOVE_NOISE = 12.0
#: What is said of derived velocities that are masked.
UNCOMPARED = "derived velocities say where windows begin, and are compared nowhere"
#: Share of what a row adds to a position that its noise may make before it is filtered.
NOISY = 0.02
#: Margin of a filter, for velocities that are compared nowhere, over the highest frequency at which positions show more
#: than noise.
MARGIN = 1.2


@dataclass(frozen=True)
class Draft:
    """The part of a config that reads the log.

    Attributes:
        document: its keys.
        logged: the log as it reads it.
        findings: what an examination still finds.
        notes: what was done and why, in words.
        smooth: the filter of noisy positions whose velocities are derived, or ``None``.
        turned: what columns of angles are, in words.
    """

    document: dict[str, Any]
    logged: LoggedData
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    smooth: Filter | None = None
    turned: tuple[str, ...] = ()

    def noted(self, note: str) -> Draft:
        """Return the draft with one more note, as the first."""
        return replace(self, notes=(note, *self.notes))


@dataclass(frozen=True)
class Reading:
    """What is known of a log and its model before a config reads it.

    Attributes:
        model, data: paths as the config has them; the log's may be several.
        columns, matching, clock: the log, what its columns are and when its rows were taken.
        places: of the model.
        timestep: the model's, seconds.
        base: folder of the config.
    """

    model: str
    data: Sequence[str]
    columns: Columns
    matching: Matching
    places: Sequence[Place]
    clock: Clock
    timestep: float
    base: Path


def is_whole(dt: float, timestep: float) -> bool:
    """Return whether rows are a whole number of the model's steps apart."""
    skip = max(1, round(dt / timestep))
    return abs(dt / timestep - skip) <= WHOLE * skip


def make_draft(reading: Reading) -> Draft:
    """Return the keys that read a log, corrected by what its examination surely finds.

    Raises:
        InputError: a log that cannot be read so.
    """
    document, notes, smooth = _document(reading, derived=False)
    logged, findings, cured = _cured(document, reading)
    told = {f.name: f.what for f in findings}
    if reasons := [why.format(told[name]) for name, why in UNFIT.items() if name in told]:
        document, notes, smooth = _document(reading, derived=True)
        notes += [f"{'; '.join(reasons)}: all velocities are derived"]
        logged, findings, cured = _cured(document, reading)
    return Draft(document, logged, findings, (*notes, *cured), smooth and _as_cured(smooth, document, reading.matching))


def _document(reading: Reading, *, derived: bool) -> tuple[dict[str, Any], list[str], Filter | None]:
    columns, matching, clock, timestep = reading.columns, reading.matching, reading.clock, reading.timestep
    dt = clock.dt
    assert dt is not None
    if matching.of("marker"):
        return *_of_markers(reading), None
    notes = _lost(matching)
    positions, velocities = list(matching.of("position")), list(matching.of("velocity"))
    lacking = [p for p in matching.lacks("velocity") if p.partner == "" or matching.at(p.partner)]
    some = [] if derived or not velocities else _derived(lacking, positions)  # beside those that are measured
    derived = derived or bool(lacking and not some)
    skip = max(1, round(dt / timestep))
    whole = is_whole(dt, timestep)
    missing = any(np.isnan(m.column.values).any() for m in matching.matches)
    smooth: Filter | None = None
    period = _own_period(columns, matching, clock)
    resampled = derived or bool(some) or not clock.even or not whole or missing or period is not None
    source = _source(reading)
    if not resampled and (whole_arrays := _standard(columns, matching)) is not None:
        source = {k: v for k, v in source.items() if k not in ("episode", "breaks")}
        return {"model": reading.model, "data": source, "frame_skip": skip, "observation": whole_arrays}, notes, None
    if derived:
        velocities, some = [], positions
    names = ", ".join(dict.fromkeys(p.label for p in lacking))
    notes += [f"velocities are derived from positions: {names} not logged"] if names else []
    senses = list(matching.of("sensor"))
    source["observations"] = [m.entry for m in positions + senses + velocities]
    commands = matching.of("command")
    follows = not commands and bool(matching.lacks("command"))
    if not follows:
        source["actions"] = [m.entry for m in commands]
    if resampled or follows:
        source["preprocess"], more, smooth = _preprocess(
            columns, matching, clock, positions, velocities, skip * timestep, follows=follows, derive=some,
            period=period,
        )  # fmt: skip
        notes += more
        notes += [] if whole else [f"rows {dt:.6g} s apart are no whole number of the model's steps: resampled"]
        notes += [] if clock.even or columns.apart else [_unevenness(clock, dt)]
    rates = _rates(some, reading.places)
    entries = [m.place.entry for m in positions + senses] + rates + [m.place.entry for m in velocities]
    document = {"model": reading.model, "data": source, "frame_skip": skip, "observation": entries}
    if some:
        document["mask"] = [p.label for p in reading.places if p.entry in rates]
        notes += [UNCOMPARED]
    return document, notes, smooth


def _source(reading: Reading) -> dict[str, Any]:
    """The keys of ``data`` that find the log, its time and its episodes."""
    columns, clock = reading.columns, reading.clock
    source: dict[str, Any] = {"path": reading.data[0] if len(reading.data) == 1 else list(reading.data)}
    source |= {} if columns.group is None else {"group": columns.group}
    source |= {} if columns.separator is None else {"separator": columns.separator}
    source |= {"stamps": dict(columns.stamps)} if columns.stamps else {}
    orientations = {a.name: a.entry for a in columns.orientations if reading.matching.array(a.name)}
    source |= {"orientations": orientations} if orientations else {}
    if columns.apart is not None:
        pass  # time stamps are the signals' own
    elif clock.column is None or clock.by_rows:
        source["dt"] = float(f"{clock.dt:.6g}")
    else:
        source["time"] = clock.entry
    if clock.episode is not None:
        source["episode"] = clock.episode.entry
    elif clock.terminals:
        source["terminals"] = [c.entry for c in clock.terminals]
    if clock.breaks and len(reading.data) > 1:
        raise InputError(
            f"{columns.source}: rows are missing within one of these files; cut it there, or join them into one file"
        )
    if clock.breaks:
        source["breaks"] = list(clock.breaks)
    return source


def _of_markers(reading: Reading) -> tuple[dict[str, Any], list[str]]:
    """The keys of a log of markers, whose states are estimated, and of encoders beside them."""
    matching, clock, notes = reading.matching, reading.clock, _lost(reading.matching)
    assert clock.dt is not None
    skip = max(1, round(clock.dt / reading.timestep))
    whole = abs(clock.dt / reading.timestep - skip) <= WHOLE * skip
    shown = [m for m in matching.matches if m.place.kind != "command"]
    source = _source(reading) | {"observations": [m.entry for m in shown]}
    source["actions"] = [m.entry for m in matching.of("command")]
    if not clock.even or not whole or any(np.isnan(m.column.values).any() for m in matching.matches):
        longest = _longest(clock, len(reading.columns), reading.columns.parts, matching.matches)
        source["preprocess"] = {"dt": float(f"{skip * reading.timestep:.9g}"), "velocities": []}
        source["preprocess"] |= {"max_gap": float(f"{min(max(1.05 * longest, 2.5 * clock.dt), GAP * clock.dt):.4g}")}
        notes.append("time stamps are uneven, or a sample is missing: resampled")
    entries = [m.place.entry for m in shown]
    notes.append("states are estimated from the markers' places; velocities are not measured")
    return {"model": reading.model, "data": source, "frame_skip": skip, "observation": entries}, notes


def _unevenness(clock: Clock, dt: float) -> str:
    """Why a log is resampled whose rows are not evenly spaced."""
    jitter = f"time stamps jitter by {clock.jitter:.0%} of {dt:.4g} s" if clock.jitter >= 0.005 else ""
    missing = f"{clock.missing:,} row{'s are' if clock.missing > 1 else ' is'} missing" if clock.missing else ""
    return f"{' and '.join(filter(None, (jitter, missing))) or 'time stamps are uneven'}: resampled"


def _lost(matching: Matching) -> list[str]:
    """What of the log is not used: columns that are nothing of the model's, and values that are no numbers."""
    told = {
        "the motion tells accelerations": [c for c in matching.unused if c.words.role == "acceleration"],
        "commands are known": [c for c in matching.unused if c.words.role == "effort" and matching.of("command")],
        "they are along other axes than the model's: a free body's velocity is along the world's, its turning about "
        "the body's": list(matching.otherwise),
    }
    told["nothing of the model is called so"] = [
        c for c in matching.unused if not any(c is other for group in told.values() for other in group)
    ]
    notes = [
        f"not used, for {why}: {', '.join(c.entry for c in group[:6])}" + ", ..." * (len(group) > 6)
        for why, group in told.items() if group
    ]  # fmt: skip
    lost = {m.column.entry: int(np.isnan(m.column.values).sum()) for m in matching.matches}
    holes = [f"{count} of {name}" for name, count in lost.items() if count]
    worded = {m.column.entry: m.column.text for m in matching.matches}
    texts = [f"{name} is {text[1]!r} at row {text[0]} (counted from 0)" for name, text in worded.items() if text]
    return notes + (
        [
            f"values that are {'NaN, blank or text' if texts else 'NaN or blank'} count as not measured; short gaps "
            f"are bridged: {'; '.join([', '.join(holes), *texts])}"
        ]
        if holes
        else []
    )


def _standard(columns: Columns, matching: Matching) -> list[str] | None:
    """What the columns of ``observations`` are, where a log's own arrays are read as they are; ``None`` elsewhere.

    That is where it has ``next_observations``, which need not be those of the next row.
    """
    names = {c.array for c in columns.columns}
    actions = [m.column.entry for m in matching.of("command")]
    arrays = {m.column.array for m in matching.matches if m.place.kind != "command"}
    plain = all(m.scale == 1.0 and not m.offset for m in matching.matches)
    own = [c.entry for c in columns.columns if c.array == "actions"]
    if "next_observations" not in names or arrays != {"observations"} or own != actions or not plain:
        return None
    held = {m.column.entry: m.place.entry for m in matching.matches}
    return [held.get(c.entry, "skip") for c in columns.columns if c.array == "observations"]


def _derived(lacking: Sequence[Place], positions: Sequence[Match]) -> list[Match]:
    """The positions of which the velocities that lack are derivatives."""
    turning = {p.joint for p in lacking if p.angular}
    own = {p.partner for p in lacking}
    return [
        m for m in positions
        if m.place.label in own or (m.place.measure == "quaternion" and m.place.joint in turning)
    ]  # fmt: skip


def _rates(positions: Sequence[Match], places: Sequence[Place]) -> list[str]:
    """Entries of the velocities that preprocessing derives, in its order."""
    found: list[str] = []
    for m in positions:
        if m.place.measure != "quaternion":
            found += [p.entry for p in places if p.kind == "velocity" and p.partner == m.place.label]
        elif m.place.axis == "w":
            found += [p.entry for p in places if p.kind == "velocity" and p.joint == m.place.joint and p.angular]
    return found


def _preprocess(
    columns: Columns, matching: Matching, clock: Clock, positions: Sequence[Match], velocities: Sequence[Match],
    step: float, *, follows: bool, derive: Sequence[Match] = (),
    period: float | None = None,
) -> tuple[dict[str, Any], list[str], Filter | None]:  # fmt: skip
    """Options that resample a log, what they are for, and the filter among them."""
    options: dict[str, Any] = {"dt": float(f"{step:.9g}")}
    notes: list[str] = []
    if velocities or derive:
        options["velocities"] = [m.column.entry for m in velocities]
    if derive:
        options["derive"] = [m.column.entry for m in derive]
    groups: dict[int, list[str]] = {}
    for m in positions:
        if m.place.measure == "quaternion":
            groups.setdefault(m.place.joint, []).append(m.column.entry)
    if groups:
        options["quaternions"] = list(groups.values())
    smooth = make_filter(derive, clock, len(columns), columns.parts) if derive else None
    if smooth is not None:
        options["cutoff"] = smooth.cutoff
        notes.append(
            f"velocities are derived through a filter at {smooth.cutoff:g} Hz, above which the log shows noise alone"
        )
    dt = clock.dt or step
    longest = _longest(clock, len(columns), columns.parts, matching.matches)
    if any(np.isnan(m.column.values).any() for m in matching.matches) or longest > 2.4 * max(dt, step):
        options["max_gap"] = float(f"{min(max(1.05 * longest, 2.5 * dt), GAP * dt):.4g}")
    if follows:
        options["actions"] = "position"
        joints = {m.place.partner for m in matching.of("command")} | {p.partner for p in matching.lacks("command")}
        options["controlled"] = [m.column.entry for m in positions if m.place.label in joints]
        notes.append("commands were not logged: servos are taken to have been told what was measured a row later")
    elif matching.of("command"):
        # one that changes within a row acts in part of it; on the log's own grid it is held
        options["actions"] = "mean"
        if period is not None:
            options["command_clock"] = True
            notes.append(f"commands change every {period:.4g} s, between rows: each is put back to when it changed")
    return options, notes, smooth


def _own_period(columns: Columns, matching: Matching, clock: Clock) -> float | None:
    """Seconds from one command to the next by a controller's own clock, if all episodes show that."""
    commands, time = matching.of("command"), clock.seconds
    if time is None or not commands or columns.apart:
        return None
    values = np.stack([m.values for m in commands], 1)
    starts = np.append(np.flatnonzero(clock.starts(len(columns), columns.parts)), len(columns))
    parts = [slice(a, b) for a, b in pairwise(starts)]
    if np.isnan(values).any() or not np.isfinite(time).all():
        return None
    found = [find_ticks(time[p], values[p]) for p in parts]
    return None if None in found else float(np.mean([ticks.period for ticks in found if ticks is not None]))


def _longest(clock: Clock, rows: int, parts: Sequence[int], matches: Sequence[Match] = ()) -> float:
    """Longest time between rows inside episodes, or between values of columns, seconds."""
    own = max((_longest_hole(m, clock.starts(rows, parts)) for m in matches), default=1) * (clock.dt or 0.0)
    stamps = clock.seconds
    if stamps is None:
        return max(own, clock.dt or 0.0)
    spacing = np.diff(stamps)[~clock.starts(rows, parts)[1:]]
    return max(own, float(spacing.max(initial=0.0)))


def _longest_hole(match: Match, starts: np.ndarray) -> int:
    """Rows from a value of a column to the next one within an episode, at most."""
    known = np.flatnonzero(np.isfinite(match.column.values))
    runs = np.cumsum(starts)[known]
    return int(np.diff(known)[np.diff(runs) == 0].max(initial=1))


@dataclass(frozen=True)
class Filter:
    """A low-pass filter through which velocities are derived from noisy positions, and what it leaves.

    Attributes:
        cutoff: its frequency, Hz.
        density: of the noise of each position, by its place's label: its unit squared by Hz.
    """

    cutoff: float
    density: dict[str, float]

    def rate_noise(self, label: str) -> float:
        """Return the standard deviation that the filter leaves of the noise of a position's derivative."""
        return self._left(self.density.get(label, 0.0))

    def turning_noise(self, joint: str) -> float:
        """Return that of an angular velocity, rad/s, from the noise of an orientation.

        A small rotation about an axis changes a unit quaternion by half as much, about each of three at right angles.
        """
        parts = (v for label, v in self.density.items() if label.startswith(f"{joint}.position[q"))
        return self._left(4 / 3 * sum(parts))

    def _left(self, density: float) -> float:
        return math.sqrt(density * self.cutoff * (2 * math.pi * self.cutoff) ** 2 / 3)


def _continuous(match: Match, positions: Sequence[Match]) -> np.ndarray:
    """The values of a position ``(N,)`` as reading makes them continuous: angles that wrap, quaternions that flip."""
    values, joint = match.values.copy(), match.place.joint
    if match.place.measure == "quaternion":
        parts = [m.values for m in positions if m.place.joint == joint and m.place.measure == "quaternion"]
        along = np.nansum([part[1:] * part[:-1] for part in parts], axis=0)
        values[1:] *= np.cumprod(np.where(along < 0, -1.0, 1.0))
    elif match.place.measure == "angle":
        values = continuous(values)
    return values


def make_filter(positions: Sequence[Match], clock: Clock, rows: int, parts: Sequence[int]) -> Filter | None:
    """Return the filter above whose frequency positions show noise alone; ``None`` where noise does not matter."""
    from scipy import signal

    starts = np.append(np.flatnonzero(clock.starts(rows, parts)), rows)
    longest = int(np.argmax(np.diff(starts)))
    part, highest, dt = slice(starts[longest], starts[longest + 1]), 0.0, clock.dt
    assert dt is not None
    is_noisy, density = False, {}
    for m in positions:
        values = _continuous(m, positions)[part]
        values = values[np.isfinite(values)]
        if len(values) < 64 or not np.ptp(values):
            continue
        noise = float(np.std(np.diff(values, 4))) / math.sqrt(70)
        is_noisy |= noise > NOISY * float(np.std(np.diff(values)))
        length = min(len(values) - 1, 512)
        frequency, power = signal.welch(np.diff(values), 1 / dt, nperseg=length, detrend="linear")
        power = power / np.maximum(4 * np.sin(np.pi * frequency * dt) ** 2, 1e-12)  # that of the positions
        density[m.place.label] = float(np.median(power[-len(power) // 4 :]))
        above = np.flatnonzero(power[1:] > ABOVE_NOISE * density[m.place.label]) + 1
        highest = max(highest, float(frequency[above.max()]) if above.size else 0.0)
    cutoff = float(f"{MARGIN * max(highest, 4 / (dt * rows)):.2g}")
    return Filter(cutoff, density) if is_noisy and cutoff <= 0.4 / dt else None


# --- what an examination cures ---


def _as_cured(smooth: Filter, document: Mapping[str, Any], matching: Matching) -> Filter:
    """A filter whose noise is in the units in which the config reads the positions."""
    factors = document["data"].get("scale", {})
    entries = {m.place.label: m.column.entry for m in matching.of("position")}
    density = {label: factors.get(entries.get(label), 1.0) ** 2 * of for label, of in smooth.density.items()}
    return replace(smooth, density=density)


def as_read(matching: Matching, places: Sequence[Place], draft: Draft) -> Matching:
    """Return what the columns are as the config reads them, after what was cured: their places and their units."""
    observation, origin = draft.logged.observation, draft.logged.trajectories.origin
    if origin is None or not origin.observation_names:
        return matching
    signals = [origin.observation_names[i] for i in observation.log_columns]
    place = {p.number: p for p in places if p.kind in ("position", "velocity")}
    held: dict[str, list[Place]] = {}  # a position whose velocity is derived has two
    for signal, column in zip(signals, observation.columns, strict=True):
        held.setdefault(signal, []).extend([place[column]] if column in place else [])
    factors = draft.document["data"].get("scale", {})
    read = [_as_read(m, held.get(m.column.entry, ()), factors.get(m.column.entry, 1.0)) for m in matching.matches]
    order = {p.label: i for i, p in enumerate(places)}
    matches = tuple(sorted(read, key=lambda m: order.get(m.place.label, len(order))))
    found = {m.place.label for m in matches}
    missing = tuple(p for p in places if p.label not in found and p in (*matching.missing, *place.values()))
    return replace(matching, matches=matches, missing=missing)


def _as_read(match: Match, held: Sequence[Place], factor: float) -> Match:
    """A match with the place and the factor that a cure gave it; markers and commands keep their place."""
    moved = match.place.kind in ("position", "velocity") and bool(held) and match.place not in held
    place = held[0] if moved else match.place
    if not moved and factor == 1.0:
        return match
    why = "the examination, not its name" if moved else f"{match.why}; in this unit by the examination"
    return replace(
        match, place=place, why=why, sureness="sure" if moved else match.sureness, scale=match.scale * factor,
        offset=match.offset * factor,
    )  # fmt: skip


def _cured(document: dict[str, Any], reading: Reading) -> tuple[LoggedData, tuple[Finding, ...], list[str]]:
    """Correct the keys, in place, by what the examination of the log surely finds; return what it finds then.

    What is named by its unit is in no other one: a position that turns too far beside it is not in degrees.
    """
    named = {m.column.entry for m in reading.matching.of("velocity") if m.column.words.scale is not None}
    notes: list[str] = []
    done: set[tuple] = set()
    for _ in range(ROUNDS):
        logged = read_log(make_config(document, base=reading.base), uneven=True)
        findings = logged.examined()
        new = [f for f in findings if f.sure and f.cure and f.name in CURED and (f.name, f.where) not in done]
        new = [f for f in new if f.name != "degrees" or not named & f.cure["data"]["scale"].keys()]
        if not new:
            break
        for finding in new[:1]:
            done.add((finding.name, finding.where))
            merge_cure(document, finding.cure)
            notes.append(f"{finding.name}: {finding.what}")
    return logged, findings, notes


def merge_cure(document: dict[str, Any], cure: Mapping[str, Any]) -> None:
    """Add the keys that cure a finding to those of a config, in place: factors multiply, lists grow."""
    for key, value in cure.items():
        if key == "data":
            for option, given in value.items():
                _MERGE.get(option, _replace)(document["data"], option, copy.deepcopy(given))
        else:
            document[key] = copy.deepcopy(value)


def _replace(data: dict[str, Any], option: str, given: Any) -> None:
    data[option] = given


def _multiply(data: dict[str, Any], option: str, given: Mapping[str, float]) -> None:
    own = data.setdefault(option, {})
    for name, factor in given.items():
        own[name] = own.get(name, 1.0) * factor


def _extend(data: dict[str, Any], option: str, given: Sequence[Any]) -> None:
    data[option] = sorted({*data.get(option, ()), *given})


def _update(data: dict[str, Any], option: str, given: Mapping[str, Any]) -> None:
    data[option] = {**data.get(option, {}), **given}


_MERGE: dict[str, Callable[[dict[str, Any], str, Any], None]] = {
    "scale": _multiply, "unwrap": _extend, "breaks": _extend, "preprocess": _update,
}  # fmt: skip
