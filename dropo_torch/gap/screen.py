"""Which candidates could explain the gap: one linear prediction each, all on the same few windows.

A candidate is tried from each of its starts. There, the projected residuals and their derivatives by the candidate's
numbers, by the declared parameters and by the effects that were accepted already predict the χ² that a full fit would
reach. The prediction only ranks; a refit decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Protocol

import numpy as np

from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.effects.engine import Variant, parts
from dropo_torch.gap.evidence import Cost, Evidence
from dropo_torch.gap.limbs import by_limbs
from dropo_torch.gap.refit import Hypothesis, Limits, Refit, beside, derivatives, limits_of, refit
from dropo_torch.gap.rules import Tried

#: Difference step of a candidate's numbers, relative to their scale.
STEP = 2e-3
#: Damping and ridge of the predicted moves; ridge, of columns of length 1, where only χ² is predicted.
DAMPING, RIDGE, FAINT = 1e-6, 1e-10, 1e-9
#: Shares of the way from where a candidate begins to where it is predicted that are tried, too.
ALONG = (0.75, 0.5, 0.25, 0.125)
#: Times that a start is looked for between one that does nothing and one that does harm.
HALVINGS = 4
#: Candidates that one batch of simulations holds.
BATCH = 96


class Beside(Protocol):
    """What candidates are compared beside: residuals ``(W·N,)`` of a hypothesis, and their derivatives."""

    @property
    def residual(self) -> np.ndarray:
        """Weighted residuals, ``(W·N,)``."""

    @property
    def slope(self) -> np.ndarray:
        """Their derivatives by the hypothesis' numbers, ``(q, W·N)``."""


@dataclass(frozen=True)
class Focus:
    """A fitted hypothesis on the few windows on which others are compared with it.

    Attributes:
        evidence: the windows.
        fitted: the hypothesis there.
    """

    evidence: Evidence
    fitted: Refit

    @cached_property
    def factor(self) -> np.ndarray:
        """Factors of the residuals under which least squares is what the fit minimized, ``(W·N,)``."""
        return np.repeat(self.evidence.caps * self.fitted.factor, self.fitted.residual.shape[1])

    @cached_property
    def residual(self) -> np.ndarray:
        """Weighted residuals of the fitted hypothesis, ``(W·N,)``."""
        return self.fitted.residual.ravel() * self.factor

    @cached_property
    def slope(self) -> np.ndarray:
        """Their derivatives by its numbers, ``(q, W·N)``."""
        return self.fitted.slope.reshape(len(self.fitted.slope), self.factor.size) * self.factor

    @cached_property
    def simulated(self) -> np.ndarray:
        """Residuals of the fitted hypothesis as they are, ``(W, N)``."""
        return self.evidence.residuals([self.fitted.hypothesis.variant])[0][0]

    @property
    def cost(self) -> Cost:
        """The misfit of the fitted hypothesis."""
        return self.evidence.cost(self.fitted.residual, self.fitted.linear)

    def beside(self, variants: Sequence[Variant]) -> np.ndarray:
        """Return residuals of hypotheses near the fitted one, ``(K, W, N)``.

        Where that has a finer step, what they change is taken from a coarser one; see :meth:`Evidence.changes`.
        """
        own = self.fitted.hypothesis
        if not any(p.effect.steps for p in own.placed):
            return self.evidence.beside(own.variant, self.simulated, variants)
        return self.simulated + self.evidence.changes(own.variant, self.simulated, variants)


@dataclass(frozen=True)
class Candidate:
    """What one start of a candidate promises.

    Attributes:
        placed: the effect with the predicted numbers.
        start: the effect where the prediction began.
        chi2: predicted χ² on the screened windows.
        residual: projected residuals at the candidate's start, ``(W·N,)``.
        slope: projected derivatives by its numbers, ``(p, W·N)``.
        dead: whether it changes nothing in these windows.
    """

    placed: Placed
    start: Placed
    chi2: float
    residual: np.ndarray
    slope: np.ndarray
    dead: bool

    @property
    def key(self) -> tuple[str, str | None]:
        """Effect and target."""
        return self.placed.key


