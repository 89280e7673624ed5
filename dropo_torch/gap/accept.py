"""Accepting effects: the one or two that remove the most, and better ones in the place of others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed
from dropo_torch.gap.cancel import cancelling
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.refit import ANEW, Refit, change_of_step, least_beside, refit, resolved
from dropo_torch.gap.renew import with_base
from dropo_torch.gap.rules import (
    accounts,
    allowance,
    beyond_free,
    is_hopeless,
    may_leave,
    most_left,
    remains,
    significant,
    simplest,
)
from dropo_torch.gap.screen import Candidate, nearer, promising_families, promising_pairs, screen
from dropo_torch.gap.shares import MANY, families, shares_of
from dropo_torch.gap.sound import absurd

#: Dry friction as MuJoCo has it by default.
SOFT = "joint_soft_friction"
#: Windows of a first fit, and the share that it must come down to there for one of all to be worth its time.
ROUGHLY, LIKELY = 12, 0.5


def beats(ground: Ground, better: Refit, worse: Refit) -> bool:
    """Return whether a hypothesis removes most of another's excess, or so much that the search goes on with it."""
    most = better.cost.left_of(worse.cost) < 1 - ground.rules.most
    return most or ground.chance(better, worse) <= ground.rules.chance.explore


def is_needed(ground: Ground, state: State, whole: Refit, without: Refit) -> bool:
    """Return whether an effect may have a name: it removes enough, and chance among all candidates does not.

    Where the windows that refits use leave this open, all windows decide, at half the level. The step with which a
    simulator made a log is asked for by itself, not among all candidates.
    """
    if not matters(ground, state.base, whole, without):
        return False
    rest = [p.key for p in without.hypothesis.placed]
    steps = all(p.effect.steps for p in whole.hypothesis.placed if p.key not in rest)
    comparisons = len({p.key for p in ground.candidates if p.effect.steps}) if steps else ground.comparisons
    chance, error = ground.rules.chance, ground.chance(whole, without) * comparisons
    if error <= chance.error or error > chance.open or len(ground.evidence.windows) <= ground.most:
        return error <= chance.error
    ground.report("judging on all windows", 0.5)
    every, base = with_base(replace(ground, few=len(ground.evidence.windows), caps=1.0), state.base.hypothesis)
    whole, without = (every.refit(r.hypothesis, iterations=4) for r in (whole, without))
    error = every.chance(whole, without) * comparisons
    return matters(every, base, whole, without) and error <= 0.5 * chance.error


def matters(ground: Ground, base: Refit, whole: Refit, without: Refit) -> bool:
    """Return whether an effect removes enough of the first excess, or all that is left where that is a small part.

    What the model's own step leaves is no part of what is left, and an effect that removes no more than that is not
    needed; of a large part, only where no step shows in the model as given: see :func:`step_shows`. Such a step itself
    is needed where it removes most of what is left, whatever remains then.
    """
    rules = ground.rules
    if without.cost.excess - whole.cost.excess >= rules.least * base.cost.above(whole.cost):
        return not without.hypothesis.placed or step_shows(ground, base) or not _step_does(ground, whole, without)
    if not significant(without.cost, rules) or whole.cost.left_of(without.cost) > 1 - rules.most:
        return False
    if not significant(whole.cost, rules) or is_of_step(ground, whole):
        return not _step_does(ground, whole, without)
    return _adds_step(whole, without) and step_shows(ground, base)


def _step_does(ground: Ground, whole: Refit, without: Refit) -> bool:
    """Whether a finer step leaves no more than noise without an effect; one that is such a step says so itself."""
    if _adds_step(whole, without):
        return not significant(whole.cost, ground.rules)
    return is_of_step(ground, without)


def _adds_step(whole: Refit, without: Refit) -> bool:
    """Whether a hypothesis differs from one without it by a finer step: no guess about the robot."""
    rest = {p.key for p in without.hypothesis.placed}
    added = [p for p in whole.hypothesis.placed if p.key not in rest]
    return len(added) == 1 and added[0].effect.steps


