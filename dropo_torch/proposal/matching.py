"""Which column of a log is which number of a model: by names, by order, and by what the numbers do."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from dropo_torch.proposal.columns import ACTIONS, STATES, Column, Columns
from dropo_torch.proposal.drives import behind_efforts, is_state, may_command, namesakes, numbered_drives
from dropo_torch.proposal.matches import Match, Matching, Sureness, is_taken, orientation
from dropo_torch.proposal.motions import LIKE, SAME, SPANS, motion, told_otherwise, turning
from dropo_torch.proposal.places import Place
from dropo_torch.proposal.units import with_unit
from dropo_torch.proposal.words import Words, split

#: Score by which what is told of a motor gives way to what is told of its joint, and words of motors.
MOTORS, _MOTOR = 1e-3, frozenset(("motor", "motors", "rotor", "mot"))
#: Score below which a column is not taken for a place, and above which its name leaves no doubt.
LEAST, SURE = 0.3, 0.75
#: What a name loses by each word that is none of the place's, and a column by never moving: of two with the joint's
#: number, the arm's is the joint's, and not its finger's.
FOREIGN, STILL = 0.02, 0.02
#: What a name is worth that is all of what a place is known as besides.
ALIAS = 0.8
#: Share of motion below which a position speaks against a velocity, where it moves by so many times its noise.
UNLIKE, SEEN = 0.1, 6.0
_AXES = ("x", "y", "z")
#: What the body is called by which all of a robot moves, whatever its name in the model, or what measures where it is.
BASE = frozenset((
    "base", "root", "floating", "torso", "trunk", "pelvis", "chassis", "odom", "odometry", "mocap", "vicon", "optitrack"
))  # fmt: skip


def match_columns(columns: Columns, places: Sequence[Place], starts: np.ndarray, taken: Sequence[Column]) -> Matching:
    """Return which column is which place, in units as names and ranges tell them.

    Args:
        columns: the log.
        places: of the model.
        starts: rows at which an episode begins, ``(N,)`` bool.
        taken: columns that are something else, such as the time.
    """
    whole = _whole_state(columns, places, starts)
    whole += _whole_action(columns, [p for p in places if p.kind == "command"])
    free = [c for c in columns.numeric if c not in taken and not any(m.column is c for m in whole)]
    free = [c for c in free if not _counts(c, starts)]
    known = {m.place.label: m for m in whole}
    own = {m.place.label: m for m in namesakes(places, [c for c in free if _may_be(c, "command")], known)}
    found = _found(places, free, known | own, starts)
    driven = {m.place.partner for m in own.values()} & {p.label for p in places if not p.optional}
    if driven and not driven & found.keys():  # what is called after drives may be all that is measured of their joints
        other = _found(places, free, known, starts)
        found = other if driven & other.keys() else found
    found, others = _along_own_axes(places, free, found, starts)
    matches = tuple(with_unit(found[p.label], found) for p in places if p.label in found)
    used = [m.column for m in matches] + list(taken)
    unused = tuple(c for c in columns.numeric if c.moves and all(c is not u for u in used) and not _counts(c, starts))
    return Matching(matches, tuple(p for p in places if p.label not in found), unused, others)


def _found(
    places: Sequence[Place], free: Sequence[Column], known: dict[str, Match], starts: np.ndarray
) -> dict[str, Match]:
    """What columns are, by label, with what is known of them already."""
    found = dict(known)
    for kind in ("position", "velocity", "command"):
        wanted = [p for p in places if p.kind == kind and p.label not in found]
        fits = _assigned(wanted, [c for c in free if not is_taken(c, found)], found, starts)
        found |= {m.place.label: m for m in fits}
        if kind == "command":
            found |= {m.place.label: m for m in namesakes(places, free, found)}
        found = _without_parts(places, free, found) if kind == "velocity" else found
        ordered = _by_family(places, kind, free, found)
        found |= {m.place.label: m for m in ordered if not _refuted(m.place, m.column, found, starts)}
    found |= {m.place.label: m for m in _in_order(places, free, found)}
    found |= {m.place.label: m for m in _gyroscope(places, free, found, starts)}
    found |= {m.place.label: m for m in numbered_drives(places, free, found)}
    found |= {m.place.label: m for m in behind_efforts(places, free, found)}
    return found


def _along_own_axes(
    places: Sequence[Place], free: Sequence[Column], found: Mapping[str, Match], starts: np.ndarray
) -> tuple[dict[str, Match], tuple[Column, ...]]:
    """What was found without free bodies' velocities along other axes than the model's, and the columns of these.

    MuJoCo has a free body's velocity along the world's axes and its turning about the body's. Loggers may have either
    the other way; what explains clearly more of the motion, turned so, is.
    """
    kept, others = dict(found), list[Column]()
    for joint in {p.joint for p in places if p.measure == "quaternion"}:
        quaternion = orientation(joint, places, found)
        if quaternion is None:
            continue
        for angular in (False, True):
            rated = [p for p in places if _is_rate_of(p, joint, angular=angular)]
            own = [m for p in rated if (m := found.get(p.label))]
            path = [m.values for p in rated if (m := found.get(p.partner))]
            if not rated or (not angular and len(path) < len(rated)):  # a ball joint has no place
                continue
            where = quaternion if angular else np.stack(path, axis=1)
            for told in [[m.column for m in own]] if own else _triples(free, found, angular=angular):
                rates = np.stack([c.values for c in told], axis=1)
                if len(told) == len(rated) and told_otherwise(where, rates, quaternion, starts):
                    others += told
                    kept = {label: m for label, m in kept.items() if m not in own}
    return kept, tuple(others)


def _triples(free: Sequence[Column], found: Mapping[str, Match], *, angular: bool) -> list[list[Column]]:
    """Columns of velocities along x, y and z that are called alike, and are nothing of the model's."""
    groups: dict[tuple, dict[str, Column]] = {}
    for c in free:
        if c.words.role == "velocity" and c.words.angular == angular and c.words.axis and not is_taken(c, found):
            groups.setdefault((c.words.objects, c.words.numbers), {}).setdefault(c.words.axis, c)
    return [[group[axis] for axis in _AXES] for group in groups.values() if {*group} == {*_AXES}]


