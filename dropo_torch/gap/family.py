"""The base family: what a real joint has besides geometry and mass, fitted at every joint at once.

A robot's joints have rotor inertia, viscous and dry friction, an offset and a delay, all of them. No search that adds
one effect after another finds these: each alone explains next to nothing while the others are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.gap.accept import ROUGHLY, SOFT, beats, extend, is_of_step, sound, with_soft_friction
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.limbs import joint_of
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.rules import near, remains, significant
from dropo_torch.gap.screen import nearer
from dropo_torch.gap.spare import FRICTION, STAGE, excesses, is_absent, needed, tolerated, without_steps

#: The effects of a joint, or of the actuator that drives it. Each is one number.
BASE = ("armature", "joint_damping", "joint_friction", "actuator_bias", "actuator_delay")
#: The one of them for which a delay stands most.
INERTIA = "armature"
#: One more of them, where what these leave is more than noise; and those on top of which it is.
SLOPE = "joint_friction_slope"
#: Numbers that a base family may have more than effects that have about as many.
ABOUT = 1
#: Iterations of a fit without some of its delays.
AGAIN = 12


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

    At several joints several members must be needed: what sits at one of them, or is of one kind, the search names
    one by one. A robot of one joint has them all there. What a coarse step does to stiff servos is no member, although
    inertia, friction and delay of every joint together make up for it. Where the first effects are not one effect at
    several joints already, and the robot has more joints than one, it must
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
    same = one_kind(found.current.hypothesis)
    kind = same or len(joints_of(ground)) == 1
    most = rules.hopeless * rules.clearer[int(kind)]
    if not same and leaves_too_much(ground, state.base.hypothesis, found.current.hypothesis, most):
        return found  # before all that costs more
    best = found if found.done or same else extend(ground, found)  # what contains the first effects may be the truth
    cost = best.current.cost
    if not significant(cost, ground.rules) or cost.left_of(state.base.cost) < rules.left:
        return found
    if is_of_step(ground, best.current):
        return found
    beside = with_one_more(ground, best)
    if beside and (not significant(beside[0].cost, ground.rules) or is_of_step(ground, beside[0])):
        return replace(best, current=beside[0])
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
    """Return whether one effect more beside the first ones leaves less than the base family, where that leaves more.

    By more than hypotheses differ that are about as good: the three may be members of the family themselves.
    """
    most = whole.cost.excess - near(whole.cost, ground.rules)
    return significant(whole.cost, ground.rules) and any(r.cost.excess < most for r in beside)


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
    """Return whether the model has joints with a base family, and touches nothing."""
    return not ground.setting.signals.contacts.any() and bool(joints_of(ground))


def joints_of(ground: Ground) -> set[int]:
    """Return the joints at which members of the base family can sit."""
    found = (joint_of(ground.setting, p) for p in base_family(ground.setting, ground.effects))
    return {joint for joint in found if joint is not None}


def whole_family(ground: Ground, fitted: Refit) -> Refit | None:
    """Return the fitted base family with the members that are needed, if several are at several joints."""
    whole = needed(ground, fitted)
    whole = None if whole is None else softened(ground, whole)
    sloped = None if whole is None else with_slopes(ground, whole)
    if sloped is not None and sloped is not whole:
        sloped = softened(ground, sloped)
    whole = None if sloped is None else without_steps(ground, sloped)
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
    first, and a joint has one only where that leaves much less at it, or where its inertia would have to vanish in
    its place.
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
    most, setting = tolerated(ground, late, 1 / ground.rules.family.delayed - 1), ground.setting
    numbers, placed = {p.key: p for p in prompt.hypothesis.placed}, late.hypothesis.placed

    def fitted(joints: Collection[int | None], iterations: int) -> Refit:
        kept = [p for p in placed if not (p.effect.is_filter and joint_of(setting, p) in joints)]
        moved = [numbers.get(p.key, p) if joint_of(setting, p) in joints else p for p in kept]
        hypothesis = replace(late.hypothesis, placed=tuple(moved))
        return refit(ground.part, hypothesis, linear=late.linear, iterations=iterations, slopes=iterations > 0)

    rotors = [p for p in numbers.values() if p.effect.name == INERTIA]
    vanishing = {joint_of(setting, p) for p in rotors if is_absent(setting, p, ground.rules.sound.edge)}
    joints = dict.fromkeys(j for p in placed if p.effect.is_filter and (j := joint_of(setting, p)) not in vanishing)
    over = {j: float((excesses(ground, fitted([j], 0)) - most).max()) for j in joints}
    idle = sorted((j for j in joints if over[j] <= 0), key=over.__getitem__)
    while idle:
        fewer = fitted(idle, AGAIN)
        if (excesses(ground, fewer) <= most).all():
            return ground.refit(fewer.hypothesis)
        idle = idle[: len(idle) // 2]
    return late


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


def spread_out(setting: Setting, hypothesis: Hypothesis, members: int) -> bool:
    """Return whether at least half of the joints, and two where there are more, have so many members each."""
    joints = [joint_of(setting, p) for p in hypothesis.placed]
    every = {joint_of(setting, p) for p in base_family(setting)} - {None}
    rich = sum(joints.count(j) >= members for j in every)
    return rich >= max(min(2, len(every)), 0.5 * len(every))


def one_kind(hypothesis: Hypothesis) -> bool:
    """Return whether the effects are one effect at three or more places."""
    return len(hypothesis.placed) > 2 and len({p.effect.name for p in hypothesis.placed}) == 1


def joint_names(setting: Setting) -> dict[str, str]:
    """Return the joint of every place where a member of the family can sit, in the model's order."""
    names = setting.names("jnt")
    places = {str(p.target): joint for p in base_family(setting) if (joint := joint_of(setting, p)) is not None}
    return {target: names[joint] for target, joint in sorted(places.items(), key=lambda item: item[1])}
