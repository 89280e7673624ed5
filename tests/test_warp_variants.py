"""Variants of a model on Warp, as a gap search simulates them: MuJoCo's states, and MuJoCo itself where Warp cannot."""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import Effect, Placed, Quantity, Setting, find_effect
from dropo_torch.effects.engine import Variant, VariantEngine
from dropo_torch.effects.placing import plain_setting
from dropo_torch.errors import UnsupportedModel
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.warp.engine import Batch, Engine
from dropo_torch.simulators.warp.layout import FIELDS, FRAMES
from dropo_torch.simulators.warp.types import Tables
from dropo_torch.simulators.warp.variants import Variants, Worlds, _structure, tabled_fields
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
    (("fluid_drag", "cart", (0.5,)),),
    (("linear_drag", "ball", (0.5,)),),
    (("actuator_gain", "lift", (0.7,)), ("armature", "elbow", (0.05,))),
]
#: Effects that are forces, alone, together, and beside another step.
FORCED: list[tuple[tuple[str, str | None, tuple[float, ...]], ...]] = [
    (("joint_cogging", "elbow", (0.5, 3.0, 0.2)),),
    (("joint_cogging", "elbow", (0.3, 2.0, 0.0)), ("joint_stribeck", "rail", (0.1, 0.3, 0.2))),
    (("joint_stribeck", "elbow", (0.05, 0.1, 0.5)), ("integration", None, (0.0025,))),
    (("joint_presliding", "rail", (0.3, 0.01)),),
]
#: Effects that are wrenches on bodies, alone, two of them, beside a force and beside another step.
WRENCHED: list[tuple[tuple[str, str | None, tuple[float, ...]], ...]] = [
    (("external_force", "lower", (1.0, -0.5, 2.0)),),
    (("external_force", "ball", (0.5, 1.5, -1.0)), ("external_force", "lower", (1.0, 0.0, 0.3))),
    (("external_force", "lower", (0.7, 0.0, 1.0)), FORCED[0][0]),
    (("external_force", "cart", (1.0, 0.0, 0.0)), ("integration", None, (0.0025,))),
]


