"""How certain fitted numbers are."""

from __future__ import annotations

import numpy as np
from scipy import stats

from dropo_torch.gap.refit import Refit


def deviations(fitted: Refit, blocks: np.ndarray) -> np.ndarray:
    """Return standard errors of all numbers of a fit ``(q,)``, in their units; infinite for those without influence.

    The larger of two: by the noise, inflated by χ² per degree of freedom; and by how much the blocks of the log
    disagree (the sandwich of cluster-robust errors), which also counts what the model still lacks.

    Args:
        fitted: a fit with its projected residuals and derivatives.
        blocks: block of each window ``(W,)``: its trajectory.
    """
    slope = fitted.slope
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
    plain = np.sqrt(np.maximum(np.diag(inverse), 0.0) * max(1.0, fitted.cost.reduced))
    names = np.unique(blocks)
    if len(names) < 4:
        blocks = (np.arange(len(blocks)) * 10) // max(len(blocks), 1)
        names = np.unique(blocks)
    scores = np.einsum("awn,wn->wa", slope, fitted.residual)
    sums = np.stack([scores[blocks == b].sum(0) for b in names])
    middle = sums.T @ sums * len(names) / max(len(names) - 1, 1)
    factor = stats.t.ppf(0.95, max(len(names) - 1, 1)) / 1.6449
    clustered = np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)) * factor
    inflated = fitted.cost.reduced > 1.5
    return np.where(known, np.maximum(plain, clustered) if inflated else plain, np.inf) * fitted.scale
