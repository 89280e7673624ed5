"""Closed loops and coupled joints: what no column shows is where the model's equality constraints are met."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from conftest import compiled

import dropo_torch as dropo
from dropo_torch.data.loops import find_loops
from dropo_torch.data.observation import Observation, parse_observation
from dropo_torch.data.trajectory import Trajectories, with_unseen
from dropo_torch.errors import InputError
from dropo_torch.gap import find_gap
from dropo_torch.proposal import propose_config

#: Two cranks with motors, two rods between them: four joints, two of which move freely.
FIVE_BAR = """
<mujoco model="five_bar"><option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body pos="-0.1 0 0"><joint name="left" axis="0 0 1" damping="0.03" armature="0.002"/>
      <geom type="capsule" fromto="0 0 0 -0.1 0.2 0" size="0.01" mass="0.15" contype="0" conaffinity="0"/>
      <body name="rod_l" pos="-0.1 0.2 0"><joint name="knee_l" axis="0 0 1" damping="0.005"/>
        <geom type="capsule" fromto="0 0 0 0.2 0.2 0" size="0.008" mass="0.12" contype="0" conaffinity="0"/></body>
    </body>
    <body pos="0.1 0 0"><joint name="right" axis="0 0 1" damping="0.03" armature="0.002"/>
      <geom type="capsule" fromto="0 0 0 0.1 0.2 0" size="0.01" mass="0.15" contype="0" conaffinity="0"/>
      <body name="rod_r" pos="0.1 0.2 0"><joint name="knee_r" axis="0 0 1" damping="0.005"/>
        <geom type="capsule" fromto="0 0 0 -0.2 0.2 0" size="0.008" mass="0.12" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <equality><connect name="tip" body1="rod_l" body2="rod_r" anchor="0.2 0.2 0" solref="0.002 1"/></equality>
  <actuator><motor name="left_motor" joint="left"/><motor name="right_motor" joint="right"/></actuator>
</mujoco>"""
#: A gripper: one motor, and a finger that follows the other one at 0.8 of its way, reversed, and a bit bent.
GRIPPER = """
<mujoco model="gripper">
  <worldbody>
    <body><joint name="driver" axis="0 0 1"/><geom size="0.02" pos="0.1 0 0"/></body>
    <body pos="0 0.2 0"><joint name="follower" axis="0 0 1"/><geom size="0.02" pos="0.1 0 0"/></body>
  </worldbody>
  <equality><joint name="mimic" joint1="follower" joint2="driver" polycoef="0 -0.8 0.1 0 0"/></equality>
  <actuator><motor name="grip" joint="driver"/></actuator>
</mujoco>"""
ENCODERS = ["qpos[left]", "qpos[right]", "qvel[left]", "qvel[right]"]


def moved(rows: int = 400, friction: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States of the five-bar every 4 ms ``(rows + 1, 8)`` and its torques ``(rows, 2)``, away from singular poses."""
    model = compiled(FIVE_BAR)
    model.dof_frictionloss[model.joint("right").dofadr] = friction
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    rates, phases = rng.uniform(2, 9, (2, 4)), rng.uniform(0, 6, (2, 4))
    states, torques = [], []
    for row in range(rows + 1):
        states.append(np.concatenate([data.qpos, data.qvel]))
        target = 0.1 * np.sin(rates * row * 0.004 + phases).sum(1)
        data.ctrl[:] = 6 * (target - data.qpos[[0, 2]]) - 0.2 * data.qvel[[0, 2]]
        torques.append(data.ctrl.copy())
        mujoco.mj_step(model, data, 4)
    return np.array(states), np.array(torques[:-1])


def log_of(states: np.ndarray, actions: np.ndarray, observation: Observation) -> Trajectories:
    shown = states[:, observation.index]
    ends = np.arange(1, len(shown)) == len(shown) - 1
    return Trajectories(shown[:-1], shown[1:], actions, ends, 0.004)


def test_a_closed_loop_is_known_by_its_motors() -> None:
    states, torques = moved()
    observation = parse_observation(compiled(FIVE_BAR), ENCODERS)
    assert observation.loops is not None
    assert observation.loops.names == ("knee_l", "knee_r")
    log = with_unseen(log_of(states, torques, observation), observation, None)
    found = observation.states(log.observations, log.unseen)
    assert np.ptp(states[:, 1]) > 0.3
    np.testing.assert_allclose(found[:, :4], states[:-1, :4], atol=5e-3)  # the constraint gives a little
    np.testing.assert_allclose(found[:, 4:], states[:-1, 4:], atol=0.1)
    moved_by = observation.full(log.observations + 1e-3, log.unseen)
    observation.loops.check(moved_by, "log")  # starts that are moved close their loops, too
    assert np.abs(moved_by[:, 1] - found[:, 1]).min() > 1e-4


