"""A floating base that no column of a log places: its feet tell where it is, and an accelerometer helps them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dropo_torch.proposal.columns import Column
from dropo_torch.proposal.matches import Match, Matching
from dropo_torch.proposal.places import Place
from dropo_torch.proposal.words import object_words
from dropo_torch.shooting.odometry import Base, find_base

#: Units of an accelerometer, in m/s²; and by how much the mean force that it shows may miss gravity, in its share.
UNITS, MISSED = (1.0, 9.80665, 9.80665e-3), 0.2
#: Angle from which on an IMU counts as turned in its base; and by which a base must lean less, rad.
TURNED, UPRIGHT = 1e-3, 0.3


def floating_base(matching: Matching, model: mujoco.MjModel) -> Base | None:
    """Return the base whose orientation the log shows, and neither its place nor its velocity; ``None`` elsewhere."""
    base = find_base(model)
    if base is None:
        return None
    shown = {m.place.number for m in matching.matches if m.place.kind in ("position", "velocity")}
    turned = set(range(base.turn.start, base.turn.stop))
    return base if turned <= shown and shown.isdisjoint(base.columns) else None


def with_base(matching: Matching, model: mujoco.MjModel, places: Sequence[Place]) -> Matching:
    """Return a matching that misses no place of such a base, and has its IMU as the log has it."""
    base = floating_base(matching, model)
    if base is None:
        return matching
    hidden = {("position", c) for c in base.columns[:3]} | {("velocity", c) for c in base.columns[3:]}
    missing = tuple(p for p in matching.missing if (p.kind, p.number) not in hidden)
    matching = _with_gyroscope(replace(matching, missing=missing), base, places)
    seat = _imu(matching, base)
    matching = _with(matching, _accelerometer(matching, base, seat))
    return matching if seat is None else _seated(matching, base, seat)


def _with(matching: Matching, found: Sequence[Match]) -> Matching:
    """A matching with some matches more."""
    used, labels = [m.column for m in found], {m.place.label for m in found}
    unused = tuple(c for c in matching.unused if all(c is not u for u in used))
    missing = tuple(p for p in matching.missing if p.label not in labels)
    return replace(matching, matches=(*matching.matches, *found), missing=missing, unused=unused)


def _with_gyroscope(matching: Matching, base: Base, places: Sequence[Place]) -> Matching:
    """A matching whose turning is that of the device which shows the orientation, where nothing else does."""
    wanted = [p for p in places if p.kind == "velocity" and p.joint == base.joint and p.angular]
    if any(matching.at(p.label) for p in wanted):
        return matching
    objects = {m.column.words.objects for m in _turning(matching, base)}
    group = {
        c.words.axis: c for c in matching.unused
        if c.words.angular and c.words.role == "velocity" and {c.words.objects} == objects and c.words.objects
    }  # fmt: skip
    if set(group) != {"x", "y", "z"}:
        return matching
    why = "the name of what shows the orientation"
    found = [Match(p, group[p.axis], group[p.axis].words.scale or 1.0, "likely", why) for p in wanted]
    order = {p.label: i for i, p in enumerate(places)}
    matching = _with(matching, found)
    return replace(
        matching, matches=tuple(sorted(matching.matches, key=lambda m: order.get(m.place.label, len(order))))
    )


def _turning(matching: Matching, base: Base) -> list[Match]:
    """The columns of the orientation."""
    return [m for m in matching.of("position") if base.turn.start <= m.place.number < base.turn.stop]


def _imu(matching: Matching, base: Base) -> int | None:
    """The model's sensor whose orientation the columns are, where it is turned in the base; ``None`` for the base's.

    A robot that walks is about as upright as the model is; where that tells neither, names do.
    """
    model, columns = base.model, _turning(matching, base)
    measured, words = _orientation(matching, base), set(columns[0].column.words.objects)
    for i in base.sensors(mujoco.mjtSensor.mjSENS_FRAMEQUAT):
        seat = base.seat(i)
        if seat is None or not model.sensor(i).name or seat.magnitude() < TURNED:
            continue
        own, there = _tilt(measured, base), _tilt(measured * seat.inv(), base)
        called = bool(words & {*object_words(model.sensor(i).name)[0]} - {*object_words(base.name)[0]})
        if there < own - UPRIGHT or (there < own + UPRIGHT and called):
            return i
    return None


def _tilt(turns: Rotation, base: Base) -> float:
    """The median angle by which a base leans against how the model stands, rad."""
    up = -np.asarray(base.model.opt.gravity)
    up = up / np.linalg.norm(up)
    stands = Rotation.from_quat(base.model.qpos0[base.turn], scalar_first=True)
    leans = turns.apply(stands.inv().apply(up))
    return float(np.median(np.arccos(np.clip(leans @ up, -1.0, 1.0))))


def _seated(matching: Matching, base: Base, seat: int) -> Matching:
    """A matching in which orientation and turning are those of an IMU that is turned in the base."""
    model, turn = base.model, base.seat(seat)
    assert turn is not None
    name = model.sensor(seat).name
    gyros = [
        model.sensor(i).name for i in base.sensors(mujoco.mjtSensor.mjSENS_GYRO)
        if (own := base.seat(i)) is not None and (own * turn.inv()).magnitude() < 1e-9 and model.sensor(i).name
    ]  # fmt: skip
    found, spare = [], []
    for m in matching.matches:
        part = m.place.number - base.turn.start if m.place.kind == "position" else -1
        rate = m.place.number - int(model.nq) - base.rate.start if m.place.kind == "velocity" else -1
        if 0 <= part < 4:
            found.append(_moved(m, name, part))
        elif 0 <= rate < 3 and gyros:
            found.append(_moved(m, gyros[0], rate))
        elif 0 <= rate < 3:
            spare.append(m.column)  # the model has no gyroscope as it is turned
        else:
            found.append(m)
    return replace(matching, matches=tuple(found), unused=(*matching.unused, *spare))


def _moved(match: Match, sensor: str, part: int) -> Match:
    """A match with the value of a sensor in the place of a number of the state."""
    place = replace(match.place, entry=f"sensor[{sensor}][{part}]", label=f"{sensor}[{match.place.axis}]")
    return replace(match, place=place, why=f"{match.why}, in the frame of the model's sensor {sensor}")


def base_note(matching: Matching, base: Base) -> str:
    """Return how the place of a base becomes known, in words."""
    helped = " and the accelerometer" if matching.of("sensor") else ""
    return (
        f"{base.name}: no column shows where it is or how fast it moves; that follows from its feet while they "
        f"stand{helped}, and is compared nowhere"
    )


def _accelerometer(matching: Matching, base: Base, seat: int | None) -> list[Match]:
    """The columns of an accelerometer on the base, which shows gravity where the base rests."""
    groups, turns = _triples(matching.unused), _orientation(matching, base)
    turned = None if seat is None else base.seat(seat)
    turns = turns if turned is None else turns * turned.inv()
    for sensor in base.sensors(mujoco.mjtSensor.mjSENS_ACCELEROMETER):
        name, own = base.model.sensor(sensor).name, base.seat(sensor)
        for group in sorted(groups, key=lambda g: -_alike(g["x"], name)) if name and own is not None else ():
            values = np.stack([group[axis].values for axis in "xyz"], axis=1)
            if (unit := _unit(values, turns * own, base)) is not None:
                return [
                    Match(
                        Place(f"{name}[{axis}]", "sensor", "length", f"sensor[{name}][{i}]", i, -1, (), (), axis=axis),
                        group[axis], unit, "likely", "the gravity that it shows", told_in=_called(unit),
                    )
                    for i, axis in enumerate("xyz")
                ]  # fmt: skip
    return []


def _called(unit: float) -> str:
    return dict(zip(UNITS, ("m/s²", "g", "mg"), strict=True))[unit]


def _triples(columns: Sequence[Column]) -> list[dict[str, Column]]:
    """Columns of accelerations along three axes."""
    groups: dict[tuple, dict[str, Column]] = {}
    for c in columns:
        if c.words.role == "acceleration" and c.words.axis in ("x", "y", "z") and not c.words.angular:
            groups.setdefault((c.words.objects, c.words.numbers), {}).setdefault(c.words.axis, c)
    return [group for group in groups.values() if len(group) == 3]


def _alike(column: Column, name: str) -> int:
    return len({*column.words.objects} & {*object_words(name)[0]})


def _orientation(matching: Matching, base: Base) -> Rotation:
    """The base's orientation in each row; that of the model where a row does not tell it."""
    parts = {m.place.number: m.values for m in matching.of("position")}
    turns = np.stack([parts[c] for c in range(base.turn.start, base.turn.stop)], axis=1)
    lost = ~(np.linalg.norm(turns, axis=1) > 1e-6)
    turns[lost] = base.model.qpos0[base.turn]
    return Rotation.from_quat(turns, scalar_first=True)


def _unit(values: np.ndarray, turns: Rotation, base: Base) -> float | None:
    """The unit in which the mean of forces ``(N, 3)`` in turning axes holds the robot up, m/s²; ``None`` for none."""
    known = np.isfinite(values).all(1)
    if not known.any():
        return None
    mean, up = turns[known].apply(values[known]).mean(0), -np.asarray(base.model.opt.gravity)
    misses = {unit: float(np.linalg.norm(unit * mean - up) / np.linalg.norm(up)) for unit in UNITS}
    best = min(misses, key=lambda unit: misses[unit])
    return best if misses[best] < MISSED else None
