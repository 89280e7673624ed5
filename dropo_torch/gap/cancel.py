"""Effects of which each undoes what the other does: where a joint moves one way only, dry friction and an offset.

Either alone is far off, so that each is needed beside the other, and their numbers may be anything.
"""

from __future__ import annotations

import itertools

import numpy as np

from dropo_torch.effects.base import Setting
from dropo_torch.gap.refit import Refit

#: Share of the size of two effects that they leave together, in the median over windows, if they undo each other.
LEFT = 0.05


def cancelling(setting: Setting, fitted: Refit) -> list[tuple[int, int]]:
    """Return pairs of effects that undo each other in most windows, those that do so best first.

    Args:
        setting: the model and its columns.
        fitted: with the effects.
    """
    sizes = contributions(setting, fitted)
    found = []
    for i, j in itertools.combinations(range(len(sizes)), 2):
        both, each = ((sizes[i] + sizes[j]) ** 2).sum(-1), (sizes[i] ** 2 + sizes[j] ** 2).sum(-1)
        acting = each > 1e-6 * each.max(initial=0.0)
        if acting.any() and (left := float(np.median(both[acting] / each[acting]))) < LEFT:
            found.append((left, (i, j)))
    return [pair for _, pair in sorted(found)]


def contributions(setting: Setting, fitted: Refit) -> np.ndarray:
    """Return what each effect does to the residuals, by the derivatives at the fit, ``(p, W, N)``."""
    row, found = len(fitted.hypothesis.declared), []
    for p in fitted.hypothesis.placed:
        neutral = np.array([q.neutral for q in p.effect.quantities(setting, p.target)])
        rows = slice(row, row + len(neutral))
        off = (np.array(p.values) - neutral) / fitted.scale[rows]
        found.append(np.tensordot(off, fitted.slope[rows], 1))
        row += len(neutral)
    return np.array(found).reshape(-1, *fitted.residual.shape)