def step_shows(ground: Ground, base: Refit) -> bool:
    """Return whether the model as given moves otherwise with a finer step, by more than noise.

    If not, its step is fine enough for it: what a finer one explains beside named effects is how the step resolves
    these, such as dry friction, and nothing that the model lacks.
    """
    change = change_of_step(ground.part, base)
    return change is None or float((change**2).sum()) > ground.rules.gate * base.cost.sigma


def is_of_step(ground: Ground, fitted: Refit) -> bool:
    """Return whether all that a hypothesis leaves is of the model's own step: a finer one leaves no more than noise.

    Where a finer step explains most of it with the derivatives of the own one, by numbers and by initial states, but
    not all, it has its own: what a coarse step distorts, such as friction that is larger near rest, is not found by
    the others.
    """
    rules, change = ground.rules, change_of_step(ground.part, fitted)
    if change is not None and significant(least_beside(ground.part, fitted, change), rules):
        return False
    last = ground.resolved(fitted)
    most = last.fit.cost.left_of(fitted.cost) <= 1 - rules.most
    if not significant(last.fit.cost, rules):
        return most or significant(fitted.cost, rules)  # of what is no more than noise, a finer step must leave less
    if not most:
        return False
    again = refit(last.evidence, last.fit.hypothesis, iterations=ANEW, slopes=False)
    return not significant(again.cost, rules)


def sound(ground: Ground, fitted: Sequence[Refit]) -> list[Refit]:
    """Return those hypotheses whose numbers are no nonsense."""
    return [r for r in fitted if not nonsense(ground, r)]


def nonsense(ground: Ground, fitted: Refit) -> list[str]:
    """Return why effects of a hypothesis can have no name."""
    return [reason for _, reason in absurd(ground.part, fitted, ground.rules.sound)]


def imitates(ground: Ground, fitted: Refit) -> bool:
    """Return whether effects with more numbers than are free leave more than noise, also with a finer step."""
    wrong = ground.rules.sound.model_error
    if not beyond_free(fitted.hypothesis, ground.rules) or fitted.cost.reduced <= wrong:
        return False
    return resolved(ground.part, fitted).fit.cost.reduced > wrong


def accounts_finely(ground: Ground, fitted: Refit, base: Refit) -> bool:
    """Return whether effects account for a gap, where what is wrong besides may be the model's own step."""
    rules = ground.rules
    if accounts(fitted, base, rules) or fitted.cost.left_of(base.cost) > may_leave(fitted, rules):
        return accounts(fitted, base, rules)
    return resolved(ground.part, fitted).fit.cost.reduced <= rules.sound.wrong


def is_done(ground: Ground, state: State) -> bool:
    """Return whether what is left is noise, or what the model's own step makes of the effects that were found.

    The latter where it is a small part of the gap, or where the model as given shows no step.

    Of a gap that is itself little more than noise, what is left may be both no more than that and a large part of it:
    there may be another effect, however well the noise is known.
    """
    base, current, rules = state.base, state.current, ground.rules
    left = current.cost.left_of(base.cost)
    if ground.clears(base, current):
        return True
    if not significant(current.cost, rules):
        small = left <= allowance(current.hypothesis, rules) and accounts(current, base, rules)
        return small or current.cost.misfit < 0.5 * rules.gate * current.cost.sigma
    if left >= rules.least and step_shows(ground, base):
        return False
    return is_of_step(ground, current)


