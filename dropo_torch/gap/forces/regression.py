"""Which linear terms explain a signal, decided on stretches of it that each fit has not seen; mathematics alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, optimize, stats

from dropo_torch.gap.chance import p_of_ranks

#: Times that the weights of the outputs are found anew.
WEIGHTED = 4
#: Change of the logarithm of all outputs' mean squares that matters to the choice of terms.
GAIN = 0.02
#: Ridge of the normal equations, relative to their diagonal.
RIDGE = 1e-10


@dataclass(frozen=True)
class Regression:
    """A signal of J outputs, and P columns that may explain it.

    Attributes:
        signal: ``(N, J)``.
        columns: ``(P, N, J)``.
        low, high: bounds of the coefficients, ``(P,)``; zero lies within.
        prior: standard deviations of the coefficients about zero, infinite for none, ``(P,)``.
        blocks: block of each row, ``(N,)``; blocks are left out one by one, and count as independent.
        correlated: rows that count as one.
    """

    signal: np.ndarray
    columns: np.ndarray
    low: np.ndarray
    high: np.ndarray
    prior: np.ndarray
    blocks: np.ndarray
    correlated: float = 1.0

    @cached_property
    def names(self) -> np.ndarray:
        """The blocks, B of them."""
        return np.unique(self.blocks)

    @cached_property
    def counts(self) -> np.ndarray:
        """Rows of each block, ``(B,)``."""
        return np.unique(self.blocks, return_counts=True)[1]

    @cached_property
    def products(self) -> np.ndarray:
        """Products of columns and signal, the signal last, in each block and output, ``(B, J, P + 1, P + 1)``."""
        every = np.concatenate([self.columns, self.signal[None]])
        parts = (every[:, self.blocks == name] for name in self.names)
        return np.stack([np.einsum("pnj,qnj->jpq", part, part) for part in parts])

    def with_column(self, index: int, values: np.ndarray) -> Regression:
        """Return the same with another column ``(N, J)`` in the place of one."""
        columns = self.columns.copy()
        columns[index] = values
        other, every = replace(self, columns=columns), np.concatenate([columns, self.signal[None]])
        rows = [self.blocks == name for name in self.names]
        new = np.stack([np.einsum("nj,qnj->jq", values[own], every[:, own]) for own in rows])
        products = self.products.copy()
        products[:, :, index], products[:, :, :, index] = new, new
        vars(other).update(products=products, names=self.names, counts=self.counts)
        return other

    def left(self, coefficients: np.ndarray) -> np.ndarray:
        """Return what coefficients ``(P,)`` leave of the signal, ``(N, J)``."""
        return self.signal - np.einsum("p,pnj->nj", coefficients, self.columns)

    def squares(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the mean squares of what coefficients ``(P,)`` leave in each block, ``(B, J)``."""
        full = np.append(-coefficients, 1.0)
        sums = np.einsum("p,bjpq,q->bj", full, self.products, full)
        return np.maximum(sums, 0.0) / self.counts[:, None]


def fit(regression: Regression, chosen: np.ndarray) -> np.ndarray:
    """Return coefficients ``(P,)`` within their bounds, zero for columns that are not chosen, ``(P,)`` bool.

    Every output weighs by what is left of it in the end; a prior counts as much as one independent row.

    Args:
        regression: the signal and all columns.
        chosen: the columns to use, ``(P,)`` bool.
    """
    (found,) = _fits(regression, chosen, regression.products.sum(0)[None], regression.counts.sum()[None])
    return found


def fits_without(regression: Regression, chosen: np.ndarray) -> np.ndarray:
    """Return the coefficients that all blocks but one have, without each in turn, ``(B, P)``; see :func:`fit`."""
    products, counts = regression.products, regression.counts
    return _fits(regression, chosen, products.sum(0) - products, counts.sum() - counts)


