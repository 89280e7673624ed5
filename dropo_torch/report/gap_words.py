"""What a search for a gap says, in plain words: effects, places, numbers with intervals, the answer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects import VOCABULARY
from dropo_torch.effects.base import all_of
from dropo_torch.gap.result import FAMILY, Disturbance, Gap, NamedEffect, Place, Remaining, Strength, fallen, reason
from dropo_torch.gap.rules import Sound
from dropo_torch.report.formatting import joined, number, percent, plain, short, with_unit

UNNAMED = "unnamed"
#: Times in seconds below this are given in milliseconds.
SHORT = 0.1
#: Share of a gap without a name that the closest candidate leaves, below which it is told.
CLOSE = 0.2
#: Of effects with more numbers than this, the answer gives only the first.
MOST_NUMBERS = 3
#: Half-widths of its interval by which a parameter must be off the model's own value to be told.
SURE = 2.0
#: What is missing, as it follows on "Your model lacks".
_NOUNS = {
    "joint_damping": "viscous friction in {0}",
    "joint_quadratic_damping": "friction in {0} that grows with the square of its velocity",
    "joint_friction": "dry (Coulomb) friction in {0}",
    "joint_stribeck": "dry friction in {0} that is larger at rest than in motion (Stribeck)",
    "joint_soft_friction": "dry (Coulomb) friction in {0} that creeps at rest",
    "joint_presliding": "dry friction in {0} that gives elastically before it slides",
    "joint_lugre": "dry friction in {0} that gives before it slides and is larger when slow",
    "joint_friction_slope": "dry friction in {0} that changes along its range",
    "joint_load_friction": "dry friction in {0} that grows with the force that drives it",
    "joint_elasticity": "a transmission of {0} that gives (elasticity between motor and joint)",
    "tendon_friction": "dry (Coulomb) friction along {0}",
    "joint_stiffness": "a spring at {0}",
    "joint_cogging": "a force at {0} that is periodic in its position (cogging)",
    "armature": "rotor or gear inertia (armature) at {0}",
    "joint_limit": "different stops of {0}",
    "joint_stop": "stops of {0}",
    "joint_coupling": "a spring between {0} and its parent joint",
    "payload": "a mass on {0}",
    "center_of_mass": "a different center of mass of {0}",
    "inertia": "different moments of inertia of {0}",
    "external_force": "a constant external force on {0}",
    "fluid_drag": "fluid drag on {0}",
    "linear_drag": "linear drag on {0}",
    "quadratic_drag": "quadratic drag on {0}",
    "axis_drag": "quadratic drag on {0} along its axes",
    "fluid_medium": "the density of a medium, such as water",
    "gravity_tilt": "a tilt of the base relative to gravity",
    "ground_slope": "a slope of the ground",
    "integration": "a finer integration step",
    "integration_own": "a finer integration step",
    "actuator_gain": "a different gain of {0}",
    "actuator_stiffness": "a different kp of {0}",
    "actuator_bias": "a constant force from {0}",
    "actuator_damping": "velocity-proportional damping in {0}",
    "actuator_delay": "a delay of the commands to {0}",
    "actuator_lag": "a first-order lag of {0}",
    "actuator_time_constant": "a different time constant of {0}",
    "actuator_deadband": "a deadband of {0}",
    "actuator_backlash": "backlash (play) in {0}",
    "actuator_saturation": "a limit on the force of {0}",
    "sensor_bias": "an offset in the measurement of {0}",
    "sensor_scale": "a scale error in the measurement of {0}",
    "sensor_delay": "a delay of the measurement of {0}",
    "contact_friction": "a different sliding friction of {0}",
    "contact_rolling": "a different resistance of {0} to rolling",
    "contact_stiffness": "softer or stiffer contacts of {0}",
    "contact_margin": "contacts of {0} that act at a distance (margin)",
    "contact_sole": "a sole or coating on {0}",
}
#: What the numbers of an effect are, where their names alone do not say it.
_QUANTITIES = {"joint_limit": "{} stop moved by", "joint_stop": "{} stop at"}
#: Whole clauses where "Your model lacks" does not fit.
_CLAUSES = {
    "joint_limit": "The stops of {0} are not where your model has them",
    "joint_stop": "The motion of {0} has stops that your model lacks",
    "center_of_mass": "The center of mass of {0} is not where your model has it",
    "inertia": "The moments of inertia of {0} are not those of your model",
    "fluid_medium": "The robot moves in a medium, such as water, that is not your model's",
    "gravity_tilt": "The base is tilted, unlike in your model",
    "ground_slope": "The ground is sloped, unlike in your model",
    "integration": "The integration step of your model is too coarse for this motion",
    "integration_own": "The log was simulated with a finer step than your model's",
    "actuator_gain": "The force of {0} for the same command is not that of your model",
    "actuator_stiffness": "The kp of {0} is not that of your model",
    "actuator_time_constant": "The time constant with which the force of {0} builds up is not that of your model",
    "sensor_bias": "The measurement of {0} has a constant offset",
    "sensor_scale": "The measurement of {0} has a scale error",
    "sensor_delay": "The measurement of {0} is delayed",
    "contact_friction": "The sliding friction of {0} is not that of your model",
    "contact_rolling": "The resistance of {0} to rolling is not that of your model",
    "contact_stiffness": "The contacts of {0} are softer or stiffer than in your model",
    "contact_margin": "The margin of contacts of {0} is not that of your model",
    "contact_sole": "The surface of {0}, where contacts act, is not where your model has it",
}
#: Effects whose first number, if negative, says that the model has too much of them.
_SIGNED = ("joint_damping", "joint_quadratic_damping", "joint_friction", "joint_stiffness", "armature",
           "actuator_damping", "tendon_friction")  # fmt: skip
#: Effects whose number is a multiple of what the model has.
_MULTIPLES = ("actuator_gain", "actuator_stiffness", "inertia")
#: Members of the base family, in a list of a joint's.
_SHORT = {
    "joint_friction": "dry friction",
    "joint_friction_slope": "slope of dry friction along the range",
    "joint_damping": "viscous friction",
    "armature": "rotor inertia",
    "actuator_bias": "offset",
    "actuator_delay": "delay",
}
_COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_BY_FORCES = (
    "Open-loop predictions of your model are no better than constant velocity on this log, so the forces at its joints "
    "decide. Your model and the robot differ in what follows; with it, {0}"
)
_CANNOT_RULE_OUT = "An effect that is weaker than the noise, or that this motion does not excite, cannot be ruled out."


def is_named(effect: NamedEffect) -> bool:
    """Return whether an effect is one of the vocabulary."""
    return effect.effect != UNNAMED


def noun(effect: str, target: str | None) -> str:
    """Return an effect and its place as a noun phrase."""
    if effect in _NOUNS:
        return _NOUNS[effect].format(_at(effect, target))
    name = "something without a name" if effect == UNNAMED else quantity(effect)
    return f"{name} at {_at(effect, target)}" if target else name


def group(places: Sequence[tuple[str, str | None]]) -> str:
    """Return several effects and their places, the first few by name."""
    return joined([noun(*place) for place in places], 3)


def rivals(effect: NamedEffect) -> list[str]:
    """Return the effects that explain the log as well, each as a noun phrase; as one where both are everywhere."""
    counts = Counter(name for name, _ in effect.indistinguishable_from)
    whole = {name for name, count in counts.items() if effect.target == FAMILY and count == len(effect.parameters)}
    places = [(name, FAMILY if name in whole else target) for name, target in effect.indistinguishable_from]
    return [noun(*place) for place in dict.fromkeys(places)]


def title(effect: str) -> str:
    """Return an effect's name for a table."""
    return "no name" if effect == UNNAMED else quantity(effect)


