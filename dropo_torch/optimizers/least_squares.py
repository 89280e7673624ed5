"""One damped step of least squares from its normal equations: Levenberg-Marquardt, with a ridge, within bounds."""

from __future__ import annotations

import numpy as np

#: What a diagonal entry of 0 counts as, relative to the largest: a column without influence stays solvable.
FLOOR = 1e-12
#: Most changes of the active set, for each entry: rounding could change one for ever.
PIVOTS = 10


def damped_step(
    normal: np.ndarray, force: np.ndarray, free: np.ndarray, damping: float, ridge: float = 0.0,
    units: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Solve (A + damping · diag A + ridge · max(diag A) · I) δ = force for the free entries; the others get 0.

    The damping is Marquardt's, for which the units of the entries do not matter; the ridge keeps entries without
    influence beside the others where they are.

    Args:
        normal: A = JᵀJ or another positive semidefinite matrix, ``(q, q)``.
        force: the negative gradient −Jᵀr, ``(q,)``.
        free: which entries move, ``(q,)`` bool.
        damping: relative to each diagonal entry.
        ridge: relative to the largest one.
        units: sizes in which the entries are solved for, ``(q,)``; by default those that scale the diagonal to 1.
    """
    step = np.zeros(len(force))
    if not free.any():
        return step
    part = normal[np.ix_(free, free)]
    diagonal = np.diag(part)
    largest = max(float(diagonal.max()), 1e-300)
    diagonal = np.where(diagonal > 0, diagonal, FLOOR * largest)
    square = diagonal if units is None else 1 / units[free] ** 2
    scale = np.sqrt(square)
    damped = part / np.outer(scale, scale) + np.diag(damping * (diagonal / square) + ridge * (largest / square))
    step[free] = np.linalg.lstsq(damped, force[free] / scale, rcond=1e-14)[0] / scale
    return step


def bounded_step(
    normal: np.ndarray, force: np.ndarray, low: np.ndarray, high: np.ndarray, damping: float, ridge: float = 0.0,
    units: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the damped step that carries nothing out of its bounds which sits at one.

    Of all such steps the best: what is held at a bound is pressed against it by what the others leave of its force
    (principal pivoting, from all entries free). So the step is zero only where the bounded minimum is. An entry inside
    its bounds may step beyond them: the caller clips, and it is at the bound in the next iteration.

    Args:
        normal, force, damping, ridge, units: of :func:`damped_step`.
        low, high: the smallest and the largest move within bounds, ``(q,)`` each; ``low <= 0 <= high``.
    """
    free = np.ones(len(force), dtype=bool)
    step = damped_step(normal, force, free, damping, ridge, units)
    for _ in range(PIVOTS * len(force)):
        left = force - normal @ step
        inwards = ~_leaves(left, low, high) & (left != 0)
        wrong = np.flatnonzero(np.where(free, _leaves(step, low, high), inwards))
        if not wrong.size:
            break
        free[wrong[-1]] ^= True
        step = damped_step(normal, force, free, damping, ridge, units)
    return step


def _leaves(direction: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which entries sit at a bound that a direction would cross, ``(q,)`` bool."""
    return ((direction < 0) & (low >= 0)) | ((direction > 0) & (high <= 0))
