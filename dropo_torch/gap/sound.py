"""What may have a name at all: numbers within the bounds of physics, and a model with skill on unseen data."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dropo_torch.effects.base import Placed, Quantity
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.refit import Refit
from dropo_torch.gap.result import Score
from dropo_torch.gap.rules import Sound


def absurd(evidence: Evidence, fitted: Refit, rules: Sound) -> Iterator[tuple[Placed, str]]:
    """Yield the effects of which a number ends at a bound of physics, with the reason.

    The upper bound of an effect's first number is where it freezes or replaces the model. At any other bound a true
    number may end by chance, so it counts only where the fit pushes beyond. Where a bound is the number's neutral
    value, this part of the effect is just absent.

    Args:
        evidence: the windows of the fit.
        fitted: the hypothesis with its effects' numbers.
        rules: thresholds.
    """
    setting, at = evidence.twin.setting, len(fitted.hypothesis.declared)
    pushes = beyond(evidence, fitted)
    for placed in fitted.hypothesis.placed:
        quantities, first = placed.effect.quantities(setting, placed.target), at
        at += len(quantities)
        for number, (q, value) in enumerate(zip(quantities, placed.values, strict=True)):
            end = _end(q, value, rules)
            if end is None:
                continue
            frozen = number == 0 and end == q.high
            push = pushes[first + number] * (1 if end == q.high else -1)
            if frozen or push > rules.pushes:
                yield placed, _reason(placed, q, end)
                break


def _end(q: Quantity, value: float, rules: Sound) -> float | None:
    """The bound at which a value is, unless the effect is absent there."""
    if q.discrete:
        return None
    near = rules.edge * q.scale
    ends = [end for end in (q.low, q.high) if abs(value - end) <= near and abs(end - q.neutral) > near]
    return ends[0] if ends else None


def _reason(placed: Placed, q: Quantity, end: float) -> str:
    name, unit = q.name.replace("_", " "), "" if q.unit in ("-", "1") else f" {q.unit}"
    where = "" if placed.target is None else f" of {placed.target}"
    called = placed.effect.name.replace("_", " ")
    value = f"{name} of {end:.3g}{unit}"
    return f"{called}{where} fits best at the bound of what is physical ({value})"


def beyond(evidence: Evidence, fitted: Refit) -> np.ndarray:
    """Return by how many standard errors the fit would move each number ``(q,)`` if no bound held it."""
    slope, residual = fitted.weighted(evidence.caps)
    normal = slope @ slope.T
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    move = -inverse @ (slope @ residual)
    error = np.sqrt(np.maximum(np.diag(inverse), 0.0) * max(1.0, fitted.cost.reduced))
    return np.where(error > 0, move / np.maximum(error, 1e-300), 0.0)


def has_skill(after: Score, floor: Score, constant: float, rules: Sound) -> bool:
    """Return whether open-loop predictions of unseen data beat constant velocity, or nothing could beat it.

    Args:
        after: of the model with the effects.
        floor: of a perfect model.
        constant: open-loop error of constant velocity.
        rules: thresholds.
    """
    return bool(after.rollout_rmse < max(constant, rules.floor * floor.rollout_rmse))