def quantity(name: str) -> str:
    """Return a quantity's name in words."""
    return name.replace("_", " ")


def target_name(target: str | None, effect: str) -> str:
    """Return where an effect sits, for a table."""
    if target is None:
        return "the whole model" if effect != UNNAMED else "not known"
    return _all(effect) if target == "*" else target


def place_name(place: Place) -> str:
    """Return a place in words."""
    if place.name is None:
        return place.kind
    return all_of(place.kind) if place.name == "*" else f"{place.kind} {place.name}"


def places(values: Iterable[tuple[str, str | None]]) -> list[tuple[str, str]]:
    """Return effects, each with all its targets in words, in the order of first mention."""
    groups: dict[str, dict[str, None]] = {}
    for effect, target in values:
        groups.setdefault(effect, {})[target_name(target, effect)] = None
    return [(title(e), joined(list(targets), 12)) for e, targets in groups.items()]


def strength(given: Strength) -> tuple[str, str, str]:
    """Return value, interval and unit of a number in words, with as many digits as the interval supports."""
    values, unit = [given.value, given.low, given.high], "" if given.unit in ("-", "1") else given.unit
    if unit == "s" and np.fmax.reduce(np.where(np.isinf(values), 0, np.abs(values))) < SHORT:
        values, unit = [1000 * v for v in values], "ms"
    value, low, high = (_digits(v, 0.5 * (values[2] - values[1])) for v in values)
    interval = "" if np.isnan(given.low) or np.isnan(given.high) else f"{low} to {high}"
    return value, interval, unit


