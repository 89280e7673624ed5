"""Leg odometry: where a floating base is that no column places, by feet, gyroscope and accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dropo_torch as dropo
from dropo_torch.commands.cli import main
from dropo_torch.data.observation import parse_observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError
from dropo_torch.shooting.odometry import find_base
from dropo_torch.shooting.posing import posed, posed_log

CORNERS = {"FL": (0.19, 0.12), "FR": (0.19, -0.12), "RL": (-0.19, 0.12), "RR": (-0.19, -0.12)}
DT, SKIP = 0.004, 2
#: Noise of the orientation, rad, the gyroscope, the accelerometer, the joints and their velocities.
TURN, GYRO, FORCE, JOINT, RATE = 2e-3, 6e-3, 0.1, 4e-4, 0.02


def _leg(name: str, x: float, y: float) -> str:
    return f"""
      <body name="{name}_thigh" pos="{x} {y} 0">
        <joint name="{name}_hip" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom type="capsule" size=".025" fromto="0 0 0 0 0 -.2" mass=".7" contype="0" conaffinity="0"/>
        <body name="{name}_shank" pos="0 0 -.2">
          <joint name="{name}_knee" axis="0 1 0" damping="0.1" armature="0.01"/>
          <geom type="capsule" size=".015" fromto="0 0 0 0 0 -.19" mass=".2" contype="0" conaffinity="0"/>
          <geom name="{name}_foot" type="sphere" size=".025" pos="0 0 -.2" mass=".06"/>
        </body>
      </body>"""


FLOOR = "<geom name='floor' type='plane' size='5 5 .1'/>"
#: Sensors of an IMU that lies on its side.
IMU = """<framequat name="imu_quat" objtype="site" objname="side"/><gyro name="imu_gyro" site="side"/>"""


def robot(floor: str = FLOOR, sensors: str = "") -> str:
    servos = "".join(
        f'<position name="{n}_{j}_servo" joint="{n}_{j}" kp="80" kv="2.5"/>' for n in CORNERS for j in ("hip", "knee")
    )
    return f"""
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    {floor}
    <body name="trunk" pos="0 0 0.4">
      <freejoint name="root"/>
      <geom name="hull" type="box" size=".2 .09 .05" mass="6" contype="0" conaffinity="0"/>
      <site name="imu" pos=".05 0 .02" euler="0 0 90"/><site name="side" euler="90 0 0"/>
      {"".join(_leg(n, x, y) for n, (x, y) in CORNERS.items())}
    </body>
  </worldbody>
  <actuator>{servos}</actuator>
  <sensor><accelerometer name="imu_acc" site="imu"/>{sensors}</sensor>
