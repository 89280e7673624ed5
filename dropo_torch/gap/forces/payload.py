"""One mass on one body in the place of several centers of mass that forces only know together."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting, find_effect
from dropo_torch.gap.forces.motion import Stretch
from dropo_torch.gap.forces.regression import GAIN, Regression, fit, score, unseen
from dropo_torch.gap.forces.terms import CENTER, Terms, columns_of, needed

#: The effect.
PAYLOAD = "payload"
#: Share of a body's own mass with which it begins; steps of its fit; bodies on which it is fitted to the end.
BEGIN, STEPS, BODIES = 0.05, 5, 2


def in_one_place(
    setting: Setting, parts: Sequence[Stretch], found: Terms, regression: Regression, chosen: np.ndarray
) -> Placed | None:
    """Return a payload that explains unseen blocks as well as the chosen centers of mass of several bodies, if any.

    It has fewer numbers, and is what usually moves the center of mass of everything from one body on.

    Args:
        setting: the model as it is.
        parts: the motion.
        found: the terms.
        regression: of these.
        chosen: the columns that explain unseen blocks, ``(P,)`` bool.
    """
    centers = np.array([p.effect.name == CENTER for p in found.placed])[found.owner]
    if len(np.unique(found.owner[chosen & centers])) < 2:
        return None
    effect, most = find_effect(PAYLOAD), score(unseen(regression, chosen)) + GAIN
    begun = [Placed(effect, t, _begin(setting, t)) for t in effect.targets(setting)]
    tried = [_fitted(setting, parts, found, regression, chosen & ~centers, p, 1) for p in begun]
    heavy = [item for item in tried if item[1].values[0] > 0]
    for _, placed in sorted(heavy, key=lambda item: item[0])[:BODIES]:
        left, there = _fitted(setting, parts, found, regression, chosen & ~centers, placed, STEPS)
        if left <= most and not _at_bounds(setting, there):
            return there
    return None


def with_payload(setting: Setting, parts: Sequence[Stretch], found: Terms, placed: Placed) -> Terms:
    """Return terms with a payload more: columns of its mass, and of a change of its place where it has the mass given.

    Forces are linear in the mass at a place, so the first coefficient is the whole mass, and none is no payload.
    """
    none = placed.at((0.0, *placed.values[1:]))
    quantities = placed.effect.quantities(setting, placed.target)
    low, high = (np.array([getattr(q, end) for q in quantities]) - none.values for end in ("low", "high"))
    heavier = copy.copy(setting.model)
    placed.effect.apply(heavier, placed.target, np.array(placed.values))
    mass = [part.compared(needed(heavier, part) - needed(setting.model, part)) for part in parts]
    places = [np.stack([part.compared(c) for c in columns_of(setting, part, placed)[1:]]) for part in parts]
    columns = np.concatenate([np.concatenate(mass)[None] / placed.values[0], np.concatenate(places, 1)])
    return replace(
        found, placed=(*found.placed, none), columns=np.concatenate([found.columns, columns]),
        owner=np.append(found.owner, np.full(len(quantities), len(found.placed))), low=np.append(found.low, low),
        high=np.append(found.high, high), prior=np.append(found.prior, np.full(len(quantities), np.inf)),
    )  # fmt: skip


def _begin(setting: Setting, target: str | None) -> tuple[float, ...]:
    """A small payload at a body's center of mass."""
    mass, *center = find_effect(PAYLOAD).quantities(setting, target)
    return (BEGIN * mass.scale, *(q.neutral for q in center))


def _fitted(
    setting: Setting, parts: Sequence[Stretch], found: Terms, regression: Regression, chosen: np.ndarray,
    placed: Placed, steps: int,
) -> tuple[float, Placed]:  # fmt: skip
    """The score of unseen blocks with a payload beside the chosen columns, and the payload after so many steps."""
    limits = [(q.low, q.high) for q in placed.effect.quantities(setting, placed.target)]
    left = np.inf
    for _ in range(steps):
        more = with_payload(setting, parts, found, placed)
        wider = replace(regression, columns=more.columns, low=more.low, high=more.high, prior=more.prior)
        own = np.arange(len(more.owner)) >= len(found.owner)
        columns = np.append(chosen, own[own])
        left = score(unseen(wider, columns))
        moved = np.array([0.0, *placed.values[1:]]) + fit(wider, columns)[own]
        moved = placed.effect.settle(np.array(placed.values), moved)
        placed = placed.at(np.clip(moved, *np.array(limits).T))
        if placed.values[0] <= 0:
            break
    return left, placed


def _at_bounds(setting: Setting, placed: Placed) -> bool:
    """Whether a payload has no mass, or sits as far from its body as it can."""
    quantities = zip(placed.effect.quantities(setting, placed.target), placed.values, strict=True)
    return any(v <= q.low or v >= q.high for q, v in quantities)
