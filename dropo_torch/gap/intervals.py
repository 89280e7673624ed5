"""How certain fitted numbers are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import blocks_of
from dropo_torch.gap.refit import Refit, refit

#: Half-width of a 90 % interval in standard errors.
Z90 = 1.6449
#: χ² per degree of freedom from which on the simulation's own step may bias a fit.
BIASED = 1.2
#: An error of first order at a step is twice what halving the step changes.
FIRST_ORDER = 2.0


def standard_errors(fitted: Refit, episodes: np.ndarray) -> np.ndarray:
    """Return standard errors of all numbers of a fit ``(q,)``, in their units; infinite for those without influence.

    The larger of two: by the noise, inflated by χ² per degree of freedom; and by how much the blocks of the log
    disagree (the sandwich of cluster-robust errors), which also counts what the model still lacks.

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
    plain = np.sqrt(np.maximum(np.diag(inverse), 0.0) * max(1.0, fitted.cost.reduced))
    blocks = blocks_of(episodes, 4)
    names = np.unique(blocks)
    scores = np.einsum("awn,wn->wa", slope, residual)
    sums = np.stack([scores[blocks == b].sum(0) for b in names])
    middle = sums.T @ sums * len(names) / max(len(names) - 1, 1)
    factor = stats.t.ppf(0.95, max(len(names) - 1, 1)) / Z90
    clustered = np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)) * factor
    inflated = fitted.cost.reduced > 1.5
    return np.where(known, np.maximum(plain, clustered) if inflated else plain, np.inf) * fitted.scale


def step_errors(evidence: Evidence, fitted: Refit) -> np.ndarray:
    """Return by how much the simulation's own step may bias each number ``(q,)``, in their units.

    The fit is repeated with half the step, on the windows and weights of the fit. Dry friction, ripples and stops are
    resolved by the step only so well, and with little noise that is more than the standard errors. Zero where the fit
    leaves no more than noise.
    """
    vector = fitted.hypothesis.vector
    finer = find_effect("integration")
    as_noise = fitted.cost.reduced < BIASED and not np.any(evidence.model_error > 1)
    if as_noise or any(p.effect is finer for p in fitted.hypothesis.placed):
        return np.zeros(len(vector))
    step = float(evidence.twin.setting.model.opt.timestep)
    other = replace(evidence, twin=evidence.twin.also(Placed(finer, None, (step / 2,))))
    again = refit(other, fitted.hypothesis, linear=fitted.linear, iterations=3)
    return FIRST_ORDER * np.abs(again.hypothesis.vector - vector)