def _fits(regression: Regression, chosen: np.ndarray, products: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Coefficients ``(F, P)`` of F fits at once, by products ``(F, J, P + 1, P + 1)`` over so many rows ``(F,)``."""
    picked, found = np.flatnonzero(chosen), np.zeros((len(rows), len(chosen)))
    used = np.append(picked, len(chosen))
    products, low, high = products[:, :, used[:, None], used], regression.low[picked], regression.high[picked]
    variance, prior = products[..., -1, -1] / rows[:, None], regression.correlated / regression.prior[picked] ** 2
    for _ in range(WEIGHTED if picked.size else 0):
        weighted = np.einsum("fjpq,fj->fpq", products, 1 / np.maximum(variance, 1e-300))
        normal, right = weighted[:, :-1, :-1] + np.diag(prior), weighted[:, :-1, -1]
        size = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
        matrix = normal / (size[:, :, None] * size[:, None]) + RIDGE * np.eye(len(picked))
        free = np.linalg.solve(matrix, (right / size)[..., None])[..., 0] / size
        for number in np.flatnonzero(((free < low) | (free > high)).any(1)):
            free[number] = _solved(normal[number], right[number], low, high)
        full = np.concatenate([-free, np.ones((len(rows), 1))], 1)
        variance = np.einsum("fp,fjpq,fq->fj", full, products, full, optimize=True) / rows[:, None]
        found[:, picked] = free
    return found


def _solved(normal: np.ndarray, right: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The least-squares solution of normal equations within bounds."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    matrix = normal / np.outer(size, size) + RIDGE * np.eye(len(size))
    factor = linalg.cholesky(matrix)
    target = linalg.solve_triangular(factor, right / size, trans="T")
    return np.asarray(optimize.lsq_linear(factor, target, (low * size, high * size), method="bvls").x / size)


def unseen(regression: Regression, chosen: np.ndarray) -> np.ndarray:
    """Return the mean squares of every block ``(B, J)`` by the coefficients that all others have."""
    full = np.concatenate([-fits_without(regression, chosen), np.ones((len(regression.names), 1))], 1)
    sums = np.einsum("bp,bjpq,bq->bj", full, regression.products, full, optimize=True)
    return np.asarray(np.maximum(sums, 0.0) / regression.counts[:, None])


def score(squares: np.ndarray) -> float:
    """Return the logarithm of the outputs' mean squares, summed, of blocks ``(B, J)``; less is better."""
    return float(np.log(np.maximum(squares.mean(0), 1e-300)).sum())


def select(regression: Regression, groups: np.ndarray, families: np.ndarray) -> np.ndarray:
    """Return which columns explain unseen blocks, ``(P,)`` bool: whole families are added, single groups dropped.

    Of groups that do not help, the one with the most columns goes first.

    Args:
        regression: the signal and all columns.
        groups: group of each column, ``(P,)``; a group is chosen whole.
        families: family of each column, ``(P,)``; of groups that are added together.
    """
    chosen = np.zeros(len(groups), dtype=bool)
    best, waiting = score(unseen(regression, chosen)), set(np.unique(families).tolist())
    while waiting:
        tried = {f: score(unseen(regression, chosen | (families == f))) for f in sorted(waiting)}
        family = min(tried, key=lambda f: tried[f])
        if tried[family] > best - GAIN:
            break
        chosen, best = chosen | (families == family), tried[family]
        waiting.discard(family)
    return refined(regression, chosen, groups, np.isin(families, families[chosen]))


def refined(regression: Regression, chosen: np.ndarray, groups: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return the chosen columns ``(P,)`` bool without groups that do not help in unseen blocks, with others that do.

    Groups may do the same: what did not help beside one that has gone since comes back, if it helps by as much as each
    of its columns must.

    Args:
        regression: the signal and all columns.
        chosen: the columns to begin with, ``(P,)`` bool.
        groups: group of each column, ``(P,)``.
        allowed: columns that may come back, ``(P,)`` bool.
    """
    best, sizes = score(unseen(regression, chosen)), np.bincount(groups)
    while True:
        without = {g: score(unseen(regression, chosen & (groups != g))) for g in np.unique(groups[chosen]).tolist()}
        if idle := [g for g in without if without[g] <= best + GAIN]:
            group = min(idle, key=lambda g: (-sizes[g], without[g]))
            chosen, best = chosen & (groups != group), min(best, without[group])
            continue
        absent = np.unique(groups[allowed & ~chosen]).tolist()
        beside = {g: score(unseen(regression, chosen | (groups == g))) for g in absent}
        helpful = [g for g in absent if beside[g] < best - GAIN * sizes[g]]
        if not helpful:
            return chosen
        group = min(helpful, key=lambda g: beside[g])
        chosen, best = chosen | (groups == group), beside[group]


def chances(regression: Regression, chosen: np.ndarray, parts: Iterable[np.ndarray]) -> list[float]:
    """Return how likely chance alone makes each part of the chosen columns help in unseen blocks as much.

    By what each block loses without it, in the mean squares of what is left with all of them: the surer of Student's t
    and the signed ranks, at half the level each. A true effect helps in every block, by very different amounts.

    Args:
        regression: the signal and all columns.
        chosen: the columns, ``(P,)`` bool.
        parts: of these, ``(P,)`` bool each.
    """
    whole = unseen(regression, chosen)
    size, found = whole.mean(0), []
    left = size > 0  # an output of which nothing is left, such as a joint that rests, has no say
    for part in parts:
        lost = unseen(regression, chosen & ~part) - whole
        found.append(chance_of((lost[:, left] / size[left]).sum(1)))
    return found


def share_left(left: np.ndarray, first: np.ndarray) -> float:
    """Return the share of the outputs' mean squares that is left, averaged over those that have any; 0 if none has.

    Args:
        left: mean squares that are left, ``(J,)``.
        first: those that there were, ``(J,)``.
    """
    there = first > 0
    return float((left[there] / first[there]).mean()) if there.any() else 0.0


def chance_of(gains: np.ndarray) -> float:
    """Return how likely chance alone makes the blocks gain as much, ``(B,)``, in the mean or in ranks."""
    assert np.isfinite(gains).all()
    spread = max(float(gains.std(ddof=1)), 1e-300) / np.sqrt(len(gains))
    by_size = float(stats.t.sf(gains.mean() / spread, len(gains) - 1))
    return min(1.0, 2 * min(by_size, p_of_ranks(gains)))


def half_widths(regression: Regression, chosen: np.ndarray) -> np.ndarray:
    """Return half-widths of the 90 % intervals of coefficients ``(P,)``, by how they move without a block (jackknife).

    A fit bends towards each of its blocks, the more the fewer these are for its columns. What is left of a block by a
    fit that has seen it would make the intervals too narrow.
    """
    return np.asarray(stats.t.ppf(0.95, max(len(regression.names) - 1, 1)) * _standard_errors(regression, chosen))


def _standard_errors(regression: Regression, chosen: np.ndarray) -> np.ndarray:
    """Standard errors of coefficients ``(P,)``, by how they move without a block."""
    count = len(regression.names)
    return np.asarray(np.sqrt((count - 1) * fits_without(regression, chosen).var(0)))


def widest(regression: Regression, chosen: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return half-widths of the 90 % intervals of coefficients ``(P,)``, as wide as their priors where nothing shows.

    The larger of the jackknife's and of what the squares that are left and the priors make: a prior that holds a
    coefficient holds it without any block, too.
    """
    picked = np.flatnonzero(chosen)
    weights = 1 / np.maximum(regression.squares(coefficients).mean(0), 1e-300)
    weighted = np.einsum("bjpq,j->pq", regression.products, weights)[np.ix_(picked, picked)]
    normal = weighted / regression.correlated + np.diag(1 / regression.prior[picked] ** 2)
    found = np.zeros(len(chosen))
    found[picked] = np.sqrt(np.maximum(np.diag(np.linalg.pinv(normal, rcond=1e-12, hermitian=True)), 0.0))
    return np.maximum(half_widths(regression, chosen), stats.norm.ppf(0.95) * found)


def neutral_chances(regression: Regression, chosen: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return how likely coefficients ``(P,)`` are as large by chance, were they 0; 1 for those not chosen."""
    errors = np.maximum(_standard_errors(regression, chosen), 1e-300)
    found = 2 * stats.t.sf(np.abs(coefficients) / errors, max(len(regression.names) - 1, 1))
    return np.where(chosen, found, 1.0)


def refusal(likely: np.ndarray, tried: int) -> float:
    """Return the level from which on Holm's procedure takes all of some effects for real, of so many that were tried.

    Args:
        likely: chances of these ``(n,)``, were they none.
        tried: effects among which they were found, n or more.
    """
    return float((np.sort(likely) * (tried - np.arange(len(likely)))).max())
