"""Which members of a base family are needed, joint by joint: what a joint's own columns lose without them decides."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.effects.joint import JointFrictionSlope
from dropo_torch.gap.accept import SOFT
from dropo_torch.gap.cancel import cancelling
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.limbs import joint_of, joint_of_column
from dropo_torch.gap.refit import Hypothesis, Refit, half_widths, resolved
from dropo_torch.gap.rules import remains
from dropo_torch.gap.shares import MANY, offsets
from dropo_torch.gap.sound import absurd

#: The member on top of which another one is that changes along the range.
FRICTION = "joint_friction"
#: What is reported.
STAGE = "fitting friction, inertia, offset and delay of all joints"


def excesses(ground: Ground, fitted: Refit) -> np.ndarray:
    """Return the excess in the columns of each joint and, at last, in all others, ``(J + 1,)``."""
    part, setting = ground.part, ground.setting
    known = setting.observation.labels
    joints = [joint_of_column(setting, label) if label in known else None for label in part.chart.labels]
    weights = np.where(fitted.linear.weights > 0, fitted.linear.weights, 1.0)
    of_rows = (fitted.residual**2 - 2 * np.log(weights)) * np.reshape(part.caps, (-1, 1)) ** 2
    of_features = of_rows.reshape(-1, part.chart.size).sum(0) - fitted.cost.degrees / part.chart.size
    last = setting.model.njnt
    return np.bincount([last if j is None else j for j in joints], of_features, last + 1)


def tolerated(ground: Ground, whole: Refit, share: float) -> np.ndarray:
    """Return the excess at each joint, ``(J + 1,)``, up to which a family with fewer members does as well.

    Args:
        ground: what the search stands on.
        whole: a fit of the family.
        share: of its excess at a joint, by which that may be larger.
    """
    own, sigma = excesses(ground, whole), whole.cost.sigma / np.sqrt(max(len(ground.part.chart.labels), 1))
    return own + np.maximum(share * own, ground.rules.alike.sigmas * sigma)


def needed(ground: Ground, whole: Refit) -> Refit | None:
    """Return a fitted family without members that are absurd or not needed; ``None`` if that comes to no end."""
    rules, tried = ground.rules.family, math.inf
    most = nothing = np.full(ground.setting.model.njnt + 1, math.inf)
    for number in range(rules.rounds):
        ground.report(STAGE, 0.5 + 0.5 * number / rules.rounds)
        idle = [placed for placed, _ in absurd(ground.part, whole, ground.rules.sound)]
        idle += pushing(ground.setting, whole.hypothesis)
        if idle:
            whole, most = _without(ground, whole, idle), nothing
            continue
        most = np.minimum(most, tolerated(ground, whole, rules.spare))
        idle = not_needed(ground, whole, most)
        if remains(whole.cost, ground.rules):
            idle = not_needed(ground, whole, most, of_all_joints(ground, whole.hypothesis.placed, idle))
        idle = idle[: int(min(len(idle), tried))]
        if not idle:
            undone = _without_what_cancels(ground, whole, most)
            if undone is whole:
                return whole
            whole = undone
            continue
        fewer = _without(ground, whole, idle)
        if (excesses(ground, fewer) <= most).all():
            whole, tried = fewer, math.inf
        else:  # by the derivatives it would not have mattered: half as many, the least needed
            tried = len(idle) // 2
    return whole if np.isfinite(most).all() else None


def of_all_joints(ground: Ground, placed: Sequence[Placed], idle: Sequence[Placed] = ()) -> set[tuple[str, str | None]]:
    """Return the members of kinds of which nearly all joints need one: then all of them have it.

    Where a model's own error and not the noise decides, whether one joint's friction is needed is a matter of chance,
    and whether a robot's joints have friction is not.

    Args:
        ground: what the search stands on.
        placed: the members of a family.
        idle: those of them that are not needed.
    """
    out, found = {p.key for p in idle}, set[tuple[str, str | None]]()
    for kind in dict.fromkeys(p.effect for p in placed):
        own, every = [p.key for p in placed if p.effect is kind], len(kind.targets(ground.setting))
        if len(own) >= MANY and len([key for key in own if key not in out]) >= ground.rules.family.nearly * every:
            found |= set(own)
    return found


def not_needed(
    ground: Ground, whole: Refit, most: np.ndarray, spared: Container[tuple[str, str | None]] = ()
) -> list[Placed]:
    """Return members without which a fit stays as good at their joints, by its derivatives, the least needed first.

    One after another: of two that do the same, one stays.

    Args:
        ground: what the search stands on.
        whole: a fit of the family.
        most: excess at each joint up to which members are dropped there, ``(J + 1,)``.
        spared: members that stay.
    """
    first, (slope, _) = len(whole.hypothesis.declared), whole.weighted(ground.part.caps)
    normal, off = slope @ slope.T, offsets(ground.setting, whole)
    every, placed = np.arange(len(slope)), whole.hypothesis.placed
    joints = np.array([-1] * first + [-1 if (j := joint_of(ground.setting, p)) is None else j for p in placed])
    spare, gone, kept = most - excesses(ground, whole), list[int](), set[int]()
    asked = [i for i in every[first:] if placed[i - first].key not in spared]
    while waiting := [i for i in asked if i not in gone and joints[i] not in kept]:
        rows = np.setdiff1d(every, gone)
        inverse = np.linalg.pinv(normal[np.ix_(rows, rows)], rcond=1e-12, hermitian=True)
        lost = normal[np.ix_(rows, np.array(gone, dtype=int))] @ off[gone]
        there = off[rows] + inverse @ lost  # what dropping the others has moved
        costs = dict(zip(rows, there**2 / np.maximum(np.diag(inverse), 1e-300), strict=True))
        weakest = min(waiting, key=lambda i: costs[i] / max(spare[joints[i]], 1e-300))
        there_gone = [i for i in [*gone, weakest] if joints[i] == joints[weakest]]
        if _cost_without(normal, off, np.setdiff1d(every, there_gone)) > spare[joints[weakest]]:
            kept.add(int(joints[weakest]))
        else:
            gone.append(int(weakest))
    return [placed[i - first] for i in gone]


def _cost_without(normal: np.ndarray, off: np.ndarray, rows: np.ndarray) -> float:
    """Return how much χ² grows where only some numbers stay, by the normal matrix and all numbers' offsets."""
    gone = np.setdiff1d(np.arange(len(off)), rows)
    inverse = np.linalg.pinv(normal[np.ix_(rows, rows)], rcond=1e-12, hermitian=True)
    across = normal[np.ix_(rows, gone)]
    schur = normal[np.ix_(gone, gone)] - across.T @ inverse @ across
    return float(off[gone] @ schur @ off[gone])


