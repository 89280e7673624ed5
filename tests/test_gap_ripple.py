"""A force that ripples with the position is found however often it does: the log shows the number of waves."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.effects import VOCABULARY
from dropo_torch.gap import Scene, find_gap, prepare
from dropo_torch.gap.ripple import WAVES, waves

MOTORS = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body><joint name="shoulder" axis="0 0 1" damping=".05" frictionloss=".02"/>
    <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".6"/>
    <body pos=".2 0 0"><joint name="elbow" axis="0 0 1" damping=".02"/>
      <geom type="capsule" fromto="0 0 0 .18 0 0" size=".015" mass=".3"/></body></body></worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator></mujoco>"""
NOISE = np.array([1e-4, 1e-4, 5e-3, 5e-3])
EFFECTS = ("joint_cogging", "joint_friction", "joint_damping", "joint_stiffness", "armature", "actuator_bias")


def scene_of(folder: Path, amplitude: float, poles: float) -> Scene:
    """A log of an arm whose shoulder ripples, which its model does not."""
    rng, model, rows = np.random.default_rng(3), mujoco.MjModel.from_xml_string(MOTORS), []
    for episode in range(4):
        data, phases = mujoco.MjData(model), rng.uniform(0, 6, 2)
        for row in range(700):
            goal = np.array([0.7, 0.8]) * np.sin(np.array([2.4, 3.1]) * row * 0.002 + phases)
            command = np.array([4.0, 1.5]) * (goal - data.qpos) - np.array([0.4, 0.12]) * data.qvel
            rows.append([episode, 0.002 * row, *data.qpos, *data.qvel, *command])
            data.ctrl[:] = command
            data.qfrc_applied[0] = amplitude * np.sin(poles * data.qpos[0] + 0.4)
            mujoco.mj_step(model, data)
    log = np.array(rows)
    log[:, 2:6] += NOISE * rng.standard_normal((len(log), 4))
    np.savetxt(folder / "log.csv", log, delimiter=",", header="episode,t,q1,q2,v1,v2,u1,u2", comments="")
    (folder / "motors.xml").write_text(MOTORS)
    (folder / "motors.yaml").write_text(
        "model: motors.xml\nframe_skip: 1\nobservation: [qpos, qvel]\nthreads: 1\n"
        "data: {path: log.csv, time: t, episode: episode, observations: [q1, q2, v1, v2], actions: [u1, u2]}\n"
    )
    return prepare(dropo.make_problem(dropo.load_config(folder / "motors.yaml"), general=True))


@pytest.mark.parametrize(("amplitude", "poles"), [(0.12, 84.0), (0.015, 250.0)])
def test_a_force_that_ripples_often_in_a_turn_is_found(amplitude: float, poles: float, tmp_path: Path) -> None:
    scene = scene_of(tmp_path, amplitude, poles)
    gap = find_gap(scene.problem, scene=scene, effects=[VOCABULARY[n] for n in EFFECTS])
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_cogging", "shoulder")]
    found = gap.effects[0].parameters
    assert abs(found["amplitude"].value) == pytest.approx(amplitude, rel=0.05)
    assert found["poles"].value == pytest.approx(poles, rel=0.005)


def test_a_log_without_ripple_adds_few_starts(tmp_path: Path) -> None:
    cogging, setting = VOCABULARY["joint_cogging"], scene_of(tmp_path, 0.0, 0.0).setting
    assert sum(len(found) for found in setting.signals.ripples.values()) <= 1
    for joint in ("shoulder", "elbow"):
        assert max(poles for _, poles, _ in cogging.starts(setting, joint)) <= 24


def swept(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Positions of a slow sweep, and the angular frequency that turns by a quarter from one to the next."""
    time = np.arange(4000) * 0.005
    position = 0.5 * np.sin(0.9 * time + rng.uniform(0, 6)) + 0.2 * np.sin(2.3 * time)
    return position, 0.5 * np.pi / float(np.sqrt(np.mean(np.diff(position) ** 2)))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_waves_are_right_to_a_tenth_of_one_over_the_range(share: float) -> None:
    rng = np.random.default_rng(1)
    position, highest = swept(rng)
    force = np.sin(share * highest * position + 0.3) + 3 * rng.standard_normal(len(position))
    force[::500] += 1e3  # impacts
    assert abs(waves(position, force, highest)[0] - share * highest) * np.ptp(position) < 0.2 * np.pi


def test_noise_has_waves_as_seldom_as_chance_makes_them() -> None:
    rng = np.random.default_rng(2)
    told = [waves(position, rng.standard_normal(len(position)), highest) for position, highest in
            (swept(rng) for _ in range(200))]  # fmt: skip
    assert sum(map(bool, told)) <= 8


def test_waves_are_no_more_than_may_be_told_and_lie_where_rows_show_them() -> None:
    position, highest = swept(np.random.default_rng(3))
    force = sum(np.sin(n * highest * position) for n in (0.2, 0.4, 0.5, 0.7, 0.9, 1.3))
    found = waves(position, force + 0.01 * np.sign(np.gradient(position)), highest)
    assert len(found) == WAVES
    assert all(0 < wave <= highest * 1.01 for wave in found)


def test_a_joint_that_rests_has_no_waves() -> None:
    rng = np.random.default_rng(4)
    assert waves(np.zeros(50), rng.standard_normal(50), 100.0) == ()
    assert waves(np.linspace(0, 1, 50), np.full(50, np.nan), 100.0) == ()