def degrees(given: Strength) -> str:
    """Return an angle in degrees, or nothing where it is none."""
    is_angle = given.unit == "rad" and np.isfinite(given.value)
    return f"{short(float(np.degrees(given.value)))}°" if is_angle else ""


def with_interval(given: Strength) -> str:
    """Return a number with unit and interval, as in ``0.150 N·m (0.148 to 0.152)``."""
    value, interval, unit = strength(given)
    return f"{with_unit(value, unit)} ({interval or 'interval not known'})".replace(" ", "\u00a0")


def numbers(parameters: Mapping[str, Strength], named: Callable[[str], str] = quantity) -> str:
    """Return all numbers of an effect, each with its name in words, or the first of many."""
    if len(parameters) < 2:
        return next(map(with_interval, parameters.values()), "strength not known")
    shown = list(parameters.items())[: MOST_NUMBERS if len(parameters) <= MOST_NUMBERS else 1]
    more = "" if len(shown) == len(parameters) else "; more in the table"
    return ", ".join(f"{named(n)} {with_interval(s)}" for n, s in shown) + more


def tabled(gap: Gap) -> list[tuple[str, str, str]]:
    """Return all numbers of the effects of which sentences give the first of many: effect, number, value."""
    if gap.forces or gap.joints:  # there each place has a sentence of its own
        return []
    many = [e for e in gap.effects if len(e.parameters) > MOST_NUMBERS]
    return [
        (noun(e.effect, e.target), n if e.target == FAMILY else quantity(n), with_interval(s))
        for e in many
        for n, s in e.parameters.items()
    ]


def ambiguous(effect: NamedEffect) -> str:
    """Return what explains the log as well as an effect, in a sentence."""
    others, own = joined(rivals(effect), last="or", rest="one of {} more"), noun(effect.effect, effect.target)
    return f"This log is explained equally well by {others}, in place of {own}; so may it be by a share of each."


def answer(gap: Gap) -> tuple[str, list[str]]:
    """Return what is missing in a sentence or two, and the items of a list that they announce, if any."""
    sentence, items = _with_values(gap)
    if gap.unfinished and gap.verdict == "partly explained":
        sentence = f"The time for the search was over before all was tried. So far: {sentence}"
    return (f"{pushes(gap.disturbances)} {sentence}" if gap.disturbances else sentence), items


