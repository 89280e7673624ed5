"""The motion to record next: what it tells adds up, limits are kept, and a seed decides everything."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml

from dropo_torch.commands.cli import main
from dropo_torch.config import Config, make_config
from dropo_torch.errors import InputError
from dropo_torch.planning import Plan, make_plan, prepare
from dropo_torch.planning.drives import drives_of
from dropo_torch.planning.information import Information, inefficiency, information_of
from dropo_torch.planning.motion import Family, Reach

PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.01"/>
  <worldbody>
    {floor}
    <body name="rod" pos="0 0 .6">
      <joint name="pivot" axis="0 1 0" damping=".05" range="-1.2 2" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".8"/>
      <site name="tip" pos="0 0 -.5"/>
    </body>
  </worldbody>
  <sensor><framepos name="marker" objtype="site" objname="tip"/></sensor>
  <actuator>{actuator}</actuator>
</mujoco>"""
MOTOR = '<motor name="drive" joint="pivot" ctrlrange="-3 3" ctrllimited="true"/>'
SERVO = '<position name="drive" joint="pivot" kp="20" kv="1"/>'
PARAMETERS = {
    "mass": {"field": "body_mass", "name": "rod", "bounds": [0.6, 1.0], "scale_inertia": True, "unit": "kg"},
    "damping": {"field": "dof_damping", "name": "pivot", "bounds": [0.02, 0.1]},
}


def config(folder: Path, *, actuator: str = MOTOR, floor: str = "", plan: dict[str, Any] | None = None,
           **changes: Any) -> Config:  # fmt: skip
    (folder / "robot.xml").write_text(PENDULUM.format(actuator=actuator, floor=floor))
    document = {
        "model": "robot.xml", "frame_skip": 2, "noise": [2e-3, 2e-2], "epsilon": 1e-12, "threads": 1,
        "parameters": PARAMETERS, "plan": {"velocity": 3, "evaluations": 24, "models": 2, **(plan or {})}, **changes,
    }  # fmt: skip
    return make_config({k: v for k, v in document.items() if v is not ...}, base=folder)


def made(folder: Path, seconds: float = 1.5, **options: Any) -> Plan:
    return make_plan(prepare(config(folder, **options), seconds))


# --- information ---


def test_what_two_motions_tell_adds_up(tmp_path: Path) -> None:
    ground = prepare(config(tmp_path), 1.5)
    numbers = np.random.default_rng(0).random((2, ground.family.dimensions))
    commands = ground.commands(ground.family.paths(numbers, 0.5))
    states = ground.states(commands)[:, 0]
    alone = [information_of(ground.problem_of(s, u).objective, ground.point)[0]
             for s, u in zip(states, commands, strict=True)]  # fmt: skip
    from dropo_torch.problem import make_problem

    both = information_of(make_problem(ground.config, log=ground.log_of(states, commands)).objective, ground.point)
    whole = both[0] + both[1]
    np.testing.assert_allclose(whole.gram, (alone[0] + alone[1]).gram, rtol=1e-8)
    np.testing.assert_allclose(whole.shared, (alone[0] + alone[1]).shared, rtol=1e-6, atol=1e-9 * whole.gram.max())
    assert (whole.errors(ground.width) < alone[0].errors(ground.width)).all()


def test_without_shared_measurements_errors_are_those_of_fisher_information() -> None:
    root = np.random.default_rng(1).standard_normal((3, 5))
    gram, width = root @ root.T, np.array([1.0, 2.0, 0.5])
    found = Information(gram, np.zeros((3, 3)))
    np.testing.assert_allclose(found.covariance(width), np.linalg.inv(gram + np.diag(width**-2.0)), rtol=1e-9)
    np.testing.assert_allclose(Information.none(3).errors(width), width)
    assert found.volume(width) < Information.none(3).volume(width)


def test_heavy_tails_waste_little_information_of_normal_noise() -> None:
    rng = np.random.default_rng(2)
    for size in (1, 4):
        from dropo_torch.likelihood import STUDENT_DOF as DOF

        z = rng.standard_normal((3000, 60, size))
        mean = z.mean(1)
        for _ in range(20):  # the most likely location by Student's t, of 3000 samples of 60
            weight = (DOF + size) / (DOF + ((z - mean[:, None]) ** 2).sum(-1))
            mean = (weight[..., None] * z).sum(1) / weight.sum(1)[:, None]
        assert 60 * mean.var() == pytest.approx(inefficiency(size), rel=0.05)


