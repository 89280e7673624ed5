"""The search for missing effects: screen, refit, accept by the excess that is removed, swap, prune, tell what ties."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Effect
from dropo_torch.gap.accept import add, is_done, prune, swap
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.naming import Naming, Screening, State
from dropo_torch.gap.refit import Hypothesis, Refit
from dropo_torch.gap.rules import allowance, significant
from dropo_torch.gap.ties import canonical, ties
from dropo_torch.support.checkpoint import Checkpoint

#: Least ratio of a feature's residuals to the noise at which that noise stays as it is.
QUIET = 0.97


def kept(path: Path, fingerprint: str) -> Checkpoint:
    """Return where a search keeps its state between rounds.

    Args:
        path: the file.
        fingerprint: identifies config, model, log and vocabulary.
    """
    return Checkpoint(path, "gap", (fingerprint,), (State,), {Effect: find_effect})


def search(ground: Ground, begin: Hypothesis, checkpoint: Checkpoint | None = None, *, resume: bool = False) -> Naming:
    """Return what is missing, beginning from the declared parameters' values.

    Args:
        ground: what the search stands on.
        begin: the declared parameters' values.
        checkpoint: where the state is kept between rounds, ``None`` for nowhere.
        resume: go on from there, if there is one.

    Raises:
        InputError: a checkpoint that is damaged, or of another search.
    """
    twin = ground.evidence.twin

    def keep(state: State) -> State:
        if checkpoint is not None:
            checkpoint.save({"state": state, "simulated_transitions": twin.simulated_transitions})
        return state

    if resume and checkpoint is not None and checkpoint.path.exists():
        content = checkpoint.load()
        state, twin.simulated_transitions = content["state"], content["simulated_transitions"]
    else:
        state = keep(start(ground, begin))
    ground = ground.at(state)
    while not state.done:
        state = keep(step(ground, state))
    return conclude(ground, state)


def start(ground: Ground, begin: Hypothesis) -> State:
    """Fit the declared parameters alone, with the influence of single windows capped, and screen beside them."""
    ground.report("fitting the declared parameters", 0.0)
    base = ground.refit(begin)
    noise = _noise(ground, base)
    if noise is not ground.evidence.noise:
        ground = replace(ground, evidence=replace(ground.evidence, noise=noise))
        base = ground.refit(base.hypothesis, iterations=4)
    caps = ground.strategy.caps(base)
    ground = replace(ground, caps=caps)
    base = ground.refit(base.hypothesis, iterations=4)
    ranked, focus = ground.screened(base), ground.focus(base)
    degrees = focus.evidence.degrees(focus.fitted.linear)
    first = Screening(tuple(ranked), float((focus.residual**2).sum()), degrees)
    return State(noise, caps, base, first, base, done=not significant(base.cost, ground.rules))


def _noise(ground: Ground, fitted: Refit) -> np.ndarray:
    """The noise of each feature, lower where even this hypothesis leaves less of it."""
    noise = ground.evidence.noise
    squares = (fitted.residual**2).reshape(len(fitted.residual), -1, len(noise))
    known = (fitted.linear.weights > 0).reshape(squares.shape)
    free = known.sum((0, 1)) * fitted.cost.degrees / max(float(known.sum()), 1.0)
    ratio = np.sqrt(squares.sum((0, 1)) / np.maximum(free, 1.0))
    if fitted.cost.reduced > ground.rules.least_reduced or (ratio > QUIET).all():
        return noise
    return noise * np.minimum(ratio, 1.0)


def step(ground: Ground, state: State) -> State:
    """Accept one or two more effects, and swap those accepted before for better ones."""
    found = add(ground, state)
    if found.done:
        return found
    found = ground.strategy.refine(ground, found)
    if not is_done(ground, found) and len(found.current.hypothesis.placed) > 1:
        found = swap(ground, found)
    number = state.number + 1
    return replace(found, number=number, done=is_done(ground, found) or number >= ground.rules.effects)


def conclude(ground: Ground, state: State) -> Naming:
    """Drop what is not needed, judge whether the rest accounts for the gap, and tell what ties with it."""
    base, rules = state.base, ground.rules
    unnamed = Naming(ground.evidence, base, state.first, base, gap=significant(base.cost, rules))
    if not unnamed.gap:
        return unnamed
    state = prune(ground, state)
    placed = state.current.hypothesis.placed
    left = max(state.current.cost.excess, 0.0) / base.cost.excess
    partial = ground.strategy.clears(base, state.current)
    if not placed or not (partial or left <= allowance(state.current.hypothesis, rules)):
        return replace(unnamed, attempts=state.attempts)
    tied, shares = [], []
    for index in range(len(placed)):
        rivals, share, state = ties(ground, state, index)
        tied.append(rivals)
        shares.append(share)
    state, told = canonical(ground, state, tied)
    return replace(
        unnamed, final=state.current, named=True, ties=told, shares=tuple(shares), attempts=state.attempts,
        partial=partial,
    )  # fmt: skip
