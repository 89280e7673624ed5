"""Which candidates explain a log as well as a named effect does, with more numbers or fewer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations

from dropo_torch.effects.base import Effect, Placed, Setting, find_effect, object_number
from dropo_torch.gap.accept import nonsense
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.limbs import joint_of, joint_of_column
from dropo_torch.gap.refit import Refit, step_may_explain
from dropo_torch.gap.rules import Alike, remains, significant
from dropo_torch.gap.screen import Candidate, Focus, left_by, nearer
from dropo_torch.gap.shares import families, shares_of

#: Iterations of their fits on few windows: a tie with more numbers than needed settles slowly.
ITERATIONS = (6, 12)
#: Iterations in which one effect settles in the place of two, of which it had done the part of one.
SETTLED = 40
#: The effect that sits on the outermost of several bodies.
LOAD = "payload"
#: The round of attempts that only look for ties.
ROUND = -1


def ties(ground: Ground, state: State, index: int) -> tuple[tuple[Refit, ...], float, State]:
    """Return fits with what ties with a named effect, the excess that it accounts for, and the state with attempts.

    First by linear algebra, of all candidates or of those that the first screening leaves open: what the effect
    explains must lie in the span of a candidate's derivatives and of those of all other numbers. A refit then
    confirms it, or not. Where one of them surpasses the effect, the state has it in its place.

    Args:
        ground: what the search stands on.
        state: where it stands.
        index: of the effect among those that are named.
    """
    current = state.current
    ground.report("looking for ties", 0.0)
    own, origin = current.hypothesis.placed[index], current.hypothesis.without(index)
    without = ground.refit(origin) if origin.placed else state.base
    likely = state.first.rivals(current.hypothesis.placed, index, ground.rules.alike)
    ranked, focus = ground.screened(without, likely), ground.focus(without)  # with the noise and on the windows of now
    near = [nearer(focus, origin, c) for c in promising(focus, ranked, own, ground.rules.alike)]
    others = [(p,) for p in (*near, *varieties(ground, near, own))]
    looking = replace(state, number=ROUND)
    rivals, found = ground.refits(
        looking, without, others, "looking for ties", origin, most=ground.rules.alike.fully, iterations=ITERATIONS,
        known=current.hypothesis,
    )  # fmt: skip
    tied = tuple(r for r in rivals if as_good(ground, state, r))
    best = next((r for r in rivals if surpasses(ground, r, current) and not nonsense(ground, r)), current)
    return tied, without.cost.excess - current.cost.excess, replace(state, current=best, attempts=found.attempts)


#: What may stand in the place of an effect that is everywhere, by its effect and target.
Everywhere = Mapping[tuple[str, str | None], Placed]


def rivals_of_all(
    ground: Ground, state: State, everywhere: Everywhere
) -> tuple[list[tuple[Placed, ...]], list[float], State]:
    """Return the ties of every named effect, with one effect in the place of two wherever it does for both.

    A search that takes one effect at a time may have explained by two, each a part of it, what one explains alone.
    Where a rival surpasses one of them, it is no tie: the state has it in its place, and the others are not looked at.

    Args:
        ground: what the search stands on.
        state: where it stands.
        everywhere: of :func:`alike_everywhere`.
    """
    while True:
        tied, shares = list[tuple[Refit, ...]](), list[float]()
        known = families(state.current.hypothesis.placed)
        members, own = {i for group in known for i in group}, shares_of(ground, state.current) if known else ()
        for index in range(len(state.current.hypothesis.placed)):
            before = state.current
            if index in members:  # what is at many places is asked about at all of them
                tied.append(())
                shares.append(own[index])
                continue
            rivals, share, state = ties(ground, state, index)
            if state.current is not before:
                return with_those(everywhere, state, tied), shares, state
            tied.append(rivals)
            shares.append(share)
        if (fewer := _one_for_two(ground, state, tied)) is None:
            return with_those(everywhere, state, tied), shares, state
        state = replace(state, current=fewer)


def with_those(everywhere: Everywhere, state: State, tied: Sequence[tuple[Refit, ...]]) -> list[tuple[Placed, ...]]:
    """Return what ties with each named effect, also of what is everywhere."""
    own = state.current.hypothesis.placed[: len(tied)]
    return [told(t) or tuple(filter(None, [everywhere.get(p.key)])) for p, t in zip(own, tied, strict=True)]


def alike_everywhere(ground: Ground, state: State) -> tuple[State, Everywhere]:
    """Return the state, and what does the same at all joints as an effect at many places of it: what is late both ways.

    Of these, the one that the vocabulary lists first is named.
    """
    order = {effect.name: i for i, effect in enumerate(ground.effects)}
    for group in families(state.current.hypothesis.placed):
        placed = state.current.hypothesis.placed
        members = [placed[i] for i in group]
        for name in (n for n in members[0].effect.everywhere_like if n in order):
            others = _in_the_place_of(ground.setting, members, find_effect(name), placed)
            if not others:
                continue
            ground.report("looking for ties", 0.1)
            rest = tuple(p for i, p in enumerate(placed) if i not in group)
            fitted = ground.refit(replace(state.current.hypothesis, placed=(*rest, *others)))
            if not as_good(ground, state, fitted) or nonsense(ground, fitted):
                continue
            others = list(fitted.hypothesis.placed[len(rest) :])
            if order[name] < order[members[0].effect.name]:
                return replace(state, current=fitted), _by_joints(ground.setting, others, members)
            return state, _by_joints(ground.setting, members, others)
    return state, {}


def _by_joints(setting: Setting, named: Sequence[Placed], others: Sequence[Placed]) -> Everywhere:
    """What stands at the same joint as each of several effects."""
    there = {_joint(setting, p): p for p in reversed(others)}
    return {p.key: there[joint] for p in named if (joint := _joint(setting, p)) in there}


def _in_the_place_of(
    setting: Setting, members: Sequence[Placed], effect: Effect, placed: Sequence[Placed]
) -> list[Placed]:
    """An effect at all joints at which another one is, where it is not already; none if it cannot be at one of them.

    In the place of what is everywhere it is everywhere, too: a joint that nothing drives has no actuator to be late.
    """
    places: dict[int | None, list[str | None]] = {}
    for target in effect.targets(setting):
        places.setdefault(_joint(setting, Placed(effect, target)), []).append(target)
    size, usual = {_joint(setting, p): p.values for p in members}, members[0].values
    if {p.target for p in members} == set(members[0].effect.targets(setting)):
        size = {joint: size.get(joint, usual) for joint in places}
    if None in size or not size.keys() <= places.keys():
        return []
    taken = {p.key for p in placed}
    wanted = [Placed(effect, target).at(values) for joint, values in size.items() for target in places[joint]]
    return [p for p in wanted if p.key not in taken]


def _joint(setting: Setting, placed: Placed) -> int | None:
    """The joint at which an effect of a sensor or an actuator sits."""
    if placed.effect.kind == "sensor":
        return joint_of_column(setting, placed.target)
    return joint_of(setting, placed)


def told(tied: Sequence[Refit]) -> tuple[Placed, ...]:
    """Return what ties with an effect, of fits in which it stands last."""
    return tuple(r.hypothesis.placed[-1] for r in tied)


def _one_for_two(ground: Ground, state: State, tied: Sequence[tuple[Refit, ...]]) -> Refit | None:
    """A fit in which what ties with one named effect stands in the place of two, and explains the log as well.

    Tried are ties of both, ties of one that are at the target of the other, and those beside which less than half of
    the other is needed: a payload ties with an inertia beside a shifted center of mass, and needs neither.
    """
    hypothesis = state.current.hypothesis
    for one, other in permutations(range(len(tied)), 2):
        shared, own = {p.key for p in told(tied[other])}, hypothesis.placed[other]
        for fitted in tied[one]:
            *others, rival = fitted.hypothesis.placed
            both = rival.key in shared and one < other
            near = own.target is not None and rival.target == own.target
            beside = size(ground, others[other - (other > one)])
            if not (both or near or beside < 0.5 * size(ground, own)):
                continue
            ground.report("looking for ties", 0.9)
            fewer = ground.refit(hypothesis.instead(one, rival).without(other), SETTLED)
            if as_good(ground, state, fewer):
                return fewer
    return None


def size(ground: Ground, placed: Placed) -> float:
    """Return by how many scales the numbers of an effect differ from those with which it is absent."""
    quantities = placed.effect.quantities(ground.setting, placed.target)
    return math.hypot(*((v - q.neutral) / q.scale for q, v in zip(quantities, placed.values, strict=True)))


def promising(focus: Focus, ranked: Sequence[Candidate], own: Placed, rules: Alike) -> list[Candidate]:
    """Return candidates that explain, to first order, most of what is left without an effect; the best first."""
    degrees = focus.evidence.degrees(focus.fitted.linear) - len(focus.slope)
    before = max(float(focus.residual @ focus.residual) - degrees, 1e-12)
    share = {c.key: (left_by(focus, [c]) - degrees) / before for c in ranked if not c.dead}
    most = max(rules.promising, 2 * share.get(own.key, 0.0))
    found = [c for c in ranked if not c.dead and c.placed.called != own.called and share[c.key] < most]
    found = [c for c in found if not (own.effect.name in c.placed.effect.contains and c.placed.target == own.target)]
    return sorted(found, key=lambda c: share[c.key])[: rules.roughly]


def varieties(ground: Ground, placed: Sequence[Placed], own: Placed) -> list[Placed]:
    """Return effects of other kinds of the same thing and with as many numbers, which are not looked for alone."""
    return [
        Placed(effect, p.target).at(values)
        for p in placed
        for effect in ground.effects
        if effect.known_as == p.effect.name and effect.name != own.effect.name
        for values in effect.extends(ground.setting, p)
        if len(values) == len(p.values)
    ]


def surpasses(ground: Ground, better: Refit, own: Refit) -> bool:
    """Return whether a hypothesis removes most of what another leaves, and that is more than noise."""
    return significant(own.cost, ground.rules) and better.cost.left_of(own.cost) < 1 - ground.rules.most


def as_good(ground: Ground, state: State, rival: Refit) -> bool:
    """Return whether a rival hypothesis explains the log as well as the one that was found."""
    current = state.current
    as_clear = ground.clears(state.base, rival) or not ground.clears(state.base, current)
    return as_clear and ground.as_good(rival, current) and not parted_by_step(ground, current, rival)


def parted_by_step(ground: Ground, own: Refit, rival: Refit) -> bool:
    """Return whether a finer step explains most of what a hypothesis leaves, but not beside a rival for it.

    Friction that is larger near rest, for one, explains little more than plain friction before the step resolves it.
    """
    if not remains(own.cost, ground.rules) or not step_may_explain(ground.part, own):
        return False
    fine = ground.resolved(own).fit
    most = fine.cost.left_of(own.cost) <= 1 - ground.rules.most
    return most and not ground.as_good(ground.resolved(rival).fit, fine)


def canonical(
    ground: Ground, state: State, tied: Sequence[tuple[Placed, ...]]
) -> tuple[State, tuple[tuple[Placed, ...], ...]]:
    """Among ties name the one with the fewest numbers that the vocabulary lists first, if it may have a name.

    What sits on one of several bodies as well is on the outermost, where tools and loads are.
    """
    order = {effect.name: i for i, effect in enumerate(ground.effects)}
    listed = list(tied)
    for index, rivals in enumerate(listed):
        own = state.current.hypothesis.placed[index]
        first = min((own, *rivals), key=lambda p: (len(p.values), order[p.effect.name], -_outward(ground.setting, p)))
        if first is own:
            continue
        instead = ground.refit(state.current.hypothesis.instead(index, first))
        if as_good(ground, state, instead) and not nonsense(ground, instead):
            state = replace(state, current=instead)
            listed[index] = tuple(own if p is first else p for p in rivals)
    return state, tuple(listed)


def _outward(setting: Setting, placed: Placed) -> int:
    """How many bodies are between the world and one on which something sits; 0 for other effects."""
    if placed.effect.name != LOAD:
        return 0
    body, count = object_number(setting.model, "body", placed.target), 0
    while body := int(setting.model.body_parentid[body]):
        count += 1
    return count