# --- paths ---


@pytest.mark.parametrize("seed", range(3))
def test_whatever_the_numbers_paths_keep_their_limits_and_return(seed: int) -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(actuator=SERVO, floor=""))
    drives = drives_of(model, np.zeros(2))
    reach = Reach(*(np.array([x]) for x in (-0.3, 0.8, 1.5, 6.0)))
    family = Family(drives, reach, np.array([0.2]), steps=200, timestep=0.02, waves=3, frequency=(0.3, 4.0))
    paths = family.paths(np.random.default_rng(seed).random((40, family.dimensions)))
    assert (paths.position >= -0.3 - 1e-9).all()
    assert (paths.position <= 0.8 + 1e-9).all()
    assert (np.abs(paths.rate) <= 1.5 + 1e-9).all()
    assert (np.abs(paths.curvature) <= 6.0 + 1e-9).all()
    np.testing.assert_allclose(paths.position[:, [0, -1]], 0.2, atol=1e-6)
    assert np.ptp(paths.position, axis=1).min() > 1e-3
    larger = family.paths(np.random.default_rng(seed).random((40, family.dimensions)), 3.0)
    assert (larger.position >= -0.3 - 1e-9).all()
    assert (larger.position <= 0.8 + 1e-9).all()


# --- plans ---


@pytest.mark.parametrize("actuator", [MOTOR, SERVO], ids=["motor", "servo"])
def test_a_plan_keeps_all_limits_in_all_models(tmp_path: Path, actuator: str) -> None:
    plan = made(tmp_path, actuator=actuator, plan={"acceleration": 15, "force": 2.5})
    assert {x.kind for x in plan.ground.limits.limits} >= {"position", "velocity", "acceleration", "force"}
    assert len(plan.ground.values) == 3
    for model, start in zip(plan.ground.models, plan.ground.starts, strict=True):
        data, previous = mujoco.MjData(model), start[1]
        data.qpos[:], data.qvel[:] = start[:1], start[1:]
        for command in plan.commands:
            data.ctrl[:] = command
            for _ in range(2):
                mujoco.mj_step(model, data)
                assert -1.2 <= data.qpos[0] <= 2
                assert abs(data.qvel[0]) <= 3
                assert abs(data.actuator_force[0]) <= 2.5 + 1e-9
            assert abs(data.qvel[0] - previous) <= 15 * 0.02 * (1 + 1e-6)
            previous = data.qvel[0]
    assert plan.errors["log"] is None
    assert not plan.unidentified


def test_a_site_stays_in_its_workspace(tmp_path: Path) -> None:
    box = {"tip": [[-0.04, 0.05], [-1, 1], [0, 1]]}
    plan, free = made(tmp_path, plan={"workspace": box}), made(tmp_path)
    tip = [-0.5 * np.sin(p.states[:, 0]) for p in (plan, free)]
    assert tip[0].min() >= -0.04
    assert tip[0].max() <= 0.05
    assert tip[1].min() < -0.04 or tip[1].max() > 0.05


def test_nothing_touches_that_need_not(tmp_path: Path) -> None:
    wall = '<geom name="wall" type="box" size=".02 1 1" pos="{} 0 .6"/>'
    plan = made(tmp_path, floor=wall.format(-0.25))
    assert np.sin(plan.states[:, 0]).max() < (0.25 - 0.02 - 0.02) / 0.5
    allowed = made(tmp_path, floor=wall.format(-0.25), plan={"touch": [["world", "rod"]]})
    assert allowed.ground.limits.touch != plan.ground.limits.touch


def test_a_seed_decides_the_plan_and_an_interrupted_search_goes_on(tmp_path: Path) -> None:
    ground = prepare(config(tmp_path), 1.5)
    whole = make_plan(ground, checkpoint=tmp_path / "whole.bin")

    class Stop(Exception):
        pass

    count = iter(range(2))

    def stop(stage: str, share: float) -> None:
        if next(count, None) is None:
            raise Stop

    with pytest.raises(Stop):
        make_plan(ground, checkpoint=tmp_path / "part.bin", report=stop)
    resumed = make_plan(ground, checkpoint=tmp_path / "part.bin", resume=True)
    np.testing.assert_array_equal(resumed.commands, whole.commands)
    np.testing.assert_array_equal(resumed.told.gram, whole.told.gram)
    other = make_plan(prepare(config(tmp_path, seed=1), 1.5))
    assert not np.array_equal(other.commands, whole.commands)
    with pytest.raises(InputError, match="belongs to another config"):
        make_plan(prepare(config(tmp_path, seed=1), 1.5), checkpoint=tmp_path / "part.bin", resume=True)


