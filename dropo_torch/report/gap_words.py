"""What a search for a gap says, in plain words: effects, places, numbers with intervals, the answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dropo_torch.effects import VOCABULARY
from dropo_torch.gap.result import Gap, NamedEffect, Place, Strength
from dropo_torch.report import figures, words

UNNAMED = "unnamed"
#: Times below this are given in milliseconds, in seconds.
SHORT = 0.1
#: Effects with more numbers than this give but the first in the answer.
MOST_NUMBERS = 3
#: What is missing, as it follows on "Your model lacks".
_NOUNS = {
    "joint_damping": "viscous friction in {0}",
    "joint_quadratic_damping": "friction in {0} that grows with the square of its velocity",
    "joint_friction": "dry (Coulomb) friction in {0}",
    "joint_stribeck": "dry friction in {0} that is larger at rest than in motion (Stribeck)",
    "joint_stiffness": "a spring at {0}",
    "joint_cogging": "a force at {0} that ripples with its position (cogging)",
    "armature": "rotor or gear inertia (armature) at {0}",
    "joint_limit": "other stops of {0}",
    "joint_coupling": "a spring between {0} and the joint before it in the chain",
    "payload": "a mass on {0}",
    "center_of_mass": "another centre of mass of {0}",
    "inertia": "other moments of inertia of {0}",
    "external_force": "a constant force on {0} from outside",
    "fluid_drag": "drag of air or water on {0}",
    "gravity_tilt": "a tilt of the base against gravity",
    "ground_slope": "a slope of the ground",
    "integration": "a finer integration step",
    "actuator_gain": "another gain of {0}",
    "actuator_bias": "a constant force from {0}",
    "actuator_damping": "braking by {0} in proportion to its velocity",
    "actuator_delay": "a delay of the commands to {0}",
    "actuator_lag": "a first-order lag of {0}",
    "actuator_deadband": "a deadband of {0}",
    "actuator_backlash": "play (backlash) of {0}",
    "actuator_saturation": "a limit to the force of {0}",
    "sensor_bias": "an offset in the measurement of {0}",
    "sensor_scale": "a wrong factor in the measurement of {0}",
    "sensor_delay": "a delay of the measurement of {0}",
    "contact_friction": "another sliding friction of {0}",
    "contact_stiffness": "softer or stiffer contacts of {0}",
    "contact_margin": "contacts of {0} that act from a distance on",
}
#: Whole clauses where "Your model lacks" does not fit.
_CLAUSES = {
    "joint_limit": "The stops of {0} sit elsewhere than in your model",
    "center_of_mass": "The centre of mass of {0} sits elsewhere than in your model",
    "inertia": "The moments of inertia of {0} are not those of your model",
    "gravity_tilt": "The base does not stand level as in your model",
    "ground_slope": "The ground is not level as in your model",
    "integration": "The integration step of your model is too coarse for this motion",
    "actuator_gain": "{0} gives another force for the same command than in your model",
    "sensor_bias": "The measurement of {0} is off by a constant",
    "sensor_scale": "The measurement of {0} is off by a factor",
    "sensor_delay": "The measurement of {0} comes late",
    "contact_friction": "The sliding friction of {0} is not that of your model",
    "contact_stiffness": "The contacts of {0} are softer or stiffer than in your model",
}
#: Effects whose first number, if negative, says that the model has too much of them.
_SIGNED = ("joint_damping", "joint_quadratic_damping", "joint_friction", "joint_stiffness", "armature",
           "actuator_damping", "contact_margin")  # fmt: skip
_COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_BEGINS = ("when", "while", "at", "in", "on", "near", "during", "after", "before", "where", "as", "with", "without",
           "under", "above", "below", "around", "only", "mostly", "if", "for", "over", "within", "from")  # fmt: skip
_ALWAYS = ("always", "everywhere", "throughout", "all the time", "at all times", "evenly")


def is_named(effect: NamedEffect) -> bool:
    """Return whether an effect is one of the vocabulary."""
    return effect.effect != UNNAMED


def noun(effect: str, target: str | None) -> str:
    """Return an effect and its place as a noun phrase."""
    if effect in _NOUNS:
        return _NOUNS[effect].format(_at(effect, target))
    name = "something without a name" if effect == UNNAMED else effect.replace("_", " ")
    return f"{name} at {_at(effect, target)}" if target else name


def title(effect: str) -> str:
    """Return an effect's name for a table."""
    return "no name" if effect == UNNAMED else effect.replace("_", " ")


def target_name(effect: str, target: str | None) -> str:
    """Return where an effect sits, for a table."""
    if target is None:
        return "the whole model" if effect != UNNAMED else "not known"
    return _all(effect) if target == "*" else target


def place_name(place: Place) -> str:
    """Return a place in words."""
    if place.name is None:
        return place.kind
    return f"all {place.kind}s" if place.name == "*" else f"{place.kind} {place.name}"