def pushes(found: Sequence[Disturbance]) -> str:
    """Return when and where something pushed that is no part of the robot, in two sentences."""
    several, told = len({d.episode for d in found} | {0}) > 1, list[str]()
    for d in found:
        size = f"at {d.joint}, up to {plain(d.moment)} {d.unit}"
        if d.body is not None and d.force is not None:
            size += f", as a force of some {short(float(np.linalg.norm(d.force)))} N on {d.body} would"
        when = f" of episode {d.episode}" if several else ""
        told.append(f"from {d.begin:.2f} to {d.end:.2f} s{when} {size}")
    rest = "that span" if len(told) == 1 else "those spans"
    return f"Something pushed that is no part of the robot: {'; '.join(told)}. Without {rest} of the log:"


def _with_values(gap: Gap) -> tuple[str, list[str]]:
    """The answer, with other values of the config's parameters."""
    sentence, items = _answer(gap)
    if not any(map(is_named, gap.effects)) or gap.forces or not (values := corrected(gap)):
        return sentence, items
    others = f"other values of parameters: {joined(values, 4)}"
    return (sentence, [*items, f"and {others}"]) if items else (f"{sentence} And it has {others}.", items)


def _answer(gap: Gap) -> tuple[str, list[str]]:
    """The answer without other values of the config's parameters, unless there is nothing else."""
    named = [e for e in gap.effects if is_named(e)]
    unexplained = f"none of the {len(VOCABULARY)} known effects explains"
    if not gap.found:
        if values := corrected(gap):
            return f"Nothing is missing beside other values of parameters: {joined(values, 6)}.", []
        fitted = " once the parameters of the config are fitted" if gap.declared else ""
        if gap.lasting:
            return f"Nothing is missing{fitted} that predictions show: {reason(gap)}.", []
        return f"Nothing is missing{fitted}: what remains is measurement noise.", []
    if not named:
        if gap.refused:
            return f"Something is missing that has no name yet: {gap.refused}; {shows(gap)}.", []
        if gap.unfinished:
            late = f"the time for the search was over before it had a name{_closest(gap)}"
            return f"Something is missing, and {late}; {shows(gap)}.", []
        return f"Something is missing that {unexplained}{_closest(gap)}; {shows(gap)}.", []
    if gap.own_step is not None:
        own, finer = (short(x) for x in gap.own_step)
        step = f" (the model's own step leaves {own} times what noise would, a finer one {finer})"
    else:
        step = ""
    if gap.forces:
        return f"{_BY_FORCES.format(fallen(gap.forces))}:", by_force(named)
    if gap.joints:
        items = by_joint(named, gap.joints)
        rest = step if gap.remaining is None else f". They do not explain everything: {left(gap.remaining)}"
        return f"Friction, inertia, offset or delay of {_count(items)} joints are not those of your model{rest}:", items
    if len(named) == 1:
        rest = step if gap.remaining is None else f", but this does not explain everything: {left(gap.remaining)}"
        return f"{_clause(named[0])}: {_strengths(named[0])}{rest}.", []
    items = [
        f"{noun(e.effect, e.target)}: {'too much in the model, ' if _too_much(e) else ''}{_strengths(e)}" for e in named
    ]
    count = _count(items)
    differ = any(_too_much(e) or _mixed(e) or e.effect in _CLAUSES for e in named)
    rest = step if gap.remaining is None else f", which do not explain everything ({left(gap.remaining)})"
    return f"Your model {'and the robot differ in' if differ else 'lacks'} {count} things{rest}:", items


def corrected(gap: Gap) -> list[str]:
    """Return the config's parameters that are surely not what the model has, each with its value and what that is."""
    found = []
    for name, given in gap.fitted.items():
        own = gap.declared[name][0]
        least, most = (SURE * (end - given.value) for end in (given.low, given.high))
        if not least <= own - given.value <= most:
            found.append(f"{name} is {with_interval(given)}, not {plain(own)}")
    return found


