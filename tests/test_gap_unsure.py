"""Names whose interval, on all windows, says that there may be nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dropo_torch.effects import Quantity
from dropo_torch.gap import outcome
from dropo_torch.gap.rules import Rules


def named(value: float, *, steps: bool = False, numbers: int = 1) -> Any:
    """An effect with so many numbers, absent at 0."""
    quantities = tuple(Quantity(f"n{i}", "-", 0.0, -10.0, 10.0, 1.0) for i in range(numbers))
    effect = SimpleNamespace(name="some", quantities=lambda setting, target: quantities, steps=steps)
    return SimpleNamespace(effect=effect, target=None, values=(value,) * numbers, key=None)


def left(monkeypatch: pytest.MonkeyPatch, family: bool, entries: list[tuple[Any, float]]) -> tuple[list[int], int]:
    """Which of several effects with half-widths stay, and of how many it stays known what they may be."""
    placed = [p for p, _ in entries]
    monkeypatch.setattr(outcome, "_keeping", lambda naming, kept, near: replaced(naming, kept))
    monkeypatch.setattr(outcome, "replace", lambda naming, **new: SimpleNamespace(**{**vars(naming), **new}))
    monkeypatch.setattr(outcome, "_beside_fewer", lambda last, off, out: (off, halves))  # nothing is entangled
    vector = np.array([v for p in placed for v in p.values])
    halves = np.concatenate([np.full(len(p.values), half) for p, half in entries])
    hypothesis = SimpleNamespace(placed=placed, declared=(), vector=vector)
    final = SimpleNamespace(hypothesis=hypothesis)
    naming: Any = SimpleNamespace(final=final, everywhere=(), family=family, kept=list(range(len(placed))), left_out=())
    fitted: Any = SimpleNamespace(
        last=SimpleNamespace(fit=SimpleNamespace(hypothesis=hypothesis, scale=np.ones(len(vector)))),
        halves=halves,
        of_names=[np.full(len(p.values), half) for p, half in entries],
    )
    found: Any = outcome._without_unsure(None, naming, fitted, Rules())  # type: ignore[arg-type]
    return (naming.kept, 0) if found is None else (found.kept, len(found.left_out))


def replaced(naming: Any, kept: list[int]) -> Any:
    return SimpleNamespace(**{**vars(naming), "kept": kept})


@pytest.mark.parametrize(
    ("family", "entries", "kept", "known"),
    [
        (False, [(named(1.0), 0.5), (named(0.4), 0.5)], [0], 0),
        (False, [(named(1.0), 0.5), (named(0.6), 0.5)], [0, 1], 0),
        (False, [(named(0.1), 0.5)], [0], 0),  # alone, it is all that explains the gap
        (False, [(named(0.3), 0.5), (named(0.4), 0.5), (named(1.0), 0.1)], [1, 2], 0),  # one after the other
        (True, [(named(1.0), 0.5), (named(0.8), 0.5), (named(2.0), 0.5)], [0, 2], 1),
        (True, [(named(0.5), 0.5), (named(0.8), 0.5), (named(0.1), 0.5), (named(2.0), 0.5)], [3], 3),
        (True, [(named(0.1, steps=True), 0.5), (named(0.1, numbers=2), 0.5), (named(2.0), 0.5)], [0, 1, 2], 0),
        (True, [(named(2.0), np.inf), (named(2.0), 0.5), (named(-2.0), 0.5)], [0, 1, 2], 0),
    ],
)
def test_what_may_as_well_be_nothing_has_no_name(
    family: bool, entries: list[tuple[Any, float]], kept: list[int], known: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert left(monkeypatch, family, entries) == (kept, known)


def test_a_slope_of_friction_goes_with_the_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    slope = SimpleNamespace(**{**vars(named(1.0)), "key": "slope"})
    monkeypatch.setattr(outcome, "pushing", lambda setting, hypothesis: [slope])
    entries = [(named(0.1), 0.5), (slope, 0.5), (named(2.0), 0.5)]
    assert left(monkeypatch, True, entries) == ([2], 2)