def _is_rate_of(place: Place, joint: int, *, angular: bool) -> bool:
    return place.kind == "velocity" and place.joint == joint and place.angular == angular


def _without_parts(places: Sequence[Place], free: Sequence[Column], found: Mapping[str, Match]) -> dict[str, Match]:
    """What was found, without a free body's velocity of which only some axes move as its place changes.

    A velocity in the body's own frame agrees along axes about which the body hardly turns.
    """
    kept = dict(found)
    for p in places:
        if p.kind != "velocity" or not p.axis or p.label in found:
            continue
        own = [m for m in found.values() if m.place.joint == p.joint and m.place.angular == p.angular]
        own = [m for m in own if m.place.kind == "velocity"]
        families = {(m.column.words.objects, m.column.words.numbers) for m in own}
        for c in free:
            is_own = (c.words.objects, c.words.numbers) in families and c.words.axis == p.axis
            if is_own and c.words.role == "velocity" and c.words.angular == p.angular and not is_taken(c, found):
                kept = {label: m for label, m in kept.items() if m not in own}
    return kept


def _counts(column: Column, starts: np.ndarray) -> bool:
    """Whether a column numbers the rows, of the log or of each episode."""
    return len(starts) > 1 and bool((np.diff(column.values)[~starts[1:]] == 1).all())


# --- arrays of a whole robot ---


