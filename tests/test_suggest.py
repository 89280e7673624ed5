"""Advice on what to record: of the motions that were tried, the one that tells two hypotheses apart."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dropo_torch.effects import Placed, find_effect
from dropo_torch.gap.rules import Rules
from dropo_torch.gap.suggest import excite, suggest
from dropo_torch.testing.effects import rig

FRICTION = Placed(find_effect("joint_friction"), "elbow", (0.1,))
TILT = Placed(find_effect("gravity_tilt"), None, (0.1, 0.0))


@dataclass(frozen=True)
class Windows:
    commands: np.ndarray

    def __len__(self) -> int:
        return len(self.commands)

    def select(self, rows: np.ndarray) -> Windows:
        return replace(self, commands=self.commands[rows])


@dataclass(frozen=True)
class Evidence:
    """Two hypotheses whose residuals differ by as many σ as the commands are large; one may diverge."""

    windows: Windows
    share: float = 1.0
    diverges: bool = False
    rules: Rules = field(default_factory=Rules)

    @property
    def twin(self) -> Any:
        model = rig()
        model.actuator_ctrllimited[0], model.actuator_ctrlrange[0] = True, (-1.0, 1.0)
        return SimpleNamespace(setting=SimpleNamespace(model=model))

    def on(self, windows: Windows) -> Evidence:
        return replace(self, windows=windows)

    def residuals(self, variants: list[Any]) -> tuple[np.ndarray, None]:
        told = self.share * np.abs(self.windows.commands).sum((1, 2))
        return np.stack([np.zeros_like(told), np.full_like(told, np.nan) if self.diverges else told]), None

    def linearise(self, variant: Any) -> None: ...

    def project_slope(self, difference: np.ndarray, initial: None) -> np.ndarray:
        return difference


def advice(**options: Any) -> str:
    commands = np.zeros((20, 6, 3))
    commands[..., 0], commands[..., 1] = 1.0, 0.5
    hypothesis: Any = SimpleNamespace(variant=None)
    return suggest(Evidence(Windows(commands), **options), hypothesis, hypothesis, FRICTION, TILT)  # type: ignore[arg-type]


def test_the_motion_that_separates_most_is_told() -> None:
    found = advice()
    assert found.startswith("To tell joint_friction of elbow from gravity_tilt, record the same motion with commands t")
    assert found.endswith("by 48 σ.")  # 16 windows of 6 steps of 1 (its range) and 2 · 0.5


def test_what_no_motion_tells_is_said() -> None:
    assert "None of 6 motions that were tried would tell" in advice(share=0.9 * Rules().shown.apart / 48)
    assert advice(diverges=True) == "No motion that was tried tells joint_friction of elbow from gravity_tilt."


@pytest.mark.parametrize(
    ("silent", "words"),
    [
        ([("joint_limit", "elbow")], "reaches the stops (for joint_limit of elbow)"),
        ([("ground_slope", None)], "slides and presses on the ground (for ground_slope)"),
        ([("payload", f"link{i}") for i in range(6)], "moves more (for payload of link0, payload of link1, payload of "
         "link2, payload of link3 and others)"),
    ],
)  # fmt: skip
def test_what_a_log_must_show_to_judge_the_rest(silent: list[tuple[str, str | None]], words: str) -> None:
    placed = [Placed(find_effect(effect), target) for effect, target in silent]
    assert excite(placed) == f"To judge what this log cannot, record a motion that {words}."
    assert excite([]) is None
