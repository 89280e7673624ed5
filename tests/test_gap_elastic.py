"""A transmission that gives, and friction under load, hidden by other code, are found with their numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_gap import load, search

from benchmarks.hidden.systems import CART_POLE
from benchmarks.hidden.truths import Effect, simulate_truth
from dropo_torch.effects import Placed, find_effect
from dropo_torch.effects.engine import Variant
from dropo_torch.gap import prepare

GIVES = {"compliance": 1 / 300, "damping": 3.0, "inertia": 0.5}
#: Episodes in which what a rotor was before is forgotten long before their middle.
LONG = {"episodes": 2, "transitions": 400}
KNOWN = ("joint_elasticity", "joint_load_friction", "joint_friction", "joint_damping", "armature", "actuator_lag")


@pytest.mark.parametrize(
    ("effect", "numbers"), [("joint_elasticity", GIVES), ("joint_load_friction", {"coefficient": 0.25})]
)
def test_what_depends_on_the_drive_is_found(effect: str, numbers: dict[str, float]) -> None:
    gap = search(simulate_truth(CART_POLE, [Effect(effect, "rail", numbers)], 3, **LONG), KNOWN)
    assert [(e.effect, e.target) for e in gap.effects] == [(effect, "rail")]
    first = next(iter(numbers))
    strength = gap.effects[0].parameters[first]
    low, high = strength.low, strength.high
    assert low <= numbers[first] <= high
    assert high - low < 0.5 * numbers[first]


def test_a_rotor_goes_on_from_the_rows_before() -> None:
    """Where the log shows the past, windows follow it better than from equilibrium; those without one do not count."""
    scene = prepare(load(simulate_truth(CART_POLE, [Effect("joint_elasticity", "rail", GIVES)], 3, **LONG)))
    twin, windows = scene.twin, scene.evidence.windows
    placed = Placed(find_effect("joint_elasticity"), "rail", tuple(GIVES.values()))
    variant = Variant(scene.begin.declared, (placed,))
    known = windows.select(twin.knows(variant, windows))
    assert 0 < len(known) < len(windows)
    sizes = []
    for own in (known, dataclasses.replace(known, observed=None)):
        shown, _ = twin.predict([variant], own)
        error = scene.evidence.chart.difference(own.measured, shown)[0] / scene.noise
        sizes.append(float(np.sqrt(np.mean(error**2))))
    assert sizes[0] < 0.7 * sizes[1]
