"""What a base family does without: what could stand in a member's place, and how large the rest may be all the same.

Whether friction or inertia of a joint is needed is a matter of a threshold; what the log allows it to be is not.
"""

from __future__ import annotations

import numpy as np

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed
from dropo_torch.gap.accept import SOFT
from dropo_torch.gap.family import BASE, SLOPE, base_family
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.limbs import joint_of
from dropo_torch.gap.refit import LEAST_DAMPING, Z90, Hypothesis, Refit, limits_of, newton_step, refit, standard_errors
from dropo_torch.gap.shares import offsets
from dropo_torch.gap.spare import FRICTION

#: An effect, and the half-widths of the 90 % intervals of its numbers.
Allowed = tuple[Placed, np.ndarray]


def absent(ground: Ground, hypothesis: Hypothesis) -> list[Placed]:
    """Return what a family could have besides its members, with neutral values: slopes only of friction that it has."""
    setting = ground.setting
    taken = {p.called for p in hypothesis.placed}
    others, slope = base_family(setting, ground.effects), find_effect(SLOPE)
    if slope in ground.effects:
        rubbing = {p.target for p in hypothesis.placed if p.effect.name in (FRICTION, SOFT)}
        others += [Placed(slope, t, (0.0,)) for t in slope.targets(setting) if t in rubbing]
    idle = [p for p in others if p.key not in taken]
    return [p.at(np.array([p.effect.quantities(setting, p.target)[0].neutral])) for p in idle]


def with_absent(ground: Ground, whole: Refit) -> Refit:
    """Return a fitted family beside all that it does without, there with neutral values, and its derivatives."""
    every = whole.hypothesis.with_effects(absent(ground, whole.hypothesis))
    return refit(ground.part, every, linear=whole.linear, iterations=0)


def family_ties(ground: Ground, whole: Refit, beside: Refit) -> tuple[tuple[Placed, ...], ...]:
    """Return for each member those that could stand in its place at its joint, by the derivatives at the fit.

    Args:
        ground: what the search stands on.
        whole: the fitted family.
        beside: the same :func:`with_absent`.
    """
    setting, hypothesis, first = ground.setting, whole.hypothesis, len(whole.hypothesis.declared)
    idle = beside.hypothesis.placed[len(hypothesis.placed) :]
    slope, residual = beside.weighted(ground.part.caps)
    off, own = offsets(setting, beside), np.arange(len(hypothesis.vector))
    margin = max(ground.rules.alike.chi2, ground.rules.alike.share * whole.cost.misfit)

    def left(rows: np.ndarray, gone: int | None) -> float:
        moved = residual if gone is None else residual - off[gone] * slope[gone]
        return float(((moved - slope[rows].T @ np.linalg.lstsq(slope[rows].T, moved, rcond=1e-9)[0]) ** 2).sum())

    with_all, found = left(own, None), []
    for index, member in enumerate(hypothesis.placed):
        at, joint = first + index, joint_of(setting, member)
        others = [j for j, p in enumerate(idle) if p.effect.name in BASE and joint_of(setting, p) == joint]
        rest = np.delete(own, at)
        found.append(tuple(idle[j] for j in others if left(np.append(rest, len(own) + j), at) < with_all + margin))
    return tuple(found)


def left_out(ground: Ground, whole: Refit, beside: Refit) -> tuple[Allowed, ...]:
    """Return how large what a family does without may be, whatever else of it there is, to first order.

    Args:
        ground: what the search stands on.
        whole: the fitted family.
        beside: the same :func:`with_absent`.
    """
    limits = limits_of(beside.hypothesis, ground.part.twin)
    there = beside.hypothesis.vector + newton_step(beside, limits, ground.part.caps, LEAST_DAMPING) * limits.scale
    moved = beside.hypothesis.at(np.clip(there, limits.low, limits.high)).placed
    halves = Z90 * standard_errors(beside, ground.part.windows.episodes)[len(beside.hypothesis.declared) :]
    members = len(whole.hypothesis.placed)
    return tuple((p, halves[n : n + 1]) for n, p in enumerate(moved) if n >= members)
