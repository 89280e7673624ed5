"""Once a hypothesis is accepted: the noise as it is beside it, and the windows whose commands it knows.

A missing effect that changes fast, such as a late sensor, passes for noise until it is named; and one with a memory
makes windows worthless whose earlier commands are not in the log. All hypotheses are then compared again, with the same
noise on the same windows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dropo_torch.gap.evidence import LEAST_KNOWN, caps_of
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.log import since_known
from dropo_torch.gap.noise import free_forces
from dropo_torch.gap.refit import Hypothesis, Refit

#: Relative change of a feature's noise from which on everything is compared again.
MOVED = 0.03


def renewed(ground: Ground, state: State) -> State:
    """Return a state with the noise beside its hypothesis, and on the windows whose commands that knows."""
    since, noise = known_since(ground, state.current.hypothesis, state.since), noise_beside(ground, state.current)
    if np.array_equal(since, state.since) and not moved(noise, state.noise):
        return state
    here, base = with_base(ground.on(noise, since), state.base.hypothesis)
    current = here.refit(state.current.hypothesis, iterations=6) if state.current.hypothesis.placed else base
    return replace(state, noise=noise, since=since, caps=here.caps, base=base, current=current)


def with_base(ground: Ground, hypothesis: Hypothesis) -> tuple[Ground, Refit]:
    """Return the declared parameters fitted alone, and the ground on which no window has more than its share of χ²."""
    base = ground.refit(hypothesis, iterations=4)
    if not ground.evidence.robust:
        ground = replace(ground, caps=caps_of(base.cost.windows, base.cost.degrees))
        base = ground.refit(base.hypothesis, iterations=4)
    return ground, base


def moved(noise: np.ndarray, before: np.ndarray) -> bool:
    """Return whether a noise differs from another by more than matters."""
    return bool(np.abs(np.log(noise / before)).max() > MOVED)


def known_since(ground: Ground, hypothesis: Hypothesis, since: np.ndarray) -> np.ndarray:
    """Return the later of some logged steps and those from which on a hypothesis knows its commands, ``(E,)``.

    Where too few windows would be left, the earlier ones stay.
    """
    windows = ground.evidence.windows
    later = np.maximum(since, ground.evidence.twin.settled(hypothesis.variant, windows.commands))
    return later if len(since_known(windows, later)) >= LEAST_KNOWN * len(windows) else since


def noise_beside(ground: Ground, fitted: Refit) -> np.ndarray:
    """Return the noise of each feature ``(m,)`` as it is beside a fitted hypothesis."""
    noise = ground.evidence.noise
    if ground.short is None:
        return noise
    return free_forces(ground.evidence.twin, ground.short, fitted.hypothesis.variant).noise