REFUSED = {
    "no actuators": ({"actuator": ""}, 1.5, "no actuators"),
    "no parameters": ({"parameters": ...}, 1.5, "parameters: none given"),
    "no rate": ({"frame_skip": ...}, 1.5, "frame_skip: not given"),
    "too short": ({}, 0.1, "--seconds: 0.1 s are 5 commands"),
    "unknown joint": ({"plan": {"velocity": {"pivots": 1}}}, 1.5, "plan.velocity: no joint .* 'pivots'; did you mean"),
    "unknown key": ({"plan": {"speed": 1}}, 1.5, "plan: unknown key 'speed'"),
    "ends": ({"plan": {"position": {"pivot": [1, 0]}}}, 1.5, "plan.position.pivot is .*lower end first"),
    "start outside": ({"plan": {"position": {"pivot": [0.5, 1]}}}, 1.5, "pivot starts at .*outside its limits"),
    "unknown site": ({"plan": {"workspace": {"hand": [[0, 1]] * 3}}}, 1.5, "no site and no body 'hand'"),
    "workspace": ({"plan": {"workspace": {"tip": [[0.3, 1]] * 3}}}, 1.5, "the workspace of tip.x reaches .*beyond"),
    "sensors": ({"observation": ["sensor"], "noise": ...}, 1.5, "names sensors and not the whole state"),
    "adapter": ({"backend": "gymnasium", "environment": "x.py:make"}, 1.5, "backend: gymnasium has a model of its own"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_planned_is_told_in_one_line(tmp_path: Path, what: str) -> None:
    options, seconds, words = REFUSED[what]
    with pytest.raises(InputError, match=words):
        made(tmp_path, seconds, **options)


# --- the command ---


def test_the_command_writes_what_a_robot_and_a_person_need(tmp_path: Path) -> None:
    first = made(tmp_path)
    rng = np.random.default_rng(0)
    shown = first.states + rng.standard_normal(first.states.shape) * [2e-3, 2e-2]
    np.savez(
        tmp_path / "log.npz", observations=shown[:40], next_observations=shown[1:41], actions=first.commands[:40],
        terminals=np.arange(40) == 39, dt=0.02,
    )  # fmt: skip
    document = config(tmp_path, data="log.npz", noise=...).document()
    path, out = tmp_path / "robot.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump(document))
    assert main(["plan", str(path), "--out", str(out), "--seconds", "1.5", "--evaluations", "12", "--no-video"]) == 0
    assert {p.name for p in out.iterdir()} == {
        "plan.json", "commands.csv", "expected.csv", "report.html", "plan-progress.bin",
    }  # fmt: skip
    plan = json.loads((out / "plan.json").read_text())
    assert plan["schema"] == "dropo-torch/plan/1"
    assert plan["noise_source"] == "the log"
    for entry in plan["parameters"].values():
        own = entry["standard_error"]
        assert own["both"] < min(own["log"], own["plan"])
    commands, expected = (pd.read_csv(out / name) for name in ("commands.csv", "expected.csv"))
    assert list(commands) == ["time", "drive"]
    assert list(expected) == ["time", "pivot.position", "pivot.velocity"]
    assert len(expected) == len(commands) + 1 == 76
    assert all(x["margin"] >= 0 for x in plan["limits"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    model.body("rod").inertia[:] *= plan["parameters"]["mass"]["value"] / 0.8
    model.body("rod").mass[:] = plan["parameters"]["mass"]["value"]
    model.joint("pivot").damping[:] = plan["parameters"]["damping"]["value"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    data.qpos[0] = plan["start"]["pivot.position"]
    for row in range(len(commands)):
        data.ctrl[0] = commands["drive"][row]
        mujoco.mj_step(model, data, 2)
        assert data.qpos[0] == pytest.approx(expected["pivot.position"][row + 1], abs=1e-6)
    page = (out / "report.html").read_text()
    assert "Standard errors to expect" in page
    assert page.count("<svg") >= 4