def places(values: Iterable[tuple[str, str | None]]) -> list[tuple[str, str]]:
    """Return effects, each with all its targets in words, in the order of first mention."""
    groups: dict[str, list[str]] = {}
    for effect, target in values:
        groups.setdefault(effect, []).append(target_name(effect, target))
    return [(title(e), words.joined(list(dict.fromkeys(t)), 12)) for e, t in groups.items()]


def either(items: list[str]) -> str:
    """Return alternatives in words, cut where they are many."""
    if len(items) > words.MOST_NAMED:
        return f"{', '.join(items[: words.MOST_NAMED])} or one of {len(items) - words.MOST_NAMED} more"
    return " or ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def strength(number: Strength) -> tuple[str, str, str]:
    """Return value, interval and unit of a number in words, with as many digits as the interval supports."""
    value, low, high = number.value, number.low, number.high
    unit = "" if number.unit in ("-", "1") else number.unit
    known = [abs(v) for v in (value, low, high) if np.isfinite(v)]
    if unit == "s" and known and max(known) < SHORT:
        value, low, high, unit = 1000 * value, 1000 * low, 1000 * high, "ms"
    half = 0.5 * (high - low) if np.isfinite(high - low) else float("nan")
    shown = [_digits(v, half) for v in (value, low, high)]
    interval = "" if np.isnan(low) or np.isnan(high) else f"{shown[1]} to {shown[2]}"
    return shown[0], interval, unit


def degrees(number: Strength) -> str:
    """Return an angle in degrees, or nothing where it is none."""
    if number.unit != "rad" or not np.isfinite(number.value):
        return ""
    return f"{_short(float(np.degrees(number.value)))}°"


def with_interval(number: Strength) -> str:
    """Return a number with unit and interval, as in ``0.150 N·m (0.148 to 0.152)``."""
    value, interval, unit = strength(number)
    return f"{value}{f' {unit}' if unit else ''} ({interval or 'interval not known'})".replace(" ", "\u00a0")


def numbers(parameters: Mapping[str, Strength]) -> str:
    """Return all numbers of an effect, or the first of many."""
    if not parameters:
        return "strength not known"
    if len(parameters) == 1:
        return with_interval(next(iter(parameters.values())))
    shown = list(parameters.items())[: MOST_NUMBERS if len(parameters) <= MOST_NUMBERS else 1]
    more = "" if len(shown) == len(parameters) else "; more in the table"
    return ", ".join(f"{quantity(n)} {with_interval(s)}" for n, s in shown) + more


def quantity(name: str) -> str:
    """Return a quantity's name in words."""
    return name.replace("_", " ")


def answer(gap: Gap) -> tuple[str, list[str]]:
    """Return what is missing in one sentence, and the items of a list that it announces, if any."""
    named = [e for e in gap.effects if is_named(e)]
    if not gap.found:
        return "Nothing is missing: what remains is measurement noise.", []
    if not named:
        return f"Something is missing that none of the {len(VOCABULARY)} known effects explains; {shows(gap)}.", []
    if len(named) == 1 and len(gap.effects) == 1:
        return f"{_clause(named[0])}: {numbers(named[0].parameters)}.", []
    items = [f"{noun(e.effect, e.target)}: {_excess(e)}{numbers(e.parameters)}" for e in named]
    if len(named) < len(gap.effects):
        items.append(f"something that none of the {len(VOCABULARY)} known effects explains")
    count = _COUNTS[len(items)] if len(items) < len(_COUNTS) else str(len(items))
    if any(_too_much(e) or e.effect in _CLAUSES for e in named):
        return f"Your model and the robot differ in {count} things:", items
    return f"Your model lacks {count} things:", items


def shows(gap: Gap) -> str:
    """Return where and when the gap shows."""
    if not gap.where:
        return "this log does not tell where"
    first = gap.where[0]
    if first.name is None:
        return f"it shows in the whole model{_when(first.when)}"
    return f"it shows at {place_name(first)}{_when(first.when)}"


def change(gap: Gap) -> str:
    """Return what the effects, or the gap, do to open-loop predictions on held-out data."""
    before, after, floor = (s.rollout_rmse for s in (gap.before, gap.after, gap.noise_floor))
    unit = position_unit(gap)
    span = f" over {_plain(gap.rollout_seconds)} s" if gap.rollout_seconds > 0 else ""
    what = f"open-loop error{span} on held-out data"

    def of(value: float) -> str:
        if np.isposinf(value):
            return "∞ (it diverges)"
        return f"{_short(value)}{f' {unit}' if unit and np.isfinite(value) else ''}".replace(" ", "\u00a0")

    bottom = "noise floor not known" if np.isnan(floor) else f"noise floor {of(floor)}"
    named = [e for e in gap.effects if is_named(e)]
    if not named:
        end = "" if gap.found else " An effect that is weaker than the noise, or that this motion does not call on, " \
            "cannot be ruled out."  # fmt: skip
        if np.isnan(before):
            return f"The {what} is not known ({bottom}).{end}"
        return f"The open-loop error of your model{span} on held-out data is {of(before)} ({bottom}).{end}"
    pronoun = "it" if len(named) == 1 else "them"
    if np.isnan(before) or np.isnan(after):
        return (
            f"With {pronoun} in the model, the {what} goes from {_known(before, of)} to {_known(after, of)} ({bottom})."
        )
    verb = "falls" if after < before else "stays" if after == before else "rises"
    text = f"With {pronoun} in the model, the {what} {verb} from {of(before)} to {of(after)} ({bottom})"
    if verb == "stays":
        text = f"With {pronoun} in the model, the {what} stays at {of(before)} ({bottom})"
    shrunk = shrinkage(gap)
    return f"{text}: the gap shrank by {percent(shrunk)}." if shrunk > 0 else f"{text}."