def add(ground: Ground, state: State) -> State:
    """Accept the one or two effects, or the family, that remove the most; where nothing does, the search is done.

    Pairs and families are tried where no single effect removes most of what is left, or accounts for the gap beside
    what was accepted before, and families of which there may be many places where the best one leaves more than noise,
    unless what was accepted before accounts for the gap: of the little that it leaves, not several more are found at
    once. One of them takes the place of the best single effect where it leaves much less, or where that alone would end
    the search.
    """
    rules, current = ground.rules, state.current
    ranked = ground.screened(current) if state.number else state.first.ranked
    alive = [c for c in ranked if not c.dead]
    hopeless, focus = most_left(current, rules) + rules.tried.slack, ground.focus(current)
    groups = [(nearer(focus, current.hypothesis, c),) for c in alive[: rules.tried.refits]]
    singles, state = ground.refits(state, current, groups, "refitting", hopeless=hopeless)
    state = replace(state, refused=next((why for r in singles[:1] for why in nonsense(ground, r)), state.refused))
    promising, singles = singles, sound(ground, singles)
    if promising and not singles:  # what contains them may explain as much within the bounds of physics
        larger = [g for r in promising for g in extensions(ground, r.hypothesis.placed[-1])]
        singles, state = ground.refits(state, current, larger, "refining")
        singles = sound(ground, singles)
    if not singles:
        return replace(state, done=True)
    best = simplest(singles, rules)
    rivals = [r for r in singles if not significant(r.cost, rules)]
    if significant(best.cost, rules) and not accounts(current, state.base, rules):
        most = best.cost.left_of(current.cost) <= 1 - rules.most
        last = state.number > 0 and accounts(best, state.base, rules)
        best, state = _among_several(ground, state, alive, best, pairs=not (most or last))
    worse = is_hopeless(best, current, rules) or not matters(ground, state.base, best, current)
    if worse or not beats(ground, best, current):
        return replace(state, done=True)
    return replace(state, current=best, rivals=tuple(r.hypothesis for r in rivals if r is not best))


def reconsidered(ground: Ground, state: State) -> State:
    """Return the best of a hypothesis and its rivals under the noise as it is now: a lower one may tell them apart."""
    if not state.rivals:
        return state
    ground.report("comparing anew", 0.0)
    fitted = [state.current, *(ground.refit(h, iterations=6) for h in state.rivals)]
    fitted = sorted(sound(ground, fitted), key=lambda r: r.cost.excess)
    return replace(state, current=simplest(fitted, ground.rules) if fitted else state.current, rivals=())


def _among_several(
    ground: Ground, state: State, alive: Sequence[Candidate], best: Refit, *, pairs: bool
) -> tuple[Refit, State]:
    """The best pair or family where it leaves much less than the best single effect, or where that is hopeless.

    Without ``pairs``, where the best single effect removes most, only families of which there may be many are tried,
    and must leave next to nothing of what it leaves.
    """
    rules, current = ground.rules, state.current
    two, state = paired(ground, state, alive, best) if pairs else ([], state)
    families = promising_families(ground.focus(current), alive, rules.tried)
    if not pairs:
        by_step = best.hypothesis.placed[-1].effect.steps  # a family, such as of late sensors, may do what a step does
        families = [f for f in families if len(f[0].effect.targets(ground.setting)) >= MANY and not by_step]
    found, state = ground.refits(state, current, families, "refitting families", known=best.hypothesis)
    several = sound(ground, found)
    for tried in (simplest(r, rules) for r in (two, several) if r):
        clearer = tried.cost.left_of(best.cost) < (rules.tried.clearer if pairs else rules.family.clearer[0])
        if clearer and not pairs:  # a family, such as of late sensors, may do besides what the model's step leaves
            finer, own = (ground.resolved(r).fit.cost for r in (tried, best))
            clearer = finer.left_of(own) < rules.family.clearer[0]
        if clearer or (is_hopeless(best, current, rules) and not is_hopeless(tried, current, rules)):
            best = tried
    return best, state


def paired(
    ground: Ground, state: State, alive: Sequence[Candidate], single: Refit | None = None
) -> tuple[list[Refit], State]:
    """Return the best pairs of candidates beside what was accepted, and the state with these attempts.

    A candidate that makes the best pair nonsense stands for another one, such as an inertia that vanishes for a motor
    that is stronger: pairs are tried again without it.

    Args:
        ground: what the search stands on.
        state: where it stands.
        alive: candidates, the best first.
        single: the best single one, fitted: what promises most beside it makes pairs, too, and they must come near it.
    """
    tried, current = ground.rules.tried, state.current
    focus = ground.focus(current, 2)  # on more windows, and from where the candidates promise the most
    before, excluded = {p.key for p in current.hypothesis.placed}, set[tuple[str, str | None]]()
    for _ in range(tried.anew):
        rest = [c.placed for c in alive if c.key not in excluded][: tried.paired]
        pairs = promising_pairs(focus, screen(focus, rest, tried), tried)
        pairs += [] if single is None else _partnered(ground, single, excluded)
        known = None if single is None else single.hypothesis
        found, state = ground.refits(state, current, pairs, "refitting pairs", known=known)
        bad = {p.key for r in found[:1] for p, _ in absurd(ground.part, r, ground.rules.sound)} - before
        excluded |= bad
        if not bad:
            break
    return sound(ground, found), state


