"""Columns of commands that are called after actuators, and not after joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from dropo_torch.proposal.columns import STATES, Column, last_part
from dropo_torch.proposal.matches import Match, Matching, is_taken
from dropo_torch.proposal.motions import LIKE
from dropo_torch.proposal.places import Place
from dropo_torch.proposal.words import Words, called, split, unit_role

#: What columns of commands are called after where they say nothing else.
DRIVES = frozenset(
    (
        *("motor", "motors", "servo", "servos", "actuator", "actuators", "drive", "drives", "rotor", "rotors", "prop"),
        *("props", "propeller", "propellers", "thruster", "thrusters", "thrust", "esc", "muscle", "muscles"),
    )
)

#: By which factor an effort may differ from its command.
ALIKE = 1.5


def namesakes(places: Sequence[Place], free: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Return commands of actuators after which a column is called, and no joint is whose position is yet to be found.

    Of several columns of a name, the one that is called a command is it.
    """
    joints = {p.label.rpartition(".")[0] for p in places if p.kind == "position" and p.label not in found}
    wanted = [p for p in places if p.kind == "command"]
    named: dict[str, Column] = {}
    left = [c for c in free if not is_state(c) and not is_taken(c, found)]
    for c in sorted(left, key=lambda c: c.words.role != "command"):
        place = _namesake(c, wanted)
        if place is not None and place.label not in joints:
            named.setdefault(place.label, c)
    return [
        Match(p, named[p.label], 1.0, "sure", "the actuator's name")
        for p in wanted if p.label in named and p.label not in found
    ]  # fmt: skip


def _namesake(column: Column, commands: Sequence[Place]) -> Place | None:
    """The command of the actuator after which a column is called, in a unit of what it takes; ``None`` for none."""
    name = column.label or column.entry
    if (same := next((p for p in commands if p.label == name), None)) is not None:
        return same
    for said in called(name, column.words):
        known = [p for p in commands if tuple(split(p.label)) == said]
        if len(known) == 1:
            return known[0] if list(said) == split(name) or _suits(column, known[0]) else None
    return None


def _suits(column: Column, place: Place) -> bool:
    """Whether neither the unit of a column nor what it is a command of is another than an actuator takes."""
    is_other = column.words.role == "command" and not may_command(column.words, place)
    return not is_other and unit_role(column.label or column.entry) in ("", place.takes)


def behind_efforts(places: Sequence[Place], free: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Return the commands that efforts answered, where the efforts were measured beside them, one for each.

    A controller's list of commands need not be in the order of the model or of what is measured; which is whose, the
    efforts say.
    """
    told = [found[p.label] for p in places if p.kind == "command" and p.label in found]
    told = [match for match in told if match.column.words.role == "effort"]
    groups: dict[tuple, list[Column]] = {}
    for c in (c for c in free if c.words.role == "command" and not is_taken(c, found)):
        if all(may_command(c.words, match.place) for match in told):
            array = c.array if c.index is not None else ""
            groups.setdefault((array, c.words.commanded, c.words.scale), []).append(c)
    for group in (group for group in groups.values() if 1 < len(group) == len(told)):
        shares = np.array([[_share(match.values, c.values) for c in group] for match in told])
        rows, columns = linear_sum_assignment(shares, maximize=True)
        if shares[rows, columns].min() > LIKE:
            pairs = zip(told, columns, shares[rows, columns], strict=True)
            why = "the effort that was measured (r² {:.2f})"
            return [Match(match.place, group[j], 1.0, "likely", why.format(share)) for match, j, share in pairs]
    return []


def _share(effort: np.ndarray, command: np.ndarray) -> float:
    """How much of an effort a command explains that is about as large; 0 of another one."""
    good = np.isfinite(effort) & np.isfinite(command)
    effort, command = (values[good] - values[good].mean() for values in (effort, command))
    size = float(command @ command)
    if not (good.any() and size > 0 and effort.any()):
        return 0.0
    slope = float(effort @ command) / size
    share = 1 - float(((effort - slope * command) ** 2).sum()) / float(effort @ effort)
    return share if 1 / ALIKE < slope < ALIKE else 0.0


def may_command(words: Words, place: Place) -> bool:
    """Return whether a column may be what an actuator takes."""
    if words.role == "effort":
        return place.takes == "effort"
    if words.role != "command":
        return False
    return words.commanded in ("", place.takes)


def is_state(column: Column) -> bool:
    """Return whether a column has a name in an array of what is measured."""
    return bool(column.label) and last_part(column.array) in STATES


def left_over(matching: Matching) -> list[Column]:
    """Return unused columns that may be commands, in whose names there is that of an actuator that has none."""
    positions = [p for p in (*matching.missing, *(m.place for m in matching.matches)) if p.kind == "position"]
    joints = {p.label.rpartition(".")[0] for p in positions}
    absent = [p for p in matching.lacks("command") if p.label not in joints]
    free = [c for c in matching.unused if c.words.role in ("", "command") and not is_state(c)]
    return [c for c in free if any(_mentions(c, p) and _suits(c, p) for p in absent)]


def _mentions(column: Column, place: Place) -> bool:
    """Whether an actuator's name is part of a column's."""
    every, own = split(column.label or column.entry), split(place.label)
    return bool(own) and any(every[i : i + len(own)] == own for i in range(len(every) - len(own) + 1))


def numbered_drives(places: Sequence[Place], free: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Return commands of actuators, none of which has a column, by columns of drives that differ by their number."""
    wanted = [p for p in places if p.kind == "command"]
    known = DRIVES | {word for p in wanted for word in p.words}
    if not wanted or any(p.label in found or p.takes == "position" for p in wanted):
        return []
    groups: dict[tuple, dict[int, Column]] = {}
    for c in (c for c in free if not is_taken(c, found) and len(c.words.numbers) == 1):
        own = {word for word in split(c.label or c.entry) if not word.isdigit()}
        if c.words.role == "" and not c.words.axis and own <= known:
            groups.setdefault(tuple(sorted(own)), {}).setdefault(c.words.numbers[0], c)
    whole = [group for group in groups.values() if len(group) == len(wanted) > 1]
    if len(whole) != 1:
        return []
    why = "the order of its number, one for each actuator"
    return [Match(p, whole[0][n], 1.0, "likely", why) for p, n in zip(wanted, sorted(whole[0]), strict=True)]