def _whole_state(columns: Columns, places: Sequence[Place], starts: np.ndarray) -> list[Match]:
    """Matches of an array that holds the state, in the order in which its velocities are its positions' best."""
    array = columns.matrix(STATES)
    positions, velocities = ([p for p in places if p.kind == kind] for kind in ("position", "velocity"))
    orders = []
    for skipped in range(1 + sum(p.optional for p in positions[:2])):
        some = positions[skipped:]
        orders += [some + velocities, velocities + some, some]
        if len(some) == len(velocities):
            orders.append([p for pair in zip(some, velocities, strict=True) for p in pair])
    orders = [o for o in orders if o and len(o) == len(array)]  # a model that may lack all positions has an empty one
    if not orders:
        return []
    best = max(orders, key=lambda order: _likeness(order, array, starts))
    sureness: Sureness = "likely" if len(orders) > 1 or velocities[0] in best else "guess"
    why = f"its place in {array[0].array}" + (", as its velocities fit" if velocities[0] in best else "")
    return [Match(p, c, 1.0, sureness, why) for p, c in zip(best, array, strict=True)]


def _likeness(order: Sequence[Place], array: Sequence[Column], starts: np.ndarray) -> float:
    held = {p.label: c.values for p, c in zip(order, array, strict=True)}
    shares = [
        motion(held[p.partner], held[p.label], starts)[0] for p in order if p.partner in held and p.kind == "velocity"
    ]
    return float(np.mean(shares)) if shares else 0.0


def _whole_action(columns: Columns, wanted: Sequence[Place]) -> list[Match]:
    array = columns.matrix(ACTIONS)
    if not wanted or len(array) != len(wanted):
        return []
    return [Match(p, c, 1.0, "likely", f"its place in {c.array}") for p, c in zip(wanted, array, strict=True)]


# --- one column after the other ---


def _assigned(
    wanted: Sequence[Place], free: Sequence[Column], found: dict[str, Match], starts: np.ndarray
) -> list[Match]:
    """The best assignment of columns to places of a kind, by names and motion."""
    free = [c for c in free if _may_be(c, wanted[0].kind)] if wanted else []
    if not free:
        return []
    words = {c.entry: w for c, w in zip(free, _of_the_body(_with_axes(free, wanted), wanted), strict=True)}
    ranks = _ranks(free, words, wanted)
    scalar = {p.label: i for i, p in enumerate(p for p in wanted if not p.axis)}
    names = np.array(
        [[_name(words[c.entry], p, ranks.get(c.entry), scalar.get(p.label)) for c in free] for p in wanted]
    )
    scores = names.copy()
    shares = np.zeros_like(scores)
    for i, p in enumerate(wanted):
        partner = found.get(p.partner) if p.kind == "velocity" else None
        for j, c in enumerate(free):
            if partner is not None and names[i, j] > -1:
                shares[i, j] = motion(partner.values, c.values, starts)[0]
                scores[i, j] += 0.8 * shares[i, j]
                if _is_partial(words[c.entry], p, names[i, j]) and _refuted(p, c, found, starts):
                    names[i, j] = scores[i, j] = -2.0
            scores[i, j] += _role_bonus(words[c.entry], p) - 1e-6 * j - 1e-7 * abs(i - j)  # else in order
            scores[i, j] -= MOTORS * bool(_MOTOR & {*split(c.entry)}) * (p.kind in ("position", "velocity"))
            scores[i, j] -= FOREIGN * len(set(words[c.entry].objects) - {*p.words, *p.aliases}) + STILL * (not c.moves)
    rows, columns = linear_sum_assignment(np.where(scores < -1, -10.0, scores), maximize=True)
    matches = []
    for i, j in zip(rows, columns, strict=True):
        named = names[i, j] >= LEAST
        same = shares[i, j] > SAME and words[free[j].entry].role in ("velocity", "")
        if (named or (same and names[i, j] > -1)) and scores[i, j] >= LEAST:
            told = words[free[j].entry]
            matches.append(_matched(wanted[i], free[j], told, float(names[i, j]), float(shares[i, j])))
    return matches


