"""One delay of all servos: what is late on the way to the robot does what is late on the way back."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import Placed, find_effect
from dropo_torch.gap import find_gap, prepare
from dropo_torch.gap.limbs import joint_of_column
from dropo_torch.gap.ties import _in_the_place_of
from dropo_torch.problem import Problem
from dropo_torch.report.gap_words import rivals

SERVOS = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body pos="0 0 1"><joint name="pan" axis="0 0 1" damping=".3" armature=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 .1" size=".03" mass=".6"/>
    <body pos="0 0 .1"><joint name="lift" axis="0 1 0" damping=".3" armature=".02"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".02" mass=".5"/>
      <body pos=".25 0 0"><joint name="bend" axis="0 1 0" damping=".3" armature=".02"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/></body></body></body>
</worldbody><actuator><position name="m_pan" joint="pan" kp="25"/><position name="m_lift" joint="lift" kp="40"/>
  <position name="m_bend" joint="bend" kp="25"/></actuator></mujoco>"""
LATE, SKIP, NOISE = 0.06, 6, 2e-4


def late_servos(folder: Path, gain: float = 1.0, *, lags: bool = False) -> Problem:
    """The log of three servos, all told 60 ms late, of which one may have another gain; positions only.

    Where it ``lags``, the commands approach what they are told with that time constant, instead.
    """
    rng, model = np.random.default_rng(5), mujoco.MjModel.from_xml_string(SERVOS)
    model.opt.timestep = 0.0025
    model.actuator_gainprm[1, 0] *= gain
    model.actuator_biasprm[1, 1] *= gain
    data, rows, sent = mujoco.MjData(model), [], []
    follows = np.zeros(3)
    turns, phases = rng.uniform(1.5, 6.0, (3, 3)), rng.uniform(0, 6.28, (3, 3))
    for row in range(700):
        target = 0.25 * np.sin(turns * row * SKIP * 0.005 + phases).sum(1)
        if row >= 60:
            rows.append([row * SKIP * 0.005, *data.qpos + NOISE * rng.standard_normal(3), *target])
        for _ in range(2 * SKIP):
            sent.append(target)
            follows += (target - follows) * (1 - np.exp(-0.0025 / LATE))
            data.ctrl[:] = follows if lags else sent[max(len(sent) - 1 - round(LATE / 0.0025), 0)]
            mujoco.mj_step(model, data)
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="t,q0,q1,q2,u0,u1,u2", comments="", fmt="%.9g")
    (folder / "arm.xml").write_text(SERVOS)
    config = folder / "arm.yaml"
    config.write_text(
        "model: arm.xml\ndata: {path: log.csv, time: t, observations: [q0, q1, q2], actions: [u0, u1, u2], "
        "preprocess: {dt: 0.03, velocities: [], derive: [q0, q1, q2], cutoff: 8.0}}\nframe_skip: 6\n"
        "observation: [qpos, qvel]\nmask: [pan.velocity, lift.velocity, bend.velocity]\n"
        f"noise: {[NOISE] * 3 + [0.05] * 3}\nthreads: 1\n"
    )
    return dropo.make_problem(dropo.load_config(config), general=True)


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_servos_that_are_all_late_are_told_so_and_not_their_sensors(tmp_path: Path, gain: float) -> None:
    gap = find_gap(late_servos(tmp_path, gain))
    told = {e.effect: e for e in gap.effects if e.effect != "integration"}
    assert set(told) == {"actuator_delay"} | ({"actuator_gain"} if gain < 1 else set())
    late = told["actuator_delay"]
    assert late.target == "*"
    for number in late.parameters.values():
        assert number.value == pytest.approx(LATE, abs=0.002)
    assert {effect for effect, _ in late.indistinguishable_from} == {"sensor_delay"}
    assert rivals(late) == ["a delay of the measurement of all sensors"]
    if gain < 1:
        assert told["actuator_gain"].target == "m_lift"
        assert next(iter(told["actuator_gain"].parameters.values())).value == pytest.approx(gain, rel=0.02)


def test_servos_that_all_lag_are_told_so_and_not_late(tmp_path: Path) -> None:
    gap = find_gap(late_servos(tmp_path, lags=True))
    (lag,) = [e for e in gap.effects if e.effect != "integration"]
    assert (lag.effect, lag.target) == ("actuator_lag", "*")
    for number in lag.parameters.values():
        assert number.value == pytest.approx(LATE, abs=0.002)


def test_what_is_late_at_a_joint_stands_at_its_sensor_and_at_its_servo(tmp_path: Path) -> None:
    setting = prepare(late_servos(tmp_path)).setting
    late, told = find_effect("actuator_delay"), find_effect("sensor_delay")
    servos = [Placed(late, f"m_{joint}", (0.01 * i,)) for i, joint in enumerate(("pan", "lift"), 1)]
    sensors = [p for p in _in_the_place_of(setting, servos, told, servos) if str(p.target).endswith("position")]
    assert [(p.target, p.values) for p in sensors] == [("pan.position", (0.01,)), ("lift.position", (0.02,))]
    back = _in_the_place_of(setting, sensors, late, sensors)
    assert [(p.target, p.values) for p in back] == [(p.target, p.values) for p in servos]
    assert _in_the_place_of(setting, sensors, late, [*sensors, servos[0]]) == back[1:]
    assert joint_of_column(setting, "bend.velocity") == joint_of_column(setting, "bend.position") == 2


def test_what_is_late_at_all_sensors_stands_at_all_servos_although_one_joint_has_none() -> None:
    """A leg on a rail: nothing drives the rail, and what the servos get late, it shows late."""
    model = mujoco.MjModel.from_xml_string(SERVOS.replace('<position name="m_bend" joint="bend" kp="25"/>', ""))
    observation = parse_observation(model, ["qpos"])
    setting: Any = SimpleNamespace(model=model, observation=observation, column=observation.labels.index)
    setting.joint = lambda name: model.joint(name).id
    late, told = find_effect("actuator_delay"), find_effect("sensor_delay")
    labels = list(observation.labels)
    sensors = [Placed(told, label, (0.01,)) for label in labels]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(told), "targets", lambda effect, setting: labels)
        patch.setattr(type(late), "targets", lambda effect, setting: ["m_pan", "m_lift"])
        there = _in_the_place_of(setting, sensors, late, sensors)
        assert [(p.target, p.values) for p in there] == [("m_pan", (0.01,)), ("m_lift", (0.01,))]
        back = _in_the_place_of(setting, there, told, there)
        assert {p.target for p in back} == {*labels}
        assert _in_the_place_of(setting, sensors[1:], late, sensors) == []  # one of the others is not late
