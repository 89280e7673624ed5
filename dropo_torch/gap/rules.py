"""What decides in the search for names: thresholds in units of the noise, and comparisons of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dropo_torch.gap.evidence import Cost
from dropo_torch.gap.refit import Hypothesis, Refit

#: χ² per degree of freedom from which on a window is wrong, and below which it is right.
WRONG, RIGHT = 20.0, 1.5


@dataclass(frozen=True)
class Rules:
    """Thresholds of the naming; the same for every log, since all they compare is in units of the noise.

    Attributes:
        gate: excess in standard deviations of χ² from which on something is missing.
        least_reduced: χ² per degree of freedom below which nothing is, since the noise itself is only estimated.
        most: share of the excess that an effect removes without further question.
        accounted: share of the first excess that the named effects must remove together, or nothing has a name.
        free: numbers of the named effects beyond which each halves what they may leave, for many numbers together
            imitate what none of them is.
        hopeless: share of the excess that the best candidate of a round may leave, or the search ends.
        least: share of the first excess below which an effect is not named.
        significance: paired standard errors, over blocks of the log, by which one hypothesis beats another.
        tie: paired standard errors within which two hypotheses tie.
        refits: candidates that are refitted in a round.
        effects: the most effects that are named.
    """

    gate: float = 5.0
    least_reduced: float = 1.1
    most: float = 0.8
    accounted: float = 0.95
    free: int = 3
    hopeless: float = 0.8
    least: float = 3e-3
    significance: float = 3.0
    tie: float = 2.0
    refits: int = 7
    effects: int = 4


def significant(cost: Cost, rules: Rules) -> bool:
    """Return whether a misfit is more than noise."""
    return cost.excess > rules.gate * cost.sigma and cost.reduced > rules.least_reduced


def near(cost: Cost) -> float:
    """Return how much more excess a hypothesis may have that is about as good."""
    return max(0.3 * max(cost.excess, 0.0), 4 * cost.sigma)


def allowance(hypothesis: Hypothesis, rules: Rules) -> float:
    """Return the share of the first excess that named effects may leave; an effect at many places counts once."""
    sizes = {p.effect.name: 0 for p in hypothesis.placed}
    for p in hypothesis.placed:
        sizes[p.effect.name] = 1 if len(p.values) == 1 else sizes[p.effect.name] + len(p.values)
    return (1 - rules.accounted) * 0.5 ** max(0, sum(sizes.values()) - rules.free)


def clears(base: Refit, current: Refit) -> bool:
    """Return whether effects leave no more than noise in most windows of a log of which most were wrong.

    What only imitates the truth makes all windows better and none of them right.
    """
    return bool(np.median(base.typical) > WRONG and np.median(current.typical) < RIGHT)


def paired(first: Cost, second: Cost, blocks: np.ndarray) -> float:
    """Return by how many standard errors the first misfit is above the second, over blocks of the log ``(W,)``."""
    change = (first.windows + first.penalty) - (second.windows + second.penalty)
    names = np.unique(blocks)
    sums = np.array([change[blocks == b].sum() for b in names])
    if len(sums) < 2:
        return float(np.sign(sums.sum()) * np.inf)
    error = sums.std(ddof=1) * np.sqrt(len(sums))
    return float(sums.sum() / max(error, 1e-12))


def simplest(fitted: Sequence[Refit]) -> Refit:
    """Return, of hypotheses that are about as good as the best, the one with the fewest numbers."""
    best = fitted[0].cost
    good = (r for r in fitted if r.cost.excess <= best.excess + near(best))
    return min(good, key=lambda r: (len(r.hypothesis.vector), r.cost.excess))
