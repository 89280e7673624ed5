"""What an examination finds, as plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import yaml

Confidence = Literal["sure", "doubtful"]

#: At most so many rows of a finding are named.
MOST_ROWS = 20


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a log, or may be.

    Attributes:
        name: what it is, such as ``degrees``; the names stand in ``docs/check.md``.
        where: the columns, by their labels; empty for what concerns the whole log.
        what: a sentence.
        confidence: ``sure`` stops a run, ``doubtful`` is told.
        rows: rows of the log where it shows, counted from 0; empty for all of it.
        evidence: the numbers that decided, by name.
        cure: the keys of the config that cure it, as they stand in YAML; empty where no key does.
        advice: what to do where no key of the config cures it, or besides.
    """

    name: str
    where: tuple[str, ...]
    what: str
    confidence: Confidence
    rows: tuple[int, ...] = ()
    evidence: Mapping[str, float] = field(default_factory=dict)
    cure: Mapping[str, Any] = field(default_factory=dict)
    advice: str = ""

    @property
    def sure(self) -> bool:
        """Whether it stops a run."""
        return self.confidence == "sure"

    @property
    def cure_line(self) -> str:
        """The lines of the config that cure it, in one; empty where there are none."""
        return ", ".join(_line(key, value) for key, value in self.cure.items())

    def document(self) -> dict[str, Any]:
        """Return the finding as plain data."""
        return {
            "name": self.name, "confidence": self.confidence, "where": list(self.where), "what": self.what,
            "rows": list(self.rows), "evidence": {k: float(v) for k, v in self.evidence.items()},
            "cure": dict(self.cure), "cure_line": self.cure_line, "advice": self.advice,
        }  # fmt: skip


def verdict(findings: Sequence[Finding]) -> str:
    """Return in a sentence what an examination found."""
    sure = sum(finding.sure for finding in findings)
    doubtful = len(findings) - sure
    more = f"{doubtful} {'thing' if doubtful == 1 else 'things'} to look at"
    if not findings:
        return "Nothing is wrong with the log."
    if not sure:
        return f"Nothing is surely wrong with the log; {more}."
    wrong = "one thing is" if sure == 1 else f"{sure} things are"
    return f"{wrong[0].upper()}{wrong[1:]} wrong with the log" + (f"; {more}." if doubtful else ".")


def confidence(sure: bool) -> Confidence:
    """Return the word for how sure a finding is."""
    return "sure" if sure else "doubtful"


def first_rows(rows: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    """Return the first of many rows."""
    return tuple(int(row) for row in rows[:MOST_ROWS])


def _line(key: str, value: Any) -> str:
    """One key of a config with its value, in YAML's flow style."""
    text = yaml.safe_dump({key: value}, default_flow_style=True, sort_keys=False, width=1_000_000, allow_unicode=True)
    return text.strip()[1:-1]
