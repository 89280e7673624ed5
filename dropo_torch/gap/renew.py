"""Once a hypothesis is accepted: the noise as it is beside it, and the windows whose commands it knows.

A missing effect that changes fast, such as a late sensor, passes for noise until it is named; and one with a memory
makes windows worthless whose earlier commands are not in the log. All hypotheses are then compared again, with the same
noise on the same windows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dropo_torch.gap.evidence import Evidence, are_calm, caps_of
from dropo_torch.gap.ground import FEWER, Ground, State
from dropo_torch.gap.log import since_known
from dropo_torch.gap.noise import Diverges, free_forces
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.rules import Rules, significant
from dropo_torch.gap.starts import merged, straightened, table_of
from dropo_torch.gap.twin import Windows

#: Times that the variance components are weighted anew.
COMPONENTS = 8
#: Times that noise and windows are found beside the hypothesis that is fitted with them, at most.
RENEWALS = 3


def renewed(ground: Ground, state: State) -> State:
    """Return a state with the noise beside its hypothesis, and on the windows whose commands that knows.

    Windows that it does not know show more than noise, so the noise is told anew once they are gone. Where simulations
    bend in the noise of their initial states, these are found first.
    """
    ground, state = restarted(ground, state)
    for _ in range(RENEWALS):
        since = known_since(ground, state.current.hypothesis, state.since)
        noise = noise_beside(ground.evidence, ground.short, state.current)
        if np.array_equal(since, state.since) and not moved(noise, state.noise, ground.rules):
            break
        ground, state = _refitted(ground.on(noise, since), replace(state, noise=noise, since=since))
    return state


def _refitted(ground: Ground, state: State) -> tuple[Ground, State]:
    """What a state has, fitted again on a changed ground."""
    here, base = with_base(ground, state.base.hypothesis)
    current = here.refit(state.current.hypothesis, iterations=6) if state.current.hypothesis.placed else base
    return here, replace(state, caps=here.caps, base=base, current=current)


def restarted(ground: Ground, state: State) -> tuple[Ground, State]:
    """Return ground and state with windows that begin where they fit best, if that leaves nothing where something is.

    Where something is left all the same, windows begin as they were: under a hypothesis that is wrong, the best start
    makes up for what it lacks, and others would be compared from there.

    Args:
        ground: what the search stands on.
        state: with a fitted hypothesis.
    """
    hypothesis = state.current.hypothesis
    if not significant(state.current.cost, ground.rules) or _is_wrong_anyhow(ground.part.few(FEWER), hypothesis):
        return ground, state
    windows = straightened(ground.part, hypothesis.variant)
    if windows is None:
        return ground, state
    starts = merged(state.starts, table_of(windows))
    here, there = _refitted(ground.begun(starts), replace(state, starts=starts))
    return (ground, state) if significant(there.current.cost, ground.rules) else (here, there)


def _is_wrong_anyhow(few: Evidence, hypothesis: Hypothesis) -> bool:
    """Whether a few windows show more than noise wherever they begin: then all of them do, and cost more to ask."""
    windows = straightened(few, hypothesis.variant)
    if windows is None:
        return False
    return significant(refit(replace(few, windows=windows), hypothesis, iterations=6, slopes=False).cost, few.rules)


def with_base(ground: Ground, hypothesis: Hypothesis) -> tuple[Ground, Refit]:
    """Return the declared parameters fitted alone, and the ground on which no window has more than its share of χ²."""
    base = ground.refit(hypothesis, iterations=4)
    if not ground.evidence.robust:
        ground = replace(ground, caps=caps_of(base.cost.windows, base.cost.degrees, ground.rules.weighed.cap))
        base = refit(ground.part, base.hypothesis, linear=base.linear, iterations=4)  # caps bend nothing
    return ground, base


def moved(noise: np.ndarray, before: np.ndarray, rules: Rules) -> bool:
    """Return whether a noise differs from another by more than matters."""
    return bool(np.abs(np.log(noise / before)).max() > rules.weighed.moved)


def known_since(ground: Ground, hypothesis: Hypothesis, since: np.ndarray) -> np.ndarray:
    """Return the later of some logged steps and those from which on a hypothesis knows its commands, ``(E,)``.

    Where too few windows would be left, the earlier ones stay.
    """
    windows = ground.evidence.windows
    later = np.maximum(since, ground.evidence.twin.settled(hypothesis.variant, windows.commands))
    return later if len(since_known(windows, later)) >= ground.rules.weighed.known * len(windows) else since


def noise_beside(evidence: Evidence, short: Windows | None, fitted: Refit) -> np.ndarray:
    """Return the noise of each feature ``(m,)`` as it is beside a fitted hypothesis.

    Free forces in short windows tell it whether or not the hypothesis is right; what that leaves in the long windows
    tells it more precisely where it is, and it is never larger. A larger one is believed only as far as the short
    windows leave it open, so that what is missing does not pass for noise; where they tell nothing, not at all.

    Args:
        evidence: of the fit, with the noise under which it was made.
        short: the short windows; ``None`` where the noise is given and can only be lower.
        fitted: the fit.
    """
    noise, left = evidence.noise, noise_left(fitted, evidence.noise, evidence.rules)
    if short is None:
        return np.minimum(noise, left)
    try:
        free = free_forces(evidence.twin, short, fitted.hypothesis.variant)
    except Diverges:  # beside a hypothesis under which nothing can be simulated, there is nothing to see
        return noise
    told = np.isfinite(free.unsure)
    agree = free.noise * (1 + evidence.rules.weighed.agree * np.where(told, free.unsure, 0.0))
    return np.where(told, np.where(left < agree, left, free.noise), np.minimum(noise, left))


def noise_left(fitted: Refit, noise: np.ndarray, rules: Rules) -> np.ndarray:
    """Return the noise of each feature ``(m,)`` by what a fit leaves in its windows; infinite where nothing tells.

    The variance components of the residuals beside their windows' initial states, each feature weighted by its own.
    Windows that stand out among the others have more than noise, and do not tell it.

    Args:
        fitted: the fit.
        noise: the noise under which it was made, ``(m,)``.
        rules: thresholds.
    """
    m, rows = len(noise), fitted.residual.shape[1]
    sharp = (fitted.linear.weights > rules.weighed.sharp) & fitted.linear.counted[:, None]
    usable = sharp & np.isfinite(fitted.residual)
    chi2 = (np.where(usable, fitted.residual, 0.0) ** 2).sum(-1)
    usable &= are_calm(chi2, usable.sum(1) - m, rules.weighed)[:, None]
    count = usable.reshape(-1, rows // m, m).sum((0, 1))
    fitted_share = len(fitted.hypothesis.vector) / max(float(usable.sum()), 1.0)
    relative = np.ones(m)
    for _ in range(COMPONENTS):
        factor = np.tile(1 / relative, rows // m)
        basis, _ = np.linalg.qr(fitted.linear.basis * factor[:, None])
        weighted = fitted.residual * factor
        along = np.einsum("wnk,wn->wk", basis, weighted)
        squares = np.where(usable, weighted - np.einsum("wnk,wk->wn", basis, along), 0.0) ** 2
        free = np.where(usable, 1 - (basis**2).sum(-1) - fitted_share, 0.0)
        sums, degrees = (x.reshape(-1, rows // m, m).sum((0, 1)) for x in (squares, free))
        relative = relative * np.sqrt(np.maximum(sums / np.maximum(degrees, 1e-9), 1e-12))
    return np.where((count >= rules.weighed.rows) & (degrees >= rules.weighed.rows / 2), noise * relative, np.inf)