def _closest(gap: Gap) -> str:
    """What would explain most of a gap that has no name, if it is most, in brackets."""
    whole = (r for r in gap.ranking if r.round == 0)  # later rounds tell what is left of what the ones before have left
    best = min(whole, key=lambda r: r.left if np.isfinite(r.left) else np.inf, default=None)
    if best is None or not best.left < CLOSE:
        return ""
    names = group(((best.effect, best.target), *best.together))
    return f" (the closest, {names}, leave{'' if best.together else 's'} {percent(best.left)} of it)"


def by_force(named: Sequence[NamedEffect]) -> list[str]:
    """Return an item for each effect that forces tell; centers of mass that are only known together are one."""
    kinds = [e.effect for e in named]
    grouped = [e for e in named if any(effect == e.effect in kinds for effect, _ in e.indistinguishable_from)]
    items = []
    for e in named:
        if e not in grouped:
            ends = f" (or {joined(rivals(e), 3)})" if e.indistinguishable_from else ""
            given = _members(e) if e.target == "*" else numbers(e.parameters)
            items.append(f"{noun(e.effect, e.target)}: {given}{ends}")
    if places := [str(e.target) for e in grouped]:
        items.append(f"mass or center of mass of {joined(places, 12)}: known together, not one by one; see the table")
    return items


def _members(effect: NamedEffect) -> str:
    return ", ".join(f"{target} {with_interval(given)}" for target, given in effect.parameters.items())


def _count(items: Sequence[str]) -> str:
    return _COUNTS[len(items)] if len(items) < len(_COUNTS) else str(len(items))


def by_joint(named: Iterable[NamedEffect], joints: Mapping[str, str]) -> list[str]:
    """Return an item for each joint, with what it has that the model lacks."""
    found: dict[str, list[str]] = {joint: [] for joint in joints.values()}
    for e in sorted(named, key=lambda e: list(_SHORT).index(e.effect)):
        members = e.parameters if e.target == "*" else {str(e.target): next(iter(e.parameters.values()))}
        for target, given in members.items():
            place = joints.get(target, target)  # an actuator that drives no single joint speaks for itself
            less = "too much in the model, " if e.effect in _SIGNED and given.value < 0 else ""
            found.setdefault(place, []).append(f"{_SHORT[e.effect]} {less}{with_interval(given)}")
    return [f"{joint}: {', '.join(members)}" for joint, members in found.items() if members]


def left(remaining: Remaining) -> str:
    """Return what named effects leave, and where and when it shows."""
    when = f"mostly at {remaining.where}{f', {remaining.when}' if remaining.when else ''}"
    far = f"open-loop errors are {short(remaining.open_loop)} times what noise makes"
    astray = remaining.open_loop > Sound().astray
    if astray and remaining.chi2_per_degree < Sound().rest:
        return f"short stretches show no more than noise, but {far}, {when}"
    size = f"what remains is {short(remaining.chi2_per_degree)} times what noise would leave (χ² per degree of freedom)"
    return f"{size}, {when}{f'; {far}' if astray else ''}"


def shows(gap: Gap) -> str:
    """Return where and when the gap shows."""
    if not gap.where:
        return "this log does not show where"
    first = gap.where[0]
    where = "in the whole model" if first.name is None else f"at {place_name(first)}"
    return f"it shows {where}{f', {first.when}' if first.when else ''}"


def change(gap: Gap) -> str:
    """Return what the effects, or the gap, do to open-loop predictions on held-out data."""
    values = [s.rollout_rmse for s in (gap.before, gap.after, gap.noise_floor)]
    before, after, floor = (_error(v, position_unit(gap)) for v in values)
    bottom = f"(noise floor {floor})"
    named = sum(map(is_named, gap.effects))
    if not named:
        whose = "" if np.isnan(values[0]) else " of your model"
        start = f"The open-loop error{whose}{span(gap)} on held-out data is {before} {bottom}."
        return start if gap.found else f"{start} {_CANNOT_RULE_OUT}"
    start = f"With {'it' if named == 1 else 'them'} in the model, the open-loop error{span(gap)} on held-out data"
    if np.isnan(values[:2]).any():
        return f"{start} goes from {before} to {after} {bottom}."
    if values[1] == values[0]:
        return f"{start} stays at {before} {bottom}."
    shrunk = gap.closed
    end = f": the gap shrank by {percent(shrunk)}" if shrunk > 0 else ""
    return f"{start} {'falls' if values[1] < values[0] else 'rises'} from {before} to {after} {bottom}{end}."