@pytest.mark.parametrize("angle", [-0.6, 0.0, 0.9])
def test_a_coupled_joint_follows(angle: float) -> None:
    observation = parse_observation(compiled(GRIPPER), ["driver.position", "driver.velocity"])
    state = observation.states(np.array([[angle, 2.0]]))[0]
    np.testing.assert_allclose(state[1], -0.8 * angle + 0.1 * angle**2, atol=1e-9)
    np.testing.assert_allclose(state[3], 2.0 * (-0.8 + 0.2 * angle), atol=1e-9)


def test_only_what_is_determined_is_found() -> None:
    model = compiled(FIVE_BAR)
    assert find_loops(model, [0, 4]) is None  # one motor of two
    assert find_loops(model, range(8)) is None
    loops = find_loops(model, [0, 1, 4, 5])
    assert loops is not None
    assert loops.names == ("right", "knee_r")
    model.eq_active0[:] = 0
    assert find_loops(model, [0, 2, 4, 6]) is None


def test_poses_that_no_loop_has_and_singular_ones_are_refused() -> None:
    observation = parse_observation(compiled(FIVE_BAR), ENCODERS)
    for angle, words in ((1.4, "row 1.*cannot be met by knee_l, knee_r"), (0.5, "row 1.*near a singular pose")):
        shown = np.array([[0.0, 0, 0, 0], [angle, -angle, 0, 0]])
        log = Trajectories(shown, shown, np.zeros((2, 2)), np.array([False, True]), 0.004)
        with pytest.raises(InputError, match=words):
            with_unseen(log, observation, None)


def test_friction_in_a_closed_loop_is_found_by_the_motors_encoders_alone(tmp_path: Path) -> None:
    states, torques = moved(2500, friction=0.06, seed=1)
    rng = np.random.default_rng(2)
    shown = states[:-1, [0, 2, 4, 6]] + rng.normal(0, [2e-4, 2e-4, 5e-3, 5e-3], (2500, 4))
    names = ["left_pos", "right_pos", "left_vel", "right_vel", "left_motor_tau", "right_motor_tau"]
    table = pd.DataFrame(np.hstack([shown, torques]), columns=names)
    table.insert(0, "time", 0.004 * np.arange(len(table)))
    table.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "model.xml").write_text(FIVE_BAR)
    proposal = propose_config(tmp_path / "model.xml", tmp_path / "log.csv", out=tmp_path / "robot.yaml")
    assert any("knee_l, knee_r: no column shows them" in note for note in proposal.draft.notes)
    config = proposal.config.model_copy(update={"parameters": None, "as_given": False})
    gap = find_gap(dropo.make_problem(config, general=True))
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_friction", "right")]
    (number,) = gap.effects[0].parameters.values()
    assert number.low <= 0.06 * 1.002
    assert number.high >= 0.06 * 0.998


#: A gripper as ROS has it: the second finger mimics the first one, and has no motor of its own.
MIMIC = """
<robot name="gripper"><link name="base"/>
  <link name="left"><inertial><mass value="0.2"/><origin xyz="0 0.03 0.01"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="right"><inertial><mass value="0.2"/><origin xyz="0 0.03 0.01"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="finger" type="revolute"><parent link="base"/><child link="left"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="9"/></joint>
  <joint name="follower" type="revolute"><parent link="base"/><child link="right"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="9"/><mimic joint="finger" multiplier="-1"/></joint>
</robot>"""


def test_a_mimicking_joint_needs_neither_columns_nor_a_motor(tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_string(MIMIC)
    spec.add_actuator(name="finger", target="finger", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model, rows = spec.compile(), []
    data = mujoco.MjData(model)
    for row in range(600):
        data.ctrl[:] = 0.5 * np.sin(row / 30) + 0.3 * np.sin(row / 11) - 3 * data.qpos[0] - 0.1 * data.qvel[0]
        rows.append([row / 100, data.qpos[0], data.qvel[0], data.ctrl[0]])
        mujoco.mj_step(model, data, 5)
    table = pd.DataFrame(rows, columns=["t", "finger_pos", "finger_vel", "finger_effort"])
    table.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "robot.urdf").write_text(MIMIC)
    found = propose_config(tmp_path / "robot.urdf", tmp_path / "log.csv", out=tmp_path / "robot.yaml")
    assert [m.place.label for m in found.matching.of("command")] == ["finger"]
    assert "follower: no column is a force there; no motor was added" in found.draft.notes
    problem = dropo.make_problem(found.config)
    assert problem.space.model is not None
    assert problem.space.model.nu == 1
    log = problem.trajectories
    states = problem.observation.states(log.observations, log.unseen)
    np.testing.assert_allclose(states[:, 1], -states[:, 0], atol=1e-9)