def _without_what_cancels(ground: Ground, whole: Refit, most: np.ndarray) -> Refit:
    """Return a fitted family without the first two members that undo each other, if any can go; else the same."""
    for pair in cancelling(ground.setting, whole):
        fewer = _without(ground, whole, [whole.hypothesis.placed[i] for i in pair])
        if (excesses(ground, fewer) <= most).all():
            return fewer
    return whole


def without_steps(ground: Ground, whole: Refit) -> Refit:
    """Return the family without members that only make up for the model's own step.

    Where a finer step is better, the interval that a member has there must not hold its neutral value, unless all
    joints have it. A slope of friction that is left without friction goes with it.
    """
    last = resolved(ground.part, whole)
    if last.fit is whole:
        return whole
    first, off = len(whole.hypothesis.declared), offsets(ground.setting, last.fit) * last.fit.scale
    within, placed = np.abs(off[first:]) < half_widths(last)[first:], whole.hypothesis.placed
    spared = of_all_joints(ground, placed) if remains(last.fit.cost, ground.rules) else set()
    idle = [p for p, absent in zip(placed, within, strict=True) if absent and p.key not in spared]
    fewer = _without(ground, whole, idle) if idle else whole
    pushes = pushing(ground.setting, fewer.hypothesis)
    return _without(ground, fewer, pushes) if pushes else fewer


def _without(ground: Ground, whole: Refit, idle: Sequence[Placed]) -> Refit:
    """Return the family fitted without some members."""
    keys = {p.key for p in idle}
    placed = tuple(p for p in whole.hypothesis.placed if p.key not in keys)
    return ground.refit(replace(whole.hypothesis, placed=placed))


def pushing(setting: Setting, hypothesis: Hypothesis) -> list[Placed]:
    """Return slopes by which dry friction would push somewhere in the measured range."""
    level = {p.target: p.values[0] for p in hypothesis.placed if p.effect.name in (FRICTION, SOFT)}
    found = []
    for p in hypothesis.placed:
        if isinstance(p.effect, JointFrictionSlope):
            away = setting.signals.position[setting.coordinate(p.target)] - p.effect.middle(setting.model, p.target)
            if level.get(p.target, 0.0) + min(p.values[0] * away) < 0:
                found.append(p)
    return found


def is_absent(setting: Setting, placed: Placed, edge: float) -> bool:
    """Return whether a member is within an ``edge``, in scales, of a bound of physics where nothing is left of it."""
    quantity = placed.effect.quantities(setting, placed.target)[0]
    bound = quantity.neutral in (quantity.low, quantity.high)
    return bound and abs(placed.values[0] - quantity.neutral) <= edge * quantity.scale
