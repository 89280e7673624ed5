"""Which candidates could explain the gap: one linear prediction each, all on the same few windows.

A candidate is tried from each of its starts. There, the projected residuals and their derivatives by the candidate's
numbers, by the declared parameters and by the effects that were accepted already predict the χ² that a full fit would
reach. The prediction only ranks; a refit decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.refit import Hypothesis, Limits, Refit, limits_of
from dropo_torch.optimizers.least_squares import damped_step

#: Difference step of a candidate's numbers, relative to their scale.
STEP = 2e-3
#: A candidate that moves the screened windows by fewer standard deviations of the noise cannot be judged by them.
DEAD = 1.5
#: Damping and ridge of the predicted moves.
DAMPING, RIDGE = 1e-6, 1e-10
#: Candidates that one batch of simulations holds.
BATCH = 24


@dataclass(frozen=True)
class Candidate:
    """What one start of a candidate promises.

    Attributes:
        placed: the effect with the predicted numbers.
        chi2: predicted χ² on the screened windows.
        windows: predicted χ² of each screened window, ``(W,)``.
        residual: projected residuals at the candidate's start, ``(W·N,)``.
        slope: projected derivatives by its numbers, ``(p, W·N)``.
        dead: whether it changes nothing in these windows.
    """

    placed: Placed
    chi2: float
    windows: np.ndarray
    residual: np.ndarray
    slope: np.ndarray
    dead: bool

    @property
    def key(self) -> tuple[str, str | None]:
        """Effect and target."""
        return self.placed.key


def all_candidates(setting: Setting, effects: Sequence[Effect]) -> Iterator[Placed]:
    """Yield every effect at every target, at each of its starts."""
    for effect in effects:
        for target in effect.targets(setting):
            for start in effect.starts(setting, target):
                yield Placed(effect, target, tuple(float(v) for v in start))


def screen(
    evidence: Evidence,
    base: Refit,
    candidates: Sequence[Placed],
    *,
    caps: np.ndarray,
    on_progress: Callable[[int], None] | None = None,
) -> list[Candidate]:
    """Return each candidate from its best start, the most promising first.

    Args:
        evidence: the windows to screen on.
        base: the fitted hypothesis so far, on these windows.
        candidates: effects at their starts.
        caps: factors of the windows' residuals.
        on_progress: called with the number of candidates done.
    """
    factor = np.repeat(caps, evidence.num_rows)
    shared = base.slope.reshape(len(base.slope), -1) * factor
    origin = base.residual.ravel() * factor
    best: dict[tuple[str, str | None], Candidate] = {}
    taken = {p.key for p in base.hypothesis.placed}
    waiting = [c for c in candidates if c.key not in taken]
    for first in range(0, len(waiting), BATCH):
        part = waiting[first : first + BATCH]
        for found in _predict(evidence, base, part, shared, origin, factor):
            known = best.get(found.key)
            if known is None or (known.dead, known.chi2) > (found.dead, found.chi2):
                best[found.key] = found
        if on_progress is not None:
            on_progress(first + len(part))
    return sorted(best.values(), key=lambda c: (c.dead, c.chi2))


def _predict(
    evidence: Evidence, base: Refit, part: Sequence[Placed], shared: np.ndarray, origin: np.ndarray, factor: np.ndarray
) -> Iterator[Candidate]:
    """Simulate candidates at their starts and beside them, in one batch, and predict."""
    hypotheses: list[Hypothesis] = []
    spans: list[tuple[int, np.ndarray, Limits, np.ndarray]] = []
    for placed in part:
        hypothesis = base.hypothesis.with_effect(placed)
        limits = limits_of(hypothesis, evidence.twin.space, evidence.twin.setting)
        size = len(placed.values)
        vector, begin = hypothesis.vector, len(hypotheses)
        hypotheses.append(hypothesis)
        signs = []
        for c in _moved(placed, len(vector) - size):
            sign = 1.0 if vector[c] + STEP * limits.scale[c] <= limits.high[c] else -1.0
            moved = vector.copy()
            moved[c] += sign * STEP * limits.scale[c]
            hypotheses.append(hypothesis.at(moved))
            signs.append(sign)
        moving = np.array(_moved(placed, 0), dtype=int)
        spans.append((begin, np.array(signs), limits.of(moving - size), moving))
    found, _ = evidence.residuals([h.variant for h in hypotheses])
    for placed, (begin, directions, limits, moving) in zip(part, spans, strict=True):
        residual = evidence.project(found[begin], base.starts).ravel() * factor
        change = (found[begin + 1 : begin + 1 + len(moving)] - found[begin]) / (directions[:, None, None] * STEP)
        slope = evidence.project_slope(change, base.starts).reshape(len(moving), -1) * factor
        lengths = np.sqrt((slope**2).sum(1))
        dead = bool(np.linalg.norm(residual - origin) < DEAD and lengths.max(initial=0.0) < DEAD)
        columns = np.concatenate([shared, slope])
        start = np.array(placed.values)
        low, high = (limits.low - start[moving]) / limits.scale, (limits.high - start[moving]) / limits.scale
        move = _move(columns, residual, len(shared), low, high)
        left = residual + move @ columns
        values = start.copy()
        values[moving] += move[len(shared) :] * limits.scale
        values = placed.effect.settle(start, values)
        windows = (left**2).reshape(len(evidence.windows), -1).sum(-1)
        yield Candidate(placed.at(values), float(windows.sum()), windows, residual, slope, dead)


def _moved(placed: Placed, first: int) -> list[int]:
    """Which of a candidate's numbers are moved, counted from ``first``."""
    chosen = placed.effect.screened()
    return [first + i for i in (range(len(placed.values)) if chosen is None else chosen)]


