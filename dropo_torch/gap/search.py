"""The search for missing effects: screen, refit, accept by the excess that is removed, swap, prune, tell what ties."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Effect, Placed
from dropo_torch.gap.absent import Allowed, family_ties, left_out, with_absent
from dropo_torch.gap.accept import (
    accounts_finely,
    add,
    everywhere,
    extend,
    imitates,
    is_done,
    nonsense,
    paired,
    prune,
    reconsidered,
    swap,
)
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.faint import with_faint
from dropo_torch.gap.family import fitted_family, has_family, whole_family, with_family
from dropo_torch.gap.ground import Ground, Screening, State
from dropo_torch.gap.limit import OutOfTime, until
from dropo_torch.gap.refit import Hypothesis, Refit
from dropo_torch.gap.renew import noise_beside, renewed, restarted, with_base
from dropo_torch.gap.result import Ranked
from dropo_torch.gap.rules import accounts, family_accounts, may_leave, remains, significant
from dropo_torch.gap.shares import shares_of
from dropo_torch.gap.spare import of_all_joints
from dropo_torch.gap.ties import alike_everywhere, canonical, rivals_of_all, surpasses, with_those
from dropo_torch.support.checkpoint import Checkpoint

#: The screening before there is one.
NOTHING = Screening((), np.zeros(0), np.zeros((0, 0)), 0.0)
#: Why what a log is too short for has no name.
UNSURE = "what explains most of it may do so by chance, for this log has too few stretches that show it"
#: Share of the gap that effects may leave to be an answer so far, where the time for the search is over.
SO_FAR = 0.5
#: Why what needs many numbers, and is still not right, has none.
IMITATES = "what explains most of it has many numbers and is still not right: they may only imitate it"
#: Why a base family that leaves too much has no names.
LEAVES = "friction, inertia, offset and delay at all joints leave too much of it"


@dataclass(frozen=True)
class Naming:
    """What was found.

    Attributes:
        evidence: the windows on which it was.
        base: the declared parameters alone.
        first: the screening beside them.
        final: with the named effects, or the base again.
        gap: whether anything is missing at all.
        named: whether the named effects account for it.
        ties: for each named effect, the candidates that do as well in its place.
        shares: excess that comes back when each named effect alone is left out.
        attempts: what was refitted, in order.
        partial: whether they leave nothing in most of the log, but something else remains in the rest.
        refused: why what was found has no name.
        unfinished: the stage in which the time for the search was over, or empty.
        family: whether what is named is the base family.
        left_out: what this does without, and how large that may be.
        everywhere: members of this that all joints have, since nearly all need them.
        lasting: whether what is more than the noise that was told is noise, too.
        faint: which of the named effects show only along their own direction: see :func:`with_faint`.
    """

    evidence: Evidence
    base: Refit
    first: Screening
    final: Refit
    gap: bool
    named: bool = False
    ties: tuple[tuple[Placed, ...], ...] = ()
    shares: tuple[float, ...] = ()
    attempts: tuple[Ranked, ...] = ()
    partial: bool = False
    refused: str = ""
    unfinished: str = ""
    family: bool = False
    left_out: tuple[Allowed, ...] = ()
    everywhere: frozenset[tuple[str, str | None]] = frozenset()
    lasting: bool = False
    faint: tuple[int, ...] = ()


@dataclass(frozen=True)
class Ended:
    """Where a search ended.

    Attributes:
        ground: what it stood on, with the noise and the windows that it found.
        state: with the named effects.
        naming: what was found; what ties with it is told by :func:`with_ties`, for it costs as much as a round.
    """

    ground: Ground
    state: State
    naming: Naming


def kept(path: Path, fingerprint: str) -> Checkpoint:
    """Return where a search keeps its state between rounds.

    Args:
        path: the file.
        fingerprint: identifies config, model, log and vocabulary.
    """
    return Checkpoint(path, "gap", (fingerprint,), (State,), {Effect: find_effect})


def search(
    ground: Ground, begin: Hypothesis, checkpoint: Checkpoint | None = None, *, resume: bool = False,
    end: float = math.inf, latest: float = -math.inf,
) -> Ended:  # fmt: skip
    """Find what is missing, beginning from the declared parameters' values.

    Args:
        ground: what the search stands on.
        begin: the declared parameters' values.
        checkpoint: where the state is kept between rounds, ``None`` for nowhere.
        resume: go on from there, if there is one.
        end: when no more effects are looked for, by ``time.monotonic``; what was found until then is judged.
        latest: the same, if it is later, where what was found until then is much of the gap.

    Raises:
        InputError: a checkpoint that is damaged, or of another search.
    """
    twin = ground.evidence.twin

    def keep(state: State) -> State:
        if checkpoint is not None:
            checkpoint.save({"state": state, "simulated_transitions": twin.simulated_transitions})
        return state

    if resume and checkpoint is not None and checkpoint.path.exists():
        content = checkpoint.load()
        state, twin.simulated_transitions = content["state"], content["simulated_transitions"]
    else:
        state = keep(start_anywhere(ground, begin))
    found, unfinished = [state], ""
    try:
        while not state.done:
            most = state.current.cost.left_of(state.base.cost) <= SO_FAR
            hurried = replace(ground, report=until(ground.report, max(end, latest) if most else end))
            state = keep(step(hurried.at(state), state, found.append))
            found.append(state)
    except OutOfTime as error:
        state = found[-1]
        unfinished = f"{error}, with {len(state.current.hypothesis.placed)} effects accepted"
    ended = conclude(ground.at(state), state)
    naming = found_so_far(ended) if unfinished else ended.naming
    return replace(ended, naming=replace(naming, unfinished=unfinished))


def found_so_far(ended: Ended) -> Naming:
    """Return what a search had accepted when its time was over, if that is much of the gap, as a part of the answer."""
    ground, state, naming = ended.ground, ended.state, ended.naming
    left = state.current.cost.left_of(state.base.cost)
    if naming.named or not naming.gap or not state.current.hypothesis.placed or left > SO_FAR:
        return naming
    return naming if nonsense(ground, state.current) else replace(naming, final=state.current, named=True, refused="")


def believed(ground: Ground, begin: Hypothesis, known: Ended) -> Ended | None:
    """Return the end of a search on other windows with the names of an earlier one, if these leave nothing there.

    In most of the log at least, where windows may part into right and wrong.

    Args:
        ground: what the search would stand on.
        begin: the declared parameters' values.
        known: where the earlier one ended, with names.
    """
    report = ground.report
    report("trying the names on other windows", 0.0)
    ground = replace(ground, report=lambda stage, share: None)  # its parts are no stages of a search
    state = start(ground, begin, known.naming.first)
    if state.done:
        return None
    here = ground.at(state)
    current = here.refit(known.naming.final.hypothesis)
    state = renewed(here, replace(state, current=current, number=1, attempts=known.state.attempts))
    ended = conclude(replace(ground.at(state), report=report), state)
    cost, same = ended.naming.final.cost, len(ended.state.current.hypothesis.placed) == len(current.hypothesis.placed)
    return ended if same and ended.naming.named and (ended.naming.partial or not remains(cost, ground.rules)) else None


def start_anywhere(ground: Ground, begin: Hypothesis) -> State:
    """Return :func:`start`, on all windows where those that refits use show nothing: a gap may show in a few only."""
    state, count = start(ground, begin), len(ground.evidence.windows)
    if not state.done or count <= ground.most:
        return state
    every = start(replace(ground, few=count), begin)
    return state if every.done else every


def start(ground: Ground, begin: Hypothesis, first: Screening | None = None) -> State:
    """Fit the declared parameters alone, with the influence of single windows capped, and screen beside them.

    Args:
        ground: what the search stands on.
        begin: the declared parameters' values.
        first: the screening, where it is known from other windows.
    """
    ground.report("fitting the declared parameters", 0.0)
    since = np.zeros(len(ground.evidence.windows.commands), dtype=int)
    base = ground.refit(begin)
    noise = noise_beside(ground.evidence, ground.short, base)
    ground, base = with_base(ground.on(noise, since), base.hypothesis)
    bare = State(noise, since, ground.caps, base, NOTHING, base, few=ground.most)
    ground, state = restarted(ground, bare)
    base, missing = state.base, significant(state.base.cost, ground.rules)
    if not missing:
        ground.report("what is left looks like noise", 0.0)
    if first is None:
        ranked, focus = ground.screened(base), ground.focus(base)
        degrees = focus.evidence.degrees(focus.fitted.linear)
        first = Screening(tuple(ranked), focus.residual, focus.slope, degrees)
    return replace(state, first=first, done=not missing)


def step(ground: Ground, state: State, on_found: Callable[[State], None] = lambda state: None) -> State:
    """Accept one or two more effects, and swap those accepted before for better ones.

    Args:
        ground: what the search stands on.
        state: with the effects accepted before.
        on_found: called with the state once something is accepted, and again before anything is swapped.
    """
    found = add(ground, state)
    if not found.done:
        on_found(replace(found, number=state.number + 1))
        rest = significant(found.current.cost, ground.rules)
        ground.report("part of it is explained" if rest else "all but noise is explained", 1.0)
    if state.number == 0:
        found = with_family(ground, state, found)
    if found.family:
        return replace(renewed(ground, found), number=1)
    if found.done:
        return found
    number = state.number + 1
    on_found(replace(found, number=number))
    found = renewed(ground, found)
    if not np.array_equal(found.noise, state.noise):
        found = reconsidered(ground.at(found), found)
    on_found(replace(found, number=number))
    ground, accepted = ground.at(found), found.current.hypothesis
    if ground.evidence.robust and not is_done(ground, found):
        found = everywhere(ground, found)
    elif significant(found.current.cost, ground.rules):
        found = extend(ground, found)
    done = is_done(ground, found)
    if not done and len(found.current.hypothesis.placed) > 1:
        found = swap(ground, found)
    if found.current.hypothesis != accepted:
        found = renewed(ground, found)
        done = is_done(ground.at(found), found)
    return replace(found, number=number, done=done or number >= ground.rules.effects)


def conclude(ground: Ground, state: State) -> Ended:
    """Drop what is not needed, and judge whether the rest accounts for the gap."""
    gap = significant(state.base.cost, ground.rules)
    unnamed = Naming(ground.evidence, state.base, state.first, state.base, gap)
    if not gap:
        return Ended(ground, state, unnamed)
    if state.family:
        return Ended(ground, state, conclude_family(ground, state, unnamed))
    count = len(state.current.hypothesis.placed)
    if count and not may_account(ground, state):
        return Ended(ground, state, replace(unnamed, attempts=state.attempts, refused=state.refused))
    pruned = state
    if count:
        ground.report(f"checking {count} effect{'s' if count > 1 else ''}", 0.0)
        pruned = prune(ground, state)
    return Ended(ground, pruned, judged(ground, pruned, state.current, unnamed))


def may_account(ground: Ground, state: State) -> bool:
    """Return whether effects, or some of them, may account for the gap: together they leave little enough of it."""
    current, rules = state.current, ground.rules
    most = max(1 - rules.accounted, may_leave(current, rules))
    return ground.clears(state.base, current) or current.cost.left_of(state.base.cost) <= most


def judged(ground: Ground, state: State, found: Refit, unnamed: Naming) -> Naming:
    """Return the effects that are left of those found with names, if they account for the gap; else without."""
    base, rules = state.base, ground.rules
    unnamed = replace(unnamed, attempts=state.attempts, refused=state.refused)
    if reasons := nonsense(ground, state.current):
        return replace(unnamed, refused=reasons[0])
    placed, partial = state.current.hypothesis.placed, ground.clears(base, state.current)
    if not placed or not (partial or accounts_finely(ground, state.current, base)):
        unsure = found.hypothesis.placed and accounts(found, base, rules)
        return replace(unnamed, refused=UNSURE if unsure else state.refused)
    if not partial and imitates(ground, state.current):
        return replace(unnamed, refused=IMITATES)
    return replace(unnamed, refused="", final=state.current, named=True, partial=partial)


def with_ties(ended: Ended, end: float = math.inf) -> Naming:
    """Return what was found, and what ties with it; first what surpasses it, where the search did not come by that.

    Args:
        ended: what was found.
        end: when no more ties are looked for, by ``time.monotonic``.
    """
    naming, ground = ended.naming, ended.ground
    if not naming.named or naming.family:
        return naming
    state, everywhere = alike_everywhere(ground, ended.state)  # one fit, for which there is always time
    try:
        tied, shares, state = rivals_of_all(ground.reporting(until(ground.report, end)), state, everywhere)
    except OutOfTime as error:
        alike = tuple(with_those(everywhere, state, ((),) * len(state.current.hypothesis.placed)))
        shares = list(shares_of(ground, state.current))
        unfinished = naming.unfinished or f"{error}, with all that was found named"
        return replace(naming, final=state.current, ties=alike, shares=tuple(shares), unfinished=unfinished)
    if surpasses(ground, state.current, ended.state.current):
        return with_ties(continued(ground, state, naming.unfinished), end)
    state, told = canonical(ground, state, tied)
    return replace(naming, final=state.current, ties=told, shares=tuple(shares), attempts=state.attempts)


def continued(ground: Ground, state: State, unfinished: str) -> Ended:
    """Return where a search ends that goes on from a better hypothesis; one whose time was over only judges it."""
    state = renewed(ground, state)
    full = state.number >= ground.rules.effects
    state = replace(state, done=bool(unfinished) or full or is_done(ground.at(state), state))
    while not state.done:
        state = step(ground.at(state), state)
    ended = conclude(ground.at(state), state)
    return replace(ended, naming=replace(ended.naming, unfinished=unfinished))


def beside_noise(ended: Ended, end: float = math.inf) -> Ended:
    """Return where a search ended, with the effects that a likelihood ratio shows in what looked like noise.

    Args:
        ended: what was found, or nothing.
        end: when no more are looked for, by ``time.monotonic``.
    """
    naming, ground = ended.naming, ended.ground
    if naming.family or naming.unfinished or (naming.gap and not naming.named):
        return ended
    try:
        state = with_faint(ground.reporting(until(ground.report, end)), ended.state)
    except OutOfTime:
        return ended
    if state.current.hypothesis == ended.state.current.hypothesis:
        return ended
    here = ground.at(state)
    naming = replace(naming, evidence=here.evidence, base=state.base, final=state.current, gap=True, named=True)
    faint = tuple(range(len(ended.state.current.hypothesis.placed), len(state.current.hypothesis.placed)))
    return Ended(here, state, replace(naming, attempts=state.attempts, faint=faint))


def instead_of_one(ended: Ended) -> Ended:
    """Return where a search ends that begins with two effects in the place of one that leaves what is wrong.

    One that explains most of a gap, such as a lag, may stand for two, such as a delay and friction: pairs are not
    tried beside it. They take its place if they remove most of what it leaves.
    """
    ground, state = ended.ground, ended.state
    alive = [c for c in state.first.ranked if not c.dead]
    if len(state.current.hypothesis.placed) != 1 or len(state.current.hypothesis.placed[0].values) != 1:
        return ended
    found, tried = paired(ground, replace(state, current=state.base), alive)
    if not found or found[0].cost.left_of(state.current.cost) > 1 - ground.rules.most:
        return ended
    better = continued(ground, replace(tried, current=found[0], done=False), ended.naming.unfinished)
    return better if better.naming.named else ended


def resort(ground: Ground, naming: Naming) -> Naming:
    """Return the base family, if it accounts for a gap for which no search has names; else what was found.

    Also where there are names that leave what is wrong, if it leaves far less.

    Args:
        ground: what the searches stood on.
        naming: what one of them found.
    """
    if not has_family(ground):
        return naming
    evidence = replace(naming.evidence, caps=1.0)
    here, base = with_base(replace(ground, evidence=evidence), naming.base.hypothesis)
    whole = whole_family(here, fitted_family(here, base.hypothesis))
    if whole is None or (naming.named and not leaves_far_less(here, whole, naming.final.hypothesis)):
        return naming
    since = np.zeros(len(evidence.windows.commands), dtype=int)
    state = State(evidence.noise, since, here.caps, base, naming.first, whole, done=True, family=True, few=here.most)
    state = renewed(here, replace(state, attempts=naming.attempts))
    found = conclude_family(here.at(state), state, replace(naming, evidence=here.at(state).evidence, base=state.base))
    return found if found.named else naming


def leaves_wrong(naming: Naming, ground: Ground) -> bool:
    """Return whether names that are no base family leave what is wrong, throughout the log."""
    wrong = naming.final.cost.reduced > ground.rules.sound.wrong
    return naming.named and not naming.family and not naming.partial and wrong


def leaves_far_less(ground: Ground, whole: Refit, rival: Hypothesis) -> bool:
    """Return whether the base family leaves far less than named effects do that are fitted to the same windows."""
    return whole.cost.left_of(ground.refit(rival).cost) < ground.rules.family.instead


def conclude_family(ground: Ground, state: State, unnamed: Naming) -> Naming:
    """Judge whether the base family accounts for the gap; its members are not exchanged one by one for others."""
    current = state.current
    reasons = nonsense(ground, current)
    if reasons or not family_accounts(current, state.base, ground.rules):
        return replace(unnamed, attempts=state.attempts, refused=reasons[0] if reasons else LEAVES)
    beside, rests = with_absent(ground, current), remains(current.cost, ground.rules)
    whole = frozenset(of_all_joints(ground, current.hypothesis.placed) if rests else ())
    return replace(
        unnamed, refused="", final=current, named=True, family=True, everywhere=whole,
        ties=family_ties(ground, current, beside),
        left_out=left_out(ground, current, beside), shares=shares_of(ground, current), attempts=state.attempts,
    )  # fmt: skip
