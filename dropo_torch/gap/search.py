"""The search for missing effects: screen, refit, accept by the excess that is removed, swap, prune, tell what ties."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dropo_torch.effects.base import Placed
from dropo_torch.errors import InputError
from dropo_torch.gap.accept import add, canonical, everywhere, extend, is_done, nonsense, prune, swap, ties
from dropo_torch.gap.evidence import Evidence, caps_of
from dropo_torch.gap.ground import Ground, Screening, State
from dropo_torch.gap.refit import Hypothesis, Refit
from dropo_torch.gap.result import Ranked
from dropo_torch.gap.rules import accounts, significant
from dropo_torch.support.files import write_atomically

#: Why what a log is too short for has no name.
UNSURE = "what explains most of it may do so by chance, for this log has too few stretches that show it"
#: Least ratio of a feature's residuals to the noise at which that noise stays as it is.
QUIET = 0.97


@dataclass(frozen=True)
class Naming:
    """What was found.

    Attributes:
        evidence: the windows on which it was.
        base: the declared parameters alone.
        first: the screening beside them.
        final: with the named effects, or the base again.
        gap: whether anything is missing at all.
        named: whether the named effects account for it.
        ties: for each named effect, the candidates that do as well in its place.
        shares: excess that comes back when each named effect alone is left out.
        attempts: what was refitted, in order.
        partial: whether they leave nothing in most of the log, but something else remains in the rest.
        refused: why what was found has no name.
    """

    evidence: Evidence
    base: Refit
    first: Screening
    final: Refit
    gap: bool
    named: bool = False
    ties: tuple[tuple[Placed, ...], ...] = ()
    shares: tuple[float, ...] = ()
    attempts: tuple[Ranked, ...] = ()
    partial: bool = False
    refused: str = ""


@dataclass(frozen=True)
class Checkpoint:
    """Where a search keeps its state between rounds.

    Attributes:
        path: the file; ``None`` for nowhere.
        resume: whether to go on from it.
        fingerprint: identifies config, model, log and vocabulary.
    """

    path: Path | None
    resume: bool
    fingerprint: str

    def load(self) -> State | None:
        """Return the state of an interrupted search, if there is one.

        Raises:
            InputError: it is of another config, model or log.
        """
        if self.path is None or not self.resume or not self.path.exists():
            return None
        try:
            document = pickle.loads(self.path.read_bytes())
            known, state = document["fingerprint"], document["state"]
        except Exception:  # whatever bytes that are no checkpoint make of a pickle
            raise InputError(f"--resume: {self.path} is no checkpoint; run without --resume") from None
        if known != self.fingerprint:
            raise InputError(
                f"--resume: {self.path} is of another config, model or log; run without --resume, "
                "or name another folder"
            )
        return state

    def save(self, state: State) -> State:
        """Write the state, whole or not at all, and return it."""
        if self.path is not None:
            write_atomically(self.path, pickle.dumps({"fingerprint": self.fingerprint, "state": state}))
        return state


def search(ground: Ground, begin: Hypothesis, checkpoint: Checkpoint) -> Naming:
    """Return what is missing, beginning from the declared parameters' values."""
    state = checkpoint.load() or checkpoint.save(start(ground, begin))
    ground = ground.at(state)
    while not state.done:
        state = checkpoint.save(step(ground, state))
    return conclude(ground, state)


def start(ground: Ground, begin: Hypothesis) -> State:
    """Fit the declared parameters alone, with the influence of single windows capped, and screen beside them."""
    ground.report("fitting the declared parameters", 0.0)
    base = ground.refit(begin)
    noise = _noise(ground, base)
    if noise is not ground.evidence.noise:
        ground = replace(ground, evidence=replace(ground.evidence, noise=noise))
        base = ground.refit(base.hypothesis, iterations=4)
    caps = 1.0 if ground.evidence.robust else caps_of(base.cost.windows, base.cost.degrees)
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
    if ground.evidence.robust and not is_done(ground, found):
        found = everywhere(ground, found)
    elif significant(found.current.cost, ground.rules):
        found = extend(ground, found)
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
    found, state = state.current, prune(ground, state)
    unnamed = replace(unnamed, attempts=state.attempts, refused=state.refused)
    if reasons := nonsense(ground, state.current):
        return replace(unnamed, refused=reasons[0])
    placed, partial = state.current.hypothesis.placed, ground.clears(base, state.current)
    if not placed or not (partial or accounts(state.current, base, rules)):
        unsure = found.hypothesis.placed and accounts(found, base, rules)
        return replace(unnamed, refused=UNSURE if unsure else state.refused)
    tied, shares = [], []
    for index in range(len(placed)):
        rivals, share, state = ties(ground, state, index)
        tied.append(rivals)
        shares.append(share)
    state, told = canonical(ground, state, tied)
    return replace(
        unnamed, refused="", final=state.current, named=True, ties=told, shares=tuple(shares), attempts=state.attempts,
        partial=partial,
    )  # fmt: skip