def _move(columns: np.ndarray, residual: np.ndarray, num_shared: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least-squares move whose last entries, the candidate's own, stay between ``low`` and ``high``."""
    normal, force = columns @ columns.T, -(columns @ residual)
    free = np.ones(len(force), dtype=bool)
    move = damped_step(normal, force, free, DAMPING, RIDGE)
    own = np.clip(move[num_shared:], low, high)
    if not np.array_equal(own, move[num_shared:]):
        free[num_shared:] = False
        move = damped_step(normal, force - normal[:, num_shared:] @ own, free, DAMPING, RIDGE)
        move[num_shared:] = own
    return move


def promising_families(base: Refit, caps: np.ndarray, candidates: Sequence[Candidate]) -> list[list[Placed]]:
    """Return the effects of one number that, at all their targets together, predict the least χ²; two at most.

    Friction or damping is seldom missing in one joint only. A family is offered where it promises less than half of
    what its best single member leaves.
    """
    factor = np.repeat(caps, base.residual.shape[1])
    shared = base.slope.reshape(len(base.slope), -1) * factor
    origin = base.residual.ravel() * factor
    families: dict[str, list[Candidate]] = {}
    for c in candidates:
        if not c.dead and len(c.placed.values) == 1:
            families.setdefault(c.placed.effect.name, []).append(c)
    found = []
    for members in families.values():
        if len(members) < 2:
            continue
        columns = [*shared, *(c.slope[0] for c in members), *(c.residual - origin for c in members)]
        left = _left(origin, np.stack(columns))
        if left < 0.5 * min(c.chi2 for c in members):
            found.append((left, [c.placed for c in members]))
    return [members for _, members in sorted(found, key=lambda item: item[0])[:2]]


def _left(origin: np.ndarray, columns: np.ndarray) -> float:
    """χ² that is left of residuals beside columns."""
    gradient = columns @ origin
    free = np.ones(len(columns), dtype=bool)
    return float(origin @ origin - gradient @ damped_step(columns @ columns.T, gradient, free, 1e-9))


def promising_pairs(
    base: Refit, candidates: Sequence[Candidate], caps: np.ndarray, count: int
) -> list[tuple[Placed, Placed]]:
    """Return the pairs of candidates that together predict the least χ², the best first."""
    factor = np.repeat(caps, base.residual.shape[1])
    shared = base.slope.reshape(len(base.slope), -1) * factor
    origin = base.residual.ravel() * factor
    alive = [c for c in candidates if not c.dead]
    found = []
    for a, b in combinations(range(len(alive)), 2):
        first, second = alive[a], alive[b]
        columns = np.concatenate(
            [shared, first.slope, second.slope, [first.residual - origin], [second.residual - origin]]
        )
        found.append((_left(origin, columns), a, b))
    found.sort()
    return [(alive[a].placed, alive[b].placed) for _, a, b in found[:count]]