</mujoco>"""


@dataclass(frozen=True)
class Walk:
    """What a quadruped did, and what its sensors say of it."""

    model: mujoco.MjModel
    positions: np.ndarray
    velocities: np.ndarray
    commands: np.ndarray
    measured: np.ndarray
    entries: tuple[str, ...]

    @property
    def log(self) -> Trajectories:
        return Trajectories.of_samples(self.measured, self.commands, dt=DT, source="walk")


def _commanded(time: float) -> np.ndarray:
    """A trot on the spot that sways and lifts two feet at a time."""
    found = []
    for k, (x, y) in enumerate(CORNERS.values()):
        phase = (time / 0.5 + 0.5 * (x * y > 0)) % 1.0
        lift = 0.35 * max(0.0, np.sin(2 * np.pi * phase)) ** 2
        sway = 0.08 * np.sin(2.1 * time + 0.3 * k)
        found += [0.7 + lift + sway, -1.4 - 1.6 * lift + 0.05 * np.sin(3.3 * time)]
    return np.array(found)


@cache
def walk(floor: str | None = None, *, seconds: float = 2.0, lift: float = 0.0, seed: int = 3) -> Walk:
    text = robot() if floor is None else robot(floor)
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[2] += lift - 0.06
    data.qpos[7:] = _commanded(0.0)
    rows = []
    for step in range(round((seconds + 1.0) / DT)):
        data.ctrl[:] = _commanded(step * DT)
        mujoco.mj_forward(model, data)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.sensordata.copy(), data.ctrl.copy()))
        mujoco.mj_step(model, data, nstep=SKIP)
    positions, velocities, forces, commands = (np.array(x)[round(1.0 / DT) :] for x in zip(*rows, strict=True))
    turns = positions[:, 3:7].copy()
    for turn in turns:
        mujoco.mju_quatIntegrate(turn, TURN * rng.standard_normal(3), 1.0)
    noisy = [
        turns,
        positions[:, 7:] + JOINT * rng.standard_normal((len(turns), 8)),
        forces + FORCE * rng.standard_normal((len(turns), 3)),
        velocities[:, 3:6] + GYRO * rng.standard_normal((len(turns), 3)),
        velocities[:, 6:] + RATE * rng.standard_normal((len(turns), 8)),
    ]
    entries = ("qpos[3:7]", "qpos[7:]", "sensor[imu_acc]", "qvel[3:6]", "qvel[6:]")
    return Walk(model, positions, velocities, commands[:-1], np.concatenate(noisy, axis=1), entries)


def _without_forces(walked: Walk) -> Walk:
    kept = np.delete(walked.measured, range(12, 15), axis=1)
    entries = tuple(e for e in walked.entries if not e.startswith("sensor"))
    return Walk(walked.model, walked.positions, walked.velocities, walked.commands, kept, entries)


def _posed(walked: Walk) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    observation = parse_observation(walked.model, walked.entries, walked.measured.shape[1])
    assert observation.is_sensed
    log, told = posed_log(walked.model, observation, walked.log, DT)
    states = np.concatenate([log.observations, log.next_observations[-1:]])
    return states[:, : walked.model.nq], states[:, walked.model.nq :], told.blind


SLOPE = "<geom name='floor' type='plane' size='5 5 .1' euler='0 4 0' pos='.3 .1 -.02'/>"


@pytest.mark.parametrize("floor", [None, SLOPE])
@pytest.mark.parametrize("helped", [True, False])
def test_feet_tell_how_a_base_moves(floor: str | None, helped: bool):
    walked = walk(floor) if helped else _without_forces(walk(floor))
    positions, velocities, blind = _posed(walked)
    base = find_base(walked.model)
    assert base is not None
    height, true = (x[:, :3] @ base.axes[:, 2] for x in (positions, walked.positions))
    assert np.abs(height - true).mean() < 1.2e-3
    off = np.sqrt(np.mean((velocities[:, :3] - walked.velocities[:, :3]) ** 2, axis=0))
    assert (off[:2] < 0.008).all()  # along the ground feet hold; across it they sink by some millimeters
    assert off[2] < (0.03 if helped else 0.045)
    labels = parse_observation(walked.model, None).labels
    assert set(blind) == {labels[c] for c in base.columns}


def test_what_is_measured_stays_as_it_was():
    walked = walk()
    positions, velocities, _ = _posed(walked)
    measured = walked.measured
    assert np.allclose(positions[:, 7:], measured[:, 4:12], atol=1e-9)
    assert np.allclose(np.abs((positions[:, 3:7] * measured[:, :4]).sum(1)), 1.0, atol=1e-9)
    assert np.allclose(velocities[:, 3:6], measured[:, 15:18], atol=1e-6)
    assert np.allclose(velocities[:, 6:], measured[:, 18:], atol=1e-6)


def test_simulations_that_begin_there_follow_the_log():
    """Heights that are wrong by a millimeter press stiff feet into the ground: joints would be far off in 20 ms."""
    walked = walk()
    positions, velocities, _ = _posed(walked)
    data, off = mujoco.MjData(walked.model), []
    for row in range(20, 480, 20):
        data.qpos[:], data.qvel[:] = positions[row], velocities[row]
        for step in range(5):
            data.ctrl[:] = walked.commands[row + step]
            mujoco.mj_step(walked.model, data, nstep=SKIP)
        off.append(data.qpos[7:] - walked.positions[row + 5, 7:])
    assert np.sqrt(np.mean(np.square(off))) < 5 * JOINT


def test_a_base_that_hangs_in_the_air_is_refused():
    walked = walk(lift=60.0, seconds=0.5)
    with pytest.raises(InputError, match=r"where trunk is, is not in the log, and its feet stand too rarely"):
        _posed(walked)


def test_without_ground_the_log_does_not_tell_it():
    text = robot("")
    model = mujoco.MjModel.from_xml_string(text)
    assert find_base(model) is None
    walked = walk()
    observation = parse_observation(model, walked.entries, walked.measured.shape[1])
    with pytest.raises(InputError, match=r"do not tell root\.position"):
        posed_log(model, observation, walked.log, DT)


def _on_its_side(walked: Walk) -> Walk:
    """The same walk, as an IMU shows it that lies on its side."""
    measured, side = walked.measured.copy(), Rotation.from_euler("x", 90, degrees=True)
    turns = Rotation.from_quat(measured[:, :4], scalar_first=True) * side
    measured[:, :4] = turns.as_quat(scalar_first=True)
    measured[:, 15:18] = side.inv().apply(measured[:, 15:18])
    model = mujoco.MjModel.from_xml_string(robot(sensors=IMU))
    entries = ("sensor[imu_quat]", "qpos[7:]", "sensor[imu_acc]", "sensor[imu_gyro]", "qvel[6:]")
    return replace(walked, model=model, measured=measured, entries=entries)


def test_an_imu_may_be_turned_in_the_base():
    expected, found = _posed(walk()), _posed(_on_its_side(walk()))
    turns = [Rotation.from_quat(p[:, 3:7], scalar_first=True) for p in (expected[0], found[0])]
    assert (turns[0] * turns[1].inv()).magnitude().max() < 1e-7
    assert np.allclose(np.delete(expected[0], range(3, 7), 1), np.delete(found[0], range(3, 7), 1), atol=1e-7)
    assert np.allclose(expected[1], found[1], atol=1e-6)
    assert expected[2].keys() == found[2].keys()


def _written(folder: Path, walked: Walk, gravity: float, sensors: str = "") -> Path:
    (folder / "dog.xml").write_text(robot(sensors=sensors))
    joints = [f"{n}_{j}" for n in CORNERS for j in ("hip", "knee")]
    measured = walked.measured.copy()
    measured[:, 12:15] /= gravity
    header = ["t", *(f"imu_q{a}" for a in "wxyz"), *(f"{j}_pos" for j in joints), *(f"imu_a{a}" for a in "xyz")]
    header += [*(f"imu_gyro_{a}" for a in "xyz"), *(f"{j}_vel" for j in joints), *(f"{j}_cmd" for j in joints)]
    commands = np.concatenate([walked.commands, walked.commands[-1:]])
    rows = np.column_stack([DT * np.arange(len(measured)), measured, commands])
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(header), comments="", fmt="%.7g")
    return folder / "robot.yaml"


@pytest.mark.parametrize("lies", [False, True])
def test_init_takes_a_log_of_encoders_and_an_imu(tmp_path: Path, lies: bool, capsys: pytest.CaptureFixture[str]):
    """Its accelerometer may tell forces in g; what the base does is derived, and compared nowhere."""
    walked = walk()
    config = _written(tmp_path, _on_its_side(walked) if lies else walked, 9.80665, IMU if lies else "")
    assert main(["init", str(tmp_path / "dog.xml"), str(tmp_path / "log.csv"), "--out", str(config)]) == 0
    assert "follows from its feet while they stand and the accelerometer" in " ".join(capsys.readouterr().out.split())
    problem = posed(dropo.make_problem(dropo.load_config(config), general=True))
    labels = parse_observation(walked.model, None).labels
    base = find_base(walked.model)
    assert base is not None
    assert set(problem.derived) == {labels[c] for c in base.columns}
    assert problem.config.noise is not None
    found = problem.trajectories.observations[:, 2]
    assert np.abs(found - walked.positions[: len(found), 2]).mean() < 1e-3


def test_what_a_config_masks_stays_masked(tmp_path: Path):
    walked = walk()
    (tmp_path / "dog.xml").write_text(robot())
    config = dropo.make_config({
        "model": str(tmp_path / "dog.xml"), "frame_skip": SKIP, "observation": list(walked.entries),
        "mask": ["FL_hip.velocity", "imu_acc[x]"],
    })  # fmt: skip
    problem = posed(dropo.make_problem(config, log=walked.log, general=True))
    assert problem.config.mask == [*problem.derived, "FL_hip.velocity"]


def test_where_a_base_is_no_other_column_tells(tmp_path: Path):
    """As many columns as it has coordinates, that are called after something else, are not its place."""
    config = _written(tmp_path, walk(), 1.0)
    log = tmp_path / "log.csv"
    log.write_text(log.read_text().replace("imu_ax,imu_ay,imu_az", "probe_a,probe_b,probe_c", 1))
    assert main(["init", str(tmp_path / "dog.xml"), str(log), "--out", str(config)]) == 0
    assert "probe" not in config.read_text()


def test_a_fit_takes_such_a_log(tmp_path: Path):
    """It begins its transitions where the feet tell, with the noise that the config has of each column."""
    walked = walk()
    (tmp_path / "dog.xml").write_text(robot())
    noise = [0.5 * TURN] * 4 + [JOINT] * 8 + [FORCE] * 3 + [GYRO] * 3 + [RATE] * 8
    config = dropo.make_config({
        "model": str(tmp_path / "dog.xml"), "frame_skip": SKIP, "observation": list(walked.entries), "noise": noise,
        "lag": 15, "parameters": {"mass": {"field": "body_mass", "name": "trunk", "bounds": [3.0, 12.0]}},
        "method": "laplace",
    })  # fmt: skip
    problem = dropo.make_problem(config, log=walked.log)
    assert problem.observation.is_sensed
    found = dropo.fit_problem(problem)
    assert found.distribution.mean[0] == pytest.approx(6.0, rel=0.02)
