"""Whether an answer, the document of a ``gap.json``, names what a robot's model lacks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.unseen.robot import Hidden, Name, Robot

#: How many names more than what is hidden an answer may have.
SPARE = 1
#: What is no physics, and so never a false name.
HARMLESS = "integration"

Entry = Mapping[str, Any]


@dataclass(frozen=True)
class Judgment:
    """What is right and wrong in an answer.

    Attributes:
        right: whether it names all that is hidden, and at most ``SPARE`` things more; or nothing, where it must not.
        why: what is wrong, in words.
        told: what the answer says, in words.
        extra: names that are not hidden.
        errors: relative errors of the numbers, by effect and parameter.
        held: whether their intervals hold the truth, likewise.
    """

    right: bool
    why: str
    told: str
    extra: tuple[Name, ...]
    errors: Mapping[str, float]
    held: Mapping[str, bool]


def judge(robot: Robot, document: Mapping[str, Any]) -> Judgment:
    """Compare an answer with the truth."""
    effects: list[Entry] = document.get("effects") or []
    entries = [e for e in effects if e["effect"] != "unnamed"]
    is_unnamed = len(entries) < len(effects)
    known = [h for h in robot.hidden if not h.is_outside]
    accepted = {*robot.beside, *(name for h in known for name in (*h.names, *h.equals))}
    extra = tuple(name for e in entries for name in _extra(e, accepted))
    missing = _missing(known, entries)
    if robot.is_outside or not robot.hidden:
        why = _named_in_vain(extra, is_unnamed, must_be=robot.is_outside)
    else:
        why = _amiss(document, missing, extra)
    numbers = [_numbers(h, e) for h in known for e in entries]
    return Judgment(
        right=not why,
        why=why,
        told=", ".join(_words(e["effect"], e.get("target")) for e in effects) or str(document.get("verdict")),
        extra=extra,
        errors={k: error for found in numbers for k, (error, _) in found.items()},
        held={k: holds for found in numbers for k, (_, holds) in found.items() if holds is not None},
    )


def required(robot: Robot) -> list[str]:
    """Return what an answer must name, in words."""
    return [_words(*h.names[0]) for h in robot.hidden if not h.is_outside]


def _named_in_vain(extra: Sequence[Name], is_unnamed: bool, must_be: bool) -> str:
    """What is wrong with an answer where no effect of the vocabulary is hidden, and, maybe, something unnamed is."""
    if extra:
        return "named in vain: " + _list(extra)
    if is_unnamed and not must_be:
        return "something unnamed is claimed"
    return "it says that nothing is missing" if must_be and not is_unnamed else ""


def _amiss(document: Mapping[str, Any], missing: Sequence[Hidden], extra: Sequence[Name]) -> str:
    """What is wrong with an answer where effects of the vocabulary are hidden."""
    if missing and document.get("verdict") == "no gap":
        moved = _moved(document)
        return "no gap" + (f", as parameters of the config take its place: {', '.join(moved)}" if moved else "")
    if missing:
        return "not named: " + _list([h.names[0] for h in missing])
    return "too many names: " + _list(extra) if len(extra) > SPARE else ""


def _moved(document: Mapping[str, Any]) -> list[str]:
    """The config's parameters whose intervals do not hold what the model has, and what notes say, in words."""
    found = []
    for name, told in (document.get("declared") or {}).items():
        given, value = told["given"], told["with_effects"]
        low, high = (value if told.get(k) is None else told[k] for k in ("low", "high"))
        if not low <= given <= high:
            found.append(f"{name} {given:.4g} → {value:.4g}")
    return found + [str(note) for note in document.get("notes") or []]


# --- names ------------------------------------------------------------------------------------------------------


def _own_names(entry: Entry) -> set[Name]:
    """An entry's effect at its target; at all its places, if there are several."""
    if entry.get("target") == "*":
        return {(entry["effect"], place) for place in entry.get("parameters") or {}}
    return {(entry["effect"], entry.get("target"))}


def _all_names(entry: Entry) -> set[Name]:
    """An entry's names, and those of what it says to be as good."""
    others = entry.get("indistinguishable_from") or []
    return _own_names(entry) | {(e["effect"], e.get("target")) for e in others}


def _missing(known: Sequence[Hidden], entries: Sequence[Entry]) -> list[Hidden]:
    """What has no entry of its own that names it, or says to be no better."""
    left, found = list(entries), []
    for names_of in (_own_names, _all_names):
        for hidden in (h for h in known if h not in found):
            entry = next((e for e in left if names_of(e) & {*hidden.names, *hidden.equals}), None)
            if entry is not None:
                left.remove(entry)
                found.append(hidden)
    return [h for h in known if h not in found]


def _extra(entry: Entry, accepted: set[Name]) -> list[Name]:
    """What an entry names that is not hidden; one that says to be no better than what is hidden names that."""
    own = _own_names(entry)
    if entry["effect"] == HARMLESS or (len(own) == 1 and _all_names(entry) & accepted):
        return []
    return sorted(own - accepted, key=str)


def _words(effect: str, target: str | None) -> str:
    return f"{effect} {target or ''}".strip()


def _list(names: Sequence[Name]) -> str:
    return ", ".join(_words(*name) for name in names)


# --- numbers ----------------------------------------------------------------------------------------------------


def _numbers(hidden: Hidden, entry: Entry) -> dict[str, tuple[float, bool | None]]:
    """Relative error of each number, and whether its interval holds the truth, if the entry has one of its names."""
    if not _own_names(entry) & set(hidden.names):
        return {}
    told, found = _aligned(entry.get("parameters") or {}, hidden.values), {}
    for key, true in hidden.values.items():
        if key in told:
            value, low, high = (told[key].get(k) for k in ("value", "low", "high"))
            holds = None if low is None or high is None else low <= true <= high
            found[f"{entry['effect']}.{key}"] = (abs(value - true) / abs(true), holds)
    return found


def _aligned(told: Mapping[str, Any], true: Mapping[str, float]) -> dict[str, Any]:
    """Told numbers of a wave with an amplitude above 0, and a phase within half a turn of the true one."""
    told = {k: dict(v) for k, v in told.items()}
    if "phase" not in told or "phase" not in true:
        return told
    wave, phase = told["amplitude"], told["phase"]
    turns = 0.0
    if wave["value"] < 0:
        told["amplitude"] = {"value": -wave["value"], "low": _minus(wave["high"]), "high": _minus(wave["low"])}
        turns = 0.5
    turns -= round((phase["value"] - true["phase"]) / (2 * math.pi) + turns)
    told["phase"] = {k: None if v is None else v + 2 * math.pi * turns for k, v in phase.items() if k != "unit"}
    return told


def _minus(value: float | None) -> float | None:
    return None if value is None else -value
