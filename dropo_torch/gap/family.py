"""The base family: what a real joint has besides geometry and mass, fitted at every joint at once.

A robot's joints have rotor inertia, viscous and dry friction, an offset and a delay, all of them. No search that adds
one effect after another finds these: each alone explains next to nothing while the others are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Container, Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.effects.joint import JointFrictionSlope
from dropo_torch.gap.accept import ROUGHLY, SOFT, beats, extend, is_of_step, sound, with_soft_friction
from dropo_torch.gap.cancel import cancelling
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.limbs import joint_of, joint_of_column
from dropo_torch.gap.refit import Hypothesis, Refit, half_widths, refit, resolved
from dropo_torch.gap.rules import remains, significant
from dropo_torch.gap.screen import nearer
from dropo_torch.gap.shares import MANY, offsets
from dropo_torch.gap.sound import absurd

#: The effects of a joint, or of the actuator that drives it. Each is one number.
BASE = ("armature", "joint_damping", "joint_friction", "actuator_bias", "actuator_delay")
#: One more of them, where what these leave is more than noise; and those on top of which it is.
SLOPE, FRICTION = "joint_friction_slope", "joint_friction"
#: Numbers that a base family may have more than effects that have about as many.
ABOUT = 1

#: Iterations of a fit without some of its delays.
AGAIN = 12

#: What is reported.
STAGE = "fitting friction, inertia, offset and delay of all joints"


def base_family(setting: Setting, known: Sequence[Effect] | None = None) -> list[Placed]:
    """Return the base family at every joint and actuator, each where its search begins.

    Args:
        setting: the model and its columns.
        known: the vocabulary to which it is confined; all of it by default.
    """
    effects = [find_effect(name) for name in BASE]
    effects = [e for e in effects if known is None or e in known]
    return [Placed(e, t, tuple(e.starts(setting, t)[0].tolist())) for e in effects for t in e.targets(setting)]


def with_family(ground: Ground, state: State, found: State) -> State:
    """Put the base family in the place of the first effects found, where these leave much and it leaves far less.

    At several joints several members must be needed: what sits at one joint, or is of one kind, the search names
    one by one. What a coarse step does to stiff servos is no member, although inertia, friction and delay of every
    joint together make up for it. Where the first effects are not one effect at several joints already, it must
    leave next to nothing of what they leave. What ends at a bound of physics is no member. Where one effect more
    beside the first ones leaves no more than noise, or less than the family that leaves more, the search goes on with
    these.

    Args:
        ground: what the search stands on.
        state: where it stood before its first effects.
        found: where it stands with them.
    """
    rules = ground.rules.family
    if not has_family(ground) or not significant(found.current.cost, ground.rules):
        return found
    kind = one_kind(found.current.hypothesis)
    best = found if found.done or kind else extend(ground, found)  # what contains the first effects may be the truth
    cost = best.current.cost
    if not significant(cost, ground.rules) or cost.left_of(state.base.cost) < rules.left:
        return found
    if is_of_step(ground, best.current):
        return found
    beside = with_one_more(ground, best)
    if beside and (not significant(beside[0].cost, ground.rules) or is_of_step(ground, beside[0])):
        return replace(best, current=beside[0])
    most = rules.hopeless * rules.clearer[int(kind)]
    if leaves_too_much(ground, state.base.hypothesis, best.current.hypothesis, most):
        return found
    fitted = fitted_family(ground, state.base.hypothesis)
    if fitted.cost.left_of(cost) > most:
        return found
    whole = whole_family(ground, fitted)
    if whole is None or is_surpassed(ground, beside, whole):
        return found
    if whole.cost.left_of(cost) > rules.clearer[int(kind)] and not is_plainer(ground, beside, whole):
        return found
    return replace(found, current=whole, family=True, done=True, refused="")


def with_one_more(ground: Ground, found: State) -> list[Refit]:
    """Return the first effects with one more beside them, the best first, where these explain most of the gap.

    What several joints lack, such as a delay, may hide what one body lacks, of which every member of a base family
    would take a part.
    """
    current = found.current
    if found.done or not current.hypothesis.placed or current.cost.left_of(found.base.cost) > 1 - ground.rules.most:
        return []
    alive = [c for c in ground.screened(current) if not c.dead][: ground.rules.tried.refits]
    focus = ground.focus(current)
    groups = [(nearer(focus, current.hypothesis, c),) for c in alive]
    singles, _ = ground.refits(found, current, groups, STAGE)
    return [r for r in sound(ground, singles) if beats(ground, r, current)]


def is_surpassed(ground: Ground, beside: Sequence[Refit], whole: Refit) -> bool:
    """Return whether one effect more beside the first ones leaves less than the base family, where that leaves more."""
    return significant(whole.cost, ground.rules) and any(r.cost.excess < whole.cost.excess for r in beside)


def is_plainer(ground: Ground, beside: Sequence[Refit], whole: Refit) -> bool:
    """Return whether the base family leaves far less than effects with one more beside them that have about as many
    numbers.

    One effect that has several numbers, such as a payload, may take in so much that the family does not leave next to
    nothing of the rest.
    """
    numbers = len(whole.hypothesis.vector)
    alike = [r for r in beside[:1] if numbers <= len(r.hypothesis.vector) + ABOUT]
    return any(whole.cost.left_of(r.cost) <= ground.rules.family.clearer[1] for r in alike)


def has_family(ground: Ground) -> bool:
    """Return whether the model has joints enough for a base family, and touches nothing."""
    joints = {joint_of(ground.setting, p) for p in base_family(ground.setting, ground.effects)} - {None}
    return not ground.setting.signals.contacts.any() and len(joints) >= ground.rules.family.joints


def whole_family(ground: Ground, fitted: Refit) -> Refit | None:
    """Return the fitted base family with the members that are needed, if several are at several joints."""
    whole = needed(ground, fitted)
    for refined in (softened, with_slopes, softened):
        whole = None if whole is None else refined(ground, whole)
    whole = None if whole is None else without_steps(ground, whole)
    if whole is None or not spread_out(ground.setting, whole.hypothesis, ground.rules.family.members):
        return None
    return whole


def leaves_too_much(ground: Ground, begin: Hypothesis, rival: Hypothesis, most: float) -> bool:
    """Return whether the base family leaves more than a share of what a fitted rival leaves, on few windows."""
    ground.report(STAGE, 0.0)
    few = ground.part.few(ROUGHLY)
    iterations = ground.rules.family.iterations
    fits = _in_turn(ground, begin, lambda h: refit(few, h, iterations=iterations, slopes=False))
    rough = min(fits, key=lambda r: r.loss)
    return rough.cost.left_of(refit(few, rival, iterations=0, slopes=False).cost) > most


def fitted_family(ground: Ground, begin: Hypothesis) -> Refit:
    """Return the base family fitted at every joint, with delays where inertia and damping do not do as well.

    A delay of a servo, its inertia and its damping nearly stand for each other. So all joints are fitted without delays
    first, and a joint has one only where the log is clearly nearer with it, or where its inertia or damping would have
    to vanish in its place.
    """
    ground.report(STAGE, 0.1)
    prompt, late = _in_turn(ground, begin, lambda h: ground.refit(h, iterations=ground.rules.family.iterations))
    return without_needless_delays(ground, prompt, late)


def without_needless_delays(ground: Ground, prompt: Refit, late: Refit) -> Refit:
    """Return a fit with delays without those of joints at which the numbers of the fit without any do as well.

    Args:
        ground: what the search stands on.
        prompt: the fit without delays.
        late: the fit with them.
    """
    most, setting = tolerated(ground, late), ground.setting
    numbers, placed = {p.key: p for p in prompt.hypothesis.placed}, late.hypothesis.placed

    def fitted(joints: Collection[int | None], iterations: int) -> Refit:
        kept = [p for p in placed if not (p.effect.is_filter and joint_of(setting, p) in joints)]
        moved = [numbers.get(p.key, p) if joint_of(setting, p) in joints else p for p in kept]
        hypothesis = replace(late.hypothesis, placed=tuple(moved))
        return refit(ground.part, hypothesis, linear=late.linear, iterations=iterations, slopes=iterations > 0)

    vanishing = {joint_of(setting, p) for p in numbers.values() if is_absent(setting, p, ground.rules.sound.edge)}
    joints = dict.fromkeys(j for p in placed if p.effect.is_filter and (j := joint_of(setting, p)) not in vanishing)
    over = {j: float((excesses(ground, fitted([j], 0)) - most).max()) for j in joints}
    idle = sorted((j for j in joints if over[j] <= 0), key=over.__getitem__)
    while idle:
        fewer = fitted(idle, AGAIN)
        if (excesses(ground, fewer) <= most).all():
            return fewer
        idle = idle[: len(idle) // 2]
    return late


def is_absent(setting: Setting, placed: Placed, edge: float) -> bool:
    """Return whether a member is within an ``edge``, in scales, of a bound of physics where nothing is left of it."""
    quantity = placed.effect.quantities(setting, placed.target)[0]
    bound = quantity.neutral in (quantity.low, quantity.high)
    return bound and abs(placed.values[0] - quantity.neutral) <= edge * quantity.scale


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


def tolerated(ground: Ground, whole: Refit) -> np.ndarray:
    """Return the excess at each joint, ``(J + 1,)``, up to which a family with fewer members is about as good."""
    rules, own = ground.rules, excesses(ground, whole)
    sigma = whole.cost.sigma / np.sqrt(max(len(ground.part.chart.labels), 1))
    return own + np.maximum(rules.family.spare * own, rules.alike.sigmas * sigma)


def _in_turn(ground: Ground, begin: Hypothesis, fit: Callable[[Hypothesis], Refit]) -> tuple[Refit, Refit]:
    """The base family as it is fitted without delays, and with delays from there on."""
    family = base_family(ground.setting, ground.effects)
    prompt = fit(begin.with_effects([p for p in family if not p.effect.is_filter]))
    return prompt, fit(prompt.hypothesis.with_effects([p for p in family if p.effect.is_filter]))


def softened(ground: Ground, whole: Refit) -> Refit | None:
    """Return the family with dry friction that creeps at rest, where it is better so, without what made up for that."""
    softer = with_soft_friction(ground, whole)
    return whole if softer is whole else needed(ground, softer)


def with_slopes(ground: Ground, whole: Refit) -> Refit:
    """Return the family with dry friction that changes along the ranges of joints, if it leaves much less so."""
    effect, rules = find_effect(SLOPE), ground.rules
    rubbing = {p.target for p in whole.hypothesis.placed if p.effect.name in (FRICTION, SOFT)}
    targets = [t for t in effect.targets(ground.setting) if t in rubbing]
    if not targets or effect not in ground.effects or not remains(whole.cost, rules):
        return whole
    ground.report(STAGE, 0.5)
    slopes = [Placed(effect, t, tuple(effect.starts(ground.setting, t)[0].tolist())) for t in targets]
    sloped, misfit = whole.hypothesis.with_effects(slopes), whole.cost.misfit
    if misfit - promised_gain(ground, whole, sloped) > rules.family.sloped * misfit:
        return whole
    more = needed(ground, ground.refit(sloped, iterations=rules.family.iterations))
    return whole if more is None or more.cost.left_of(whole.cost) > rules.family.sloped else more


def promised_gain(ground: Ground, whole: Refit, larger: Hypothesis) -> float:
    """Return by how much χ² would fall with more members, by the derivatives where these are still absent."""
    slope, residual = refit(ground.part, larger, linear=whole.linear, iterations=0).weighted(ground.part.caps)
    left = residual - slope.T @ np.linalg.lstsq(slope.T, residual, rcond=1e-9)[0]
    return float(residual @ residual - left @ left)


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
        most = np.minimum(most, tolerated(ground, whole))
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


def _without_what_cancels(ground: Ground, whole: Refit, most: np.ndarray) -> Refit:
    """Return a fitted family without the first two members that undo each other, if any can go; else the same."""
    for pair in cancelling(ground.setting, whole):
        fewer = _without(ground, whole, [whole.hypothesis.placed[i] for i in pair])
        if (excesses(ground, fewer) <= most).all():
            return fewer
    return whole


def without_steps(ground: Ground, whole: Refit) -> Refit:
    """Return the family without members that only make up for the model's own step.

    Where a finer step is better, the interval that a member has there must not hold its neutral value.
    """
    last = resolved(ground.part, whole)
    if last.fit is whole:
        return whole
    first, off = len(whole.hypothesis.declared), offsets(ground.setting, last.fit) * last.fit.scale
    within = np.abs(off[first:]) < half_widths(last)[first:]
    idle = [p for p, absent in zip(whole.hypothesis.placed, within, strict=True) if absent]
    return _without(ground, whole, idle) if idle else whole


def _without(ground: Ground, whole: Refit, idle: Sequence[Placed]) -> Refit:
    """Return the family fitted without some members."""
    keys = {p.key for p in idle}
    placed = tuple(p for p in whole.hypothesis.placed if p.key not in keys)
    return ground.refit(replace(whole.hypothesis, placed=placed))


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


def spread_out(setting: Setting, hypothesis: Hypothesis, members: int) -> bool:
    """Return whether at least half of the joints, and two, have so many members each."""
    joints = [joint_of(setting, p) for p in hypothesis.placed]
    every = {joint_of(setting, p) for p in base_family(setting)} - {None}
    rich = sum(joints.count(j) >= members for j in every)
    return rich >= max(2, 0.5 * len(every))


def one_kind(hypothesis: Hypothesis) -> bool:
    """Return whether the effects are one effect at three or more places."""
    return len(hypothesis.placed) > 2 and len({p.effect.name for p in hypothesis.placed}) == 1


def joint_names(setting: Setting) -> dict[str, str]:
    """Return the joint of every place where a member of the family can sit, in the model's order."""
    names = setting.names("jnt")
    places = {str(p.target): joint for p in base_family(setting) if (joint := joint_of(setting, p)) is not None}
    return {target: names[joint] for target, joint in sorted(places.items(), key=lambda item: item[1])}
