"""Activations of actuators on the Warp backend: filters as the MuJoCo backend has them, and their gradients."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.stepper import MujocoStepper
from dropo_torch.rl.warp_stepper import WarpStepper
from dropo_torch.simulators import MujocoSimulator
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.engine import Batch, Engine

ARM = """<mujoco><option timestep="0.005" integrator="{integrator}"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
<geom size="0.03 0.2" type="capsule" pos="0 0 -0.2"/>
<body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 .2" damping="0.1"/>
<geom size="0.02 0.15" type="capsule" pos="0 0 -0.15"/></body></body></worldbody>
<actuator>{actuators}</actuator></mujoco>"""
FILTERS = """<general name="a" joint="shoulder" gainprm="4" dyntype="filter" dynprm="0.03"/>
<general name="b" joint="elbow" gainprm="2" dyntype="filterexact" dynprm="0.02" ctrlrange="-0.8 0.8" actlimited="true"
 actrange="-0.5 0.6" actearly="true"/><motor joint="elbow"/>"""
CONSTANTS = {
    "a": {"field": "actuator_dynprm", "name": "a", "index": 0, "bounds": [0.02, 0.1]},
    "b": {"field": "actuator_dynprm", "name": "b", "index": 0, "bounds": [0.02, 0.1]},
}
MASS = {"mass": {"field": "body_mass", "name": "fore", "bounds": [0.1, 1.0]}}
SKIP, HISTORY = 2, 5


def arm(integrator: str, actuators: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(integrator=integrator, actuators=actuators))


def transitions(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(0, 0.5, (5, 4))), torch.from_numpy(rng.uniform(-1, 1, (5, HISTORY + 2, 3)))


@pytest.mark.parametrize("parameters", [MASS, CONSTANTS | MASS], ids=["mass", "time constants"])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_filters_are_replayed_as_by_mujoco(integrator: str, parameters: dict) -> None:
    """And have the gradients of its central differences, in the controls before a transition, too."""
    model = arm(integrator, FILTERS)
    space = ParameterSpace(model, parameters)
    ours, theirs = (
        simulator(model, parameters=space, frame_skip=SKIP, num_threads=1, history=HISTORY)
        for simulator in (WarpSimulator, MujocoSimulator)
    )
    states, controls = transitions(0)
    values = torch.from_numpy(
        space.low + np.random.default_rng(1).uniform(0, 1, (3, len(space))) * (space.high - space.low)
    )
    np.testing.assert_allclose(
        ours.rollout(states, controls, values).numpy(), theirs.rollout(states, controls, values).numpy(), atol=1e-11
    )
    given = [x.clone().requires_grad_(True) for x in (states, controls, values)]
    weights = torch.from_numpy(np.random.default_rng(2).normal(0, 1, (5, 3, 2, 4)))
    bars = torch.autograd.grad((ours.rollout(*given) * weights).sum(), given)
    assert (bars[1][:, :HISTORY, :2] != 0).any()
    for k, (x, bar) in enumerate(zip((states, controls, values), bars, strict=True)):
        for at in np.random.default_rng(k).choice(x.numel(), min(12, x.numel()), replace=False):
            shift = torch.zeros_like(x)
            shift.view(-1)[at] = 1e-5
            ends = [theirs.rollout(*(y + s * shift if i == k else y for i, y in enumerate((states, controls, values))))
                    for s in (1, -1)]  # fmt: skip
            slope = float(((ends[0] - ends[1]) * weights).sum() / 2e-5)
            assert float(bar.view(-1)[at]) == pytest.approx(slope, rel=1e-5, abs=1e-7), (k, at)


def test_the_jacobian_includes_where_filters_start() -> None:
    model = arm("Euler", FILTERS)
    space = ParameterSpace(model, CONSTANTS | MASS)
    simulator = WarpSimulator(model, parameters=space, frame_skip=SKIP, num_threads=1, history=HISTORY)
    states, controls = transitions(3)
    values = torch.from_numpy(np.stack([space.low, space.high]))
    after, by_values, by_states = simulator.jacobian(states, controls, values)
    for k in range(2):

        def last(s: torch.Tensor, v: torch.Tensor, k: int = k) -> torch.Tensor:
            return simulator.simulate(s, controls, v[None])[:, 0]

        np.testing.assert_array_equal(after[:, k], last(states, values[k]))
        slopes = torch.autograd.functional.jacobian(lambda v, f=last: f(states, v), values[k])
        np.testing.assert_allclose(by_values[:, k], slopes, atol=1e-12)
        slopes = torch.autograd.functional.jacobian(lambda s, f=last, k=k: f(s, values[k]).sum(0), states)
        np.testing.assert_allclose(by_states[:, k], slopes.transpose(0, 1), atol=1e-12)


REMEMBERING = """<general name="a" joint="shoulder" gainprm="4" dyntype="integrator"
 actlimited="true" actrange="-.6 .7"/>
