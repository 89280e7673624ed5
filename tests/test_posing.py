"""Logs of markers and encoders as logs of states: what columns tell, what gap finds there, and init's part."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.commands.cli import main
from dropo_torch.data.observation import parse_observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.load import load_model
from dropo_torch.shooting.posing import derived, posed, posed_log
from dropo_torch.view.run import read_run

#: A camera's rate, of which no step of the model is a whole part.
RATE = 59.94
SWING = """
<mujoco>
  <option timestep=".002"/>
  <worldbody>
    <body name="arm" pos=".1 0 .9">
      <joint name="pivot" axis="0 1 0" {own}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.45" size=".006" mass=".12"/>
      <geom name="bob" type="sphere" pos="0 0 -.45" size=".03" mass=".3"/>
      <site name="led" pos="0 0 -.38"/>
    </body>
  </worldbody>
</mujoco>
"""
DOUBLE = """
<mujoco>
  <option timestep=".002"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="upper" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".2" contype="0"/>
      <site name="m1" pos="0 0 -.4"/>
      <body pos="0 0 -.4">
        <joint name="lower" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".1" contype="0"/>
        <site name="m2" pos="0 0 -.3"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <framepos name="p1" objtype="site" objname="m1"/>
    <framepos name="p2" objtype="site" objname="m2"/>
    <gyro name="gyro" site="m2"/>
    <jointpos name="q1" joint="upper"/>
  </sensor>
</mujoco>
"""
BOX = """
<mujoco>
  <option timestep=".002"/>
  <worldbody>
    <body name="box" pos="0 0 1">
      <freejoint/>
      <geom type="box" size=".1 .07 .04" mass="1"/>
      <site name="a" pos=".1 0 0"/><site name="b" pos="0 .1 0"/><site name="c" pos="0 0 .1"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="pa" objtype="site" objname="a"/>
    <framepos name="pb" objtype="site" objname="b"/>
    <framepos name="pc" objtype="site" objname="c"/>
    <gyro name="gyro" site="a"/>
    <framequat name="turn" objtype="site" objname="a"/>
  </sensor>
</mujoco>
"""


def motion(model: mujoco.MjModel, position, velocity, seconds: float, rate: float = RATE):
    """States ``(T, nq + nv)`` and sensors ``(T, nsensordata)`` at a rate, by steps of 0.1 ms."""
    model.opt.timestep = 1 / (rate * round(1e4 / rate))
    data, states, sensors = mujoco.MjData(model), [], []
    data.qpos[:], data.qvel[:] = position, velocity
    for _ in range(round(seconds * rate)):
        mujoco.mj_forward(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
        sensors.append(data.sensordata.copy())
        mujoco.mj_step(model, data, round(1e4 / rate))
    return np.array(states), np.array(sensors)


def log_of(columns: np.ndarray, rate: float = RATE) -> Trajectories:
    return Trajectories.of_samples(columns, np.zeros((len(columns) - 1, 0)), dt=1 / rate, source="log")


# --- states of rows ---


@pytest.mark.parametrize("entries", [["sensor[p1]", "sensor[p2]"], ["qpos[upper]", "sensor[p2][0]", "sensor[p2][2]"]])
def test_markers_tell_the_poses_of_a_chain(entries):
    model = mujoco.MjModel.from_xml_string(DOUBLE)
    states, sensors = motion(mujoco.MjModel.from_xml_string(DOUBLE), [2.5, -0.9], [1.0, -2.0], 3.0)
    observation = parse_observation(model, entries)
    columns = np.hstack([states, sensors])[:, observation.index]
    rng = np.random.default_rng(0)
    found, told = posed_log(model, observation, log_of(columns + 5e-4 * rng.standard_normal(columns.shape)), 1 / RATE)
    off = found.observations - states[:-1]
    assert np.abs(off[:, :2]).max() < 0.012  # of a rad, by half a millimeter at 0.3 m
    assert np.sqrt(np.mean(off[:, 2:] ** 2)) < 0.06 * states[:, 2:].std()
    assert tuple(told.blind) == ("upper.velocity", "lower.velocity")


def test_a_gyroscope_measures_what_it_shows_of_velocities():
    """Of the sum of two joints' velocities, it tells neither; of a free body, all three of its rotation."""
    model = mujoco.MjModel.from_xml_string(DOUBLE)
    observation = parse_observation(model, ["sensor[p1]", "sensor[p2]", "sensor[gyro]"])
    states, sensors = motion(mujoco.MjModel.from_xml_string(DOUBLE), [0.5, 0.4], [1.0, -2.0], 1.0)
    columns = np.hstack([states, sensors])[:, observation.index]
    found, told = posed_log(model, observation, log_of(columns), 1 / RATE)
    assert tuple(told.blind) == ("upper.velocity", "lower.velocity")
    np.testing.assert_allclose(found.observations[:, 2:].sum(1), states[:-1, 2:].sum(1), atol=1e-6)
    model = mujoco.MjModel.from_xml_string(BOX)
    states, sensors = motion(mujoco.MjModel.from_xml_string(BOX), [0, 0, 1, 1, 0, 0, 0], [1, 0.5, 2, 3, -4, 2], 0.5)
    for entries in (["sensor[pa]", "sensor[pb]", "sensor[pc]"], ["sensor[pa]", "sensor[turn]"]):
        observation = parse_observation(model, [*entries, "sensor[gyro]"])
        columns = np.hstack([states, sensors])[:, observation.index]
        found, told = posed_log(model, observation, log_of(columns), 1 / RATE)
        assert [label.rpartition("[")[2] for label in told.blind] == ["vx]", "vy]", "vz]"]
        turned = np.sign(found.observations[:, 3:4]) * np.sign(states[:-1, 3:4]) * found.observations[:, 3:7]
        np.testing.assert_allclose(turned, states[:-1, 3:7], atol=1e-5)
        np.testing.assert_allclose(found.observations[:, 7:], states[:-1, 7:], atol=5e-3)