def all_candidates(setting: Setting, effects: Sequence[Effect]) -> Iterator[Placed]:
    """Yield every effect that is looked for by itself at every target, at each of its starts."""
    for effect in (e for e in effects if e.alone):
        for target in effect.targets(setting):
            for start in effect.starts(setting, target):
                yield Placed(effect, target, tuple(float(v) for v in start))


def screen(
    focus: Focus,
    candidates: Sequence[Placed],
    tried: Tried,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Candidate]:
    """Return each candidate from its best start, the most promising first.

    Args:
        focus: the fitted hypothesis so far, on the windows to screen on.
        candidates: effects at their starts.
        tried: thresholds.
        on_progress: called with the share of candidates that is done.
    """
    taken = {p.called for p in focus.fitted.hypothesis.placed}
    waiting, found = [c for c in candidates if c.called not in taken], list[Candidate]()
    waiting.sort(key=lambda c: c.effect.has("force"))  # forces are asked step by step, of all of a batch at once
    for rows in parts(len(waiting), BATCH):
        found += _predict(focus, waiting[rows], tried.dead)
        on_progress(rows.stop / len(candidates))
    found += _between(focus, found, tried.dead)
    best: dict[tuple[str, str | None], Candidate] = {}
    for candidate in sorted(found, key=lambda c: (c.dead, c.chi2)):
        best.setdefault(candidate.key, candidate)
    return list(best.values())


def _between(focus: Focus, found: Sequence[Candidate], least: float) -> list[Candidate]:
    """Predict from starts between one that does nothing in these windows and the next one, which only does harm.

    A limit of force that binds in one window of many acts below the largest force there, and does harm not far below.
    """
    apart, more = _apart(focus, found), list[Candidate]()
    for _ in range(HALVINGS):
        middle = [harmful.at([_middle(idle, harmful.values[0])]) for idle, harmful in apart]
        tried = [c for rows in parts(len(middle), BATCH) for c in _predict(focus, middle[rows], least)]
        more += tried
        left = [(ends, c) for ends, c in zip(apart, tried, strict=True) if not _helps(c, focus)]
        apart = [(c.start.values[0], ends[1]) if c.dead else (ends[0], c.start) for ends, c in left]
    return more


def _apart(focus: Focus, found: Sequence[Candidate]) -> list[tuple[float, Placed]]:
    """Number that does nothing and start that does harm, beside each other, of each candidate that never helps.

    Starts may do nothing, and so does the neutral number of a limit; friction or a delay acts from zero on.
    """
    groups: dict[tuple[str, str | None], list[Candidate]] = {}
    for c in found:
        if c.placed.effect.shares and len(c.placed.values) == 1:
            groups.setdefault(c.key, []).append(c)
    apart = []
    for members in groups.values():
        first = members[0].start
        limit = first.effect.quantities(focus.evidence.twin.setting, first.target)[0]
        harmful = [c.start for c in members if not c.dead]
        if limit.discrete or not harmful or any(_helps(c, focus) for c in members):
            continue

        def strength(number: float, neutral: float = limit.neutral) -> float:
            return abs(number - neutral)

        weakest = min(harmful, key=lambda p: strength(p.values[0]))
        idle = [c.start.values[0] for c in members if c.dead] + [limit.neutral] * (limit.neutral >= limit.high)
        weaker = [number for number in idle if strength(number) < strength(weakest.values[0])]
        if weaker:
            apart.append((max(weaker, key=strength), weakest))
    return apart


def _helps(candidate: Candidate, focus: Focus) -> bool:
    """Whether a candidate is predicted to leave less than the fitted hypothesis."""
    return not candidate.dead and candidate.chi2 < float(focus.residual @ focus.residual)


def _middle(one: float, other: float) -> float:
    """Return the geometric mean of two numbers of one sign, otherwise their mean."""
    return float(np.sign(one) * np.sqrt(one * other)) if one * other > 0 else 0.5 * (one + other)


