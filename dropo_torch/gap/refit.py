"""Fitting a hypothesis: its effects' numbers together with the declared parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.effects.engine import Variant
from dropo_torch.gap.evidence import Cost, Evidence, Starts, cost_of, robust_factors
from dropo_torch.parameters import ParameterSpace

#: Difference step and the smallest move that is worth another iteration, relative to a parameter's scale.
STEP, LEAST_MOVE = 1e-3, 2e-5
#: Move, relative to a parameter's scale, after which the starts are linearised again.
FAR = 0.03


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
        d = len(self.declared)
        placed, position = [], d
        for p in self.placed:
            placed.append(p.at(vector[position : position + len(p.values)]))
            position += len(p.values)
        return Hypothesis(tuple(float(v) for v in vector[:d]), tuple(placed))

    def with_effect(self, placed: Placed) -> Hypothesis:
        """Return the same with one more effect."""
        return Hypothesis(self.declared, (*self.placed, placed))

    def without(self, index: int) -> Hypothesis:
        """Return the same without one of its effects."""
        return Hypothesis(self.declared, self.placed[:index] + self.placed[index + 1 :])


@dataclass(frozen=True)
class Limits:
    """Bounds and sizes of a hypothesis' numbers, ``(q,)`` each."""

    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray

    def of(self, columns: np.ndarray) -> Limits:
        """Return those of some of the numbers."""
        return Limits(self.low[columns], self.high[columns], self.scale[columns])


def limits_of(hypothesis: Hypothesis, space: ParameterSpace, setting: Setting) -> Limits:
    """Return the bounds and sizes of a hypothesis' numbers."""
    low, high = list(space.low), list(space.high)
    scale = [0.25 * (h - a) for a, h in zip(low, high, strict=True)]
    for p in hypothesis.placed:
        for q in p.effect.quantities(setting, p.target):
            low.append(q.low)
            high.append(q.high)
            scale.append(q.scale)
    return Limits(np.array(low), np.array(high), np.array(scale))


@dataclass(frozen=True)
class Refit:
    """A fitted hypothesis.

    Attributes:
        hypothesis: with the fitted numbers.
        cost: its misfit.
        residual: projected residuals, ``(W, N)``.
        slope: projected derivatives by all numbers, in units of their scale, ``(q, W, N)``.
        starts: the linearisation by the starts.
        scale: the numbers' scales, ``(q,)``.
        converged: whether the moves became small.
        factor: factors of the windows' residuals that the fit ended with, ``(W,)``.
    """

    hypothesis: Hypothesis
    cost: Cost
    residual: np.ndarray
    slope: np.ndarray
    starts: Starts
    scale: np.ndarray
    converged: bool
    factor: np.ndarray


