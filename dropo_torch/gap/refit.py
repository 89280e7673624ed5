"""Fitting a hypothesis: its effects' numbers together with the declared parameters, and how certain they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.linalg import block_diag

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed
from dropo_torch.effects.engine import Variant
from dropo_torch.gap.evidence import Cost, Evidence, Linearization, robust_factors, robust_loss
from dropo_torch.gap.log import blocks_of
from dropo_torch.gap.rules import remains
from dropo_torch.gap.twin import Twin
from dropo_torch.optimizers.least_squares import bounded_step

#: Difference step and the smallest move that is worth another iteration, relative to a parameter's scale.
STEP, LEAST_MOVE = 1e-3, 2e-5
#: Longer difference step, where the simulation is rough, and times by which the short one must show more to jump.
LONG_STEP, JUMPS = 0.1, 2.0
#: Damping at first, at least, and at most.
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e4
#: Gain in loss that is worth another iteration, and its share in the loss.
LEAST_GAIN, LEAST_SHARE = 0.01, 1e-6
#: Share of what is more than noise that must be gained at least once in so many iterations.
SHARE, FEW_GAINS = 1e-4, 2
#: Times the last gain that each step to come is expected to gain at most.
PACE = 2.0
#: Free numbers from which on a step's own change of the residuals corrects their derivatives, which then serve for the
#: next one, if it has gained this share of what they promised.
MANY, KEPT = 12, 0.5
#: Ridge of a step, and its longest move relative to a parameter's scale.
RIDGE, LONGEST = 1e-12, 5.0
#: Ridge in units of a damping that rejected steps have raised: what has next to no influence here moves the least.
HELD = 1e-4
#: Move, relative to a parameter's scale, after which the initial states are linearised again, and steps that follow.
#: Beside contacts, how often, while what is more than noise falls by this share: what a change of the initial state
#: explains there is another thing for every load.
FAR, AGAIN, LINEARIZATIONS, LEAST_SHRUNK = 0.03, 4, 8, 0.05
#: Half-width of a 90 % interval in standard errors.
Z90 = 1.6449
#: Degrees of freedom that show a variance.
FEW = 30.0
#: The model's field that is its step.
STEP_FIELD = "opt.timestep"
#: Simulations with a finer step in which numbers settle there.
MOVES = 4
#: Iterations of a fit with the derivatives of a finer step.
ANEW = 8
#: Loss up to which a finer step that fits worse than the model's own is not told from it: χ² at 99 %.
UNTOLD = 6.6


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects with values, and the declared parameters.

    Attributes:
        declared: values of the declared parameters, ``(d,)``.
        placed: the effects, with values.
    """

    declared: tuple[float, ...]
    placed: tuple[Placed, ...] = ()

    @property
    def variant(self) -> Variant:
        """The hypothesis as the twin simulates it."""
        return Variant(self.declared, self.placed)

    @property
    def vector(self) -> np.ndarray:
        """All numbers, declared ones first."""
        return np.array([*self.declared, *(v for p in self.placed for v in p.values)])

    def at(self, vector: np.ndarray) -> Hypothesis:
        """Return the same with other numbers."""
        ends = np.cumsum([len(self.declared), *(len(p.values) for p in self.placed)])
        declared, *values, _ = np.split(vector, ends)
        placed = tuple(p.at(v) for p, v in zip(self.placed, values, strict=True))
        return Hypothesis(tuple(float(v) for v in declared), placed)

    def settled(self, vector: np.ndarray) -> np.ndarray:
        """Return the numbers ``(q,)`` that a linear prediction from these stands for."""
        there = self.at(vector).placed
        pairs = zip(self.placed, there, strict=True)
        values = [own.effect.settle(np.array(own.values), np.array(new.values)) for own, new in pairs]
        return np.concatenate([vector[: len(self.declared)], *values])

    @property
    def directions(self) -> np.ndarray:
        """The moves of all numbers along which differences are taken, ``(q, q)``."""
        blocks = [p.effect.directions(np.array(p.values)) for p in self.placed]
        return np.asarray(block_diag(np.eye(len(self.declared)), *blocks))

    def with_effects(self, placed: Sequence[Placed]) -> Hypothesis:
        """Return the same with more effects."""
        return replace(self, placed=(*self.placed, *placed))

    def without(self, index: int) -> Hypothesis:
        """Return the same without one of its effects."""
        return replace(self, placed=self.placed[:index] + self.placed[index + 1 :])

    def instead(self, index: int, placed: Placed) -> Hypothesis:
        """Return the same with another effect in the place of one."""
        return replace(self, placed=(*self.placed[:index], placed, *self.placed[index + 1 :]))


