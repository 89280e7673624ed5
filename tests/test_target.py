"""The targets that stand for real robots: what they have that the models lack, and what their equipment writes."""

from __future__ import annotations

from pathlib import Path

import dropo_sims.puck.target
import dropo_sims.push.target
import mujoco
import numpy as np
import pytest
from dropo_sims.puck import SIM as PUCK
from dropo_sims.puck.policy import HOME
from dropo_sims.push import SIM as PUSH
from dropo_sims.push.policy import START
from dropo_sims.target import FINER, JOINTS, Arm, Equipment, Run, Target, log_config, run_writer, write_raw
from scipy.spatial.transform import Rotation

from dropo_torch.config import make_config
from dropo_torch.data.preprocess import Preprocess, signal_delays
from dropo_torch.data.readers import read_recording, read_trajectories
from dropo_torch.logged import read_log

NOTHING = (0.0,) * JOINTS
SILENT = Equipment(angle=0.0, place=0.0, turn=0.0)


def arm(delay: float = 0.0, dry: float = 0.0, viscous: float = 0.0) -> Arm:
    return Arm(delay, (dry,) * JOINTS, (viscous,) * JOINTS)


def puck_at_rest() -> np.ndarray:
    start = np.concatenate([mujoco.MjModel.from_xml_path(str(PUCK.model)).qpos0, np.zeros(13)])
    start[:JOINTS] = HOME
    return start


def held(time: float, state: np.ndarray) -> np.ndarray:
    return HOME


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_without_all_that_it_has_it_is_the_model_with_finer_steps() -> None:
    target, start = Target(PUCK, {}, arm(), SILENT), puck_at_rest()
    start[14 + JOINTS] = 0.4  # the puck slides
    run = target.run(start, lambda time, state: HOME + 0.1 * np.sin(5 * time), 30, random())
    model = mujoco.MjModel.from_xml_path(str(PUCK.model))
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(start, [model.nq])
    for step in range(30):
        data.ctrl[:] = HOME + 0.1 * np.sin(5 * step * 0.01)
        mujoco.mj_step(model, data, PUCK.frame_skip * FINER)
    np.testing.assert_allclose(run.final, np.concatenate([data.qpos, data.qvel]), atol=1e-12)


def test_a_delay_shifts_what_the_arm_does() -> None:
    def moved(delay: float) -> np.ndarray:
        step = HOME + 0.02 * np.arange(1, 8)
        control = lambda time, state: step if time > 0.045 else HOME  # noqa: E731
        return Target(PUCK, {}, arm(delay), SILENT).run(puck_at_rest(), control, 15, random()).qpos[:, :JOINTS]

    at_once, late = moved(0.0), moved(0.006)
    shift = round(0.006 / 2e-4)
    still = np.abs(at_once[: round(0.05 / 2e-4)] - HOME).max()  # held, but for a servo's settling
    assert np.abs(at_once[-1] - HOME).max() > 1e-2 > 100 * still
    np.testing.assert_allclose(late[shift:], at_once[:-shift], atol=2 * still + 1e-12)


def test_friction_takes_energy_and_no_more_than_it_should() -> None:
    target = Target(PUCK, {}, Arm(0.0, (0.5,) * JOINTS, (2.0,) * JOINTS))
    velocity = random().normal(size=(50, JOINTS))
    power = np.array([target._friction(v) @ v for v in velocity])
    np.testing.assert_allclose(power, -(2 * velocity**2 + 0.5 * np.abs(velocity)).sum(1), rtol=0.02)

    def swung(dry: float, viscous: float) -> float:
        """Energy of the arm after a free swing."""
        free = Target(PUCK, {}, arm(0.0, dry, viscous), SILENT)
        free.model.actuator_gainprm[:], free.model.actuator_biasprm[:] = 0.0, 0.0
        start = puck_at_rest()
        start[14] = 1.0
        final = free.run(start, held, 20, random()).final
        return float(np.abs(final[14 : 14 + JOINTS]).sum())

    assert swung(1.0, 0.0) < 0.9 * swung(0.0, 0.0)
    assert swung(0.0, 2.0) < 0.9 * swung(0.0, 0.0)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_puck_that_slides_down_a_tilted_board_slows_less(way: float) -> None:
    target = Target(PUCK, {"friction_x": 0.3, "friction_y": 0.3}, arm(), SILENT, tilt=(0.0, 0.02))
    start = puck_at_rest()
    start[JOINTS], start[14 + JOINTS] = 1.2, way  # out of the stick's reach
    path = target.run(start, held, 25, random()).qpos[:, JOINTS]
    step = target.model.opt.timestep
    speeds = np.diff(path) / step
    slowed = way * (speeds[250] - speeds[1000]) / (750 * step)
    assert slowed == pytest.approx(9.81 * (0.3 * np.cos(0.02) - way * np.sin(0.02)), rel=0.03)


def test_a_tilt_leaves_the_arm_a_small_force_that_its_model_does_not_have() -> None:
    target = Target(PUCK, {}, arm(), SILENT, tilt=(0.02, -0.015))
    data = mujoco.MjData(target.model)
    data.qpos[:JOINTS] = HOME
    mujoco.mj_forward(target.model, data)
    assert np.abs(data.qfrc_bias - data.qfrc_gravcomp)[:JOINTS].max() < 1e-9  # MuJoCo compensates the tilted gravity
    pull = target._uneven[target.model.body("link4").id]
    mass = target.model.body("link4").mass[0]
    np.testing.assert_allclose(pull, mass * 9.81 * np.array([-0.015, -0.02, 0]), atol=0.01)
    assert not target._uneven[target.model.body("puck").id].any()