def slopes(
    evidence: Evidence, hypothesis: Hypothesis, limits: Limits, columns: np.ndarray, step: float = STEP
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals ``(W, N)`` and their derivatives ``(len(columns), W, N)`` by numbers in units of their scale."""
    vector = hypothesis.vector
    variants, signs = [hypothesis.variant], []
    for c in columns:
        sign = 1.0 if vector[c] + step * limits.scale[c] <= limits.high[c] else -1.0
        moved = vector.copy()
        moved[c] += sign * step * limits.scale[c]
        variants.append(hypothesis.at(moved).variant)
        signs.append(sign)
    found, _ = evidence.residuals(variants)
    change = (found[1:] - found[:1]) / (np.array(signs)[:, None, None] * step)
    return found[0], change


def refit(
    evidence: Evidence,
    hypothesis: Hypothesis,
    *,
    starts: Starts | None = None,
    caps: np.ndarray | None = None,
    iterations: int = 12,
) -> Refit:
    """Fit all numbers of a hypothesis by Levenberg-Marquardt on projected residuals.

    Args:
        evidence: the windows.
        hypothesis: where to begin.
        starts: the linearisation to use; by default at the hypothesis, and again at the result if that is far away.
        caps: factors of the windows' residuals.
        iterations: the most of them.
    """
    space, setting = evidence.twin.space, evidence.twin.setting
    limits = limits_of(hypothesis, space, setting)
    columns = np.arange(len(limits.scale))
    relinearise = starts is None
    starts = evidence.linearise(hypothesis.variant) if starts is None else starts
    fixed, tail = np.ones(len(evidence.windows)) if caps is None else caps, evidence.tail(starts)
    damping, converged = 1e-3, False
    current = hypothesis.at(np.clip(hypothesis.vector, limits.low, limits.high))
    begin = current.vector
    raw, change = slopes(evidence, current, limits, columns)
    residual, slope = evidence.project(raw, starts), evidence.project_slope(change, starts)
    value, factor = _loss(residual, fixed, tail)
    for _ in range(iterations):
        move = _step(residual * factor[:, None], slope * factor[:, None], current.vector, limits, damping)
        trial = current.at(np.clip(current.vector + move * limits.scale, limits.low, limits.high))
        largest = float(np.abs((trial.vector - current.vector) / limits.scale).max()) if len(move) else 0.0
        if largest < LEAST_MOVE:
            converged = True
            break
        raw, change = slopes(evidence, trial, limits, columns)
        found = evidence.project(raw, starts)
        after, following = _loss(found, fixed, tail)
        if after < value:
            gain, current, residual, factor = value - after, trial, found, following
            slope, value = evidence.project_slope(change, starts), after
            damping = max(damping / 8, 1e-9)
            if gain < 1e-6 * value + 0.01:
                converged = True
                break
        else:
            damping *= 6
            if damping > 1e4:
                break
    far = np.abs((current.vector - begin) / limits.scale).max(initial=0.0) > FAR
    if relinearise and far:
        return refit(evidence, current, starts=evidence.linearise(current.variant), caps=caps, iterations=4)
    degrees = evidence.degrees(starts) - len(columns)
    cost = cost_of(residual, starts, degrees, caps, tail)
    return Refit(current, cost, residual, slope, starts, limits.scale, converged, factor / fixed)


def _loss(residual: np.ndarray, fixed: np.ndarray, tail: float | None) -> tuple[float, np.ndarray]:
    """The cost that is minimised, and the factors ``(W,)`` of its least squares."""
    chi2 = ((residual * fixed[:, None]) ** 2).sum(-1)
    value = float((chi2 if tail is None else tail * np.log1p(chi2 / tail)).sum())
    return value, fixed * robust_factors(chi2, tail)


def _step(residual: np.ndarray, slope: np.ndarray, vector: np.ndarray, limits: Limits, damping: float) -> np.ndarray:
    """Return the damped step in units of the scales; numbers at a bound that it would cross stay there."""
    if not len(slope):
        return np.zeros(0)
    flat = slope.reshape(len(slope), -1)
    normal, gradient = flat @ flat.T, -(flat @ residual.ravel())
    free = np.ones(len(vector), dtype=bool)
    move = np.zeros(len(vector))
    for _ in range(len(vector)):
        index = np.flatnonzero(free)
        if not index.size:
            break
        part = normal[np.ix_(index, index)]
        diagonal = np.diag(part).copy()
        diagonal[diagonal <= 0] = 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-300)
        move[:] = 0.0
        ridge = np.diag(damping * diagonal + 1e-12 * diagonal.max())
        move[index] = np.linalg.lstsq(part + ridge, gradient[index], rcond=None)[0]
        after = vector + move * limits.scale
        tight = 1e-12 * limits.scale
        below = (after < limits.low) & (vector <= limits.low + tight)
        above = (after > limits.high) & (vector >= limits.high - tight)
        stuck = free & (below | above)
        if not stuck.any():
            break
        free &= ~stuck
    return np.clip(move, -5.0, 5.0)