def _partnered(ground: Ground, single: Refit, excluded: Collection[tuple[str, str | None]]) -> list[list[Placed]]:
    """The best single candidate, fitted, with each of those that promise most beside it.

    Where a gap is large, predictions from where candidates begin pair those that bend the least.
    """
    own, focus = single.hypothesis.placed[-1], ground.focus(single)
    alive = [c for c in ground.screened(single) if not (c.dead or c.key in excluded)]
    return [[own, nearer(focus, single.hypothesis, c)] for c in alive[: ground.rules.tried.partners]]


def swap(ground: Ground, state: State) -> State:
    """Try to put another effect in the place of each accepted one, but not of one that is at many places at once."""
    tried = ground.rules.tried
    for _ in range(2):
        before = state.current
        for own in _single(before.hypothesis.placed):
            keys = [p.key for p in state.current.hypothesis.placed]
            if own not in keys:
                continue
            index = keys.index(own)
            ground.report("swapping", 0.0)
            without = ground.refit(state.current.hypothesis.without(index))
            focus = ground.focus(without)
            here = refit(focus.evidence, state.current.hypothesis, iterations=0, slopes=False).cost.chi2
            likely = state.first.rivals(state.current.hypothesis.placed, index, ground.rules.alike)
            alive = [c for c in ground.screened(without, likely) if not c.dead]
            # Far from where it begins, a prediction promises too little of any effect, of the accepted one as well.
            least = max(here, next((c.chi2 for c in alive if c.key == own), 0.0))
            rivals = [(c.placed,) for c in alive[: tried.rivals] if c.key != own and c.chi2 < tried.promises * least]
            found, _ = ground.refits(state, without, rivals, "swapping", known=state.current.hypothesis)
            better = [r for r in sound(ground, found[:1]) if r.cost.excess < state.current.cost.excess]
            if better and beats(ground, better[0], state.current):
                state = replace(state, current=better[0])
        if state.current is before:
            break
    return state


def _single(placed: Sequence[Placed]) -> list[tuple[str, str | None]]:
    """Effects and targets that are not members of a family."""
    names = Counter(p.effect.name for p in placed)
    return [p.key for p in placed if names[p.effect.name] < MANY]


def extend(ground: Ground, state: State) -> State:
    """Put effects that contain an accepted one in its place, where that explains more."""
    state = replace(state, current=with_soft_friction(ground, state.current))
    for index, own in enumerate(state.current.hypothesis.placed):
        if not (groups := extensions(ground, own)):
            continue
        origin = state.current.hypothesis.without(index)
        found, state = ground.refits(state, ground.refit(origin), groups, "refining", origin)
        for better in found[:1]:
            if refines(ground, state, better):
                state = replace(state, current=better)
    return state


def with_soft_friction(ground: Ground, fitted: Refit) -> Refit:
    """Return a hypothesis with dry friction that creeps at rest, at all joints, if it leaves next to nothing so."""
    setting, soft = ground.setting, find_effect(SOFT)
    found = {i: v[0] for i, p in enumerate(fitted.hypothesis.placed) if (v := soft.extends(setting, p))}
    if not found or soft not in ground.effects or not significant(fitted.cost, ground.rules):
        return fitted
    ground.report("refining", 0.5)
    placed = [Placed(soft, p.target).at(found[i]) if i in found else p for i, p in enumerate(fitted.hypothesis.placed)]
    hypothesis, few = replace(fitted.hypothesis, placed=tuple(placed)), ground.part.few(ROUGHLY)
    own, rough = (refit(few, h, iterations=2, slopes=False).cost for h in (fitted.hypothesis, hypothesis))
    if rough.left_of(own) > LIKELY:
        return fitted
    softer = ground.refit(hypothesis)
    return softer if softer.cost.left_of(fitted.cost) < 1 - ground.rules.most else fitted