@dataclass(frozen=True)
class _Plan:
    """How a candidate's prediction is simulated.

    Attributes:
        placed: the candidate at its start.
        variant: the hypothesis with it.
        moving: which of its numbers move, ``(q,)``.
        limits: bounds and scales of these.
        moves: by which they are moved, in units of their scales, ``(q, q)``.
        rows: the simulations that belong to it.
    """

    placed: Placed
    variant: Variant
    moving: np.ndarray
    limits: Limits
    moves: np.ndarray
    rows: slice

    @property
    def start(self) -> np.ndarray:
        """The numbers that move, as they begin, ``(q,)``."""
        return np.array(self.placed.values)[self.moving]

    def settled(self, move: np.ndarray) -> np.ndarray:
        """Return all of its numbers after a move ``(q,)`` that was predicted to first order."""
        start = np.array(self.placed.values)
        values = start.copy()
        values[self.moving] += move * self.limits.scale
        return self.placed.effect.settle(start, values)

    def allows(self, move: np.ndarray) -> bool:
        """Return whether what a move stands for is within the bounds."""
        there = self.settled(move)[self.moving]
        return bool(np.all((self.limits.low <= there) & (there <= self.limits.high)))


def _predict(focus: Focus, part: Sequence[Placed], least: float) -> Iterator[Candidate]:
    """Simulate candidates at their starts and beside them, in one batch, and predict.

    A neutral start is the fitted hypothesis itself, but for filters: these may act under a step of their own, and what
    they show first is from before the window.
    """
    evidence, linear, factor = focus.evidence, focus.fitted.linear, focus.factor
    variants: list[Variant] = []
    plans = []
    for placed in part:
        hypothesis = focus.fitted.hypothesis.with_effects([placed])
        chosen, size = placed.effect.screened(), len(placed.values)
        moving = np.arange(size) if chosen is None else np.array(chosen, dtype=int)
        limits = limits_of(hypothesis, evidence.twin)
        moving = moving[limits.free[len(hypothesis.vector) - size + moving]]
        columns = len(hypothesis.vector) - size + moving
        moved, moves = beside(hypothesis, limits, columns, STEP)
        begins = [] if placed.is_neutral(evidence.twin.setting) and not placed.effect.is_filter else [hypothesis]
        own = [h.variant for h in (*begins, *moved)]
        rows = slice(len(variants), len(variants) + len(own))
        variants += own
        plans.append(_Plan(placed, hypothesis.variant, moving, limits.of(columns), moves, rows))
    found = focus.beside(variants)
    before, shared = focus.residual, focus.slope
    for plan in plans:
        size = len(plan.moves)
        begin, *there = found[plan.rows] if size < len(found[plan.rows]) else (focus.simulated, *found[plan.rows])
        residual = evidence.project(begin, linear).ravel() * factor
        changes = np.reshape(there, (size, *begin.shape)) - begin
        slope = evidence.project_slope(derivatives(changes, plan.moves), linear).reshape(size, factor.size) * factor
        known = evidence.twin.knows(plan.variant, evidence.windows)
        here = np.repeat(known, len(residual) // len(known))  # windows whose commands it does not know stay as they are
        residual, slope = np.where(here, residual, before), slope * here
        lengths = np.sqrt((slope**2).sum(1))
        dead = bool(np.linalg.norm(residual - before) < least and lengths.max(initial=0.0) < least)
        columns = np.concatenate([shared, slope])
        move = _move(columns * here, residual * here, plan)
        left = ((residual + move @ columns) ** 2).reshape(len(evidence.windows), -1).sum(-1)
        chi2 = promised(float(left[known].mean() * len(left)) if known.any() else np.inf)
        predicted = plan.placed.at(plan.settled(move[len(shared) :]))
        yield Candidate(predicted, plan.placed, chi2, residual, slope, dead)


def _move(columns: np.ndarray, residual: np.ndarray, plan: _Plan) -> np.ndarray:
    """Least-squares move whose last entries, those of the candidate's own numbers, stay within bounds."""
    normal, shared = columns @ columns.T, len(columns) - len(plan.moves)
    diagonal = np.diag(normal)
    damped = normal + np.diag(DAMPING * diagonal + RIDGE * diagonal.max(initial=1e-300))
    move = np.linalg.solve(damped, -(columns @ residual))
    if plan.allows(move[shared:]):
        return move
    own = np.clip(move[shared:], *plan.limits.moves(plan.start))
    if not np.array_equal(own, move[shared:]):
        rest = residual + own @ columns[shared:]
        move[:shared] = np.linalg.solve(damped[:shared, :shared], -(columns[:shared] @ rest))
        move[shared:] = own
    return move


def nearer(focus: Focus, origin: Hypothesis, candidate: Candidate) -> Placed:
    """Return a candidate with the numbers, from those begun with to the predicted, that explain most.

    A prediction goes too far where an effect does less and less the larger it is, such as friction that holds a joint.
    """
    begin, end = np.array(candidate.start.values), np.array(candidate.placed.values)
    between = [candidate.placed.at(begin + share * (end - begin)) for share in ALONG]

    def loss(placed: Placed) -> float:
        hypothesis = origin.with_effects([placed])
        return refit(focus.evidence, hypothesis, linear=focus.fitted.linear, iterations=0, slopes=False).loss

    return min((candidate.placed, candidate.start, *between), key=loss)


def promising_families(focus: Focus, candidates: Sequence[Candidate], tried: Tried) -> list[list[Placed]]:
    """Return the effects of one number that, at several of their targets together, predict the least χ².

    Friction or damping is seldom missing in one joint only: it is at all of them, or at the same joint of each limb. A
    family is offered where it promises much less than what its best single member leaves, and with it the one that does
    the same.
    """
    families: dict[str, list[Candidate]] = {}
    for c in candidates:
        if not c.dead and len(c.placed.values) == 1:
            families.setdefault(c.placed.effect.name, []).append(c)
    setting, whole = focus.evidence.twin.setting, list(families.values())
    parts = [[m[i] for i in rows] for m in whole for rows in by_limbs(setting, [c.placed for c in m])]
    found = list[list[Placed]]()
    for groups in (whole, parts):
        best = _best(focus, [members for members in groups if len(members) > 1])
        clear = (members for left, members in best if left < tried.clearer * min(c.chi2 for c in members))
        found += [[c.placed for c in members] for members in clear][: tried.families]
    known = {group[0].effect.name for group in found}
    alike = dict.fromkeys(name for group in found for name in group[0].effect.everywhere_like if name not in known)
    return found + [[c.placed for c in families[name]] for name in alike if len(families.get(name, ())) > 1]


def promising_pairs(focus: Focus, candidates: Sequence[Candidate], tried: Tried) -> list[list[Placed]]:
    """Return the pairs of candidates that together predict the least χ², the best first."""
    alive = combinations([c for c in candidates if not c.dead], 2)
    pairs = (pair for pair in alive if len({c.placed.called for c in pair}) == 2)
    return [[c.placed for c in pair] for _, pair in _best(focus, pairs)[: tried.pairs]]


def _best(focus: Focus, groups: Iterable[Sequence[Candidate]]) -> list[tuple[float, Sequence[Candidate]]]:
    """Groups of candidates with the χ² that they leave together, the best first."""
    return sorted(((left_by(focus, members), members) for members in groups), key=lambda item: item[0])


def left_by(beside: Beside, members: Sequence[Candidate]) -> float:
    """Return the χ² that is left beside the shared numbers, the members' numbers, and the steps to their starts."""
    before = beside.residual
    steps = [(c.residual - before)[None] for c in members]
    columns = np.concatenate([beside.slope, *(c.slope for c in members), *steps])
    norm = np.sqrt((columns**2).sum(1))
    columns = columns[norm > 0] / norm[norm > 0, None]
    gradient = columns @ before
    normal = columns @ columns.T + FAINT * np.eye(len(columns))
    return promised(float(before @ before - gradient @ np.linalg.solve(normal, gradient)))


def promised(chi2: float) -> float:
    """Return a predicted χ² by which candidates may be sorted: infinite where it is no number."""
    return np.inf if np.isnan(chi2) else chi2
