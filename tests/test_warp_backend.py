"""The Warp backend as a simulator: what it promises beyond agreeing with MuJoCo on one transition."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator, engine
from dropo_torch.simulators.warp.fields import Fields
from dropo_torch.simulators.warp.layout import FIELDS
from dropo_torch.simulators.warp.pairs import candidate_pairs

HOPPER = Path(gymnasium.__file__).parent / "envs/mujoco/assets/hopper.xml"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(HOPPER))


@pytest.fixture(scope="module")
def space(model) -> ParameterSpace:
    fields = {b: {"field": "body_mass", "name": b, "bounds": [0.5, 20]} for b in ("torso", "thigh", "leg", "foot")}
    fields["friction"] = {"field": "geom_friction", "name": "foot_geom", "bounds": [0.1, 4]}
    fields["damping"] = {"field": "dof_damping", "name": "leg_joint", "bounds": [0.1, 4]}
    return ParameterSpace(model, fields)


@pytest.fixture(scope="module")
def problem(model, space) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(3)
    data = mujoco.MjData(model)
    states = []
    for _ in range(60):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data, 4)
        states.append(np.r_[data.qpos, data.qvel])
    controls = rng.uniform(-1, 1, (10, 3, model.nu))
    values = space.nominal * rng.uniform(0.7, 1.4, (5, len(space)))
    return torch.tensor(np.array(states[50:])), torch.tensor(controls), torch.tensor(values)


def reference(space: ParameterSpace, states, controls, values, skip: int) -> np.ndarray:
    """States after every logged step, ``(T, K, lag, n)``."""
    out = np.full((len(states), len(values), controls.shape[1], states.shape[1]), np.inf)
    for k, vector in enumerate(values.numpy()):
        model = space.apply(vector)
        data = mujoco.MjData(model)
        for t, state in enumerate(states.numpy()):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
            for step, control in enumerate(controls[t].numpy()):
                data.ctrl[:] = control
                mujoco.mj_step(model, data, skip)
                out[t, k, step] = np.r_[data.qpos, data.qvel]
    return out


def gradients(simulator: WarpSimulator, problem, *, rollout: bool = False) -> list[torch.Tensor]:
    leaves = [x.clone().requires_grad_() for x in problem]
    out = simulator.rollout(*leaves) if rollout else simulator.simulate(*leaves)
    weights = torch.linspace(-1, 1, out.numel(), dtype=torch.float64).view_as(out)
    (out * weights).sum().backward()
    return [leaf.grad for leaf in leaves]


def test_rollout_over_several_parameter_vectors(space, model, problem):
    simulator = WarpSimulator(model, parameters=space, frame_skip=4)
    out = simulator.rollout(*problem)
    assert out.shape == (10, 5, 3, model.nq + model.nv)
    assert out.dtype == torch.float64
    np.testing.assert_allclose(out.numpy(), reference(space, *problem, 4), atol=1e-6)
    torch.testing.assert_close(simulator.simulate(*problem), out[:, :, -1], rtol=0, atol=0)


def test_gradient_through_a_lag_is_the_chain_of_single_steps(space, model, problem):
    simulator = WarpSimulator(model, parameters=space, frame_skip=2)
    states, controls, values = (x.clone().requires_grad_() for x in (problem[0], problem[1], problem[2][:1]))
    at = states
    for step in range(controls.shape[1]):
        at = simulator.simulate(at, controls[:, step : step + 1], values)[:, 0]
    at.square().sum().backward()
    chained = [x.grad.clone() for x in (states, controls, values)]
    for x in (states, controls, values):
        x.grad = None
    simulator.simulate(states, controls, values).square().sum().backward()
    for x, expected in zip((states, controls, values), chained, strict=True):
        torch.testing.assert_close(x.grad, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("rollout", [False, True])
def test_results_do_not_depend_on_threads_chunks_or_memory(space, model, problem, rollout, monkeypatch):
    plain = WarpSimulator(model, parameters=space, frame_skip=4, num_threads=1)
    expected, grads = plain.simulate(*problem), gradients(plain, problem, rollout=rollout)
    monkeypatch.setattr(engine, "ALONE", 0)
    for threads, chunk in ((2, 4096), (1, 7), (3, 13), (2, 1)):
        other = WarpSimulator(model, parameters=space, frame_skip=4, num_threads=threads, chunk_size=chunk)
        assert torch.equal(other.simulate(*problem), expected)
        for a, b in zip(gradients(other, problem, rollout=rollout), grads, strict=True):
            assert torch.equal(a, b)
    monkeypatch.setattr(engine, "KEEP_BYTES", 0)  # simulate again in the backward
    for a, b in zip(gradients(plain, problem, rollout=rollout), grads, strict=True):
        assert torch.equal(a, b)


def test_no_state_between_calls_and_a_second_backward(space, model, problem):
    simulator = WarpSimulator(model, parameters=space, frame_skip=4)
    first = simulator.simulate(*problem)
    gradients(simulator, (problem[0] + 0.1, problem[1], problem[2]))
    assert torch.equal(simulator.simulate(*problem), first)
    leaves = [x.clone().requires_grad_() for x in problem]
    loss = simulator.simulate(*leaves).square().sum()
    loss.backward(retain_graph=True)
    once = [x.grad.clone() for x in leaves]
    loss.backward()
    for x, g in zip(leaves, once, strict=True):
        torch.testing.assert_close(x.grad, 2 * g)


def test_divergence_is_nan_in_its_own_row_only(space, model, problem):
    states = problem[0].clone()
    states[2, model.nq] = 1e9
    states[4, 0] = float("nan")
    simulator = WarpSimulator(model, parameters=space, frame_skip=40)
    out = simulator.simulate(states, problem[1], problem[2])
    bad = out.isnan().any(dim=(1, 2))
    assert bad[4]
    assert out[4].isnan().all()
    assert not bad[[0, 1, 3, 5]].any()
    clean = simulator.simulate(problem[0], problem[1], problem[2])
    assert torch.equal(out[5], clean[5])
    values = problem[2].clone().requires_grad_()
    kept = simulator.simulate(states, problem[1], values)[[0, 1, 3, 5]]
    kept.sum().backward()
    assert values.grad.isfinite().all()


def test_empty_problems_and_wrong_shapes(space, model, problem):
    simulator = WarpSimulator(model, parameters=space, frame_skip=4)
    assert simulator.simulate(problem[0][:0], problem[1][:0], problem[2]).shape == (0, 5, 12)
    assert simulator.simulate(problem[0], problem[1], problem[2][:0]).shape == (10, 0, 12)
    with pytest.raises(InputError, match="controls"):
        simulator.simulate(problem[0], problem[1][:3], problem[2])
    with pytest.raises(InputError, match="frame_skip"):
        WarpSimulator(model, parameters=space, frame_skip=0)
    with pytest.raises(InputError, match="device"):
        WarpSimulator(model, parameters=space, frame_skip=1, device="cuda:99")


def test_the_model_is_not_changed(space, model, problem):
    before = copy.copy(model)
    simulator = WarpSimulator(model, parameters=space, frame_skip=4)
    gradients(simulator, problem)
    np.testing.assert_array_equal(model.body_mass, before.body_mass)
    np.testing.assert_array_equal(model.dof_invweight0, before.dof_invweight0)
    assert simulator.num_states == 12
    assert simulator.timestep == pytest.approx(0.008)


TREE = """<mujoco><worldbody><body name="a"><freejoint/><geom type="box" size=".1 .2 .3"/>
<body name="b" pos=".3 0 0"><joint type="ball" armature=".01"/><geom type="capsule" size=".05 .2"/>
<body name="c" pos="0 0 .4"><joint name="h" axis="0 1 1" armature=".1"/><geom type="sphere" size=".1" pos=".1 0 0"/>
<body name="d" pos=".1 0 0"><geom type="sphere" size=".05"/></body></body></body></body>
<body name="e" pos="1 0 0"><joint type="slide" armature=".2"/><joint type="slide" axis="1 0 0"/>
<geom type="sphere" size=".1"/></body><geom type="plane" size="1 1 1"/></worldbody></mujoco>"""


@pytest.mark.parametrize("xml", [TREE, HOPPER.read_text()], ids=["tree", "hopper"])
def test_derived_weights_are_those_of_set_const(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    body = model.body(model.nbody - 2).name
    space = ParameterSpace(
        model,
        {
            "mass": {"field": "body_mass", "name": body, "bounds": [0.1, 10]},
            "inertia": {"field": "body_inertia", "name": body, "index": 1, "bounds": [0.001, 10]},
            "ipos": {"field": "body_ipos", "name": body, "index": 0, "bounds": [-1, 1]},
            "armature": {
                "field": "dof_armature",
                "name": model.joint(model.njnt - 2).name or "joint3",
                "bounds": [0, 1],
            },
        },
    )
    fields = Fields(model, space, candidate_pairs(model))
    rng = np.random.default_rng(0)
    values = space.nominal + rng.uniform(0.01, 0.2, (4, 4))
    theta = fields(torch.tensor(values))
    for row, vector in zip(theta.numpy(), values, strict=True):
        applied = space.apply(vector)
        np.testing.assert_allclose(row[fields.columns("dof_invweight")], applied.dof_invweight0, rtol=1e-11)
        weights = [
            applied.body_invweight0[model.geom_bodyid[[g1, g2]], 0].sum() for g1, g2, _p in candidate_pairs(model)
        ]
        np.testing.assert_allclose(row[fields.columns("pair_invweight")], weights, rtol=1e-11)


REFUSED = """<mujoco><option solver="CG" integrator="discrete" noslip_iterations="3">
<flag nativeccd="disable"/></option><default><geom mass="1"/></default><worldbody>
<site name="above" pos=".3 .2 .5"/>
<body><joint name="j"/><geom name="cyl" type="cylinder" size=".1 .2"/><site name="below" pos="-.3 .2 -.5"/>
<body><joint name="k" type="ball"/><geom name="ell" type="ellipsoid" size=".1 .1 .1" pos="1 0 0"/></body></body>
<body name="w" pos="3 0 0"><freejoint name="free"/><geom name="box" type="box" size=".1 .1 .1"/></body></worldbody>
<tendon><spatial name="string" stiffness="3"><site site="above"/><geom geom="cyl"/><site site="below"/></spatial>
</tendon>
<actuator><position name="ball_motor" joint="k" kp="1"/><general name="own" joint="j" dyntype="user" actdim="1"/>
<position name="damped" joint="j" kp="1"/></actuator></mujoco>"""


def test_one_error_names_everything_that_is_refused():
    model = mujoco.MjModel.from_xml_string(REFUSED)
    space = ParameterSpace(
        model,
        {
            "place": {"field": "site_pos", "name": "below", "index": 1, "bounds": [0.1, 1]},
            "gear1": {"field": "actuator_gear", "name": "damped", "index": 3, "bounds": [0.1, 1]},
        },
    )
    with pytest.raises(InputError) as caught:
        WarpSimulator(model, parameters=space, frame_skip=1)
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "integrator=discrete", "noslip", "'string'", "wraps", "'ball_motor'", "'own'", "user", "tendon", "'cyl'",
        "'ell'", "ellipsoid", "cylinder", "'place'", "site_pos", "'gear1'", "gear[0]",
    ):  # fmt: skip
        assert part in message, f"{part} in {message}"


def test_options_that_do_not_act_are_accepted(model, space):
    xml = HOPPER.read_text().replace(
        '<option integrator="RK4" timestep="0.002"/>',
        '<option integrator="RK4" timestep="0.002" jacobian="sparse" magnetic="1 2 3"><flag energy="enable"'
        ' sensor="disable" midphase="disable"/></option><statistic extent="3"/>',
    )
    other = mujoco.MjModel.from_xml_string(xml.replace("</mujoco>", '<sensor><clock name="c"/></sensor></mujoco>'))
    WarpSimulator(other, parameters=space, frame_skip=1)


@pytest.mark.parametrize(
    "flag", ["gravity", "contact", "limit", "actuation", "frictionloss", "spring", "damper", "clampctrl", "eulerdamp",
             "refsafe", 'spring="disable" damper', "filterparent", "constraint"]
)  # fmt: skip
def test_disabled_flags_act_as_in_mujoco(flag):
    xml = f"""<mujoco><option timestep="0.01" density="50"><flag {flag}="disable"/></option><worldbody>
    <geom type="plane" size="5 5 1"/><body pos="0 0 .2"><joint name="z" type="slide" axis="0 0 1" damping="1"/>
    <geom type="sphere" size=".25"/><body pos="0 0 .2" gravcomp=".5"><joint name="h" axis="0 1 0" stiffness="5"
    springref="30" damping=".5" frictionloss=".1" limited="true" range="-5 5"
    solreflimit=".004 1"/>
    <geom type="capsule" size=".05 .2" pos=".2 0 0"/></body></body></worldbody>
    <actuator><motor joint="h" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    space = ParameterSpace(model, {"m": {"field": "body_mass", "name": "body1", "bounds": [0.1, 1e3]}})
    rng = np.random.default_rng(0)
    states = torch.tensor(rng.uniform(-0.2, 0.2, (20, 4)))
    controls = torch.tensor(rng.uniform(-3, 3, (20, 1, 1)))
    values = torch.tensor(space.nominal[None])
    out = WarpSimulator(model, parameters=space, frame_skip=3).rollout(states, controls, values)
    np.testing.assert_allclose(out.numpy(), reference(space, states, controls, values, 3), atol=1e-7)