def shrinkage(gap: Gap) -> float:
    """Return the share of the open-loop error above the noise floor that is gone; NaN where that says nothing."""
    before, after, floor = (s.rollout_rmse for s in (gap.before, gap.after, gap.noise_floor))
    if not np.isfinite([before, after, floor]).all() or before <= floor:
        return float("nan")
    return float(np.clip((before - after) / (before - floor), -np.inf, 1.0))


def position_unit(gap: Gap) -> str:
    """Return the unit of the open-loop error: that of all positions, or nothing where they differ."""
    units = {u for u in gap.units if u in ("rad", "m")}
    return units.pop() if len(units) == 1 else ""


def chi(gap: Gap) -> str:
    """Return what χ² per degree of freedom says."""
    before, after = gap.reduced
    what = "χ² per degree of freedom compares the misfit with the noise; about 1 means that only noise is left."
    if not any(is_named(e) for e in gap.effects):
        return f"{what} It is {_known(before, _short)} for your model with its declared parameters fitted."
    return f"{what} It was {_known(before, _short)} before, and is {_known(after, _short)} with the effects."


def percent(share: float) -> str:
    """Return a share in percent."""
    if not np.isfinite(share):
        return "not known"
    size = abs(100 * share)
    if size == 0:
        return "0\u00a0%"
    if 0 < 100 - size < 1:
        text = f"{size:.2f}" if 100 - size < 0.1 else f"{size:.1f}"
        text = "100" if size > 99.995 else text
    elif size < 0.001:
        return "below 0.001\u00a0%"
    else:
        text = f"{size:.0f}" if size >= 10 else f"{size:.2g}"
    return f"{'−' if share < 0 else ''}{text}\u00a0%"


def _clause(effect: NamedEffect) -> str:
    if _too_much(effect):
        return f"Your model has too much {noun(effect.effect, effect.target).removeprefix('a ')}"
    if effect.effect in _CLAUSES:
        text = _CLAUSES[effect.effect].format(_at(effect.effect, effect.target))
        return text[0].upper() + text[1:] if text.startswith(("actuator ", "all ", "the world ")) else text
    return f"Your model lacks {noun(effect.effect, effect.target)}"


def _excess(effect: NamedEffect) -> str:
    return "too much in the model, " if _too_much(effect) else ""


def _too_much(effect: NamedEffect) -> bool:
    first = next(iter(effect.parameters.values()), None)
    return effect.effect in _SIGNED and first is not None and first.value < 0


def _at(effect: str, target: str | None) -> str:
    if target is None:
        return "the world"
    if target == "*":
        return _all(effect)
    return f"actuator {target}" if effect.startswith("actuator_") else target


def _all(effect: str) -> str:
    kind = VOCABULARY[effect].kind if effect in VOCABULARY else "joint"
    return {"body": "all bodies", "sensor": "all sensors"}.get(kind, f"all {kind}s")


def _when(when: str) -> str:
    """A regime as it ends a sentence."""
    text = when.strip().rstrip(".")
    if not text:
        return ""
    if text.lower().startswith(_ALWAYS):
        return f", {text}"
    begin = text.split()[0].lower()
    text = text if begin in _BEGINS else f"when {text}"
    return f", {text}" if begin in ("only", "mostly") else f", mostly {text}"


def _digits(value: float, half: float) -> str:
    """A number with the digits that half the width of its interval supports."""
    if not np.isfinite(value) or not np.isfinite(half) or half <= 0:
        return words.number(value)
    exponent = int(np.floor(np.log10(half)))
    decimals = -exponent + (half / 10.0**exponent < 1.5)
    if decimals > 6 or abs(value) >= 1e6:
        return words.number(value, half)
    text = f"{round(value, decimals):,.{max(decimals, 0)}f}"
    return (text[1:] if not text.strip("-0.,") and text.startswith("-") else text).replace("-", "−")


def _short(value: float) -> str:
    """A number with three digits."""
    return words.number(value) if not np.isfinite(value) else _plain(float(f"{value:.3g}"))


def _plain(value: float) -> str:
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e9 else figures.plain(value)


def _known(value: float, of: object) -> str:
    return "not known" if np.isnan(value) else of(value)  # type: ignore[operator]