def _matched(place: Place, column: Column, words: Words, name: float, share: float) -> Match:
    """A match, with what it was found by."""
    spoken = "its name" if words.objects or words.axis else "its number" if words.numbers else "its kind"
    spoken = column.made_of or spoken
    seen = f"motion (r² {share:.2f})" if share > LIKE else ""
    by = f"{spoken} and {seen}" if name >= LEAST and seen else spoken if name >= LEAST else f"its {seen or 'motion'}"
    sureness: Sureness = "sure" if name >= SURE or (name >= LEAST and share > LIKE) else "likely"
    sureness = "guess" if name <= LEAST and share <= LIKE else sureness
    return Match(place, column, 1.0, sureness, by)


def _is_partial(words: Words, place: Place, score: float) -> bool:
    """Whether a column's name has no word of a velocity, or is the place's in part only."""
    is_own = bool(words.numbers and place.numbers) or bool(words.objects and score >= SURE)
    return words.role != "velocity" or not is_own


def _refuted(place: Place, column: Column, found: Mapping[str, Match], starts: np.ndarray) -> bool:
    """Whether a place is the velocity of a known position, and a column does not move as that changes.

    One whose name has no word of velocities must move so.
    """
    partner = found.get(place.partner) if place.kind == "velocity" else None
    if partner is None:
        return False
    share, _ = motion(partner.values, column.values, starts)
    if column.words.role != "velocity":
        return share <= LIKE
    return share < UNLIKE and column.moves and _moves_visibly(partner.values, starts)


def _moves_visibly(position: np.ndarray, starts: np.ndarray) -> bool:
    """Whether a position changes within rows by more than its noise."""
    runs, span = np.cumsum(starts), SPANS[-1]
    change = (position[span:] - position[:-span])[runs[span:] == runs[:-span]]
    noise = np.diff(position, 4)[runs[4:] == runs[:-4]] / math.sqrt(70)
    change, noise = change[np.isfinite(change)], noise[np.isfinite(noise)]
    return bool(change.size and noise.size and np.std(change) > SEEN * np.std(noise))


def _may_be(column: Column, kind: str) -> bool:
    """Whether a column's role allows it to be one of a kind of places."""
    role = column.words.role
    if kind == "position":
        return role in ("position", "")
    if kind == "velocity":
        return role in ("velocity", "")
    return role in ("command", "effort", "")


def _role_bonus(words: Words, place: Place) -> float:
    """What a role that the name says is worth beside one that it leaves open."""
    if place.kind == "command":
        return 0.2 if words.role == "command" and words.commanded == place.takes else 0.1 * (words.role == "command")
    return 0.1 * (words.role == place.kind)


def _name(words: Words, place: Place, rank: int | None, own: int | None) -> float:
    """How well a column's name fits a place, up to 1; -2 where it speaks against it.

    Args:
        words: what the name says.
        place: the place.
        rank: of the column among those that differ by their number, where there is one for each place.
        own: the place's.
    """
    if place.kind == "command" and not may_command(words, place):
        return -2.0
    known, others = set(place.words), set(place.words) | set(place.aliases)
    said = set(words.objects) - (BASE if place.is_base else set())
    if place.axis:
        fits = words.axis == place.axis and words.quaternion == (place.measure == "quaternion")
        if not fits or (place.kind == "velocity" and words.angular != place.angular):
            return -2.0
        return 0.9 if said & others else 0.6 if not said else 0.2
    if words.quaternion or (words.angular and words.axis):
        return -2.0
    axes = known & set(_AXES)
    if axes and words.axis:
        if words.axis not in axes:
            return -2.0
        said |= {words.axis}
    numbered = None
    if words.numbers and rank is not None:
        numbered = rank == own
    elif words.numbers and place.numbers:
        numbered = words.numbers[-1] == place.numbers[-1]
    if numbered is False:
        return -2.0
    score = _likeness_of_words(said, known, set(place.aliases), words.axis)
    bare = not words.role and not (words.percent and place.kind == "command")
    if bare and score < SURE and (said or not words.axis):  # a bare name must be the joint's
        return 0.0
    if not said and not numbered and score == 0.0 and not words.axis:
        return 0.4 if words.turns and place.measure == "angle" else 0.0 if words.turns else LEAST
    if not numbered:
        return score
    if place.numbers or score > 0:
        return min(1.0, 0.6 + 0.4 * score) if not said or score > 0 or not known else 0.4
    return 0.5 if not said or not known else 0.35