def engines(xml: str = ROUND) -> tuple[VariantEngine, VariantEngine]:
    model = mujoco.MjModel.from_xml_string(xml)
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
    variants = [variant(effects, mass) for effects in (*NATIVE, *FORCED, *WRENCHED) for mass in (0.7, 1.1)]
    ours, theirs = (simulated(engine, variants, fine) for engine in engines())
    assert ours.shape == (len(variants), WINDOWS, STEPS if fine else STEPS // SKIP, 9 + 8 + 2)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8)
    assert np.abs(ours - ours[:1]).max((1, 2, 3))[1:].min() > 1e-6


def test_what_is_simulated_with_warp_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models outside the subset go to MuJoCo; an engine serves all variants of a structure."""
    asked: list[bool] = []
    worlds = Variants.worlds

    def counted(self: Variants, *arguments: object) -> Worlds | None:
        found = worlds(self, *arguments)  # type: ignore[arg-type]
        asked.append(found is not None)
        return found

    monkeypatch.setattr(Variants, "worlds", counted)
    outside, theirs = engines(ROUND.replace("<option", '<option noslip_iterations="2"'))
    np.testing.assert_array_equal(*(simulated(engine, [variant((), 0.7)]) for engine in (outside, theirs)))
    assert asked == [False]
    ours, _ = engines()
    simulated(ours, [variant(effects, mass) for effects in ((), WRENCHED[0]) for mass in (0.5, 0.9)])
    assert asked == [False, True, True]
    assert sum(e is not None for e in ours._warp._engines.values()) == 1


def tables_of(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, object] | None:
    """All that an engine of a model has in its tables; ``None`` where there is none."""
    try:
        engine = Engine(model, space, skip=1, chunk_size=1, num_threads=1, device="cpu")
    except UnsupportedModel:
        return None
    values = {name: getattr(engine.tables, name) for name in Tables.vars}
    return {n: v.numpy().tolist() if hasattr(v, "numpy") else np.array(v).tolist() for n, v in values.items()}


def test_models_of_one_structure_share_their_tables() -> None:
    """Whatever number of θ is zero, or is not."""
    model = mujoco.MjModel.from_xml_string(ROUND)
    space = ParameterSpace(model, MASS)
    tabled = tabled_fields(model)
    known, shared = {_structure(model, tabled): tables_of(model, space)}, 0
    for field in sorted(set(FIELDS) - set(FRAMES)):
        for flat in range(read_field(model, field).size):
            for value in (0.3,) if field in ("body_mass", "body_inertia") else (0.0, 0.3, -0.3):
                other = copy.copy(model)
                if field.startswith("opt."):
                    array = read_field(other, field).copy()
                    array.reshape(-1)[flat] = value
                    setattr(other.opt, field[4:], array if array.size > 1 else value)
                else:
                    getattr(other, field).reshape(-1)[flat] = value
                key = _structure(other, tabled)
                shared += key in known
                tables = tables_of(other, space)
                assert known.setdefault(key, tables) == tables, (field, flat, value)
    assert shared > 5 * len(known)
    assert sum(tables is not None for tables in known.values()) > 0.9 * len(known)


def test_principal_axes_stand_in_theta() -> None:
    """Bodies whose inertias are turned share an engine, and each moves as MuJoCo has it."""
    spec = mujoco.MjSpec.from_string(ROUND)
    for body in spec.bodies[1:]:
        body.simple = 0
    model = spec.compile()
    model.body_sameframe[:] = model.geom_sameframe[:] = 0
    rng, turned = np.random.default_rng(0), []
    for _ in range(3):
        own = copy.copy(model)
        own.body_inertia[1:] *= (1.0, 1.5, 1.9)
        own.body_iquat[1:] = rng.normal(size=(model.nbody - 1, 4))
        own.body_iquat[1:] /= np.linalg.norm(own.body_iquat[1:], axis=1, keepdims=True)
        mujoco.mj_setConst(own, mujoco.MjData(own))
        turned.append(own)
    worlds = Variants(ParameterSpace(model, MASS), num_threads=1).worlds(turned, 1)
    assert len(worlds.engines) == 1
    start = np.concatenate([model.qpos0, rng.normal(0, 0.5, model.nv)])
    path = worlds.rollout(np.tile(start, (3, 1)), np.zeros((3, 20, model.nu)), 1)
    for own, found in zip(turned, path, strict=True):
        data = mujoco.MjData(own)
        data.qpos[:], data.qvel[:] = np.split(start, [model.nq])
        for _ in range(20):
            mujoco.mj_step(own, data)
        np.testing.assert_allclose(found[-1], np.concatenate([data.qpos, data.qvel]), rtol=1e-8, atol=1e-9)
    assert np.abs(path[0, -1] - path[1, -1]).max() > 1e-4


def test_variants_share_the_arrays_that_they_have_in_common() -> None:
    """Tables are only read, so that one array serves all models with its content; others have their own."""
    model = mujoco.MjModel.from_xml_string(ROUND)
    longer = copy.copy(model)
    longer.opt.timestep = 0.5 * model.opt.timestep
    longer.body_quat[2] = [0.6, 0.8, 0, 0]
    space = ParameterSpace(model, MASS)
    first, second = (Variants(space, num_threads=1).worlds([m], 1).engines[0][0].tables for m in (model, longer))
    assert first.h != second.h
    assert first.body_parent is second.body_parent
    assert first.body_mat is not second.body_mat
    assert not np.array_equal(first.body_mat.numpy(), second.body_mat.numpy())


def test_effects_are_written_in_any_order() -> None:
    """Friction's softness is that of the step, whichever is named first."""
    effects, engine = (("joint_friction", "elbow", (0.2,)), ("integration", None, (0.0025,))), engines()[1]
    one, other = (engine.model(variant(order, 0.7)) for order in (effects, effects[::-1]))
    assert one.opt.timestep == other.opt.timestep
    np.testing.assert_array_equal(one.dof_solref, other.dof_solref)


class Rotor(Effect):
    """An effect of a user's own that writes what no effect of the package does."""

    name, kind, sentence = "test_rotor", "actuator", "the motor of {target} has inertia"

    def targets(self, setting: Setting) -> list[str | None]:
        return ["lift"]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("inertia", "kg m^2", 0.0, 0.0, 1.0, 0.1),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.actuator_armature[:] = values[0]


def test_no_engine_serves_a_model_that_differs_in_anything_else() -> None:
    model = mujoco.MjModel.from_xml_string(ROUND)
    tabled = tabled_fields(model)
    own = _structure(model, tabled)
    for field in tabled:
        if field.startswith("opt."):
            continue
        other = copy.copy(model)
        numbers = getattr(other, field).reshape(-1)
        numbers[-1] = not numbers[-1] if numbers.dtype == bool else numbers[-1] + 1
        assert _structure(other, tabled) != own, field
    for field in ("eq_active0", "geom_rbound", "jnt_actgravcomp", "opt.solver", "opt.enableflags"):
        assert field in tabled or not read_field(model, field).size, field


def test_an_own_effect_is_simulated_as_by_mujoco_whatever_came_before() -> None:
    ours, theirs = engines()
    variants = [variant((), 0.7), Variant((0.7,), (Placed(Rotor(), "lift", (0.3,)),))]
    plain, rotor = (np.concatenate([simulated(engine, [v]) for v in variants]) for engine in (ours, theirs))
    np.testing.assert_allclose(plain, rotor, rtol=0, atol=1e-8)
    assert np.abs(plain[1] - plain[0]).max() > 1e-3


def test_pushes_are_those_of_mujoco() -> None:
    """Generalized forces of every logged step, alone and beside an effect that is a force."""
    ours, theirs = engines()
    variants = [variant(effects, 0.7) for effects in ((), FORCED[0], WRENCHED[0], WRENCHED[2])]
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


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize(("applied", "wrenched"), [(True, False), (False, True), (True, True)])
def test_what_acts_besides_has_gradients(applied: bool, wrenched: bool, integrator: str) -> None:
    """Of all that stands in the controls, of the state and of θ beside it, by central differences."""
    model = mujoco.MjModel.from_xml_string(ROUND)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    center = {"center": {"field": "body_ipos", "name": "lower", "index": 2, "bounds": [-0.3, 0.3]}}
    engine = Engine(model, ParameterSpace(model, MASS | center), skip=SKIP, chunk_size=8, num_threads=1, device="cpu")
    width, rng = model.nu + 6 * model.nbody * wrenched + model.nv * applied, np.random.default_rng(2)
    state = np.concatenate([model.qpos0, rng.normal(0, 0.3, model.nv)])
    state[[0, 1, 4, 9]] += [0.2, -0.3, 0.5, 0.1]  # the ball is in the air
    turned = range(5, 9)  # the ball's quaternion, which has no gradient but along turns
    given = {
        "theta": engine.fields.of([model]), "states": torch.from_numpy(state[None]),
        "controls": torch.from_numpy(rng.normal(0, 0.3, (1, 2, width))),
    }  # fmt: skip
    batch = Batch(**given, skip=SKIP, applied=applied, wrenched=wrenched)
    _, traces = engine.simulate(batch, True)
    bars = engine.adjoint(batch, torch.ones(2, model.nq + model.nv, dtype=torch.float64), traces)
    for (name, x), bar in zip(given.items(), bars, strict=True):
        for k in engine.fields.wanted[:8] if name == "theta" else range(x[0].numel()):
            if name == "states" and k in turned:
                continue
            shift = torch.zeros_like(x)
            shift.view(-1)[k] = 1e-5
            there, back = (engine.simulate(replace(batch, **{name: x + s * shift}), False)[0] for s in (1, -1))
            slope = float((there - back).sum() / 2e-5)
            assert slope == pytest.approx(float(bar.view(-1)[k]), rel=1e-4, abs=1e-6), (name, k)


def test_a_force_that_is_there_twice_acts_twice() -> None:
    one, two = (("joint_cogging", "elbow", (a, 3.0, 0.2)) for a in (0.25, 0.5))
    for engine in engines():
        twice, once = simulated(engine, [variant((one, one), 0.7), variant((two,), 0.7)])
        np.testing.assert_allclose(twice, once, rtol=0, atol=1e-12)
