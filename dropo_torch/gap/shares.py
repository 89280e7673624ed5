"""What each effect of a hypothesis accounts for, by the derivatives at its fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.refit import Refit

#: Places from which on an effect is a family, whose members stand together.
MANY = 3


def offsets(setting: Setting, whole: Refit) -> np.ndarray:
    """Return by how many scales each number differs from its neutral value ``(q,)``; declared parameters do not."""
    placed = whole.hypothesis.placed
    neutral = [quantity.neutral for p in placed for quantity in p.effect.quantities(setting, p.target)]
    absent = np.concatenate([whole.hypothesis.declared, neutral])
    return np.asarray((whole.hypothesis.vector - absent) / whole.scale)


def shares_of(ground: Ground, whole: Refit) -> tuple[float, ...]:
    """Return the χ² that would come back without each effect, by the derivatives at the fit."""
    slope, _ = whole.weighted(ground.part.caps)
    covariance = np.linalg.pinv(slope @ slope.T, rcond=1e-12, hermitian=True)
    off, end, found = offsets(ground.setting, whole), len(whole.hypothesis.declared), []
    for placed in whole.hypothesis.placed:
        own = slice(end, end := end + len(placed.values))
        found.append(float(off[own] @ np.linalg.pinv(covariance[own, own], rcond=1e-12, hermitian=True) @ off[own]))
    return tuple(found)


def families(placed: Sequence[Placed]) -> list[list[int]]:
    """Return which effects are one effect of one number at many places, those of each."""
    counts = Counter(p.effect.name for p in placed)
    many = [name for name, count in counts.items() if count >= MANY]
    groups = [[i for i, p in enumerate(placed) if p.effect.name == name] for name in many]
    return [group for group in groups if len(placed[group[0]].values) == 1]
