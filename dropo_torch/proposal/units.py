"""The units of columns: by their names, by their joints' ranges, and by what velocities are of positions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dropo_torch.proposal.matches import ANGLES, LENGTHS, Match, Matching, orientation
from dropo_torch.proposal.motions import LIKE, motion, turning
from dropo_torch.proposal.places import Place

#: Relative distance from a factor within which a unit is named.
UNIT = 0.3
#: What LeRobot calls a gripper's position, which it has in hundredths of the range, and by how many these may pass it.
GRIPPER, PAST = "gripper.pos", 5.0
#: What hundredths are told to be of, and the largest number that is a share of one, and no hundredths.
OF_RANGE, OF_COMMAND, SHARE = "% of the joint's range", "% of the command's range", 1.05


def with_unit(match: Match, found: dict[str, Match]) -> Match:
    """Return a match with its unit, by its name, by its joint's range, or by the joint's own unit for a target."""
    place, column = match.place, match.column
    if place.measure == "quaternion":
        return match
    named = column.words.scale
    if (limits := _hundredths_of(match, found)) is not None:
        return _of_range(match, limits)
    if place.kind == "command" and place.takes != "position":
        return match if named in (None, 1.0) or (place.takes == "effort" and named != 1e-3) else _scaled(match, named)
    if named is not None:
        return _scaled(match, named)
    if (limits := _calibrated(match, found)) is not None:
        return replace(match, scale=(limits[1] - limits[0]) / 100, offset=limits[0], told_in=OF_RANGE)
    if place.kind == "position":
        return _scaled(match, _by_range(place, column.values))
    if place.kind == "command":
        partner = found.get(place.partner)
        if partner is not None:
            own = with_unit(partner, found).scale
            return _scaled(match, own if _alike(column.values, partner.column.values) else 1.0)
    return match


def _calibrated(match: Match, found: dict[str, Match]) -> tuple[float, float] | None:
    """The range of which a gripper's position, or its target, is told in hundredths; ``None`` where it is not."""
    place, values = match.place, match.column.values
    of = found[place.partner].place if place.kind == "command" and place.partner in found else place
    inside = np.isfinite(values) & (values > -PAST) & (values < 100 + PAST)
    name = match.column.entry.rstrip("]").rpartition("[")[2]
    return of.limits if place.kind != "velocity" and name.endswith(GRIPPER) and inside.mean() > 0.99 else None


def _hundredths_of(match: Match, found: dict[str, Match]) -> tuple[float, float] | None:
    """The range of which a column is told in percent, by its name: an actuator's, or a joint's; ``None`` of none."""
    place, values = match.place, match.column.values[np.isfinite(match.column.values)]
    if not match.column.words.percent or place.kind == "velocity" or not values.size:
        return None
    partner = found.get(place.partner)
    limits = place.limits or (partner.place.limits if partner is not None and place.takes == "position" else None)
    return limits if SHARE < np.abs(values).max() < 100 + PAST else None


def _of_range(match: Match, limits: tuple[float, float]) -> Match:
    """A match in hundredths of a range: positions from its lower end, forces and speeds from zero where it has that."""
    low, high = limits
    if match.place.kind == "command" and match.place.takes != "position" and low <= 0 <= high:
        return replace(match, scale=max(-low, high) / 100, told_in=OF_COMMAND)
    told_in = OF_COMMAND if match.place.kind == "command" else OF_RANGE
    return replace(match, scale=(high - low) / 100, offset=low, told_in=told_in)


def _scaled(match: Match, scale: float | None) -> Match:
    return match if scale is None else replace(match, scale=scale)


def _alike(command: np.ndarray, position: np.ndarray) -> bool:
    """Whether a target has the size of what was measured."""
    sizes = [float(np.nanquantile(np.abs(x), 0.95)) for x in (command, position)]
    return sizes[1] > 0 and 1 / 6 < sizes[0] / sizes[1] < 6


def _by_range(place: Place, values: np.ndarray) -> float:
    """The unit in which a position lies within its joint's range; 1 where nothing speaks for another."""
    if place.limits is None:
        return 1.0
    low, high = place.limits
    margin = 0.2 * (high - low)
    finite = values[np.isfinite(values)]

    def inside(scale: float) -> float:
        return float(((scale * finite >= low - margin) & (scale * finite <= high + margin)).mean())

    others = [s for s in (ANGLES if place.measure == "angle" else LENGTHS) if s != 1.0 and s != math.pi / 30]
    if inside(1.0) > 0.8:
        return 1.0
    return max((s for s in others if inside(s) > 0.95), default=1.0)  # the one that fills the range best


def with_velocity_units(matching: Matching, starts: np.ndarray, dt: float) -> Matching:
    """Return a matching in which velocities have the unit in which they are their positions' derivatives."""
    found = []
    for m in matching.matches:
        if m.place.angular and m.column.words.scale is None and (unit := _unit_of_turns(matching, m, starts, dt)):
            m = replace(m, scale=unit)
        partner = matching.at(m.place.partner) if m.place.kind == "velocity" else None
        if partner is not None and m.column.words.scale is None:
            share, slope = motion(partner.values, m.column.values, starts)
            if share > LIKE and (unit := nearest_unit(slope / dt, m.place)) is not None:
                m = replace(m, scale=unit)
        found.append(m)
    return replace(matching, matches=tuple(found))


def _unit_of_turns(matching: Matching, match: Match, starts: np.ndarray, dt: float) -> float | None:
    """The unit of a free body's angular velocity, in which it is the derivative of the orientation."""
    found = {m.place.label: m for m in matching.matches}
    places = [m.place for m in matching.matches]
    quaternion = orientation(match.place.joint, places, found)
    rates = [m.column.values for m in matching.matches if m.place.joint == match.place.joint and m.place.angular]
    if quaternion is None or len(rates) != 3:
        return None
    share, slope = turning(quaternion, np.stack(rates, axis=1), starts)
    unit = nearest_unit(slope / dt, match.place) if share > LIKE else None
    return unit if unit is not None and unit > 0 else None


def nearest_unit(factor: float, place: Place) -> float | None:
    """Return the unit's factor nearest to one that was measured, with its sign; ``None`` where none is near."""
    known = ANGLES if place.measure == "angle" else LENGTHS
    size = abs(factor)
    near = min(known, key=lambda s: abs(math.log(max(size, 1e-300) / s)))
    return math.copysign(near, factor) if abs(size / near - 1) < UNIT else None


def rows_apart(matching: Matching, starts: np.ndarray) -> list[float]:
    """Return the seconds between rows that each velocity makes of its position's changes, in the model's units."""
    found = []
    for m in matching.of("velocity"):
        partner = matching.at(m.place.partner)
        if partner is not None:
            share, slope = motion(partner.values, m.values, starts)
            if share > LIKE:
                found.append(abs(slope))
    return found