def _likeness_of_words(said: set[str], known: set[str], aliases: set[str], axis: str) -> float:
    """How alike the words of a column and of a joint are, up to 1."""
    besides = ALIAS * len(said & aliases) / len(said) if said else 0.0
    if said and known:
        if "".join(sorted(said)) == "".join(sorted(known)) or said == known:
            return 1.0
        share = len(said & known) / max(len(said), len(known))
        near = difflib.SequenceMatcher(None, "".join(sorted(said)), "".join(sorted(known))).ratio()
        besides = max(besides, 0.4 + 0.6 * share if share else 0.0, near if near > 0.75 else 0.0)
    if besides:
        return besides
    if axis and not said and axis in known | aliases | {w[-1] for w in known if len(w) > 2 and w[:-1] == "root"}:
        return 0.7
    return 0.0


def _with_axes(columns: Sequence[Column], wanted: Sequence[Place]) -> list[Words]:
    """The words of columns, with the axes that numbers stand for in groups of three and four of what has axes."""
    groups: dict[tuple, list[int]] = {}
    known = {word for p in wanted if p.axis or set(p.words) & set(_AXES) for word in (*p.words, *p.aliases)}
    for i, c in enumerate(columns):
        w = c.words
        if w.numbers and not w.axis and (set(w.objects) & known or w.quaternion or w.angular):
            groups.setdefault((w.role, w.objects, w.quaternion, w.angular, w.scale, w.numbers[:-1]), []).append(i)
    found = [c.words for c in columns]
    for (_, _, quaternion, *_), members in groups.items():
        letters = "wxyz" if quaternion else "xyz"
        if len(members) == len(letters):
            ordered = sorted(members, key=lambda i: columns[i].words.numbers[-1])
            for i, letter in zip(ordered, letters, strict=True):
                found[i] = replace(found[i], axis=letter)
    return found


def _of_the_body(words: Sequence[Words], wanted: Sequence[Place]) -> list[Words]:
    """The words of columns, without those of what measures it where one orientation is told, of a single free body.

    It is the body's, whether it is called after the body, an IMU, a state estimator or a motion capture system.
    """
    bodies = {p.joint: {*p.words, *p.aliases} for p in wanted if p.axis}
    poses: dict[tuple, set[tuple]] = {}
    for w in words:
        if w.axis and not w.angular and w.role in ("position", ""):
            poses.setdefault((w.objects, w.numbers), set()).add((w.quaternion, w.axis))
    whole = {(True, axis) for axis in "wxyz"}
    found = [called for called, parts in poses.items() if whole <= parts]
    if len(bodies) != 1 or len(found) != 1 or not found[0][0] or {*found[0][0]} & next(iter(bodies.values())):
        return list(words)
    return [replace(w, objects=()) if w.axis and (w.objects, w.numbers) == found[0] else w for w in words]


def _ranks(columns: Sequence[Column], words: dict[str, Words], wanted: Sequence[Place]) -> dict[str, int]:
    """The place that a column's number names, among those of one coordinate, where there is a column for each.

    Columns that differ by their number only are counted from whatever the first has, unless the model's numbers are
    theirs.
    """
    numbers = [p.numbers[-1] if p.numbers else None for p in wanted if not p.axis]
    groups: dict[tuple, list[Column]] = {}
    for c in columns:
        w = words[c.entry]
        if w.numbers and not w.axis:
            groups.setdefault((w.role, w.objects, w.commanded, w.scale, w.numbers[:-1]), []).append(c)
    found: dict[str, int] = {}
    for members in groups.values():
        if len(members) != len(numbers):
            continue
        own = {words[c.entry].numbers[-1]: c.entry for c in members}
        same = set(own) == set(numbers)
        order = [numbers.index(n) if same else i for i, n in enumerate(sorted(own))]
        found |= {own[n]: place for n, place in zip(sorted(own), order, strict=True)}
    return found