<general name="b" joint="elbow" gainprm="2" dyntype="muscle" dynprm=".01 .04 {width}" actearly="{early}"
 ctrlrange="-.2 1.2"/><motor joint="elbow"/>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize(("width", "early"), [("0", "false"), (".3", "true")])
def test_activations_are_states_of_the_kernels(integrator: str, width: str, early: str) -> None:
    """Integrators and muscles advance as in MuJoCo from whatever they are, and have gradients."""
    model = arm(integrator, REMEMBERING.format(width=width, early=early))
    constants = {f"t{i}": {"field": "actuator_dynprm", "name": "b", "index": i, "bounds": [0.001, 1]} for i in range(2)}
    engine = Engine(model, ParameterSpace(model, constants), skip=3, chunk_size=8, num_threads=1, device="cpu")
    rng, (states, controls) = np.random.default_rng(5), transitions(4)
    states = torch.cat([states, torch.from_numpy(rng.uniform([-0.8, 0], [0.8, 1], (5, 2)))], 1)
    batch = Batch(engine.fields.of([model]), states, controls[:, :2].contiguous(), 3)
    out, traces = engine.simulate(batch, True)

    def reference(theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor) -> torch.Tensor:
        data, found = mujoco.MjData(model), []
        model.actuator_dynprm[:, :3] = theta[0, engine.fields.columns("dynprm")].numpy().reshape(-1, 3)
        for state, control in zip(states.numpy(), controls.numpy(), strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:], data.act[:] = np.split(state, [2, 4])
            for now in control:
                data.ctrl[:] = now
                mujoco.mj_step(model, data, 3)
                found.append(np.concatenate([data.qpos, data.qvel, data.act]))
        return torch.tensor(np.array(found))

    inputs = [batch.theta, batch.states, batch.controls]
    np.testing.assert_allclose(out.numpy(), reference(*inputs).numpy(), atol=1e-11)
    weights = torch.from_numpy(rng.normal(0, 1, out.shape))
    bars = engine.adjoint(batch, weights, traces)
    for k, (x, bar) in enumerate(zip(inputs, bars, strict=True)):
        for at in engine.fields.wanted if k == 0 else rng.choice(x.numel(), 12, replace=False):
            shift = torch.zeros_like(x)
            shift.view(-1)[at] = 1e-6
            ends = [reference(*(y + s * shift if i == k else y for i, y in enumerate(inputs))) for s in (1, -1)]
            slope = float(((ends[0] - ends[1]) * weights).sum() / 2e-6)
            assert float(bar.view(-1)[at]) == pytest.approx(slope, rel=1e-5, abs=1e-6), (k, at)


def test_environments_go_on_from_their_activations() -> None:
    """Step after step as MuJoCo's, from zero when an episode starts."""
    model = arm("Euler", REMEMBERING.format(width="0", early="false"))
    space, (states, controls), paths = ParameterSpace(model, MASS), transitions(6), []
    for stepper in (make(space, 5, frame_skip=2, num_threads=1) for make in (WarpStepper, MujocoStepper)):
        rows, values = torch.arange(5), torch.full((5, 1), 0.4, dtype=torch.float64)
        stepper.reset(rows, states, values)
        path = [stepper.step(controls[:, k : k + 1]) for k in range(4)]
        stepper.reset(rows[:2], states[:2], values[:2])
        paths.append(torch.cat([*path, stepper.step(controls[:, 4:5])], 1))
    np.testing.assert_allclose(*(path.numpy() for path in paths), atol=1e-10)


def test_what_no_log_holds_is_refused_by_name() -> None:
    model = arm("Euler", REMEMBERING.format(width="0", early="false"))
    with pytest.raises(InputError, match="actuators a, b keep a hidden state"):
        WarpSimulator(model, parameters=ParameterSpace(model, MASS), frame_skip=1)
