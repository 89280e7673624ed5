"""What gives, in a transmission or before it slides, and friction under load, are found with their numbers."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from test_gap import load, search

from benchmarks.hidden.systems import CART_POLE
from benchmarks.hidden.truths import Effect, simulate_truth
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import Placed, find_effect
from dropo_torch.effects.drive import Drive, Drives
from dropo_torch.effects.engine import Variant
from dropo_torch.effects.placing import plain_setting
from dropo_torch.effects.presliding import PAST
from dropo_torch.gap import prepare
from dropo_torch.gap.refit import derivatives

GIVES = {"compliance": 1 / 300, "damping": 3.0, "inertia": 0.5}
#: Episodes in which what a rotor was before is forgotten long before their middle.
LONG = {"episodes": 2, "transitions": 400}
#: Friction of all kinds.
DRY = ("joint_presliding", "joint_friction", "joint_soft_friction", "joint_stribeck", "joint_damping", "armature")
SWING = """<mujoco><worldbody><body><joint name="hinge"/><geom size=".1" pos=".3 0 0"/></body></worldbody></mujoco>"""
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


@pytest.mark.parametrize(("joint", "coulomb"), [("hinge", 0.2), ("rail", 1.5)])
@pytest.mark.parametrize("displacement", [0.003, 0.1])
def test_dry_friction_that_gives_is_told_from_other_friction(joint: str, coulomb: float, displacement: float) -> None:
    truth = Effect("joint_presliding", joint, {"coulomb": coulomb, "displacement": displacement})
    gap = search(simulate_truth(CART_POLE, [truth], 3, episodes=4, transitions=100), DRY)
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_presliding", joint)]
    found = gap.effects[0].parameters
    assert found["coulomb"].value == pytest.approx(coulomb, rel=0.01)
    assert found["displacement"].value == pytest.approx(displacement, rel=0.05)
    assert gap.reduced[1] < 1.1


def test_dry_friction_that_gives_and_is_larger_when_slow_is_found() -> None:
    numbers = {"coulomb": 0.2, "displacement": 0.01, "static": 0.36, "velocity": 0.3}
    gap = search(
        simulate_truth(CART_POLE, [Effect("joint_lugre", "hinge", numbers)], 3, episodes=4, transitions=100),
        ("joint_lugre", "joint_presliding", "joint_friction", "joint_stribeck", "joint_damping"),
    )
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_lugre", "hinge")]
    found = gap.effects[0].parameters
    assert {k: found[k].value for k in numbers} == pytest.approx(numbers, rel=0.1)
    assert gap.reduced[1] < 1.1


def test_bristles_follow_the_motion_before_a_simulation() -> None:
    """Once a joint has turned, its friction is not what its velocity alone tells."""
    placed = Placed(find_effect("joint_presliding"), "hinge", (0.2, 0.1))
    model = mujoco.MjModel.from_xml_string(SWING)
    setting, dt = plain_setting(model, parse_observation(model, None), 1), 0.01
    speed = np.concatenate([np.full(40, -1.0), np.full(5, 0.4)])[None, :, None]
    angle = np.concatenate([[0.0], np.cumsum(0.5 * dt * (speed[0, 1:, 0] + speed[0, :-1, 0]))])[None, :, None]
    drive = Drive(Drives.of([model]), np.zeros((1, 44, 0)), dt)
    ((bristle, at),) = placed.effect.replay(setting, "hinge", np.array([placed.values]), angle, speed, drive)
    before = -1 + np.exp(-(PAST + (39 + 0.3) * dt) / 0.1)  # at the mean of both speeds where it turns
    assert at == angle[0, -1, 0]
    assert bristle == pytest.approx(1 + (before - 1) * np.exp(-4 * 0.4 * dt / 0.1))
    speed[0, :42] = np.nan  # an episode that begins there: as if the joint had moved so before
    ((begun, _),) = placed.effect.replay(setting, "hinge", np.array([placed.values]), angle, speed, drive)
    assert begun == pytest.approx(1 - np.exp(-0.4 * (PAST + 2 * dt) / 0.1))


def test_a_transmission_moves_in_its_compliance_and_products() -> None:
    """A spring twice as soft, with half the damping and half the rotor, is nearly the same below its resonance."""
    effect, start = find_effect("joint_elasticity"), np.array([1 / 300, 3.0, 0.5])
    along = effect.directions(start)
    for share in (0.02, 1.0, -0.5):
        there = effect.settle(start, start + share * start[0] * along[0])
        np.testing.assert_allclose(there[0] * there[1:], start[0] * start[1:])
        assert there[0] == pytest.approx((1 + share) * start[0])
    np.testing.assert_array_equal(along[1:], np.eye(3)[1:])
    np.testing.assert_array_equal(effect.settle(np.zeros(3), start), start)


def test_derivatives_follow_from_moves_of_several_numbers() -> None:
    rng = np.random.default_rng(0)
    slope, moves = rng.normal(size=(3, 2, 5)), np.array([[1e-3, -2e-3, 4e-4], [0, 1e-3, 0], [0, 0, -1e-3]])
    np.testing.assert_allclose(derivatives(np.einsum("kc,cwn->kwn", moves, slope), moves), slope)
    changes = np.einsum("kc,cwn->kwn", np.diag(np.diag(moves)), slope)
    changes[1, 0] = np.nan  # a simulation that diverges says nothing of the other numbers
    found = derivatives(changes, np.diag(np.diag(moves)))
    np.testing.assert_allclose(found[[0, 2]], slope[[0, 2]])
    assert np.isnan(found[1, 0]).all()


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