def _by_family(places: Sequence[Place], kind: str, free: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Places whose names nobody used, by the order of columns that belong together, one for each place of a kind."""
    scalar = [p for p in places if p.kind == kind and not p.axis]
    for wanted in (scalar, [p for p in scalar if not p.optional]):
        for family in _families(free, wanted):
            if len(family) == len(wanted) and (matches := _ordered(wanted, family, found)):
                return matches
    return []


def _ordered(wanted: Sequence[Place], family: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Columns for the places that have none, if those that names have told stand in the model's order, too.

    A single one that is left needs no order.
    """
    known = [found.get(p.label) for p in wanted]
    lacking = [i for i, match in enumerate(known) if match is None]
    left = [c for c in family if not is_taken(c, found)]
    if len(left) != len(lacking):
        return []
    if all(match is None or match.column is c for match, c in zip(known, family, strict=True)):
        sureness: Sureness = "likely" if len(lacking) < len(wanted) else "guess"
        return [Match(wanted[i], family[i], 1.0, sureness, "the order of columns") for i in lacking]
    if len(left) == 1:
        return [Match(wanted[lacking[0]], left[0], 1.0, "likely", "the only one left")]
    return []


def _families(free: Sequence[Column], wanted: Sequence[Place]) -> list[list[Column]]:
    """Columns that may be of a kind of places and belong together: by array, kind, unit and what is commanded.

    What is called a command comes before efforts that may have been measured.
    """
    groups: dict[tuple, list[Column]] = {}
    for c in (c for c in free if wanted and _may_be(c, wanted[0].kind)):
        w = c.words
        is_bare = not w.role and not is_state(c)
        is_other = wanted[0].kind == "command" and not may_command(w, wanted[0])
        if not (is_bare or is_other or w.axis or w.quaternion):
            groups.setdefault((c.array if c.index is not None else "", w.role, w.commanded, w.scale), []).append(c)
    return sorted(groups.values(), key=lambda group: wanted[0].kind == "command" and group[0].words.role != "command")


def _in_order(places: Sequence[Place], free: Sequence[Column], found: dict[str, Match]) -> list[Match]:
    """Places that nothing told apart, in the order of as many columns without a name.

    Where a free body is, no columns are that are called after something else, and not by its axes: an IMU's
    accelerations are not.
    """
    wanted = [p for p in places if p.label not in found and p.kind == "position" and not p.optional]
    nameless = [c for c in free if not is_taken(c, found) and c.words.role in ("", "position") and c.moves]
    if not wanted or len(wanted) != len(nameless):
        return []
    named = ((p.axis, c.words) for p, c in zip(wanted, nameless, strict=True))
    if any(axis and words.objects and words.axis != axis for axis, words in named):
        return []
    return [Match(p, c, 1.0, "guess", "the order of columns") for p, c in zip(wanted, nameless, strict=True)]


def _gyroscope(
    places: Sequence[Place], free: Sequence[Column], found: dict[str, Match], starts: np.ndarray
) -> list[Match]:
    """Angular velocities of a free body by a gyroscope, whatever it is called, that turns as the orientation does."""
    wanted = [p for p in places if p.kind == "velocity" and p.angular and p.label not in found]
    for joint in {p.joint for p in wanted}:
        own = [p for p in wanted if p.joint == joint]
        quaternion = orientation(joint, places, found)
        groups: dict[tuple, dict[str, Column]] = {}
        for c in free:
            if c.words.angular and c.words.role == "velocity" and c.words.axis and not is_taken(c, found):
                groups.setdefault((c.words.objects, c.words.numbers), {}).setdefault(c.words.axis, c)
        for group in groups.values():
            if len(own) == len(group) == 3 and quaternion is not None:
                share, _ = turning(quaternion, np.stack([group[p.axis].values for p in own], axis=1), starts)
                if share > SAME:
                    why = f"the motion of the orientation (r² {share:.2f})"
                    return [Match(p, group[p.axis], 1.0, "likely", why) for p in own]
    return []


# --- motion and units ---
