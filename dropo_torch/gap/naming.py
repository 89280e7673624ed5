"""What a search holds between two of its steps, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.effects.base import Placed
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.refit import Refit
from dropo_torch.gap.screen import Candidate


@dataclass(frozen=True)
class Attempt:
    """A candidate that was refitted, for the report: what it left of the excess, and in which round."""

    placed: Placed
    excess: float
    before: float
    round: int


@dataclass(frozen=True)
class Screening:
    """What every candidate promises beside the declared parameters alone.

    Attributes:
        ranked: the candidates, the most promising first.
        chi2: χ² of the screened windows without them.
        degrees: its degrees of freedom.
    """

    ranked: tuple[Candidate, ...]
    chi2: float
    degrees: float

    @property
    def silent(self) -> tuple[Placed, ...]:
        """Candidates that change nothing on this log, which it therefore cannot judge."""
        return tuple(c.placed for c in self.ranked if c.dead)


@dataclass(frozen=True)
class State:
    """Where a search stands; a checkpoint holds nothing else.

    Attributes:
        noise: standard deviation of each feature, ``(m,)``: lower than the scene's where a fit showed that it is.
        caps: factors of the windows' residuals in all fits, ``(W,)``.
        base: the declared parameters alone.
        first: the screening beside them.
        current: the hypothesis so far.
        number: rounds done.
        done: whether no round is to follow.
        attempts: what was refitted, in order.
    """

    noise: np.ndarray
    caps: np.ndarray
    base: Refit
    first: Screening
    current: Refit
    number: int = 0
    done: bool = False
    attempts: tuple[Attempt, ...] = ()


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
    """

    evidence: Evidence
    base: Refit
    first: Screening
    final: Refit
    gap: bool
    named: bool = False
    ties: tuple[tuple[Placed, ...], ...] = ()
    shares: tuple[float, ...] = ()
    attempts: tuple[Attempt, ...] = ()
    partial: bool = False
