"""What a model remembers besides its state: filters are replayed, mocap poses stand in the log, the rest is refused."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.config import load_config
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects.engine import Variant, VariantEngine
from dropo_torch.effects.placing import plain_setting
from dropo_torch.errors import InputError
from dropo_torch.gap.log import make_setting
from dropo_torch.gap.scene import prepare
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.simulators import make_simulator
from dropo_torch.simulators.hidden import filter_memory, prescribed_bodies

ARM = """
<mujoco><option timestep="0.005" integrator="{integrator}"/>
<worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
<geom size="0.03 0.2" type="capsule" pos="0 0 -0.2"/>
<body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
<geom size="0.02 0.15" type="capsule" pos="0 0 -0.15"/></body></body></worldbody>
<actuator><general name="a" joint="shoulder" gainprm="4" dyntype="filter" dynprm="0.08"/>
<general name="b" joint="elbow" gainprm="2" dyntype="filterexact" dynprm="0.03" ctrlrange="-0.8 0.8" actlimited="true"
 actrange="-0.5 0.6"/></actuator></mujoco>
"""
MASS = {"mass": {"field": "body_mass", "name": "fore", "bounds": [0.1, 1.0]}}
CONSTANT = {"constant": {"field": "actuator_dynprm", "name": "a", "index": 0, "bounds": [0.03, 0.2]}}
GRIPPER = """
<mujoco><option timestep="0.004"/><worldbody>
<body name="hand" mocap="true" pos="0 0 0.5"><geom size="0.02" contype="0" conaffinity="0"/></body>
<body name="tool" pos="0 0 0.5"><freejoint name="root"/><geom size="0.05 0.02 0.1" type="box" mass="0.4"/></body>
<body name="goal" mocap="true"><site name="target"/></body></worldbody>
<equality><weld body1="hand" body2="tool" solref="0.05 1"/></equality></mujoco>
"""
SKIP, ROWS = 4, 400


def recorded(model: mujoco.MjModel, controls: np.ndarray, poses: np.ndarray | None = None) -> np.ndarray:
    """States ``(T + 1, nq + nv)`` of one long simulation whose filters have settled at the first control."""
    data = mujoco.MjData(model)
    if model.na:
        low, high = np.where(model.actuator_ctrllimited, model.actuator_ctrlrange.T, [[-np.inf], [np.inf]])
        limits = np.where(model.actuator_actlimited, model.actuator_actrange.T, [[-np.inf], [np.inf]])
        data.act[:] = np.clip(np.clip(controls[0], low, high), *limits)
    path = [np.concatenate([data.qpos, data.qvel])]
    for step in range(ROWS):
        data.ctrl[:] = controls[step]
        if poses is not None:
            data.mocap_pos[0], data.mocap_quat[0] = poses[step, :3], poses[step, 3:]
        mujoco.mj_step(model, data, SKIP)
        path.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(path)


def arm(integrator: str) -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator=integrator))
    controls = np.random.default_rng(3).uniform(-1, 1, (ROWS // 8, 2)).repeat(8, 0)
    return model, controls, recorded(model, controls)


@pytest.mark.parametrize("parameters", [MASS, CONSTANT], ids=["mass", "time constant"])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_filters_are_replayed_over_the_commands_before_a_transition(integrator: str, parameters: dict) -> None:
    model, controls, path = arm(integrator)
    space = ParameterSpace(model, parameters)
    history = -(-filter_memory(space) // SKIP)
    assert 0 < history < ROWS
    before = np.maximum(np.arange(ROWS)[:, None] + np.arange(-history, 1), 0)
    arguments = torch.from_numpy(path[:-1]), torch.from_numpy(controls[before]), torch.from_numpy(space.nominal[None])
    found = make_simulator("mujoco", model, parameters=space, frame_skip=SKIP, history=history).simulate(*arguments)
    np.testing.assert_allclose(found[:, 0].numpy(), path[1:], atol=1e-7)
    settled = make_simulator("mujoco", model, parameters=space, frame_skip=SKIP)
    wrong = settled.simulate(arguments[0], arguments[1][:, -1:], arguments[2])
    assert np.abs(wrong[:, 0].numpy() - path[1:]).max() > 1e-2


def test_a_search_over_effects_replays_filters_too() -> None:
    model, controls, path = arm("implicitfast")
    setting = plain_setting(model, parse_observation(model, None), SKIP)
    engine = VariantEngine(setting, ParameterSpace(model, MASS), num_threads=1)
    variant = Variant((float(model.body("fore").mass[0]),), ())
    fine = controls.repeat(SKIP, 0)
    starts = np.array([0, 7, 150, 301])
    at = np.maximum(starts[:, None] * SKIP + np.arange(-engine.lead, 20 * SKIP), 0)
    found = engine.paths([variant], engine.models([variant]), path[starts][None], fine[at][None])
    expected = np.stack([path[s + 1 : s + 21] for s in starts])
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


@pytest.mark.parametrize("effects", [[], [{"effect": "actuator_gain", "target": "a", "gain": 1.0}],
                                     [{"effect": "joint_quadratic_damping", "target": "elbow", "coefficient": 0.0}],
                                     [{"effect": "actuator_delay", "target": "a", "delay": 0.0}]])  # fmt: skip
def test_a_fit_sees_a_log_of_filtered_actuators_as_it_was(tmp_path, effects: list) -> None:
    _, controls, path = arm("implicitfast")
    (tmp_path / "arm.xml").write_text(ARM.format(integrator="implicitfast"))
    ends = np.zeros(ROWS, bool)
    ends[-1] = True
    np.savez(tmp_path / "log.npz", observations=path[:-1], next_observations=path[1:], actions=controls, terminals=ends)
    text = (
        "model: arm.xml\ndata: log.npz\nframe_skip: 4\n"
        "parameters: {mass: {field: body_mass, name: fore, bounds: [0.1, 1.0]}}\n"
    )
    (tmp_path / "robot.yaml").write_text(text + (f"effects: {effects}\n" if effects else ""))
    problem = make_problem(load_config(tmp_path / "robot.yaml"))
    objective = problem.objective
    found = problem.simulator.simulate(
        objective.evaluator.states, objective.evaluator.controls, torch.from_numpy(problem.space.nominal[None])
    )
    rows = objective.transitions.rows  # without those in which the filters may still remember what was before
    assert 0 < problem.left_out == ROWS - len(rows) <= ROWS // 2
    np.testing.assert_allclose(found[:, 0].numpy(), path[1:][rows], atol=1e-6)


def test_a_mocap_pose_stands_beside_the_controls() -> None:
    model = mujoco.MjModel.from_xml_string(GRIPPER)
    assert prescribed_bodies(model) == [model.body("hand").id]  # nothing feels the goal
    time = np.arange(ROWS) * SKIP * model.opt.timestep
    poses = np.zeros((ROWS, 7))
    poses[:, :3] = np.stack([0.1 * np.sin(2 * time), 0.05 * time, 0.5 + 0.05 * np.cos(3 * time)], 1)
    poses[:, 3], poses[:, 6] = np.cos(0.3 * time), np.sin(0.3 * time)
    path = recorded(model, np.zeros((ROWS, 0)), poses)
    space = ParameterSpace(model, {"mass": {"field": "body_mass", "name": "tool", "bounds": [0.1, 1.0]}})
    simulator = make_simulator("mujoco", model, parameters=space, frame_skip=SKIP)
    assert simulator.num_controls == 7
    found = simulator.simulate(
        torch.from_numpy(path[:-1]), torch.from_numpy(poses[:, None]), torch.from_numpy(space.nominal[None])
    )
    np.testing.assert_allclose(found[:, 0].numpy(), path[1:], atol=1e-6)


def test_a_log_without_the_mocap_poses_is_refused_by_name(tmp_path) -> None:
    (tmp_path / "gripper.xml").write_text(GRIPPER)
    rows, ends = np.zeros((20, 13)), np.zeros(20, bool)
    rows[:, 3], ends[-1] = 1.0, True
    log = {"observations": rows, "next_observations": rows, "actions": np.zeros((20, 2)), "terminals": ends}
    np.savez(tmp_path / "log.npz", **log)
    (tmp_path / "robot.yaml").write_text(
        "model: gripper.xml\ndata: log.npz\nframe_skip: 4\n"
        "parameters: {mass: {field: body_mass, name: tool, bounds: [0.1, 1.0]}}\n"
    )
    with pytest.raises(InputError, match=r"2 action columns, but .* 0 actuators and 7 numbers of mocap poses \(hand"):
        make_problem(load_config(tmp_path / "robot.yaml"))


def test_effects_are_refused_where_mocap_bodies_act(tmp_path) -> None:
    """By the search for them, too, in one line; a setting is made of the commands alone."""
    (tmp_path / "gripper.xml").write_text(GRIPPER)
    rows, ends, poses = np.zeros((60, 13)), np.arange(60) == 59, np.zeros((60, 7))
    rows[:, 2], rows[:, 3], poses[:, 3] = 0.5 + 0.1 * np.sin(np.arange(60)), 1.0, 1.0
    np.savez(tmp_path / "log.npz", observations=rows, next_observations=rows, actions=poses, terminals=ends)
    text = (
        "model: gripper.xml\ndata: log.npz\nframe_skip: 4\n"
        "parameters: {mass: {field: body_mass, name: tool, bounds: [0.1, 1.0]}}\n"
    )
    (tmp_path / "robot.yaml").write_text(text)
    problem = make_problem(load_config(tmp_path / "robot.yaml"), general=True)
    with pytest.raises(InputError, match=r"^gap: mocap bodies \(hand\) cannot be had together with effects$"):
        prepare(problem)
    assert make_setting(problem, problem.trajectories).signals.command.shape == (0,)
    (tmp_path / "robot.yaml").write_text(
        text + "effects: [{effect: external_force, target: tool, x: 0.5, y: 0, z: 0}]\n"
    )
    with pytest.raises(InputError, match=r"^effects: mocap bodies \(hand\) cannot be had together with effects$"):
        make_problem(load_config(tmp_path / "robot.yaml"))