def test_derived_velocities_are_exact_of_cubics_and_average_noise():
    model = mujoco.MjModel.from_xml_string(DOUBLE)
    time = np.arange(200) / 100
    cubic = np.stack([time**3 - time, 2 - time**2], axis=1)
    rates = np.stack([3 * time**2 - 1, -2 * time], axis=1)
    np.testing.assert_allclose(derived(model, cubic, 0.01)[0], rates, atol=1e-9)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(cubic.shape)
    found, told = derived(model, cubic + noise, 0.01)
    error = found - rates
    np.testing.assert_allclose(told, error[15:-15].std(0), rtol=0.25)
    assert error[15:-15].std() < 0.2 * (np.gradient(cubic + noise, 0.01, axis=0) - rates).std()


@pytest.mark.parametrize(
    ("entries", "moved", "message"),
    [
        (["sensor[gyro]", "sensor[q1]"], 0.0, "do not tell lower.position"),
        (["sensor[p1]"], 0.0, "do not tell lower.position"),
        (["sensor[p1]", "sensor[p2]"], 0.1, "no pose of the model has p[12].*is it along the world's axes"),
    ],
)
def test_what_no_pose_has_is_refused_in_a_line(entries, moved, message):
    model = mujoco.MjModel.from_xml_string(DOUBLE)
    states, sensors = motion(mujoco.MjModel.from_xml_string(DOUBLE), [0.5, 0.4], [1.0, -2.0], 1.0)
    observation = parse_observation(model, entries)
    columns = np.hstack([states, sensors])[:, observation.index] + moved
    with pytest.raises(InputError, match=message) as error:
        posed_log(model, observation, log_of(columns), 1 / RATE)
    assert "\n" not in str(error.value)


# --- what a newcomer does ---


@dataclass(frozen=True)
class Camera:
    """How a camera's track is written: columns, by axis, and what they are multiplied by."""

    columns: dict[str, str]
    scale: float


TRACKS = {
    "millimeters": Camera({"x": "marker_x_mm", "z": "marker_z_mm"}, 1e3),
    "site": Camera({"x": "led_x", "y": "led_y", "z": "led_z"}, 1.0),
    "no unit": Camera({"x": "track_x", "z": "track_z"}, 1e3),
    "bare": Camera({"x": "x", "z": "z"}, 1.0),
}