def span(gap: Gap) -> str:
    """Return how long open-loop predictions go, as it follows on what they are."""
    return f" over {plain(gap.rollout_seconds)} s" if gap.rollout_seconds > 0 else ""


def position_unit(gap: Gap) -> str:
    """Return the unit of the open-loop error: that of all positions, or nothing where they differ."""
    units = {u for u in gap.units if u in ("rad", "m")}
    return units.pop() if len(units) == 1 else ""


def chi(gap: Gap) -> str:
    """Return what χ² per degree of freedom says."""
    before, after = ("not known" if np.isnan(v) else short(v) for v in gap.reduced)
    what = "χ² per degree of freedom compares the misfit with the noise; about 1 means that only noise is left."
    if not any(map(is_named, gap.effects)):
        fitted = "with its declared parameters fitted" if gap.declared else "as it is"
        return f"{what} It is {before} for your model {fitted}."
    return f"{what} It was {before} before, and is {after} with the effects."


def _error(value: float, unit: str) -> str:
    """An open-loop error in words."""
    if np.isnan(value):
        return "not known"
    if np.isposinf(value):
        return "∞ (it diverges)"
    return with_unit(short(value), unit).replace(" ", "\u00a0")


def _clause(effect: NamedEffect) -> str:
    missing = noun(effect.effect, effect.target)
    if _too_much(effect):
        return f"Your model has too much {missing.removeprefix('a ')}"
    if _mixed(effect):
        return f"Your model has too little or too much {missing.removeprefix('a ')}"
    kind = next((name for name in (effect.variant, effect.effect) if name in _CLAUSES), None)
    if kind is None:
        return f"Your model lacks {missing}"
    text = _CLAUSES[kind].format(_at(effect.effect, effect.target))
    return text[0].upper() + text[1:] if text.startswith(("actuator ", "all ", "the world ")) else text


def _signs(effect: NamedEffect) -> set[bool]:
    """Whether the model has too much of an effect, wherever that can be said; of a family at each of its places."""
    given = list(effect.parameters.values())[: None if effect.target == "*" else 1]
    return {s.value < 0 for s in given} if effect.effect in _SIGNED else set()


def _too_much(effect: NamedEffect) -> bool:
    return _signs(effect) == {True}


def _mixed(effect: NamedEffect) -> bool:
    return len(_signs(effect)) > 1


def _strengths(effect: NamedEffect) -> str:
    own = effect.parameters
    if effect.effect in _MULTIPLES:
        own = {name: replace(given, unit="times the model's") for name, given in own.items()}
    if effect.target == "*":
        return numbers(own, str)
    said = _QUANTITIES.get(effect.variant or effect.effect, "{}")
    return numbers(own, lambda name: said.format(quantity(name)))


def _at(effect: str, target: str | None) -> str:
    if target is None:
        return "the world"
    if target == "*":
        return _all(effect)
    kind = effect.split("_")[0]
    return f"{kind} {target}" if kind in ("actuator", "tendon") else target


def _all(effect: str) -> str:
    return all_of(VOCABULARY[effect].kind if effect in VOCABULARY else "joint")


def _digits(value: float, half: float) -> str:
    """A number with the digits that half the width of its interval supports."""
    if not np.isfinite(value) or not np.isfinite(half) or half <= 0:
        return number(value)
    exponent = int(np.floor(np.log10(half)))
    decimals = -exponent + (half / 10.0**exponent < 1.5)
    if decimals > 6 or abs(value) >= 1e6:
        return number(value, half)
    text = f"{round(value, decimals):,.{max(decimals, 0)}f}"
    return (text[1:] if not text.strip("-0.,") and text.startswith("-") else text).replace("-", "−")