def test_no_differentiable_field_is_dead(model):
    """Every field that is accepted as a parameter has columns whose gradient is asked for."""
    every = mujoco.MjModel.from_xml_string(
        TREE.replace('<geom type="box"', '<geom name="g1" type="box"')
        .replace('<geom type="plane"', '<geom name="g2" type="plane"')
        .replace('<joint name="h"', '<joint name="h" range="-1 1" limited="true" stiffness="1"')
        .replace(
            "</worldbody>",
            '</worldbody><actuator><position joint="h" kp="1"/></actuator><equality><joint name="e" joint1="h"/>'
            '</equality><contact><pair name="p" geom1="g1" geom2="g2"/></contact>'
            '<tendon><fixed name="t" stiffness="1"><joint joint="h" coef="1"/></fixed></tendon>',
        )
    )
    names = {"body": "c", "jnt": "h", "dof": "h", "qpos": "h", "actuator": "h", "eq": "e", "geom": "g1", "pair": "p"}
    names["tendon"] = "t"
    for field in sorted(FIELDS):
        entry: dict = {"field": field, "bounds": [0.5, 1.0]}
        if not field.startswith("opt."):
            entry["name"] = names[field.split("_")[0]]
        for index in (None, 0, 1):
            try:
                space = ParameterSpace(every, {"x": entry | ({} if index is None else {"index": index})})
            except InputError:
                continue
            assert len(Fields(every, space, candidate_pairs(every)).wanted) > 0, field


def test_the_library_does_not_need_warp():
    code = (
        "import sys; sys.modules['warp'] = None; import dropo_torch.simulators.warp as w, dropo_torch.simulators.base\n"
        "try:\n    w.WarpSimulator\nexcept ImportError:\n    print('late')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "late" in done.stdout