def film(folder: Path, camera: Camera, own: str = "", seconds: float = 20, seed: int = 0) -> tuple[Path, Path]:
    """A model, and the track of its marker where the real one has attributes of its joint that the model lacks."""
    (folder / "swing.xml").write_text(SWING.format(own=""))
    real = mujoco.MjModel.from_xml_string(SWING.format(own=own))
    data, marker = mujoco.MjData(real), []
    states, _ = motion(real, [1.4], [-2.0], seconds)
    for state in states:
        data.qpos[:] = state[:1]
        mujoco.mj_kinematics(real, data)
        marker.append(data.site("led").xpos.copy())
    shown = np.array(marker) + [8e-4, 6e-4, 1.1e-3] * np.random.default_rng(seed).standard_normal((len(marker), 3))
    picked = camera.scale * shown[:, ["xyz".index(axis) for axis in camera.columns]]
    table = np.column_stack([1e3 * np.arange(len(shown)) / RATE + 12345, picked])
    names = ",".join(["t_ms", *camera.columns.values()])
    np.savetxt(folder / "track.csv", table, "%.7g", ",", header=names, comments="")
    return folder / "swing.xml", folder / "track.csv"


@pytest.mark.parametrize("name", TRACKS)
def test_init_knows_a_markers_track(name, tmp_path):
    camera = TRACKS[name]
    model, log = film(tmp_path, camera, seconds=8)
    proposal = dropo.propose_config(model, log, out=tmp_path / "robot.yaml")
    assert [m.place.label for m in proposal.matching.matches] == [f"led_marker[{axis}]" for axis in camera.columns]
    assert {m.scale for m in proposal.matching.matches} == {1 / camera.scale}
    copy = load_model(tmp_path / "robot_markers.xml")
    assert copy.sensor("led_marker").objid[0] == copy.site("led").id
    assert copy.opt.timestep * proposal.document["frame_skip"] == pytest.approx(1 / RATE, rel=1e-4)
    assert "preprocess" not in proposal.document["data"]
    problem = posed(dropo.make_problem(proposal.config, general=True))
    assert not problem.observation.is_sensed
    assert abs(problem.trajectories.observations[:, 0]).max() < 2


def test_a_marker_that_is_hidden_now_and_then_is_interpolated(tmp_path):
    model, log = film(tmp_path, TRACKS["millimeters"], seconds=8)
    lines = log.read_text().splitlines()
    for row in (60, 61, 62, 200, 300, 301):
        lines[row] = lines[row].split(",")[0] + ",,"
    log.write_text("\n".join(lines))
    found = dropo.propose_config(model, log, out=tmp_path / "robot.yaml")
    assert found.document["data"]["preprocess"]["max_gap"] > 4 / RATE
    assert len(posed(dropo.make_problem(found.config)).trajectories) > 470


def test_what_is_no_track_of_the_models_is_told(tmp_path):
    model, log = film(tmp_path, Camera({"x": "m_x", "z": "m_z"}, 1.0), seconds=5)
    model.write_text(model.read_text().replace('pos=".1 0 .9"', 'pos=".4 0 .9"'))
    with pytest.raises(InputError, match=r"m_x, m_z may be a marker's track, but nothing .* can follow it.* off"):
        dropo.propose_config(model, log, out=tmp_path / "robot.yaml")


@pytest.mark.parametrize(
    ("own", "effect", "truth"),
    [
        pytest.param('frictionloss=".012"', "joint_friction", 0.012, marks=pytest.mark.slow),
        ('damping=".004"', "joint_damping", 0.004),
        pytest.param("", None, 0.0, marks=pytest.mark.slow),
    ],
)
def test_gap_names_what_a_marker_shows(own, effect, truth, tmp_path, capsys):
    model, log = film(tmp_path, TRACKS["millimeters"], own)
    config, out = tmp_path / "robot.yaml", tmp_path / "gap"
    text = dropo.propose_config(model, log, out=config).text
    config.write_text(text.partition("\nparameters:")[0] + "\n")  # or they would take it in
    assert main(["gap", str(config), "--out", str(out)]) == 0
    found = json.loads((out / "gap.json").read_text())
    if effect is None:
        assert found["effects"] == []
        return
    (named,) = found["effects"]
    names = {named["effect"], *(name for name, _ in named["indistinguishable_from"])}
    assert effect in names
    assert named["effect"] in ("joint_friction", "joint_damping")
    if named["effect"] == effect:
        (number,) = named["parameters"].values()
        assert number["value"] == pytest.approx(truth, rel=0.05)
    assert load_model(out / "model.xml").nsensor
    assert "sensor" in (out / "config.yaml").read_text()
    assert dropo.make_problem(dropo.load_config(out / "config.yaml")).observation.is_sensed
    shown = read_run(out)
    assert [c.name for c in shown.candidates] == ["before", "after"]
    assert not any(c.problem.observation.is_sensed for c in shown.candidates)