def extensions(ground: Ground, own: Placed) -> list[tuple[Placed, ...]]:
    """Return the effects that contain one, with the numbers with which they do."""
    return [(Placed(e, own.target).at(v),) for e in ground.effects for v in e.extends(ground.setting, own)]


def refines(ground: Ground, state: State, better: Refit) -> bool:
    """Return whether an effect that contains an accepted one explains enough more to stand in its place.

    Where the model's own step may be part of what both leave, a finer one tells: it may even be that the own step makes
    the wrong one of two the better. Of the same effects with another whole number, the one that leaves less is right.
    """
    rules, own, here = ground.rules, state.current, better
    if {p.key for p in own.hypothesis.placed} == {p.key for p in better.hypothesis.placed}:
        return better.cost.excess < own.cost.excess
    larger = len(better.hypothesis.vector) > len(own.hypothesis.vector)
    gained, least = own.cost.excess - here.cost.excess, rules.least * state.base.cost.above(here.cost)
    more = here.cost.left_of(own.cost) <= (rules.most if larger else 1 - rules.most)
    if not more or gained < min(least, rules.most * own.cost.above(here.cost)):
        if not more and not remains(own.cost, rules):
            return False
        change = change_of_step(ground.part, here)
        if change is not None and least_beside(ground.part, here, change).left_of(own.cost) > 1 - rules.most:
            return False
        own, here = (ground.resolved(r).fit for r in (own, here))
        if here.cost.left_of(own.cost) > 1 - rules.most:
            return False
    return beats(ground, here, own)


def everywhere(ground: Ground, state: State) -> State:
    """Put the last accepted effect at all its other targets, too, where that explains more."""
    hypothesis = state.current.hypothesis
    effect = hypothesis.placed[-1].effect
    if len(hypothesis.placed[-1].values) != 1:
        return state
    idle = {p.key for p in (*hypothesis.placed, *state.first.silent)}
    others = [
        Placed(effect, target, (effect.quantities(ground.setting, target)[0].neutral,))
        for target in effect.targets(ground.setting)
        if (effect.name, target) not in idle
    ]
    ground.report("refitting families", 0.5)
    whole = ground.refit(hypothesis.with_effects(others))
    return replace(state, current=whole) if beats(ground, whole, state.current) else state


def prune(ground: Ground, state: State) -> State:
    """Drop effects that are not needed, the least needed first; then two that only undo each other.

    Of one effect at many places, the place is asked about at which it explains least.
    """
    current = state.current
    while current.hypothesis.placed:
        count = len(current.hypothesis.placed)
        asked = _least(ground, current)
        without = [ground.refit(current.hypothesis.without(i)) if count > 1 else state.base for i in asked]
        idle = [r for r in without if not is_needed(ground, state, current, r)]
        idle = idle or undone(ground, state, current)
        if not idle:
            break
        current = min(idle, key=lambda r: r.cost.excess)
    return replace(state, current=current)


def _least(ground: Ground, current: Refit) -> list[int]:
    """The effects of a hypothesis, of each family only the member that explains least by the derivatives."""
    groups = families(current.hypothesis.placed)
    shares = shares_of(ground, current) if groups else ()
    spared = {i for group in groups for i in group if i != min(group, key=shares.__getitem__)}
    return [i for i in range(len(current.hypothesis.placed)) if i not in spared]


def undone(ground: Ground, state: State, current: Refit) -> list[Refit]:
    """Return the hypothesis without two effects that undo each other, if both together are not needed."""
    for pair in cancelling(ground.setting, current):
        first, second = sorted(pair)
        rest = current.hypothesis.without(second).without(first)
        fewer = ground.refit(rest) if rest.placed else state.base
        if not is_needed(ground, state, current, fewer):
            return [fewer]
    return []
