"""Whether a fitted model explains its log: the verdict of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["explained", "not_explained", "hopeless"]


@dataclass(frozen=True)
class Judgment:
    """Whether the model explains the log.

    Attributes:
        verdict: ``"explained"``, ``"not_explained"`` or ``"hopeless"``.
        reason: why, in one sentence.
        standard_errors: parameter → ``mean`` and ``std``.
    """

    verdict: Verdict
    reason: str
    standard_errors: dict[str, dict[str, float | None]]
