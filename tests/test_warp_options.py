"""Options of a model: solvers and their limits, which converge to one optimum, and flags that change nothing."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.variants import Variants
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

SLIDING = """<mujoco><option timestep="0.004" {option}><flag {flag}/></option><worldbody>
<geom type="plane" size="5 5 1" zaxis=".1 0 1"/><body name="a" pos="0 0 .1"><freejoint/>
<geom name="a" type="capsule" size=".1 .15" euler="0 80 10"/>
<body name="b" pos=".3 0 0"><joint name="b" axis="0 1 0" range="-10 10" limited="true" frictionloss=".1"/>
<geom type="sphere" size=".08"/></body></body></worldbody><actuator><motor joint="b"/></actuator></mujoco>"""


def sliding(option: str = "", flag: str = "") -> ParameterSpace:
    model = mujoco.MjModel.from_xml_string(SLIDING.format(option=option, flag=flag))
    return ParameterSpace(
        model,
        {
            "mass": {"field": "body_mass", "name": "a", "bounds": [0.1, 1e3]},
            "friction": {"field": "geom_friction", "name": "a", "bounds": [0.1, 10]},
        },
    )


def transitions(model: mujoco.MjModel, number: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """States of a fall onto the floor and of the slide after it, and controls."""
    rng = np.random.default_rng(0)
    data, states = mujoco.MjData(model), []
    data.qvel[:] = rng.normal(0, 0.5, model.nv)
    while len(states) < number:
        states.append(np.r_[data.qpos, data.qvel])
        for _ in range(5):
            mujoco.mj_step(model, data)
    return torch.from_numpy(np.array(states)), torch.from_numpy(rng.uniform(-1, 1, (number, 1, model.nu)))


@pytest.mark.parametrize(
    ("option", "note"),
    [
        ('solver="PGS"', "solver PGS has the same optimum"),
        ('solver="CG" cone="elliptic"', "solver CG has the same optimum"),
        ('iterations="1" ls_iterations="2"', "not for 1 iterations"),
    ],
)
def test_every_solver_and_its_limits_mean_the_optimum(option: str, note: str) -> None:
    space = sliding(option)
    assert space.model is not None
    simulator = WarpSimulator(space.model, parameters=space, frame_skip=2, num_threads=1)
    assert len(simulator.notes) == 1
    assert note in simulator.notes[0]
    check_simulator(
        simulator, *transitions(space.model), torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), 2),
        tolerance=Tolerance(states=1e-9, worst=1e-6, gradient=1e-5, most=1e-2),
    )  # fmt: skip


def test_options_that_are_kept_are_not_remarked_on() -> None:
    space = sliding('iterations="50" tolerance="1e-10"')
    assert space.model is not None
    assert WarpSimulator(space.model, parameters=space, frame_skip=1).notes == ()


@pytest.mark.parametrize("flag", ['sleep="enable"', 'invdiscrete="enable"', 'island="disable"'])
def test_flags_that_do_not_act_on_bodies_in_motion(flag: str) -> None:
    space, plain = sliding(flag=flag), sliding()
    assert space.model is not None
    assert plain.model is not None
    states, controls = transitions(plain.model)
    values = torch.from_numpy(plain.nominal[None])
    expected = WarpSimulator(plain.model, parameters=plain, frame_skip=2).simulate(states, controls, values)
    found = WarpSimulator(space.model, parameters=space, frame_skip=2).simulate(states, controls, values)
    assert torch.equal(found, expected)
    true = mujoco_reference(converged(space), 2)(states, controls, values)[:, :, -1]
    torch.testing.assert_close(found, true, rtol=1e-8, atol=1e-8)


def test_a_free_joint_has_no_limits() -> None:
    space, plain = sliding(), sliding()
    assert space.model is not None
    assert plain.model is not None
    space.model.jnt_limited[0], space.model.jnt_range[0] = 1, (-0.1, 0.1)
    states, controls = transitions(plain.model)
    values = torch.from_numpy(plain.nominal[None])
    runs = [
        WarpSimulator(s.model, parameters=s, frame_skip=2).simulate(states, controls, values) for s in (space, plain)
    ]
    assert torch.equal(*runs)


def test_a_stand_in_for_mujoco_keeps_its_solver() -> None:
    """Where Warp only saves time, results are those of the model's own options."""
    for option, taken in (("", True), ('solver="CG"', False), ('iterations="2"', False)):
        space = sliding(option)
        assert space.model is not None
        assert (Variants(space).worlds([space.model], 1) is not None) == taken
