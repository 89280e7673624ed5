"""The robots with hidden effects: their logs against their own truths, and the law by which answers are judged."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest

from benchmarks import unseen_robots
from benchmarks.unseen import drives
from benchmarks.unseen.judge import Judgment, judge
from benchmarks.unseen.record import record, write
from benchmarks.unseen.replay import misfit
from benchmarks.unseen.robot import Name, Robot, units
from benchmarks.unseen.robots import ROBOTS, select
from dropo_torch.effects import VOCABULARY

every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=list(ROBOTS))
LACKING = [r for r in ROBOTS.values() if r.hidden]

#: Seconds of an episode that show what is hidden; a cart must meet its stop, and a glider is slow.
SECONDS, LONGER = 2.0, {"cart": 5.0, "glider": 4.0, "pusher": 1.5, "rollbot": 5.0}


# --- robots -----------------------------------------------------------------------------------------------------


@every_robot
def test_a_log_is_what_the_truth_predicts_to_the_noise(robot: Robot) -> None:
    """And not what the model as given does, nor what the truth without any one thing that is hidden does."""
    episodes = record(robot, seed=1, seconds=LONGER.get(robot.name, SECONDS))
    assert misfit(robot, episodes, windows=10) == pytest.approx(1.0, abs=0.15)
    assert all(misfit(robot, episodes, [hidden], windows=10) > 1.5 for hidden in robot.hidden)
    assert not robot.hidden or misfit(robot, episodes, robot.hidden, windows=10) > 2.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@every_robot
def test_whole_logs_are_what_their_truths_predict(robot: Robot, seed: int) -> None:
    episodes = record(robot, seed)
    assert misfit(robot, episodes, windows=40) == pytest.approx(1.0, abs=0.1)
    assert not robot.hidden or misfit(robot, episodes, robot.hidden, windows=40) > 2.5


@every_robot
def test_a_robot_is_described_in_terms_of_its_model(robot: Robot) -> None:
    """And of the vocabulary: targets are things of the model, and columns no more than it has numbers."""
    model = robot.given()
    log = robot.log
    for names, most in ((log.positions, model.nq), (log.velocities, model.nv), (log.commands, model.nu)):
        assert len(names) <= most
    assert len(log.commands) == model.nu
    assert [len(sizes) for sizes in log.noise] == [model.nv, model.nv]
    assert robot.row / robot.step == pytest.approx(round(robot.row / robot.step))
    kinds = [getattr(mujoco.mjtObj, f"mjOBJ_{k}") for k in ("BODY", "JOINT", "ACTUATOR", "GEOM")]
    for hidden in robot.hidden:
        for effect, target in (*hidden.names, *hidden.equals, *robot.beside):
            assert effect in VOCABULARY
            thing = (target or "world").partition(".")[0]
            assert any(mujoco.mj_name2id(model, kind, thing) >= 0 for kind in kinds)


def test_there_are_robots_of_every_kind() -> None:
    assert len(ROBOTS) == 24
    assert sum(not r.hidden for r in ROBOTS.values()) == 3
    assert sum(r.is_outside for r in ROBOTS.values()) == 1
    assert sum(len(r.hidden) > 1 for r in ROBOTS.values()) == 3
    assert select("ro*") == ["rover", "rollbot"]


def test_a_seed_decides_the_log(tmp_path: Path) -> None:
    robot = ROBOTS["paddle"]
    places = (("a", 1), ("b", 1), ("c", 2))
    logs = [write(robot, tmp_path / name, seed, seconds=0.3)[1].read_text() for name, seed in places]
    assert logs[0] == logs[1] != logs[2]


def test_a_folder_is_what_a_user_would_have(tmp_path: Path) -> None:
    """Model and log, in the units that columns say; the command of a row that was sent a row before."""
    robot = ROBOTS["cart"]
    model, log = write(robot, tmp_path, seed=0, seconds=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.csv", "robot.xml"]
    assert model.read_text() == robot.text
    frame, (rows,) = pd.read_csv(log), record(robot, seed=0, seconds=1)
    assert list(frame) == ["time_s", *robot.log.positions, *robot.log.velocities, *robot.log.commands]
    np.testing.assert_allclose(frame["rail_mm"], [1e3 * row.seen[0][0] for row in rows], atol=0.05)
    np.testing.assert_allclose(frame["force_cmd"][1:], [row.command[0] for row in rows[:-1]], atol=1e-4)


def test_columns_of_one_name_are_an_array(tmp_path: Path) -> None:
    with np.load(write(ROBOTS["quadruped"], tmp_path, seed=0, seconds=1)[1]) as log:
        widths = {name: log[name].shape[1:] for name in log}
    assert widths == {
        "time": (), "base_pos": (3,), "base_quat": (4,), "joint_pos": (12,), "base_lin_vel": (3,),
        "base_ang_vel": (3,), "joint_vel": (12,), "joint_pos_target": (12,),
    }  # fmt: skip


def test_names_of_columns_tell_units() -> None:
    assert units("shoulder_pos_deg") == pytest.approx(180 / math.pi)
    assert [units(name) for name in ("rail_vel_mm_s", "t_us", "ms", "hip_torque")] == [1e3, 1e6, 1e3, 1.0]


def test_drives_do_what_they_say() -> None:
    late, slow, weak = (make(0.1)(0.01, 0.0) for make in (drives.delay, drives.lag, drives.gain))
    assert [late(1.0) for _ in range(11)] == [0.0] * 10 + [1.0]
    assert [slow(1.0) for _ in range(10)][-1] == pytest.approx(1 - math.exp(-1))
    assert weak(3.0) == pytest.approx(0.3)
    dead, loose = drives.deadband(0.5)(0.01, 0.0), drives.backlash(0.5)(0.01, 0.0)
    assert [dead(u) for u in (0.4, -0.4, 2.0, -2.0)] == [0.0, 0.0, 1.5, -1.5]
    assert [loose(u) for u in (1.0, 0.6, 0.4, -1.0)] == [0.75, 0.75, 0.65, -0.75]


# --- judging ----------------------------------------------------------------------------------------------------


def entry(effect: str, target: str | None, ties: tuple[Name, ...] = (), **numbers: float) -> dict[str, Any]:
    parameters = {
        k: {"value": v, "low": v - 0.01 * abs(v), "high": v + 0.01 * abs(v), "unit": "-"} for k, v in numbers.items()
    }
    others = [{"effect": e, "target": t} for e, t in ties]
    return {"effect": effect, "target": target, "parameters": parameters, "indistinguishable_from": others}


def judged(robot: str, *entries: dict[str, Any], **document: Any) -> Judgment:
    return judge(ROBOTS[robot], {"verdict": "explained" if entries else "no gap", "effects": entries, **document})


LAG, FRICTION = entry("actuator_lag", "trolley_drive"), entry("joint_friction", "bridge")
FALSE = entry("armature", "bridge"), entry("joint_damping", "trolley")
STEP, UNNAMED = entry("integration", None), entry("unnamed", "pan", force=2.0)


def test_all_that_is_hidden_must_be_named() -> None:
    assert judged("gantry", LAG, FRICTION).right
    assert judged("gantry", LAG).why == "not named: joint_friction bridge"
    assert not judged("gantry", LAG, entry("joint_friction", "trolley")).right


def test_a_tie_is_a_name() -> None:
    assert judged("gantry", LAG, entry("armature", "bridge", (("joint_friction", "bridge"),))).right
    assert judged("gantry", entry("armature", "bridge", (("joint_friction", "bridge"),)), LAG).right
    either = entry("armature", "bridge", (("joint_friction", "bridge"), ("actuator_lag", "trolley_drive")))
    assert not judged("gantry", either).right
    assert judged("beam", entry("inertia", "hub")).right
    assert not judged("beam", entry("inertia", "seg1")).right


def test_one_name_more_is_told_and_two_are_wrong() -> None:
    one = judged("gantry", LAG, FRICTION, FALSE[0])
    assert one.right
    assert one.extra == (("armature", "bridge"),)
    assert judged("gantry", LAG, FRICTION, *FALSE).why == "too many names: armature bridge, joint_damping trolley"


def test_integration_and_what_may_stand_beside_are_not_false() -> None:
    assert judged("gantry", LAG, FRICTION, FALSE[0], STEP).extra == (("armature", "bridge"),)
    assert judged("cart", entry("joint_limit", "rail"), entry("actuator_delay", "belt")).extra == ()
    assert not judged("cart", entry("actuator_delay", "belt")).right


def test_an_effect_at_all_places_is_a_name_at_each() -> None:
    everywhere = entry("joint_friction", "*", bridge=24.0, trolley=1.0, sway_x=0.1)
    assert judged("gantry", LAG, everywhere).extra == (("joint_friction", "sway_x"), ("joint_friction", "trolley"))


@pytest.mark.parametrize("robot", [name for name, r in ROBOTS.items() if not r.hidden])
def test_where_nothing_is_missing_only_integration_may_be_named(robot: str) -> None:
    assert judged(robot).right
    assert judged(robot, STEP).right
    assert judged(robot, UNNAMED).why == "something unnamed is claimed"
    assert judged(robot, FALSE[0]).why == "named in vain: armature bridge"


@pytest.mark.parametrize("robot", [name for name, r in ROBOTS.items() if r.is_outside])
def test_what_has_no_name_must_be_claimed_without_one(robot: str) -> None:
    assert judged(robot, UNNAMED).right
    assert judged(robot, UNNAMED, STEP).right
    assert judged(robot, UNNAMED, FALSE[0]).why == "named in vain: armature bridge"
    assert judged(robot).why == "it says that nothing is missing"


def test_a_parameter_of_the_config_does_not_stand_for_a_name() -> None:
    moved = {"given": 0.36, "alone": 0.37, "with_effects": 0.37, "low": 0.369, "high": 0.371}
    still = {"given": 1.0, "alone": 1.01, "with_effects": 1.01, "low": 0.98, "high": 1.04}
    answer = judged("ballbot", declared={"torso_center": moved, "ball_mass": still})
    assert not answer.right
    assert answer.why == "no gap, as parameters of the config take its place: torso_center 0.36 → 0.37"
    assert judged("ballbot").why == "no gap"


def test_numbers_are_compared_under_the_own_name_only() -> None:
    answer = judged("beam", entry("armature", "hub", armature=0.026))
    assert answer.errors == {"armature.armature": pytest.approx(0.04)}
    assert answer.held == {"armature.armature": False}
    assert judged("beam", entry("inertia", "hub", factor=53.0)).errors == {}


def test_a_wave_with_a_negative_amplitude_is_the_same_half_a_turn_on() -> None:
    answer = judged(
        "telescope", entry("joint_cogging", "azimuth", amplitude=-0.32, poles=24.0, phase=0.7 - 3 * math.pi)
    )
    assert max(answer.errors.values()) < 1e-9
    assert set(answer.errors) == {f"joint_cogging.{k}" for k in ("amplitude", "poles", "phase")}


@pytest.mark.parametrize("robot", LACKING, ids=lambda r: r.name)
def test_the_truth_is_a_right_answer(robot: Robot) -> None:
    told = [entry(*h.names[0], **h.values) if h.names else UNNAMED for h in robot.hidden]
    answer = judged(robot.name, *told)
    assert answer.right
    assert all(answer.held.values())
    assert set(answer.errors.values()) <= {0.0}


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command_only_lists_or_writes_where_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unseen_robots.main(["--list", "--cases", "va*"])
    assert capsys.readouterr().out.startswith("valve")
    unseen_robots.main(["--logs", str(tmp_path), "--cases", "telescope"])
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*")) == [
        "telescope/log.csv", "telescope/robot.xml", "truth.json",
    ]  # fmt: skip
    (hidden,) = json.loads((tmp_path / "truth.json").read_text())["telescope"]
    assert hidden["values"] == {"amplitude": 0.32, "poles": 24.0, "phase": 0.7}


def test_a_run_tells_each_robot_and_totals_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def briefly(robot: Robot, folder: Path, seed: int) -> tuple[Path, Path]:
        return write(robot, folder, seed, seconds=0.1)

    def pretended(arguments: list[str], folder: Path, threads: int) -> tuple[float, float]:
        if folder.name == "valve":
            raise unseen_robots.CommandFailed("dropo init exited with 2: no such column")
        (folder / "gap").mkdir(exist_ok=True)
        (folder / "gap" / "gap.json").write_text(json.dumps({"verdict": "no gap", "effects": []}))
        return 2.0, 1.0

    monkeypatch.setattr(unseen_robots, "write", briefly)
    monkeypatch.setattr(unseen_robots, "run_command", pretended)
    unseen_robots.main(["--out", str(tmp_path), "--cases", "[tgv][ear]*[rle]"])
    said = capsys.readouterr().out
    assert "WRONG telescope [joint_cogging azimuth] → no gap (no gap); init 2 s (1 s of processor)" in said
    assert "right gripper [nothing] → no gap; init" in said
    assert "WRONG valve [joint_stribeck stem]: dropo init exited with 2: no such column" in said
    with pytest.raises(SystemExit):
        unseen_robots.main(["--out", str(tmp_path)])
    unseen_robots.main(["--out", str(tmp_path), "--cases", "[tgv][ear]*[rle]", "--resume"])
    assert "3 robots, 2 of them done before" in capsys.readouterr().out