@dataclass(frozen=True)
class Limits:
    """Bounds and sizes of a hypothesis' numbers, ``(q,)`` each."""

    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Which numbers move, ``(q,)`` bool."""
        return self.low < self.high

    def moves(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and the largest move from values within the bounds, in units of the scale."""
        return (self.low - values) / self.scale, (self.high - values) / self.scale

    def of(self, columns: np.ndarray) -> Limits:
        """Return those of some of the numbers."""
        return Limits(self.low[columns], self.high[columns], self.scale[columns])


def limits_of(hypothesis: Hypothesis, twin: Twin) -> Limits:
    """Return the bounds and sizes of a hypothesis' numbers; both bounds of a discrete one are its value."""
    space = twin.space
    numbers = [(low, high, 0.25 * (high - low)) for low, high in zip(space.low, space.high, strict=True)]
    for p in hypothesis.placed:
        quantities = zip(p.effect.quantities(twin.setting, p.target), p.values, strict=True)
        numbers += [(v if q.discrete else q.low, v if q.discrete else q.high, q.scale) for q, v in quantities]
    return Limits(*np.array(numbers).reshape(-1, 3).T)


@dataclass(frozen=True)
class Refit:
    """A fitted hypothesis.

    Attributes:
        hypothesis: with the fitted numbers.
        cost: its misfit.
        residual: projected residuals, ``(W, N)``.
        slope: projected derivatives by all numbers, in units of their scale, ``(q, W, N)``.
        linear: the linearization in the initial states.
        scale: the numbers' scales, ``(q,)``.
        factor: factors of the windows' residuals that the robust cost ended with, ``(W,)``.
        loss: what the fit minimized.
    """

    hypothesis: Hypothesis
    cost: Cost
    residual: np.ndarray
    slope: np.ndarray
    linear: Linearization
    scale: np.ndarray
    factor: np.ndarray
    loss: float = 0.0

    def weighted(self, caps: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives ``(q, W·N)`` and residuals ``(W·N,)`` as the fit weighed them, by windows' ``caps``."""
        factor = np.broadcast_to(caps * self.factor, len(self.residual))[:, None]
        return (self.slope * factor).reshape(len(self.slope), self.residual.size), (self.residual * factor).ravel()

    @property
    def typical(self) -> np.ndarray:
        """χ² of each window, relative to what noise makes on average, ``(W,)``."""
        return (self.residual**2).sum(-1) * len(self.residual) / self.cost.degrees


def beside(
    hypothesis: Hypothesis, limits: Limits, columns: np.ndarray, step: float
) -> tuple[list[Hypothesis], np.ndarray]:
    """Return hypotheses that are moved a little, and their moves ``(c, c)`` in units of the numbers' scales.

    Each moves one number, or several along one of its effect's :meth:`~Effect.directions`.

    Args:
        hypothesis: where the differences are taken.
        limits: its numbers' bounds and scales.
        columns: which numbers are moved.
        step: by how much; backwards where the upper bound forbids it forwards.
    """
    vector, own = hypothesis.vector, limits.of(columns)
    steps = np.where(vector[columns] + step * own.scale <= own.high, step, -step)
    changes = np.zeros((len(columns), len(vector)))
    changes[:, columns] = (steps * own.scale)[:, None] * hypothesis.directions[np.ix_(columns, columns)]
    return [hypothesis.at(vector + change) for change in changes], changes[:, columns] / own.scale


def refit(
    evidence: Evidence, hypothesis: Hypothesis, *, linear: Linearization | None = None, iterations: int = 12,
    slopes: bool = True, target: float = math.inf,
) -> Refit:  # fmt: skip
    """Fit all numbers of a hypothesis by Levenberg-Marquardt on projected residuals.

    Derivatives cost a simulation of all windows for each number, so they are taken only where the fit goes on.

    Args:
        evidence: the windows.
        hypothesis: where to begin.
        linear: the linearization to use; by default at the hypothesis, and again at the result if that is far away.
        iterations: the most steps that make it better; others only shorten the next, and cost little.
        slopes: whether the result needs its derivatives; without them they may be zero.
        target: loss that it must come down to, or is of no interest: one that would not at its pace ends early.
    """
    limits = limits_of(hypothesis, evidence.twin)
    first = evidence.linearize(hypothesis.variant) if linear is None else linear
    last = _descent(evidence, hypothesis, first, limits, iterations, target)
    times = LINEARIZATIONS if evidence.twin.setting.signals.contacts.any() else 1
    for number in range(times if linear is None else 0):
        moved = _distance(last.here.hypothesis.vector, last.begin.hypothesis, limits) > FAR
        if not moved or (number and last.gain < LEAST_SHRUNK * last.begin.cost.misfit):
            break
        again = evidence.linearize(last.here.hypothesis.variant)
        last = _descent(evidence, last.here.hypothesis, again, limits, AGAIN, target)
    if slopes and not last.sloped:
        return _sloped(evidence, last.here, limits, last.residuals)
    return last.here


@dataclass(frozen=True)
class _Descent:
    """A fit with one linearization in the initial states: where it begins and ends, and residuals there ``(W, N)``."""

    begin: Refit
    here: Refit
    residuals: np.ndarray
    sloped: bool

    @property
    def gain(self) -> float:
        """How much of the loss is gone."""
        return self.begin.loss - self.here.loss


def _descent(
    evidence: Evidence, hypothesis: Hypothesis, linear: Linearization, limits: Limits, iterations: int, target: float
) -> _Descent:
    """Levenberg-Marquardt; derivatives by many numbers are carried on as long as steps gain what they promise.

    Only what derivatives taken where the fit stands say ends it.
    """
    linear = evidence.counting(linear, hypothesis.variant)
    here, residuals = _at(evidence, hypothesis, linear, limits, hypothesis.vector)
    begin, damping, taken, small, many = here, DAMPING, 0, 0, limits.free.sum() >= MANY
    sloped = carried = False
    while taken < iterations and damping <= MOST_DAMPING:
        if not (sloped or carried):
            here, sloped = _sloped(evidence, here, limits, residuals), True
        trial = here.hypothesis.vector + newton_step(here, limits, evidence.caps, damping) * limits.scale
        trial = here.hypothesis.settled(np.clip(trial, limits.low, limits.high))
        trial = np.clip(trial, limits.low, limits.high)
        near = _distance(trial, here.hypothesis, limits) < LEAST_MOVE
        if near and sloped:
            break
        there, found = (here, residuals) if near else _at(evidence, hypothesis, linear, limits, trial)
        if not there.loss < here.loss:
            damping, carried = damping if carried else damping * 6, False
            continue
        gain, damping, taken = here.loss - there.loss, max(damping / 8, LEAST_DAMPING), taken + 1
        small = small + 1 if gain < SHARE * here.cost.misfit else 0
        over = gain < LEAST_GAIN + LEAST_SHARE * here.loss or small >= FEW_GAINS
        was_sloped, sloped = sloped, False
        carried = many and not over and gain > KEPT * _promised(here, there, evidence.caps)
        here, residuals = (_corrected(here, there) if carried else there), found
        if over and was_sloped:
            break
        if here.loss - PACE * gain * (iterations - taken) > target:
            break
    return _Descent(begin, here, residuals, sloped)


def _promised(here: Refit, there: Refit, caps: np.ndarray | float) -> float:
    """What a step gains by the derivatives where it begins."""
    slope, residual = here.weighted(caps)
    left = residual + ((there.hypothesis.vector - here.hypothesis.vector) / here.scale) @ slope
    return float(residual @ residual - left @ left)


def _corrected(here: Refit, there: Refit) -> Refit:
    """A fit after a step with the derivatives before it, corrected to what it changed (Broyden 1965)."""
    step = (there.hypothesis.vector - here.hypothesis.vector) / here.scale
    wrong = there.residual - here.residual - np.tensordot(step, here.slope, 1)
    return replace(there, slope=here.slope + step[:, None, None] * (wrong / (step @ step)))


def _distance(vector: np.ndarray, other: Hypothesis, limits: Limits) -> float:
    return float(np.abs((vector - other.vector) / limits.scale).max(initial=0.0))


def _at(
    evidence: Evidence, hypothesis: Hypothesis, linear: Linearization, limits: Limits, vector: np.ndarray
) -> tuple[Refit, np.ndarray]:
    """A hypothesis at other numbers, its derivatives not taken yet, and its residuals ``(W, N)`` as they are."""
    there = hypothesis.at(np.clip(vector, limits.low, limits.high))
    found = evidence.residuals([there.variant])[0][0]
    return _fitted(evidence, there, found, np.zeros((len(vector), *found.shape)), linear, limits.scale), found


def _sloped(evidence: Evidence, here: Refit, limits: Limits, residuals: np.ndarray) -> Refit:
    """The same with its derivatives ``(q, W, N)``, none by discrete numbers, from its residuals ``(W, N)``.

    Where contacts flicker, a window jumps by as much as its noise however little a number moves, and a short difference
    shows nothing else: such windows have the longer one.
    """
    slope, columns = np.zeros_like(here.slope), np.flatnonzero(limits.free)
    if columns.size:
        slope[columns] = _differences(evidence, here, limits, residuals, columns, STEP)
    if columns.size and (evidence.rough or evidence.twin.setting.signals.contacts.any()):
        longer = _differences(evidence, here, limits, residuals, columns, LONG_STEP)
        jumps = np.linalg.norm(slope[columns], axis=-1) > JUMPS * np.linalg.norm(longer, axis=-1)
        slope[columns] = np.where(jumps[..., None], longer, slope[columns])
    return replace(here, slope=slope)


def _differences(
    evidence: Evidence, here: Refit, limits: Limits, residuals: np.ndarray, columns: np.ndarray, step: float
) -> np.ndarray:
    """Derivatives by some numbers ``(c, W, N)``, each moved by a step in its scale, from residuals ``(W, N)``."""
    moved, moves = beside(here.hypothesis, limits, columns, step)
    changes = evidence.changes(here.hypothesis.variant, residuals, [h.variant for h in moved])
    return evidence.project_slope(derivatives(changes, moves), here.linear)


def derivatives(changes: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return derivatives by numbers ``(c, W, N)``, in units of their scales, of changes along some of their moves.

    Args:
        changes: of residuals, ``(c, W, N)``, NaN where a simulation diverges; other numbers do not care.
        moves: see :func:`beside`.
    """
    slopes = [sum(row[k] * changes[k] for k in np.flatnonzero(row)) for row in np.linalg.inv(moves)]
    return np.reshape(slopes, changes.shape)


def _fitted(
    evidence: Evidence, hypothesis: Hypothesis, residuals: np.ndarray, slope: np.ndarray, linear: Linearization,
    scale: np.ndarray,
) -> Refit:  # fmt: skip
    """A hypothesis with its whitened residuals ``(W, N)`` and its projected derivatives."""
    residual, tail = evidence.project(residuals, linear), evidence.tail(linear)
    chi2 = ((residual * np.reshape(evidence.caps, (-1, 1))) ** 2).sum(-1)
    loss, factor = float(robust_loss(chi2, tail).sum()), robust_factors(chi2, tail)
    cost = evidence.cost(residual, linear, len(scale))
    return Refit(hypothesis, cost, residual, slope, linear, scale, factor, loss)


def newton_step(here: Refit, limits: Limits, caps: np.ndarray | float, damping: float) -> np.ndarray:
    """Return the damped step in units of the scales, ``(q,)``, of residuals with caps of their windows, ``(W,)``."""
    if not len(here.slope):
        return np.zeros(0)
    flat, residual = here.weighted(caps)
    low, high = limits.moves(here.hypothesis.vector)
    ridge = RIDGE if damping <= DAMPING else HELD * damping
    step = bounded_step(flat @ flat.T, -(flat @ residual), low, high, damping, ridge, np.ones(len(flat)))
    return np.clip(step, -LONGEST, LONGEST)


def standard_errors(fitted: Refit, episodes: np.ndarray) -> np.ndarray:
    """Return standard errors of all numbers of a fit ``(q,)``, in their units; infinite for those without influence.

    The larger of two: by the noise, of each feature as large as the residuals show; and by how much the blocks of the
    log disagree (the sandwich of cluster-robust errors), which also counts what the model still lacks.

    Args:
        fitted: a fit with its projected residuals and derivatives.
        episodes: trajectory of each window, ``(W,)``.
    """
    slope, residual = fitted.slope * fitted.factor[:, None], fitted.residual * fitted.factor[:, None]
    size = len(slope)
    if not size:
        return np.zeros(0)
    normal = np.einsum("awn,bwn->ab", slope, slope)
    diagonal = np.diag(normal)
    known = diagonal > 1e-12 * diagonal.max(initial=0.0)
    length = np.where(known, np.sqrt(np.maximum(diagonal, 0.0)), 1.0)
    unit = np.outer(length, length)
    shown = np.where(np.outer(known, known), normal / unit, np.eye(size))
    inverse = np.linalg.pinv(shown, rcond=1e-12, hermitian=True) / unit
    variance = _variances(fitted, residual)
    spread = np.tile(np.sqrt(variance), residual.shape[1] // len(variance))
    weighted = slope * spread
    by_noise = inverse @ np.einsum("awn,bwn->ab", weighted, weighted) @ inverse
    plain = np.sqrt(np.maximum(np.diag(by_noise), 0.0))
    blocks = blocks_of(episodes, 4)
    names = np.unique(blocks)
    scores = np.einsum("awn,wn->wa", slope, residual)
    sums = np.stack([scores[blocks == b].sum(0) for b in names])
    middle = sums.T @ sums * len(names) / max(len(names) - 1, 1)
    factor = stats.t.ppf(0.95, max(len(names) - 1, 1)) / Z90
    clustered = np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)) * factor
    return np.where(known, np.maximum(plain, clustered), np.inf) * fitted.scale


def _variances(fitted: Refit, residual: np.ndarray) -> np.ndarray:
    """Variance of each feature's weighted residuals ``(m,)`` per degree of freedom that the initial states leave it."""
    linear, m = fitted.linear, max(fitted.linear.num_features, 1)
    free = ((linear.weights > 0) * (1 - (linear.basis**2).sum(-1))).reshape(-1, m).sum(0)
    variance = (residual**2).reshape(-1, m).sum(0) / np.maximum(free, 1.0)
    return np.where(free > FEW, variance * free.sum() / max(free.sum() - len(fitted.scale), 1.0), 1.0)


@dataclass(frozen=True)
class Resolved:
    """A fit of which the simulation's own step is no part any more.

    Attributes:
        fit: the fit; its residuals are those under the step that is best.
        evidence: that under this step.
        error: half-width ``(q,)`` of what the step leaves uncertain, in the numbers' units.
    """

    fit: Refit
    evidence: Evidence
    error: np.ndarray


def resolved(evidence: Evidence, fitted: Refit, *, anew: bool = False) -> Resolved:
    """Return a fit as it would be under an endlessly fine step, where a finer one explains the log better.

    Dry friction, ripples and stops are resolved by a step only to first order in it, which with little noise is more
    than the standard errors. So the numbers are fitted under a fourth and an eighth of it, and extrapolated, unless the
    fourth explains the log better: then it was simulated with about that step. As much as this adds stays uncertain.
    Where the log does not tell a finer step from the model's own one, what lies between them does.

    Args:
        evidence: the windows, with the weights of the fit.
        fitted: the fit under the model's own step. Its derivatives serve for the finer ones, too.
        anew: whether to fit with the derivatives of the finer steps where more than noise remains with the others:
            what a coarse step distorts may be far from where it is with a finer one. Such fits are not extrapolated.
            Derivatives by many numbers would take too long: those of the coarse step serve, as far as they are right.
    """
    vector, finest = fitted.hypothesis.vector, finest_step(evidence, fitted.hypothesis)
    if finest is None:
        return Resolved(fitted, evidence, np.zeros(len(vector)))
    finer, coarser = (_stepped(evidence, fitted, step) for step in (finest, finest.at((2 * finest.values[0],))))
    anew = anew and finer.fit.loss < fitted.loss and remains(finer.fit.cost, evidence.rules)
    if anew := anew and len(vector) < MANY and step_may_explain(evidence, fitted):
        finer = _anew(finer)
        coarser = _nearest(
            coarser.evidence, finer.fit, finer.fit.hypothesis, limits_of(fitted.hypothesis, evidence.twin)
        )
    fine = finer.fit
    made, between = _as_made(evidence, fitted, finer)
    if made is not None:
        return made
    if fine.loss >= fitted.loss:
        untold = fine.loss < fitted.loss + UNTOLD
        return Resolved(fitted, evidence, np.abs(fine.hypothesis.vector - vector) * untold)
    change = fine.hypothesis.vector - coarser.fit.hypothesis.vector
    if coarser.fit.loss < fine.loss:
        return replace(coarser, error=2 * np.abs(change))
    limits = limits_of(fitted.hypothesis, evidence.twin)
    ahead = fine.hypothesis.vector if anew else fine.hypothesis.vector + change
    there = fine.hypothesis.at(np.clip(ahead, limits.low, limits.high))
    return Resolved(replace(fine, hypothesis=there), finer.evidence, np.abs(change) + between)


def _as_made(evidence: Evidence, fitted: Refit, finest: Resolved) -> tuple[Resolved | None, np.ndarray]:
    """A fit under the step of the model's own integrator with which a log was made, if it shows that it was.

    A simulated log has the error of the simulator that made it. That of a model's integrator is of first order in the
    step, so a fit under its own step and one under the finest tell by their residuals which step between them it is.

    Returns:
        The fit, and what remains uncertain of the numbers ``(q,)`` where there is none.
    """
    own, setting = find_effect("integration_own"), evidence.twin.setting
    vector, fine = fitted.hypothesis.vector, finest.fit
    nothing = np.zeros(len(vector))
    if not own.targets(setting):
        return None, nothing
    caps = np.reshape(evidence.caps, (-1, 1))
    rest, change = caps * fine.residual, caps * (fitted.residual - fine.residual)
    size = float(np.linalg.norm(change))
    share = -float((rest * change).sum()) / max(size**2, 1e-300)
    if not 0 < share < 1:
        return None, nothing
    moved = np.abs(vector - fine.hypothesis.vector)
    if (min(share, 1 - share) * size) ** 2 < UNTOLD:
        return None, share * moved
    (quantity,) = own.quantities(setting, None)
    ratio = round(np.clip(1 / share, 2, quantity.high / quantity.low))
    made = _stepped(evidence, fitted, Placed(own, None, (quantity.high / ratio,)))
    if made.fit.loss > min(fine.loss, fitted.loss) - UNTOLD:
        return None, nothing
    return replace(made, error=max(Z90 / size, abs(share - 1 / ratio)) * moved), nothing


def finest_step(evidence: Evidence, hypothesis: Hypothesis) -> Placed | None:
    """Return the finest step with which a hypothesis is compared, ``None`` where it says itself what the step is."""
    if STEP_FIELD in evidence.twin.space.fields or any(p.effect.steps for p in hypothesis.placed):
        return None
    effect = find_effect("integration")
    return Placed(effect, None, (effect.quantities(evidence.twin.setting, None)[0].low,))


def change_of_step(evidence: Evidence, fitted: Refit) -> np.ndarray | None:
    """Return by how much the finest step changes what a fit leaves, ``(W, N)``, as the windows' caps weigh it.

    ``None`` where the hypothesis says itself what the step is.
    """
    if (finest := finest_step(evidence, fitted.hypothesis)) is None:
        return None
    finer = replace(evidence, twin=evidence.twin.finer(finest))
    own, there = (e.project(e.residuals([fitted.hypothesis.variant])[0][0], fitted.linear) for e in (evidence, finer))
    return np.asarray((there - own) * np.reshape(evidence.caps, (-1, 1)))


def step_may_explain(evidence: Evidence, fitted: Refit) -> bool:
    """Return whether a finer step may take a part that counts of what a fit leaves, by how much it changes that."""
    change = change_of_step(evidence, fitted)
    return change is None or least_beside(evidence, fitted, change).left_of(fitted.cost) < evidence.rules.most


def least_beside(evidence: Evidence, fitted: Refit, change: np.ndarray) -> Cost:
    """Return the least that a finer step can leave, by how much it changes the residuals ``(W, N)`` of a fit."""
    own = fitted.residual * np.reshape(evidence.caps, (-1, 1))
    share = min(1.0, float(np.linalg.norm(change)) / max(float(np.linalg.norm(own)), 1e-300))
    return evidence.cost(fitted.residual * (1 - share), fitted.linear, len(fitted.scale))


def half_widths(last: Resolved) -> np.ndarray:
    """Return half-widths of the 90 % intervals of all numbers ``(q,)``, in their units."""
    error = last.error + _of_named_step(last.evidence, last.fit)
    return np.hypot(Z90 * standard_errors(last.fit, last.evidence.windows.episodes), error)


def _of_named_step(evidence: Evidence, fitted: Refit) -> np.ndarray:
    """By how much numbers ``(q,)`` change with twice the step that a hypothesis names: as much as without any."""
    index = next((i for i, p in enumerate(fitted.hypothesis.placed) if p.effect.steps), None)
    if index is None:
        return np.zeros(len(fitted.scale))
    own = fitted.hypothesis.placed[index]
    twice = fitted.hypothesis.instead(index, own.at(2 * np.array(own.values)))
    limits = limits_of(twice, evidence.twin)
    there = _nearest(evidence, fitted, twice, limits).fit.hypothesis.vector
    return np.where(limits.free, np.abs(there - fitted.hypothesis.vector), 0.0)


def _anew(last: Resolved) -> Resolved:
    """A fit under another step, fitted with the derivatives that it has there."""
    there = refit(last.evidence, last.fit.hypothesis, linear=last.fit.linear, iterations=ANEW)
    return replace(last, fit=there) if there.loss < last.fit.loss else last


def _stepped(evidence: Evidence, fitted: Refit, step: Placed) -> Resolved:
    """A fit moved to where it is best under another step, by the derivatives that it has."""
    finer = replace(evidence, twin=evidence.twin.finer(step))
    return _nearest(finer, fitted, fitted.hypothesis, limits_of(fitted.hypothesis, evidence.twin))


def _nearest(evidence: Evidence, fitted: Refit, trial: Hypothesis, limits: Limits) -> Resolved:
    """A hypothesis near a fitted one moved to where it is best, by the derivatives of that one, within its limits."""
    best = None
    for _ in range(MOVES):
        found, _ = evidence.residuals([trial.variant])
        there = _fitted(evidence, trial, found[0], fitted.slope, fitted.linear, fitted.scale)
        if best is not None and there.loss >= best.loss:
            break
        best = _corrected(best, there) if best is not None and limits.free.sum() >= MANY else there
        move = newton_step(best, limits, evidence.caps, LEAST_DAMPING)
        if np.abs(move).max(initial=0.0) < LEAST_MOVE:
            break
        trial = trial.at(np.clip(trial.vector + move * limits.scale, limits.low, limits.high))
    assert best is not None
    return Resolved(best, evidence, np.zeros(len(fitted.scale)))
