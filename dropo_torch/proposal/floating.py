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
from dropo_torch.shooting.odometry import Base, find_base

#: Units of an accelerometer, in m/s²; and by how much the mean force that it shows may miss gravity, in its share.
UNITS, MISSED = (1.0, 9.80665, 9.80665e-3), 0.2


def floating_base(matching: Matching, model: mujoco.MjModel) -> Base | None:
    """Return the base whose orientation the log shows, and neither its place nor its velocity; ``None`` elsewhere."""
    base = find_base(model)
    if base is None:
        return None
    shown = {m.place.number for m in matching.matches if m.place.kind in ("position", "velocity")}
    turned = set(range(base.turn.start, base.turn.stop))
    return base if turned <= shown and shown.isdisjoint(base.columns) else None


def with_base(matching: Matching, model: mujoco.MjModel) -> Matching:
    """Return a matching that misses no place of such a base, and has its accelerometer where the log has one."""
    base = floating_base(matching, model)
    if base is None:
        return matching
    hidden = {("position", c) for c in base.columns[:3]} | {("velocity", c) for c in base.columns[3:]}
    missing = tuple(p for p in matching.missing if (p.kind, p.number) not in hidden)
    matching = replace(matching, missing=missing)
    found = _accelerometer(matching, base)
    used = [m.column for m in found]
    unused = tuple(c for c in matching.unused if all(c is not u for u in used))
    return replace(matching, matches=(*matching.matches, *found), unused=unused)


def base_note(matching: Matching, base: Base) -> str:
    """Return how the place of a base becomes known, in words."""
    helped = " and the accelerometer" if matching.of("sensor") else ""
    return (
        f"{base.name}: no column shows where it is or how fast it moves; that follows from its feet while they "
        f"stand{helped}, and is compared nowhere"
    )


def _accelerometer(matching: Matching, base: Base) -> list[Match]:
    """The columns of an accelerometer on the base, which shows gravity where the base rests."""
    sensors, groups = _sensors(base), _triples(matching.unused)
    turns = _orientation(matching, base)
    for name, site in sensors:
        for group in sorted(groups, key=lambda g: -_alike(g["x"], name)):
            values = np.stack([group[axis].values for axis in "xyz"], axis=1)
            if (unit := _unit(values, turns, base, site)) is not None:
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


def _sensors(base: Base) -> list[tuple[str, int]]:
    """Names and sites of the accelerometers on a base."""
    model = base.model
    body = model.body_weldid[model.jnt_bodyid[base.joint]]
    return [
        (model.sensor(i).name, int(model.sensor_objid[i]))
        for i in np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_ACCELEROMETER))
        if model.sensor(i).name and model.body_weldid[model.site_bodyid[model.sensor_objid[i]]] == body
    ]


def _triples(columns: Sequence[Column]) -> list[dict[str, Column]]:
    """Columns of accelerations along three axes."""
    groups: dict[tuple, dict[str, Column]] = {}
    for c in columns:
        if c.words.role == "acceleration" and c.words.axis in ("x", "y", "z") and not c.words.angular:
            groups.setdefault((c.words.objects, c.words.numbers), {}).setdefault(c.words.axis, c)
    return [group for group in groups.values() if len(group) == 3]


def _alike(column: Column, name: str) -> int:
    return len({*column.words.objects} & {*name.lower().split("_")})


def _orientation(matching: Matching, base: Base) -> Rotation:
    """The base's orientation in each row; that of the model where a row does not tell it."""
    parts = {m.place.number: m.values for m in matching.of("position")}
    turns = np.stack([parts[c] for c in range(base.turn.start, base.turn.stop)], axis=1)
    lost = ~(np.linalg.norm(turns, axis=1) > 1e-6)
    turns[lost] = base.model.qpos0[base.turn]
    return Rotation.from_quat(turns, scalar_first=True)


def _unit(values: np.ndarray, turns: Rotation, base: Base, site: int) -> float | None:
    """The unit in which the mean of forces ``(N, 3)`` at a site holds the robot up, m/s²; ``None`` for none."""
    seat = Rotation.from_quat(base.model.site_quat[site], scalar_first=True)
    known = np.isfinite(values).all(1)
    if not known.any():
        return None
    mean, up = (turns[known] * seat).apply(values[known]).mean(0), -np.asarray(base.model.opt.gravity)
    misses = {unit: float(np.linalg.norm(unit * mean - up) / np.linalg.norm(up)) for unit in UNITS}
    best = min(misses, key=lambda unit: misses[unit])
    return best if misses[best] < MISSED else None
