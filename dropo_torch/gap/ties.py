"""Which candidates explain the log as well in the place of a named effect, and which of them gives its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.rules import near
from dropo_torch.gap.screen import Candidate

#: Cosine of two candidates' derivatives from which on they are the same thing on this log.
SAME = 0.9999
#: The round of attempts that only look for ties.
TIES = -1


def ties(ground: Ground, state: State, index: int) -> tuple[tuple[Placed, ...], float, State]:
    """Return candidates that tie with a named effect, the excess that it accounts for, and the state with attempts."""
    current = state.current
    own, origin = current.hypothesis.placed[index], current.hypothesis.without(index)
    without = ground.refit(origin) if origin.placed else state.base
    ranked = ground.screened(without) if origin.placed else state.first.ranked
    same = equivalents(ground.setting, own, ranked)
    known = {own.key, *(p.key for p in same)}
    fits = [c for c in ranked if not c.dead and len(c.placed.values) <= len(own.values)]
    others = [(c.placed,) for c in fits if c.key not in known][: max(5 - len(same), 2)]
    alike = [ground.refit(origin.with_effects([p]), iterations=3) for p in same]
    rivals, state = ground.refits(replace(state, number=TIES), without, others, "looking for ties", origin)
    found = []
    for fitted in (*alike, *rivals):
        as_clear = ground.clears(state.base, fitted) or not ground.clears(state.base, current)
        close = fitted.cost.excess - current.cost.excess < near(current.cost)
        if close and as_clear and ground.advantage(current, fitted) < ground.rules.tie:
            found.append(fitted.hypothesis.placed[-1])
    return tuple(found), without.cost.excess - current.cost.excess, state


def equivalents(setting: Setting, own: Placed, ranked: Sequence[Candidate]) -> list[Placed]:
    """Return candidates of one number whose derivatives point the same way, with the values that do the same.

    Args:
        setting: the model and its columns.
        own: the effect, with its value.
        ranked: a screening beside the hypothesis without it.
    """
    single = [c for c in ranked if len(c.slope) == len(c.placed.values) == 1]
    mine = next((c.slope[0] for c in single if c.key == own.key), None)
    if mine is None:
        return []
    found = []
    for other in single:
        slope = other.slope[0]
        cosine = float(mine @ slope / max(np.linalg.norm(mine) * np.linalg.norm(slope), 1e-300))
        if other.key == own.key or other.dead or abs(cosine) < SAME:
            continue
        here, there = (p.effect.quantities(setting, p.target)[0] for p in (own, other.placed))
        ratio = float(mine @ slope / (slope @ slope)) / here.scale * there.scale
        value = there.neutral + ratio * (own.values[0] - here.neutral)
        found.append(other.placed.at([float(np.clip(value, there.low, there.high))]))
    return found


def canonical(
    ground: Ground, state: State, tied: Sequence[tuple[Placed, ...]]
) -> tuple[State, tuple[tuple[Placed, ...], ...]]:
    """Among exact ties name the one with the fewest numbers that the vocabulary lists first."""
    order = {effect.name: i for i, effect in enumerate(ground.effects)}
    told = list(tied)
    for index, rivals in enumerate(told):
        own = state.current.hypothesis.placed[index]
        first = min((own, *rivals), key=lambda p: (len(p.values), order[p.effect.name]))
        if first is not own:
            state = replace(state, current=ground.refit(state.current.hypothesis.instead(index, first)))
            told[index] = tuple(own if p is first else p for p in rivals)
    return state, tuple(told)
