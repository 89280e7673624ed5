"""The base family: what a real joint has besides geometry and mass, fitted at every joint at once.

A robot's joints have rotor inertia, viscous and dry friction, an offset and a delay, all of them. No search that adds
one effect after another finds these: each alone explains next to nothing while the others are missing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from dropo_torch.effects import find_effect
from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Placed, Setting, object_number
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.refit import Hypothesis, Refit, refit, standard_errors
from dropo_torch.gap.rules import significant
from dropo_torch.gap.sound import absurd

#: The effects of a joint, or of the actuator that drives it. Each is one number.
BASE = ("armature", "joint_damping", "joint_friction", "actuator_bias", "actuator_delay")


def base_family(setting: Setting) -> list[Placed]:
    """Return the base family at every joint and actuator, each where its search begins."""
    effects = [find_effect(name) for name in BASE]
    return [Placed(e, t, tuple(e.starts(setting, t)[0].tolist())) for e in effects for t in e.targets(setting)]


def with_family(ground: Ground, state: State, found: State) -> State:
    """Put the base family in the place of the first effects found, where these leave much and it leaves far less.

    At several joints several members must be needed, each by its own standard error: what sits at one joint, or is of
    one kind, the search names one by one. What begins or ends at a bound of physics is no member.

    Args:
        ground: what the search stands on.
        state: where it stood before its first effects.
        found: where it stands with them.
    """
    setting, rules = ground.setting, ground.rules.family
    left = max(found.current.cost.excess, 0.0)
    family = base_family(setting)
    begin = state.base.hypothesis
    if setting.signals.contacts.any() or len({p.target for p in family if p.effect.kind == "joint"}) < 2:
        return found
    if not significant(found.current.cost, ground.rules) or left < rules.left * state.base.cost.excess:
        return found
    ground.report("fitting friction, inertia, offset and delay of all joints", 0.0)
    whole = ground.refit(begin.with_effects(family), iterations=rules.iterations)
    for number in range(rules.rounds):
        idle = {p.key for p in not_needed(ground, whole)}
        if not idle:
            break
        ground.report("fitting friction, inertia, offset and delay of all joints", (number + 1) / (rules.rounds + 1))
        placed = tuple(p for p in whole.hypothesis.placed if p.key not in idle)
        whole = ground.refit(replace(whole.hypothesis, placed=placed))
    else:
        return found
    if whole.cost.excess > rules.clearer * left or not spread_out(setting, whole.hypothesis, rules.members):
        return found
    return replace(found, current=whole, family=True, done=True, refused="")


def not_needed(ground: Ground, whole: Refit) -> list[Placed]:
    """Return members that are at a bound of physics, or else those that are no more than chance among so many.

    The latter one after another, by the derivatives at the fit: of two that do the same, one stays.
    """
    if bound := [placed for placed, _ in absurd(ground.part, whole, ground.rules.sound)]:
        return bound
    placed, first = whole.hypothesis.placed, len(whole.hypothesis.declared)
    least = stats.norm.isf(0.5 * ground.rules.chance.error / max(len(placed), 1))
    slope = flat_slope(ground, whole)
    normal, move = slope @ slope.T, np.zeros(len(slope))
    off, rows = offsets(ground.setting, whole), np.arange(len(slope))
    while len(rows) > first:
        errors = standard_errors(
            replace(whole, slope=whole.slope[rows], scale=whole.scale[rows]), ground.part.windows.episodes, lacking=True
        )
        deviations = np.abs((off + move)[rows] * whole.scale[rows]) / np.maximum(errors, 1e-300)
        deviations[:first] = np.inf
        weakest = int(np.argmin(deviations))
        if deviations[weakest] >= least:
            break
        rows = np.delete(rows, weakest)
        gone = np.setdiff1d(np.arange(len(slope)), rows)
        move = np.zeros(len(slope))
        move[gone] = -off[gone]
        kept = np.linalg.pinv(normal[np.ix_(rows, rows)], rcond=1e-12, hermitian=True)
        move[rows] = kept @ normal[np.ix_(rows, gone)] @ off[gone]
    return [p for i, p in enumerate(placed, first) if i not in rows]


def flat_slope(ground: Ground, whole: Refit) -> np.ndarray:
    """Return the derivatives of all residuals by all numbers, as the fit weighed them, ``(q, W·N)``."""
    return (whole.slope * np.reshape(ground.part.caps * whole.factor, (-1, 1))).reshape(len(whole.slope), -1)


def offsets(setting: Setting, whole: Refit) -> np.ndarray:
    """Return by how many scales each number differs from its neutral value ``(q,)``; declared parameters do not."""
    neutral = [p.effect.quantities(setting, p.target)[0].neutral for p in whole.hypothesis.placed]
    absent = np.concatenate([whole.hypothesis.declared, neutral])
    return np.asarray((whole.hypothesis.vector - absent) / whole.scale)


def shares_of(ground: Ground, whole: Refit) -> tuple[float, ...]:
    """Return the χ² that would come back without each effect, by the derivatives at the fit."""
    slope, first = flat_slope(ground, whole), len(whole.hypothesis.declared)
    variance = np.diag(np.linalg.pinv(slope @ slope.T, rcond=1e-12, hermitian=True))
    return tuple((offsets(ground.setting, whole) ** 2 / np.maximum(variance, 1e-300))[first:].tolist())


def family_ties(ground: Ground, whole: Refit) -> tuple[tuple[Placed, ...], ...]:
    """Return for each member those that could stand in its place at its joint, by the derivatives at the fit."""
    setting, hypothesis = ground.setting, whole.hypothesis
    taken = {p.key for p in hypothesis.placed}
    idle = [p for p in base_family(setting) if p.key not in taken]
    absent = [p.at(np.array([p.effect.quantities(setting, p.target)[0].neutral])) for p in idle]
    beside = refit(ground.part, hypothesis.with_effects(absent), linear=whole.linear, iterations=0)
    slope, first = flat_slope(ground, beside), len(hypothesis.declared)
    residual = (beside.residual * np.reshape(ground.part.caps * whole.factor, (-1, 1))).ravel()
    off, own = offsets(setting, beside), np.arange(len(hypothesis.vector))
    margin = max(ground.rules.alike.chi2, ground.rules.alike.share * whole.cost.excess)

    def left(rows: np.ndarray, gone: int | None) -> float:
        moved = residual if gone is None else residual - off[gone] * slope[gone]
        return float(((moved - slope[rows].T @ np.linalg.lstsq(slope[rows].T, moved, rcond=1e-9)[0]) ** 2).sum())

    with_all, found = left(own, None), []
    for index, member in enumerate(hypothesis.placed):
        at, joint = first + index, joint_of(setting, member)
        others = [j for j, p in enumerate(idle) if joint_of(setting, p) == joint]
        rest = np.delete(own, at)
        found.append(tuple(idle[j] for j in others if left(np.append(rest, len(own) + j), at) < with_all + margin))
    return tuple(found)


def spread_out(setting: Setting, hypothesis: Hypothesis, members: int) -> bool:
    """Return whether at least half of the joints, and two, have so many members each."""
    joints = [joint_of(setting, p) for p in hypothesis.placed]
    every = {joint_of(setting, p) for p in base_family(setting)} - {None}
    rich = sum(joints.count(j) >= members for j in every)
    return rich >= max(2, 0.5 * len(every))


def joint_of(setting: Setting, placed: Placed) -> int | None:
    """Return the joint at which a member of the family sits; ``None`` for what drives none."""
    if placed.effect.kind == "joint":
        return setting.joint(placed.target)
    return driven_joint(setting.model, object_number(setting.model, "actuator", placed.target))
