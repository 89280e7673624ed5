"""Effects that show in one direction only, where all residuals together look like noise.

The χ² of n residuals that are noise varies by √(2n), so the gate lets an effect pass unseen that explains several
hundred of many thousand. Along the one direction in which a candidate moves the residuals, noise makes no more than a
few: there, a likelihood ratio tells. It is trusted only where what is left is no more than noise, and that along no
direction has far more of it than along others: the noise of every column is only estimated, and need not be white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.gap.accept import sound
from dropo_torch.gap.chance import p_of_ratio, p_of_scores
from dropo_torch.gap.ground import Ground, State
from dropo_torch.gap.refit import Refit, refit
from dropo_torch.gap.renew import renewed
from dropo_torch.gap.rules import significant
from dropo_torch.gap.screen import Beside, Candidate, Focus, left_by, nearer, screen

#: Candidates that are screened again on the windows that refits use, and that are fitted on all, at most.
AGAIN, FITTED = 12, 3
#: Share of what a candidate must be worth that a prediction on few windows promises, at least.
PROMISED = 0.5
#: Iterations of these fits.
ITERATIONS = 6
#: The stage as it is reported, and the share of it that has passed when candidates are fitted.
STAGE, FITTING = "looking for what is faint", 0.6


def may_tell(ground: Ground, fitted: Refit) -> bool:
    """Return whether noise is all that a fit leaves, and windows bend so little in it that a ratio can be trusted."""
    return not (ground.evidence.rough or ground.evidence.robust or significant(fitted.cost, ground.rules))


def with_faint(ground: Ground, state: State) -> State:
    """Return a state with the effects that a likelihood ratio shows beside those that were accepted.

    Args:
        ground: what the search stands on, as the state has it.
        state: with a hypothesis that leaves no more than noise.
    """
    while len(state.current.hypothesis.placed) < ground.rules.effects and may_tell(ground, state.current):
        better = _shown(ground, state)
        if better is None:
            break
        state = renewed(ground, replace(state, current=ground.refit(better.hypothesis)))
        ground = ground.at(state)
    return state


def _shown(ground: Ground, state: State) -> Refit | None:
    """The hypothesis with the one effect more that explains the most, if a likelihood ratio shows it; on all windows.

    What a finer step explains half as well is no effect of the robot.
    """
    hopeful = _hopeful(ground, state)
    if not hopeful:
        return None
    ground.report(STAGE, FITTING)
    every = replace(ground, few=len(ground.evidence.windows), caps=1.0)
    whole = refit(every.part, state.current.hypothesis, iterations=ITERATIONS)
    if not may_tell(every, whole):
        return None
    focus, found = Focus(ground.part, state.current), list[Refit]()
    for number, candidate in enumerate(hopeful):
        ground.report(STAGE, FITTING + (1 - FITTING) * (number + 1) / (len(hopeful) + 1))
        start = whole.hypothesis.with_effects([nearer(focus, whole.hypothesis, candidate)])
        found.append(refit(every.part, start, linear=whole.linear, iterations=ITERATIONS))
    found.sort(key=lambda r: r.loss)
    gains = [(whole.loss - r.loss, r.hypothesis.placed[-1].effect.steps) for r in found]
    if any(step and 2 * gain > gains[0][0] for gain, step in gains):
        return None
    best = sound(every, found[:1])
    named = state.base.cost.reduced - state.current.cost.reduced
    return best[0] if best and is_shown(every, whole, best[0], named) else None


def _hopeful(ground: Ground, state: State) -> list[Candidate]:
    """The candidates that may show, as the windows that refits use have it, and with them the best finer step."""
    current, tried = state.current, ground.rules.tried
    ground.report(STAGE, 0.0)
    if current.hypothesis.placed:
        looking = ground.reporting(lambda stage, share: ground.report(STAGE, FITTING * share))
        ranked = _promising(ground.focus(current), looking.screened(current))
    else:
        ranked = _promising(state.first, state.first.ranked)
    steps = [c for c in ranked if c.placed.effect.steps]
    focus, first = Focus(ground.part, current), [c for c in ranked if not c.placed.effect.steps][:AGAIN]
    again = _promising(focus, screen(focus, [c.start for c in (*first, *steps[:1])], tried))
    before = left_by(focus, [])
    found = [c for c in again if not c.placed.effect.steps and _may_show(ground, current, c, before - c.chi2)]
    return [*found[:FITTED], *(c for c in again if c.placed.effect.steps)] if found else []


def _may_show(ground: Ground, current: Refit, candidate: Candidate, gain: float) -> bool:
    """Whether a candidate with such a gain on the windows that refits use may show on all.

    That is unlikely by chance, were the noise known as it is, and it is near what it must be worth.
    """
    if gain < PROMISED * ground.rules.chance.worth * current.cost.degrees:
        return False
    share = len(ground.part.windows) / len(ground.evidence.windows)
    return p_of_ratio(gain / share, len(candidate.slope)) * ground.comparisons < 1


def _promising(beside: Beside, ranked: Sequence[Candidate]) -> list[Candidate]:
    """Candidates, those first that noise would promise the least often to gain as much."""
    before = left_by(beside, [])
    return sorted((c for c in ranked if not c.dead), key=lambda c: p_of_ratio(before - c.chi2, len(c.slope)))


def is_shown(ground: Ground, without: Refit, better: Refit, named: float = 0.0) -> bool:
    """Return whether a likelihood ratio shows what one hypothesis has more than another, both fitted on all windows.

    Noise as the gate allows for it, several times in one direction, must not make as much; and no few blocks of the
    log alone. Nor must what names explain already, ``named`` χ² per degree of freedom, if they are off by a little: the
    step of a simulation alone bends a lag by as much.
    """
    chance = ground.rules.chance
    numbers = len(better.hypothesis.vector) - len(without.hypothesis.vector)
    gain = (without.loss - better.loss) / max(better.cost.reduced, 1.0)
    if gain < max(chance.worth, chance.beside * named) * better.cost.degrees:
        return False
    if p_of_ratio(gain / chance.judged, numbers) * ground.comparisons > chance.error:
        return False
    return p_of_scores(_scores(ground, without, better)) <= chance.error


def _scores(ground: Ground, without: Refit, better: Refit) -> np.ndarray:
    """Of each block, how far its residuals lie along what the added numbers do beside all others, ``(B, p)``."""
    count = len(without.hypothesis.vector)
    slope = better.slope.reshape(len(better.slope), better.residual.size)
    own, others = slope[count:], slope[:count]
    if count:
        own = own - (own @ others.T) @ np.linalg.pinv(others @ others.T, rcond=1e-12, hermitian=True) @ others
    windows = np.einsum("pwn,wn->wp", own.reshape(len(own), *better.residual.shape), without.residual)
    blocks = ground.blocks
    return np.stack([windows[blocks == b].sum(0) for b in np.unique(blocks)])
