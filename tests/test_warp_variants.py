"""Variants of a model on Warp, as a gap search simulates them: MuJoCo's states, and MuJoCo itself where Warp cannot."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import Placed, find_effect
from dropo_torch.effects.engine import Variant, VariantEngine
from dropo_torch.effects.placing import plain_setting
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp.engine import Batch, Engine
from dropo_torch.simulators.warp.variants import Variants, Worlds
from dropo_torch.testing.effects import RIG

pytest.importorskip("warp")

#: The rig with a sphere in the place of the cart's box, which no other geom could touch on Warp.
ROUND = RIG.replace('name="cart" type="box" size=".1 .1 .1"', 'name="cart" type="sphere" size=".1"')
SKIP, WINDOWS, STEPS = 2, 3, 12
MASS = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.3]}}
NATIVE: list[tuple[tuple[str, str | None, tuple[float, ...]], ...]] = [
    (),
    (("joint_friction", "elbow", (0.2,)),),
    (("gravity_tilt", None, (0.1, 0.05)),),
    (("integration", None, (0.0025,)),),
    (("actuator_gain", "lift", (0.7,)), ("armature", "elbow", (0.05,))),
]
#: Effects that are forces, alone, together, and beside another step.
FORCED: list[tuple[tuple[str, str | None, tuple[float, ...]], ...]] = [
    (("joint_cogging", "elbow", (0.5, 3.0, 0.2)),),
    (("joint_cogging", "elbow", (0.3, 2.0, 0.0)), ("joint_stribeck", "rail", (0.1, 0.3, 0.2))),
    (("joint_stribeck", "elbow", (0.05, 0.1, 0.5)), ("integration", None, (0.0025,))),
    (("joint_presliding", "rail", (0.3, 0.01)),),
]


def engines() -> tuple[VariantEngine, VariantEngine]:
    model = mujoco.MjModel.from_xml_string(ROUND)
    setting = plain_setting(model, parse_observation(model, None), SKIP)
    space = ParameterSpace(model, MASS)
    return VariantEngine(setting, space, num_threads=1, warp=True), VariantEngine(setting, space, num_threads=1)


def variant(effects: tuple[tuple[str, str | None, tuple[float, ...]], ...], mass: float) -> Variant:
    return Variant((mass,), tuple(Placed(find_effect(name), target, values) for name, target, values in effects))


def simulated(
    engine: VariantEngine, variants: list[Variant], fine: bool = False, pushes: np.ndarray | None = None
) -> np.ndarray:
    rng, model = np.random.default_rng(0), engine.model(variants[0])
    starts = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (WINDOWS, 1))
    starts[:, [0, 1, 9]] += rng.uniform(-0.5, 0.5, (WINDOWS, 3))
    starts[:, model.nq :] += rng.normal(0, 0.5, (WINDOWS, model.nv))
    signals = np.repeat(rng.uniform(-1, 1, (WINDOWS, STEPS // SKIP, model.nu)), SKIP, 1)
    shape = (len(variants), 1, 1, 1)
    return engine.paths(
        variants, engine.models(variants), np.tile(starts, shape[:3]), np.tile(signals, shape), fine=fine, pushes=pushes
    )


@pytest.mark.parametrize("fine", [False, True])
def test_variants_are_those_of_mujoco(fine: bool) -> None:
    variants = [variant(effects, mass) for effects in (*NATIVE, *FORCED) for mass in (0.7, 1.1)]
    ours, theirs = (simulated(engine, variants, fine) for engine in engines())
    assert ours.shape == (len(variants), WINDOWS, STEPS if fine else STEPS // SKIP, 9 + 8 + 2)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8)
    assert np.abs(ours - ours[:1]).max((1, 2, 3))[1:].min() > 1e-6


def test_what_is_simulated_with_warp_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrenches and models outside the subset go to MuJoCo; an engine serves all variants of a structure."""
    asked: list[bool] = []
    worlds = Variants.worlds

    def counted(self: Variants, *arguments: object) -> Worlds | None:
        found = worlds(self, *arguments)  # type: ignore[arg-type]
        asked.append(found is not None)
        return found

    monkeypatch.setattr(Variants, "worlds", counted)
    ours, theirs = engines()
    pushed = variant((("external_force", "cart", (1.0, 0.0, 0.0)),), 0.7)
    np.testing.assert_array_equal(simulated(ours, [pushed]), simulated(theirs, [pushed]))
    assert asked == []
    dragged = variant((("fluid_drag", "cart", (0.5,)),), 0.7)
    np.testing.assert_array_equal(simulated(ours, [dragged]), simulated(theirs, [dragged]))
    assert asked == [False]
    plain = [variant((), mass) for mass in (0.5, 0.9)]
    simulated(ours, plain)
    assert asked == [False, True]
    assert sum(e is not None for e in ours._warp._engines.values()) == 1


def test_pushes_are_those_of_mujoco() -> None:
    """Generalised forces of every logged step, alone and beside an effect that is a force."""
    ours, theirs = engines()
    variants = [variant((), 0.7), variant(FORCED[0], 0.7)]
    pushes = np.random.default_rng(1).normal(0, 0.5, (len(variants), STEPS // SKIP, 9))
    pushed, same = (simulated(engine, variants, pushes=pushes) for engine in (ours, theirs))
    np.testing.assert_allclose(pushed, same, rtol=0, atol=1e-8)
    assert np.abs(pushed - simulated(ours, variants)).max() > 1e-3


def test_forces_keep_to_their_rows() -> None:
    """Whatever variants lie between those of one effect, and whatever it remembers."""
    cogging, presliding = ((FORCED[i][0],) for i in (0, 3))
    mixed = [variant(effects, mass) for effects, mass in ((presliding, 0.7), (cogging, 0.7), (presliding, 1.1))]
    for engine in engines():
        together = simulated(engine, mixed)
        alone = np.concatenate([simulated(engine, [one]) for one in mixed])
        np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


def test_applied_forces_have_gradients() -> None:
    """Of all that stands in the controls, by central differences."""
    model = mujoco.MjModel.from_xml_string(ROUND)
    engine = Engine(model, ParameterSpace(model, MASS), skip=SKIP, chunk_size=8, num_threads=1, device="cpu")
    theta, width, rng = engine.fields.of([model]), model.nu + model.nv, np.random.default_rng(2)
    state = torch.from_numpy(np.concatenate([model.qpos0, rng.normal(0, 0.3, model.nv)])[None])
    controls = torch.from_numpy(rng.normal(0, 0.3, (1, 2, width)))

    batch = Batch(theta, state, controls, SKIP, applied=True)
    _, traces = engine.simulate(batch, True)
    _, _, bar = engine.adjoint(batch, torch.ones(2, state.shape[1], dtype=torch.float64), traces)
    for k in range(width):
        shift = torch.zeros_like(controls)
        shift[0, 0, k] = 1e-5
        there, back = (engine.simulate(replace(batch, controls=controls + s * shift), False)[0] for s in (1, -1))
        assert float((there - back).sum() / 2e-5) == pytest.approx(float(bar[0, 0, k]), rel=1e-4, abs=1e-6)


def test_a_force_that_is_there_twice_acts_twice() -> None:
    one, two = (("joint_cogging", "elbow", (a, 3.0, 0.2)) for a in (0.25, 0.5))
    for engine in engines():
        twice, once = simulated(engine, [variant((one, one), 0.7), variant((two,), 0.7)])
        np.testing.assert_allclose(twice, once, rtol=0, atol=1e-12)
