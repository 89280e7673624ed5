"""One damped step of least squares from its normal equations: Levenberg-Marquardt, with a ridge, within bounds."""

from __future__ import annotations

import numpy as np

#: Diagonal entries below this, relative to the largest, count as this: a column without influence stays solvable.
FLOOR = 1e-14


def damped_step(
    normal: np.ndarray, force: np.ndarray, free: np.ndarray, damping: float, ridge: float = 0.0
) -> np.ndarray:
    """Solve (A + damping · diag A + ridge · max(diag A) · I) δ = force for the free entries; the others get 0.

    The damping is Marquardt's, for which the units of the entries do not matter; the ridge keeps entries without
    influence beside the others where they are. The system is solved with its diagonal scaled to 1.

    Args:
        normal: A = JᵀJ or another positive semidefinite matrix, ``(q, q)``.
        force: the negative gradient −Jᵀr, ``(q,)``.
        free: which entries move, ``(q,)`` bool.
        damping: relative to each diagonal entry.
        ridge: relative to the largest one.
    """
    step = np.zeros(len(force))
    if not free.any():
        return step
    part, diagonal = normal[np.ix_(free, free)], np.diag(normal)
    largest = max(float(diagonal.max()), 1e-300)
    scale = np.sqrt(np.maximum(diagonal[free], FLOOR * largest))
    damped = part / np.outer(scale, scale) + np.diag(damping + ridge * largest / scale**2)
    step[free] = np.linalg.lstsq(damped, force[free] / scale, rcond=1e-14)[0] / scale
    return step


def bounded_step(
    normal: np.ndarray, force: np.ndarray, low: np.ndarray, high: np.ndarray, damping: float, ridge: float = 0.0
) -> np.ndarray:
    """Return :func:`damped_step` with an active set: what would leave its bounds from a bound stays there.

    At a bound, entries whose force points out are held, and so are those that the step of all free entries together
    would carry out; the others are then solved anew. The step is zero only where the bounded minimum is. An entry
    inside its bounds may step beyond them: the caller clips, and it is at the bound in the next iteration.

    Args:
        normal, force, damping, ridge: of :func:`damped_step`.
        low, high: the smallest and the largest move within bounds, ``(q,)`` each; ``low <= 0 <= high``.
    """
    free = ~_leaves(force, low, high)
    while True:
        step = damped_step(normal, force, free, damping, ridge)
        stuck = free & _leaves(step, low, high)
        if not stuck.any():
            return step
        free &= ~stuck


def _leaves(direction: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which entries sit at a bound that a direction would cross, ``(q,)`` bool."""
    return ((direction < 0) & (low >= 0)) | ((direction > 0) & (high <= 0))
