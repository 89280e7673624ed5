"""What decides in the search for names: every threshold, and comparisons of hypotheses by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dropo_torch.gap.chance import least_surplus, p_of_gain, p_of_stretch

if TYPE_CHECKING:
    from dropo_torch.gap.evidence import Cost
    from dropo_torch.gap.refit import Hypothesis, Refit


@dataclass(frozen=True)
class Chance:
    """How often chance may decide.

    Attributes:
        error: share of logs in which an effect that has nothing to do with the gap may get a name: the level of each
            named effect's test against what is left without it, over all candidates together (Bonferroni).
        explore: level at which the search goes on with an effect; it only costs time, for the test above decides.
        open: level up to which an effect that misses ``error`` on the windows that refits use is judged on all.
        blocks: stretches of the log that count as independent, at least, where it has as many windows: of fewer than
            about 15, no ranks are sure enough among hundreds of candidates.
        judged: times that χ² along one direction may be what it is by noise, where all residuals together look like
            noise: its size is only estimated, and it need not be white.
        worth: share of χ² that an effect must explain there: less is not worth a name, however sure it is.
        beside: share that it must explain there of what is named already, which is right to no more than that.
    """

    error: float = 0.01
    explore: float = 0.05
    open: float = 1.0
    blocks: int = 20
    judged: float = 2.0
    worth: float = 0.02
    beside: float = 2e-5


@dataclass(frozen=True)
class Alike:
    """When two hypotheses explain a log alike: unless one is surely worse by more than what matters.

    Attributes:
        chi2: χ² that does not matter, however sure it is: odds of e² to one.
        share: share of the excess that does not matter, where the model's own error and not the noise decides.
        error: how often a true tie may be missed.
        excess: share of the excess, and
        sigmas: standard deviations of χ², by one of which a rival may be worse at all, however unsure that is; the
            search prefers fewer numbers among hypotheses within it.
        promising: share of what a named effect explains that a candidate may leave, to first order, to be tried.
        straight: share of what a named effect explains that the first screening may have left, to first order, for it
            to say which candidates are screened again as ties, and
        likely: the share below which they are.
        roughly, fully: candidates that are tried as ties of one effect, at most, by a rough refit and by a full one.
    """

    chi2: float = 4.0
    share: float = 0.01
    error: float = 0.05
    excess: float = 0.3
    sigmas: float = 4.0
    promising: float = 0.3
    straight: float = 0.1
    likely: float = 0.7
    roughly: int = 16
    fully: int = 8


@dataclass(frozen=True)
class Tried:
    """What the search tries. These cost time or miss a name; they give none.

    Attributes:
        refits: candidates that are refitted in a round.
        paired: candidates of which pairs are tried, where no single one removes most.
        pairs, families: of these, how many are refitted; as many families at all places, and at one joint of each limb.
        partners: how many are refitted as a pair with the best single candidate, as they promise the most beside it.
        anew: times that pairs are chosen, each without candidates that make the best of the ones before nonsense.
        clearer: share of what the best single one leaves below which a pair or a family takes its place.
        promises: share of the misfit that a rival for an accepted effect promises to leave, to be refitted;
        rivals: how many are.
        worse: excess of a rough fit, relative to the best one's, up to which it is fitted in full, and
        sigmas: standard deviations of χ² that it may have besides.
        slack: by how much a rough fit may leave more than lets the search go on, to be fitted in full beside the best.
        dead: standard deviations of the noise by which a candidate must move the screened windows to be judged.
    """

    refits: int = 7
    paired: int = 16
    pairs: int = 5
    partners: int = 3
    anew: int = 3
    families: int = 2
    clearer: float = 0.5
    promises: float = 0.8
    rivals: int = 3
    worse: float = 3.0
    sigmas: float = 10.0
    slack: float = 0.05
    dead: float = 1.5


@dataclass(frozen=True)
class Family:
    """When the base family, at all joints together, takes the place of the first effects found.

    Attributes:
        left: share of the excess that these must leave for it to be tried.
        clearer: share of what they leave below which it takes their place: of effects at some joints; and of one effect
            at three or more, or at a robot's only joint.
        hopeless: times that share which all members together may leave for those that are needed to be looked for; dry
            friction that creeps at rest, or changes along the range, then makes it smaller.
        instead: share of what named effects leave below which it takes their place in the end, where this is wrong.
        members: of it, so many must be needed at half of the joints.
        spare: share of the excess that it leaves at a joint by which dropping the members least needed there may raise
            it.
        delayed: share of the excess at a joint that a delay there must leave at most.
        nearly: share of the joints that must need a member of a kind for all of them to have it, where what remains is
            more than noise.
        sloped: share of the excess that it must leave at most where dry friction changes along the joints' ranges.
        sure: half-widths of its 90 % interval by which a member must in the end differ from none.
        iterations, rounds: of its fit, and how often those not needed are dropped, at most.
    """

    left: float = 3e-3
    clearer: tuple[float, float] = (0.05, 0.4)
    hopeless: float = 6.0
    instead: float = 0.5
    members: int = 2
    spare: float = 0.03
    delayed: float = 0.7
    nearly: float = 0.75
    sloped: float = 0.7
    sure: float = 1.8
    iterations: int = 24
    rounds: int = 8


@dataclass(frozen=True)
class Sound:
    """What may have a name, and what is said of the rest.

    Attributes:
        pushes: standard errors by which the fit would pass a bound of physics, were it none: then the number is absurd.
        edge: distance from a bound, relative to the number's scale, within which it is at it.
        floor: open-loop error, relative to what noise alone makes, up to which a model has skill although constant
            velocity predicts as well: where nothing accelerates, a perfect model is no better.
        astray: open-loop error, relative to what noise alone makes, from which on something remains besides the named
            effects although short windows hardly show it: a small force adds up.
        rest: χ² per degree of freedom from which on what remains beside the named effects is said in the first
            sentence. An estimate of the noise that is a fifth too low makes as much.
        model_error: χ² per degree of freedom from which on the last fit weighs residuals by their own sizes, since the
            model's own error decides.
        wrong, right: χ² per degree of freedom from which on a window is wrong, or a log with many numbers, and below
            which a window is right.
        idle: share of the excess that whatever was tried must leave, for it to be noise and no effect's; and χ² per
            degree of freedom of long stretches then is within ``floor`` times that of windows.
    """

    pushes: float = 3.0
    edge: float = 1e-3
    floor: float = 1.5
    astray: float = 5.0
    rest: float = 1.5
    model_error: float = 3.0
    wrong: float = 20.0
    right: float = 1.5
    idle: float = 0.9


@dataclass(frozen=True)
class Cut:
    """How long windows are: as long as their initial states act nearly linearly.

    Attributes:
        lengths: logged steps of a window that are tried, the longest first.
        blind: those before them where no velocity is measured: what a force does to positions grows with the square
            of the time; and
        seconds: that they may last at most, and
        enough: windows of such a length that the log must have.
        rough: share of residuals whose variance, over noise on the initial states, stays unexplained, up to which a
            length will do.
        bent: the share from which on windows are linearized statistically.
        gained: share of that of longer windows which shorter ones must have less than, to be taken where neither is
            below ``rough``.
        astray: typical error at a window's end, relative to the motion, from which on contacts come at other times than
            measured.
    """

    lengths: tuple[int, ...] = (30, 15, 8, 4)
    blind: tuple[int, ...] = (120, 60)
    seconds: float = 1.0
    enough: int = 10
    rough: float = 0.03
    bent: float = 0.001
    gained: float = 0.5
    astray: float = 0.08


@dataclass(frozen=True)
class Weighed:
    """How much windows and residuals count, and which noise is believed.

    Attributes:
        cap: largest share of all windows' χ² that one window may have.
        tail: expected χ² of a window, times this: from there on a robust cost grows with the logarithm only.
        known: least share of the windows that a hypothesis must know the commands of, or it cannot be judged by them.
        sharp: weight from which on a residual counts as one that noise on the initial state does not bend, and
        rows: the least of them that show a feature's noise.
        calm: standard deviations by which a window's χ² may exceed the median one's, for it to tell the noise.
        agree: standard errors by which the noise that long windows leave may exceed what short ones with free forces
            say.
        moved: relative change of a feature's noise from which on everything is compared again.
        growth: share of the motion's own standard deviation that noise at the start may grow to in an open-loop
            prediction.
    """

    cap: float = 0.03
    tail: float = 3.0
    known: float = 0.25
    sharp: float = 0.999
    rows: int = 60
    calm: float = 4.0
    agree: float = 4.0
    moved: float = 0.03
    growth: float = 0.1


@dataclass(frozen=True)
class Shown:
    """What is told of where and when a gap shows; none of it gives a name.

    Attributes:
        place: share of the gap from which on a place is listed.
        places: places that are listed at most.
        regime: p-value, over blocks of the log, below which a regime is told.
        correlation: squared rank correlation of the missing force from which on a regime is told, and
        better: by how much a less plain one must exceed a plainer one's, absolute and relative.
        constant: share of the force's mean square in its mean, and
        sure: standard errors of the mean, from which on the force is always the same.
        changes: how many times larger the missing force's typical square is in one part of the log, to be told so.
        term: share of an unnamed force's root mean square below which its formula has no such term.
        formula: share of its mean square below which no formula is offered, and
        terms: the most terms that one may have.
        apart: standard deviations of the noise by which a motion must separate two hypotheses to be proposed.
    """

    place: float = 0.05
    places: int = 8
    regime: float = 0.01
    correlation: float = 0.05
    better: tuple[float, float] = (0.02, 1.05)
    constant: float = 0.5
    sure: float = 5.0
    changes: float = 30.0
    term: float = 0.15
    formula: float = 0.5
    terms: int = 5
    apart: float = 5.0


@dataclass(frozen=True)
class Forces:
    """When the forces that were logged at all joints give names, where open-loop predictions have no skill.

    Attributes:
        left: share of the forces' mean squares on unseen data, averaged over the joints, that may be left.
        clearer: what may be left, relative to what effects leave that predictions named, to take their place.
        error: how often chance may give an effect a name there, over all effects that forces can tell, and an effect of
            one number, over all of its kind.
        blocks: stretches of the log that count as independent, at least and at most.
        sampled: change of the logarithm of a joint's missing force, where every second row of the log is left out, from
            which on sampling makes too much of it.
        gives: share of what friction leaves that depends on the velocity alone, at its joint, that friction which gives
            before it slides may leave to take its place.
    """

    left: float = 0.25
    clearer: float = 0.7
    error: float = 0.05
    blocks: tuple[int, int] = (8, 20)
    sampled: float = 0.2
    gives: float = 0.9


@dataclass(frozen=True)
class Disturbed:
    """When spans of the log are told as pushes that are no part of the robot.

    Attributes:
        typical: χ² per degree of freedom of a typical stretch, at most; as if that were noise, others stand out.
        share: share of the log that spans take, at most.
        spans: spans, at most.
        minor: share of what the worst stretch leaves up to which another one is none, for the model errs there
            otherwise.
        sure: standard errors of a joint's free force, by which it is one; and
        left: χ² per degree of freedom that free forces may leave; or the
        rest: share of what the model leaves there.
        near: distance of a joint's position, velocity and commands from those of another time, in their standard
            deviations, within which it moved alike there.
    """

    typical: float = 3.0
    share: float = 0.1
    spans: int = 6
    minor: float = 0.02
    sure: float = 5.0
    left: float = 2.0
    rest: float = 0.01
    near: float = 0.5


@dataclass(frozen=True)
class Rules:
    """Thresholds of the naming; the same for every log, since all they compare is in units of the noise.

    Attributes:
        gate: excess in standard deviations of χ² from which on something is missing.
        least_reduced: χ² per degree of freedom below which nothing is, since the noise itself is only estimated.
        most: share of the excess that an effect removes without that pairs are tried in its place.
        accounted: share of the first excess that the named effects must remove together, or nothing has a name.
        misjudged: share that few numbers may leave where it is no more than ``sound.rest``: so much may be wrong with
            the estimate of the noise.
        own_step: likewise where all that is named is the model's own step, and what it leaves no more than noise.
        free: numbers of the named effects beyond which each halves what they may leave, for many numbers together
            imitate what none of them is; what they leave must be less than ``sound.wrong`` then.
        hopeless: share of the excess that the best candidate of a round may leave, or the search ends;
        imitating: the share where what is named has more numbers than are ``free``, and is still wrong.
        least: share of the first excess below which an effect is not named.
        effects: the most effects that are named.
        chance, alike, tried, family, sound, cut, weighed, forces, disturbed, shown: see there.
    """

    gate: float = 5.0
    least_reduced: float = 1.1
    most: float = 0.8
    accounted: float = 0.95
    misjudged: float = 0.1
    own_step: float = 0.3
    free: int = 3
    hopeless: float = 0.8
    imitating: float = 0.5
    least: float = 3e-3
    effects: int = 4
    chance: Chance = field(default_factory=Chance)
    alike: Alike = field(default_factory=Alike)
    tried: Tried = field(default_factory=Tried)
    family: Family = field(default_factory=Family)
    sound: Sound = field(default_factory=Sound)
    cut: Cut = field(default_factory=Cut)
    weighed: Weighed = field(default_factory=Weighed)
    forces: Forces = field(default_factory=Forces)
    disturbed: Disturbed = field(default_factory=Disturbed)
    shown: Shown = field(default_factory=Shown)


def significant(cost: Cost, rules: Rules) -> bool:
    """Return whether a misfit is more than noise."""
    return cost.misfit > rules.gate * cost.sigma and cost.reduced > rules.least_reduced


def remains(cost: Cost, rules: Rules) -> bool:
    """Return whether what named effects leave is so much more than noise that it must be said."""
    return significant(cost, rules) and cost.reduced > rules.sound.rest


def near(cost: Cost, rules: Rules) -> float:
    """Return how much more excess a hypothesis may have that is about as good."""
    return max(rules.alike.excess * max(cost.misfit, 0.0), rules.alike.sigmas * cost.sigma)


def beyond_free(hypothesis: Hypothesis, rules: Rules) -> int:
    """Return how many numbers named effects have more than are free; an effect at many places counts once.

    A finer step of the simulation, one of a few, imitates nothing and does not count.
    """
    placed = [p for p in hypothesis.placed if not p.effect.steps]
    sizes = {p.effect.name: 0 for p in placed}
    for p in placed:
        sizes[p.effect.name] = 1 if len(p.values) == 1 else sizes[p.effect.name] + len(p.values)
    return max(0, sum(sizes.values()) - rules.free)


def allowance(hypothesis: Hypothesis, rules: Rules) -> float:
    """Return the share of the first excess that named effects may leave."""
    return (1 - rules.accounted) * 0.5 ** beyond_free(hypothesis, rules)


def may_leave(named: Refit, rules: Rules) -> float:
    """Return the share of the first excess that a fit may leave; more of it where the noise may be misjudged."""
    most = allowance(named.hypothesis, rules)
    small = not beyond_free(named.hypothesis, rules) and not remains(named.cost, rules)
    if all(p.effect.steps for p in named.hypothesis.placed) and not significant(named.cost, rules):
        return rules.own_step  # the step that a simulator has claims nothing of the robot
    return max(most, rules.misjudged) if small else most


def most_left(current: Refit, rules: Rules) -> float:
    """Return the share of its excess that the best candidate beside a hypothesis may leave, or the search ends."""
    imitates = beyond_free(current.hypothesis, rules) and current.cost.reduced > rules.sound.wrong
    return rules.imitating if imitates else rules.hopeless


def is_hopeless(better: Refit, current: Refit, rules: Rules) -> bool:
    """Return whether what would be added to a hypothesis removes too little for the search to go on with it."""
    return better.cost.left_of(current.cost) > most_left(current, rules)


def accounts(named: Refit, base: Refit, rules: Rules) -> bool:
    """Return whether named effects remove as much of the excess as they must.

    With more numbers than are free, which together imitate much, what they leave must not be wrong besides.
    """
    if beyond_free(named.hypothesis, rules) and named.cost.reduced > rules.sound.wrong:
        return False
    return named.cost.left_of(base.cost) <= may_leave(named, rules)


def family_accounts(named: Refit, base: Refit, rules: Rules) -> bool:
    """Return whether a base family removes as much of the excess as it must.

    Its members are each needed beside all others, so their number does not count against them; nor does what is wrong
    besides: with much motion and little noise, the last hundredths of a real robot's misfit are many times the noise.
    """
    return named.cost.left_of(base.cost) <= 1 - rules.accounted


def clears(base: Refit, current: Refit, rules: Rules) -> bool:
    """Return whether effects leave no more than noise in most windows of a log of which most were wrong.

    What only imitates the truth makes all windows better and none of them right.
    """
    return bool(np.median(base.typical) > rules.sound.wrong and np.median(current.typical) < rules.sound.right)


def chance_of(better: Refit, worse: Refit, blocks: np.ndarray) -> float:
    """Return how likely a hypothesis is as much better by chance, over blocks of the log ``(W,)``."""
    numbers = max(1, len(better.hypothesis.vector) - len(worse.hypothesis.vector))
    right = better.cost.penalty  # what one that is right would leave
    everywhere = p_of_gain(_excesses(worse.cost, blocks, right), _excesses(better.cost, blocks, right), numbers)
    every = np.unique(blocks, return_inverse=True)[1]
    noise = np.sqrt(2 * worse.residual.shape[1] * np.bincount(every))
    before, after = (np.bincount(every, _plain(r)) for r in (worse, better))
    return min(1.0, 1.5 * everywhere, 3 * p_of_stretch(before, after, noise, numbers))


def _plain(fitted: Refit) -> np.ndarray:
    """Excess χ² of each window as it is, however it is capped ``(W,)``; none of those that do not count."""
    chi2 = (fitted.residual**2).sum(-1)
    return np.where(fitted.linear.counted, chi2 - fitted.linear.weights.astype(bool).sum(-1), 0.0)


def as_good(rival: Cost, own: Cost, blocks: np.ndarray, rules: Rules) -> bool:
    """Return whether a rival explains a log as well: it is not surely worse by more than what matters."""
    surplus = _excesses(rival, blocks, own.penalty) - _excesses(own, blocks, own.penalty)
    alike = rules.alike
    margin = max(alike.chi2, alike.share * own.misfit)
    return surplus.sum() < near(own, rules) and least_surplus(surplus, alike.error) <= margin


def _excesses(cost: Cost, blocks: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The excess of each block ``(B,)`` over that of a hypothesis with these penalties that is right."""
    windows = cost.windows + cost.penalty - right - cost.degrees / len(cost.windows)
    return np.bincount(np.unique(blocks, return_inverse=True)[1], windows)


def simplest(fitted: Sequence[Refit], rules: Rules) -> Refit:
    """Return, of hypotheses that are about as good as the best, the one with the fewest numbers."""
    best = fitted[0].cost
    good = (r for r in fitted if r.cost.excess <= best.excess + near(best, rules))
    return min(good, key=lambda r: (len(r.hypothesis.vector), r.cost.excess))