def test_a_box_slides_less_far_where_friction_grows_as_it_slows() -> None:
    target, data = dropo_sims.push.target.make_target(), mujoco.MjData(mujoco.MjModel.from_xml_path(str(PUSH.model)))
    truth, pair = dropo_sims.push.target.TRUTH, target.model.pair("table_box").id
    for speed, share in ((0.0, 1.4), (0.12, 1 + 0.4 / np.e), (1.0, 1.0)):
        data.qvel[JOINTS : JOINTS + 2] = 0.6 * speed, -0.8 * speed
        dropo_sims.push.target._friction_by_speed(target.model, data)
        expected = share * np.array([truth["friction_y"], truth["friction_x"]])
        np.testing.assert_allclose(target.model.pair_friction[pair, :2], expected, rtol=1e-3)

    def slid(target: Target) -> float:
        start = np.concatenate([target.model.qpos0, np.zeros(target.model.nv)])
        start[:JOINTS], start[JOINTS], start[14 + JOINTS] = START, 0.9, 0.12
        run = target.run(start, lambda time, state: np.zeros(JOINTS), 10, random())
        assert np.linalg.norm(run.final[21:24]) < 1e-3
        return float(run.final[JOINTS] - 0.9)

    assert slid(target) < 0.9 * slid(Target(PUSH, truth, arm()))


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Target, list[Run]]:
    path = tmp_path_factory.mktemp("raw") / "log.csv"
    target, runs = dropo_sims.push.target.make_target(), dropo_sims.push.target.record_runs(2, seed=4)
    write_raw(path, target, runs)
    return path, target, runs


def test_the_cameras_latency_is_found_by_the_marker_and_holds_for_the_object(
    raw: tuple[Path, Target, list[Run]],
) -> None:
    path, target, _ = raw
    options = log_config(path, 0.06)
    recording = read_recording(**{k: v for k, v in options.items() if k != "preprocess"})
    delays = signal_delays(recording, Preprocess(dt=0.02, **options["preprocess"]))
    assert set(delays) == {"marker_x", *(f"object_{a}" for a in ("x", "y", "z", "qw", "qx", "qy", "qz"))}
    assert np.ptp(list(delays.values())) == 0
    assert delays["marker_x"] == pytest.approx(target.equipment.latency, abs=1e-3)


def test_preprocessing_gives_back_the_true_states_within_the_noise(raw: tuple[Path, Target, list[Run]]) -> None:
    path, target, runs = raw
    log = read_trajectories(
        log_config(path, 0.06) | {"preprocess": {**log_config(path, 0.06)["preprocess"], "dt": 0.02}}
    )
    first = log.observations[log.episodes == 0]
    stride = round(0.02 / target.model.opt.timestep)
    true = runs[0].qpos[round(0.06 / target.model.opt.timestep) :: stride][: len(first)]
    assert len(first) > 35
    means = target.equipment
    assert np.abs(first[:, :JOINTS] - true[:, :JOINTS]).std() < 2 * means.angle
    assert (first[:, JOINTS : JOINTS + 3] - true[:, JOINTS : JOINTS + 3]).std() < 3 * means.place
    turned = Rotation.from_quat(first[:, 10:14], scalar_first=True).inv() * Rotation.from_quat(
        true[:, 10:14], scalar_first=True
    )
    assert turned.as_rotvec().std() < 3 * means.turn
    commands = np.stack([c[1:] for c in runs[0].commands])[3 : 3 + len(first)]
    np.testing.assert_allclose(log.actions[log.episodes == 0], commands, atol=1e-8)


def test_what_the_policy_sees_is_late_and_made_of_measurements(raw: tuple[Path, Target, list[Run]]) -> None:
    _, target, runs = raw
    run, now = runs[0], 0.5 + 1e-9
    shown = target.shown(Run([r for r in run.readings if r[0] <= now], [f for f in run.frames if f[0] <= now]), now)
    step = target.model.opt.timestep
    frame = np.floor((now - target.equipment.latency) * target.equipment.rate) / target.equipment.rate
    late, at_once = (run.qpos[round(t / step)] for t in (frame, now))
    assert abs(shown[JOINTS] - late[JOINTS]) < 5e-4 < abs(at_once[JOINTS] - late[JOINTS])
    np.testing.assert_allclose(shown[:JOINTS], at_once[:JOINTS], atol=1e-4)
    speeds = (run.qpos[round(now / step)] - run.qpos[round(now / step) - 20])[:JOINTS] / (20 * step)
    np.testing.assert_allclose(shown[14 : 14 + JOINTS], speeds, atol=0.02)


def test_the_log_is_in_order_and_a_seed_decides_it(tmp_path: Path, raw: tuple[Path, Target, list[Run]]) -> None:
    path, target, _ = raw
    again = tmp_path / "again.csv"
    write_raw(again, target, dropo_sims.push.target.record_runs(2, seed=4))
    assert again.read_bytes() == path.read_bytes()
    findings = read_log(make_config({"sim": "push", "data": log_config(path, 0.06)})).examined()
    assert not any(finding.sure for finding in findings)


def test_a_log_that_cannot_be_written_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments in (["x.csv", "--runs", "0"], [str(tmp_path / "no" / "x.csv"), "--runs", "1"]):
        with pytest.raises(SystemExit) as stop:
            run_writer("a test", Target(PUSH, {}, arm()), lambda count, seed, alone: [], 1, arguments)
        assert stop.value.code == 2
        assert "error: " in capsys.readouterr().err
