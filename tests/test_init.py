"""A config from a model and a log alone: names, units, rates and episodes that people use, and what a log can tell."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import dropo_torch as dropo
from benchmarks.init.systems import ROBOTS
from benchmarks.unseen.record import write
from benchmarks.unseen.robots import ROBOTS as UNSEEN
from dropo_torch.commands.cli import main
from dropo_torch.gap import find_gap
from dropo_torch.gap.given import as_given
from dropo_torch.models.load import load_model
from dropo_torch.parameters import ParameterSpace
from dropo_torch.proposal import propose
from dropo_torch.proposal.angles import Angles, find_angles
from dropo_torch.proposal.candidates import Candidate, decides
from dropo_torch.proposal.choice import choose
from dropo_torch.proposal.clock import find_clock
from dropo_torch.proposal.columns import read_columns
from dropo_torch.proposal.draft import Filter
from dropo_torch.proposal.information import nominal_point
from dropo_torch.proposal.matches import Match, unit_name
from dropo_torch.proposal.matching import match_columns
from dropo_torch.proposal.motions import motion
from dropo_torch.proposal.places import command_kind, known_names, places_of
from dropo_torch.proposal.words import actual, body_rates, by_family, read_name

DEG = 180 / math.pi

CARTPOLE = (ROBOTS / "cartpole.xml").read_text(encoding="utf-8").replace("0.004", "0.005")

URDF = """<robot name="two"><link name="world_link"/>
<joint name="arm_joint1" type="revolute"><parent link="world_link"/><child link="link1"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="10" velocity="5"/></joint>
<link name="link1"><inertial><origin xyz=".1 0 0"/><mass value="1"/>
  <inertia ixx=".01" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="arm_joint2" type="revolute"><parent link="link1"/><child link="link2"/><origin xyz=".3 0 0"/>
  <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="10" velocity="5"/></joint>
<link name="link2"><inertial><origin xyz=".1 0 0"/><mass value=".5"/>
  <inertia ixx=".004" iyy=".008" izz=".008" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def recorded(
    model: mujoco.MjModel, seconds: float, every: int, command: Callable[[float], Sequence[float]], *,
    start: Sequence[float] = (), noise: tuple[float, float] = (1e-3, 5e-3), seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Times, noisy positions and velocities, and commands of a run, one row each ``every`` steps."""
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(seed)
    data.qpos[: len(start)] = start
    for step in range(int(seconds / model.opt.timestep / every)):
        data.ctrl[:] = command(step * every * model.opt.timestep)
        rows.append((data.time, data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
        mujoco.mj_step(model, data, every)
    t, q, v, u = (np.array(x) for x in zip(*rows, strict=True))
    return t, q + noise[0] * rng.standard_normal(q.shape), v + noise[1] * rng.standard_normal(v.shape), u


def cartpole(friction: float = 0.25) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(CARTPOLE)
    model.body("cart").mass[0], model.joint("slider").damping[0] = 1.3, 0.5
    model.joint("slider").frictionloss[0] = friction
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def push(t: float) -> list[float]:
    return [4 * math.sin(2 * t) + 3 * math.sin(5.3 * t)]


@pytest.fixture(scope="module")
def log() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return recorded(cartpole(), 8, 4, push)


def written(folder: Path, frame: dict[str, np.ndarray], xml: str = CARTPOLE, name: str = "robot.xml") -> list[str]:
    """Write a model and a log, and return their paths."""
    (folder / name).write_text(xml)
    pd.DataFrame(frame).to_csv(folder / "log.csv", index=False, float_format="%.9g")
    return [str(folder / name), str(folder / "log.csv")]


# --- names ---


@pytest.mark.parametrize(
    ("name", "role", "scale", "objects", "numbers"),
    [
        ("q_shoulder", "position", None, ("shoulder",), ()),
        ("A1 Ist [°]", "", 1 / DEG, ("a",), (1,)),
        ("Yaw Rate (°/s)", "velocity", 1 / DEG, ("yaw",), ()),
        ("torque_cmd_mNm", "command", 1e-3, (), ()),
        ("x [µm]", "", 1e-6, (), ()),
        ("pos [rev]", "position", math.tau, (), ()),
        ("speed [rev/s]", "velocity", math.tau, (), ()),
        ("tau [N m]", "effort", 1.0, (), ()),
        ("drive [kN]", "", 1e3, ("drive",), ()),
        ("rev_joint_pos", "position", None, ("rev",), ()),
        ("shoulder_pos", "position", None, ("shoulder",), ()),
        ("dq1", "velocity", None, (), (1,)),
        ("tau_1", "effort", None, (), (1,)),
        ("cmd", "command", None, (), ()),
        ("position.0", "position", None, (), (0,)),
        ("joint_states.position[2]", "position", None, (), (2,)),
        ("j3_vel_deg_s", "velocity", 1 / DEG, ("j",), (3,)),
        ("trolleyY_mm", "", 1e-3, ("trolley",), ()),
        ("theta_dot", "velocity", None, (), ()),
        ("shoulderVelocity", "velocity", None, ("shoulder",), ()),
        ("t_ms", "time", None, ("ms",), ()),
        ("run", "episode", None, (), ()),
        ("motor_temp_2", "other", None, (), (2,)),
        ("cmd_v_fr_N", "command", 1.0, ("v", "fr"), ()),
        ("elbow_acceleration", "acceleration", None, ("elbow",), ()),
        ("J2_spd(rpm)", "velocity", math.pi / 30, ("j",), (2,)),
        ("current_position_3", "position", None, (), (3,)),
        ("present_velocity", "velocity", None, (), ()),
        ("motor_current_1", "effort", None, (), (1,)),
        ("target_current", "command", None, (), ()),
        ("FL_knee_qdes", "command", None, ("fl", "knee"), ()),
        ("taucmd_2", "command", None, (), (2,)),
        ("address", "", None, ("address",), ()),
        ("subtarget", "", None, ("subtarget",), ()),
        ("motor_voltage [V]", "command", None, (), ()),
        ("arm_volts", "command", None, ("arm",), ()),
        ("u_V", "command", None, (), ()),
        ("battery_voltage", "other", None, (), ()),
        ("v", "velocity", None, (), ()),
        ("imu_ay", "acceleration", None, ("imu",), ()),
        ("az_deg", "", math.pi / 180, ("az",), ()),
        ("az_rate", "velocity", None, ("az",), ()),
        ("az_torque", "effort", None, ("az",), ()),
        ("Istwert_A1_deg", "", math.pi / 180, ("a",), (1,)),
        ("Sollwert_A1_deg", "command", math.pi / 180, ("a",), (1,)),
        ("Drehzahl_A1_degps", "velocity", math.pi / 180, ("a",), (1,)),
    ],
)
def test_names_say_what_people_mean(
    name: str, role: str, scale: float | None, objects: tuple[str, ...], numbers: tuple[int, ...]
) -> None:
    words = read_name(name)
    assert (words.role, words.objects, words.numbers) == (role, objects, numbers)
    assert words.scale == (pytest.approx(scale) if scale else None)


@pytest.mark.parametrize(
    ("name", "role", "objects"),
    [
        ("target_x_pos", "position", ("target", "x")),
        ("target_x_vel", "velocity", ("target", "x")),
        ("target_x", "", ("target", "x")),
        ("target_y", "command", ()),
        ("goal_cmd", "command", ("goal",)),
        ("load_torque", "effort", ("load",)),
        ("elbow_vel", "velocity", ("elbow",)),
    ],
)
def test_the_words_of_a_joints_name_say_nothing_else(name: str, role: str, objects: tuple[str, ...]) -> None:
    """A joint may be called after what other logs call a command, such as the two slides of Gymnasium's reacher."""
    told = read_name(name, ["target_x", "goal", "load", "elbow"])
    assert (told.role, told.objects) == (role, objects)


@pytest.mark.parametrize(
    ("name", "axis", "quaternion", "angular"),
    [("box_qw", "w", True, False), ("vx", "x", False, False), ("base_wz", "z", False, True),
     ("box_quat_y", "y", True, False), ("imu.angular_velocity.x", "x", False, True)],
)  # fmt: skip
def test_names_of_poses(name: str, axis: str, quaternion: bool, angular: bool) -> None:
    words = read_name(name)
    assert (words.axis, words.quaternion, words.angular) == (axis, quaternion, angular)


def test_p_q_and_r_together_are_body_rates() -> None:
    found = [read_name(name) for name in body_rates(["t", "p_degps", "q_degps", "r_degps", "qw"])]
    assert [(w.axis, w.angular, w.scale) for w in found[1:4]] == [
        (a, True, pytest.approx(math.pi / 180)) for a in "xyz"
    ]
    assert body_rates(["p", "q", "r"], ["P", "knee"]) == ["p", "q", "r"]
    assert body_rates(["p", "q", "dq"]) == ["p", "q", "dq"]
    assert body_rates(["p", "q", "q2", "r"])[0] == "p"


@pytest.mark.parametrize("name", ["{}_rate_dps", "{}speed_dps", "{}_vel_deg_s"])
def test_rates_of_roll_pitch_and_yaw_are_body_rates(name: str) -> None:
    names = ["t", *(name.format(word) for word in ("roll", "pitch", "yaw")), "roll_deg", "pitch_deg", "yaw_deg"]
    found = [read_name(called) for called in body_rates(names)]
    assert [(w.axis, w.angular) for w in found[1:4]] == [(a, True) for a in "xyz"]
    assert body_rates(names)[4:] == names[4:]
    assert body_rates(names, ["yaw_joint"]) == names


def test_columns_of_text_say_of_which_joints_numbered_ones_are(tmp_path: Path) -> None:
    """Joints in another order than the model's, as a message with their names has them."""
    told = ["elbow", "base_yaw", "shoulder"]
    frame = swung([f"field.position{i}" for i in range(3)])
    named = {f"field.name{i}": np.full(200, joint) for i, joint in enumerate(told)}
    found = matched(tmp_path, frame | named)
    assert [found[f"{joint}.position"] for joint in told] == list(frame)


def test_of_a_motors_angle_and_its_joints_the_joints_counts(tmp_path: Path) -> None:
    frame = swung([f"{side}_{joint}_pos" for side in ("motor", "link") for joint in ("base_yaw", "shoulder", "elbow")])
    found = matched(tmp_path, frame)
    assert [found[f"{joint}.position"] for joint in ("shoulder", "elbow")] == ["link_shoulder_pos", "link_elbow_pos"]


def test_seconds_and_their_parts_are_one_clock_in_any_unit(tmp_path: Path) -> None:
    stamps = 5_000_000 + 20_000 * np.arange(200)
    frame = {"tv_sec": stamps // 10**6, "tv_usec": stamps % 10**6, **swung(["elbow"])}
    pd.DataFrame(frame).to_csv(tmp_path / "log.csv", index=False)
    clock = find_clock(read_columns(tmp_path / "log.csv"), 0.01)
    assert clock.dt == pytest.approx(0.02)
    assert not clock.breaks


def test_a_family_may_be_called_after_what_measures_it() -> None:
    joints = ["sled", "sled_x", "sled_y", "sled_yaw", "table"]
    assert by_family(["t", "cam_x_mm", "cam_y_mm", "cam_yaw_mrad"], joints)[1:] == [
        "sled x mm",
        "sled y mm",
        "sled yaw mrad",
    ]
    for others in (["cam_x", "cam_y", "cam_z"], ["cam_x", "cam_y"], ["cam_x", "cam_y", "cam_yaw", "sled_vx"]):
        assert by_family(others, joints) == others


def test_two_families_of_the_same_words_are_not_confused() -> None:
    joints = ["left_hip", "left_knee", "right_hip", "right_knee"]
    for names in (["l_hip", "l_knee", "r_hip", "r_knee"], ["enc_hip", "enc_knee"]):
        assert by_family(names, joints) == names


def test_act_says_what_was_measured_where_nothing_else_does() -> None:
    """Beside a position of the same joint it is the command, as in data sets of imitation."""

    def told(*names: str) -> list[str]:
        return [read_name(n).role for n in actual(names, [read_name(n) for n in names])]

    assert told("elbow_ActPos_deg", "elbow_Torque_Nm") == ["position", "effort"]
    assert told("elbow_pos", "elbow_act_pos") == ["position", "command"]
    assert told("elbow_actVel", "elbow_pos") == ["velocity", "position"]
    assert told("act_pos", "cmd_pos") == ["position", "command"]


# --- columns of a cart that nothing but a motor holds ---

CART = """<mujoco><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1"/></body>
  </worldbody><actuator><motor name="pusher" joint="rail"/></actuator></mujoco>"""


def test_a_model_of_level_slides_alone_is_matched(tmp_path: Path) -> None:
    """A log may lack every position of such a model, and needs no array of states."""
    t = 0.02 * np.arange(200)
    frame = {"time": t, "cart_pos": np.sin(t), "cart_vel": np.cos(t), "force_cmd": np.sin(3 * t)}
    assert matched(tmp_path, frame, CART) == {
        "rail.position": "cart_pos", "rail.velocity": "cart_vel", "pusher": "force_cmd",
    }  # fmt: skip
    del frame["cart_pos"]
    assert matched(tmp_path, frame, CART) == {"rail.velocity": "cart_vel", "pusher": "force_cmd"}


def test_actual_positions_beside_commands(tmp_path: Path) -> None:
    """Of columns called ``act``, those are measured beside which there are commands."""
    sent = {f"j{i}_cmd_deg": v for i, v in zip((1, 2), swung(("a", "b")).values(), strict=True)}
    shown = {f"j{i}_act_deg": 0.9 * v for i, v in zip((1, 2), sent.values(), strict=True)}
    rates = {f"j{i}_vel_deg": v for i, v in zip((1, 2), swung(("a", "b"), rates=True).values(), strict=True)}
    arm = """<mujoco><worldbody><body><joint name="j1" axis="0 1 0"/><geom size=".1"/>
      <body><joint name="j2" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
      <actuator><position name="a1" joint="j1" kp="9"/><position name="a2" joint="j2" kp="9"/></actuator></mujoco>"""
    assert matched(tmp_path, {**shown, **rates, **sent}, arm) == {
        "j1.position": "j1_act_deg", "j2.position": "j2_act_deg", "j1.velocity": "j1_vel_deg",
        "j2.velocity": "j2_vel_deg", "a1": "j1_cmd_deg", "a2": "j2_cmd_deg",
    }  # fmt: skip
    only = {"j1_deg": shown["j1_act_deg"], "j2_deg": shown["j2_act_deg"], "j1_act_deg": sent["j1_cmd_deg"]}
    assert matched(tmp_path, {**only, "j2_act_deg": sent["j2_cmd_deg"]}, arm)["a2"] == "j2_act_deg"


@pytest.mark.parametrize(
    ("prm", "kind"),
    [
        ('gainprm="2" biasprm="0 0 -2"', "velocity"),
        (f'gainprm="{2 * np.pi / 30}" biasprm="0 0 -2"', "velocity"),
        ('gainprm="0.05" biasprm="0 0 -.35"', "effort"),  # a motor by its voltage, which its back-EMF brakes
        ('gainprm="9" biasprm="0 -9 -1"', "position"),
    ],
)
def test_what_an_actuator_takes(prm: str, kind: str) -> None:
    xml = CART.replace('<motor name="pusher"', f'<general name="pusher" biastype="affine" {prm}')
    assert command_kind(mujoco.MjModel.from_xml_string(xml), 0) == kind


def test_tensions_are_what_winches_pull_with(tmp_path: Path) -> None:
    """No name has a word in common, but there are as many forces as winches."""
    xml = """<mujoco><worldbody><site name="a" pos="-1 0 1"/><site name="b" pos="1 0 1"/><body>
      <joint name="px" type="slide" axis="1 0 0"/><joint name="tilt" axis="0 1 0"/><geom size=".1"/>
      <site name="l" pos="-.1 0 0"/><site name="r" pos=".1 0 0"/></body></worldbody>
      <tendon><spatial name="c1"><site site="a"/><site site="l"/></spatial><spatial name="c2"><site site="b"/>
      <site site="r"/></spatial></tendon><actuator><motor name="winch1" tendon="c1" gear="-1"/>
      <motor name="winch2" tendon="c2" gear="-1"/></actuator></mujoco>"""
    t = 0.02 * np.arange(200)
    (x, tilt), (v, rate) = swung(("a", "b")).values(), swung(("a", "b"), rates=True).values()
    frame = {"time": t, "platform_x": x, "platform_tilt": tilt, "platform_vx": v, "tilt_rate": rate}
    found = matched(tmp_path, frame | {f"tension_{i}": np.sin((5 + i) * t) for i in (1, 2)}, xml)
    assert (found["winch1"], found["winch2"]) == ("tension_1", "tension_2")


def test_actuators_called_as_poses_are(tmp_path: Path) -> None:
    stage = """<mujoco><worldbody><body><joint name="stage" type="slide" axis="1 0 0"/><geom size=".1"/>
      <body><joint name="table" axis="0 0 1"/><geom size=".1"/></body></body></worldbody>
      <actuator><motor name="lin" joint="stage"/><motor name="rot" joint="table"/></actuator></mujoco>"""
    (a, b), (c, d) = swung(("a", "b")).values(), swung(("a", "b"), rates=True).values()
    t = 0.02 * np.arange(200)
    frame = {
        "time": t, "stage_mm": a, "table_deg": b, "stage_vel_mm": c, "table_vel_deg": d, "lin_force": np.sin(9 * t),
        "rot_torque": np.sin(7 * t),
    }  # fmt: skip
    found = matched(tmp_path, frame, stage)
    assert (found["lin"], found["rot"]) == ("lin_force", "rot_torque")


# --- columns of commands that are called after what they drive ---

ROTORS = "".join(f'<motor name="thrust{i}" site="rotor{i}" gear="0 0 1 0 0 .016"/>' for i in range(1, 5))
DRONE = f"""<mujoco><worldbody><body name="drone"><freejoint/><geom size=".1"/>
  {
    "".join(
        f'<site name="rotor{i}" pos="{x} {y} 0"/>'
        for i, (x, y) in enumerate(itertools.product((-0.1, 0.1), repeat=2), 1)
    )
}</body></worldbody><actuator>{ROTORS}</actuator></mujoco>"""


def flown(command: str) -> dict[str, np.ndarray]:
    """A log of the drone, whose rotors' columns are called so."""
    names = [f"mocap_{axis}" for axis in ("px", "py", "pz", "qw", "qx", "qy", "qz")]
    return {"time": 0.02 * np.arange(200)} | swung(names) | swung([command.format(i) for i in (3, 1, 2, 4)])


@pytest.mark.parametrize("command", ["thrust{}", "motor{}", "rotor_{}", "thrust{}_cmd"])
def test_a_command_may_be_called_after_its_actuator_or_be_numbered_like_it(command: str, tmp_path: Path) -> None:
    """The exact name needs no word for a command, and motors of one number each have their order."""
    found = matched(tmp_path, flown(command), DRONE)
    assert [found.get(f"thrust{i}") for i in range(1, 5)] == [command.format(i) for i in range(1, 5)]


@pytest.mark.parametrize("command", ["touch{}", "thrust{}_temp"])
def test_numbered_columns_of_something_else_are_no_commands(command: str, tmp_path: Path) -> None:
    assert not set(matched(tmp_path, flown(command), DRONE)) & {f"thrust{i}" for i in range(1, 5)}


def test_a_column_called_after_a_joint_is_its_position(tmp_path: Path) -> None:
    """Even if an actuator has the same name."""
    xml = CART.replace('name="pusher"', 'name="rail"')
    t = 0.02 * np.arange(200)
    assert "rail" not in matched(tmp_path, {"time": t, "other_pos": np.sin(3 * t), "rail": np.sin(t)}, xml)


@pytest.mark.parametrize(
    ("gear", "transmission", "unit"),
    [
        ("0 0 1 0 0 0", 'site="rotor1"', "N"),
        ("0 0 0 0 0 2", 'site="rotor1"', "N·m"),
        ("0 0 1 0 0 .016", 'site="rotor1"', "N"),  # a thrust in newtons, which turns by the way
        ("0 0 3 0 0 2", 'site="rotor1"', "SI"),
        ("1", 'joint="fan"', "N·m"),
        ("1", 'tendon="rope"', "N"),
        ("1", 'tendon="flexor"', "N"),
        ("1", 'tendon="pair"', "N·m"),
    ],
)
def test_the_unit_of_a_command_is_that_of_what_it_makes(gear: str, transmission: str, unit: str) -> None:
    xml = DRONE.replace(ROTORS, f'<motor name="thrust" {transmission} gear="{gear}"/>')
    fan = '<body><joint name="fan"/><geom size=".1"/><site name="end"/></body></body>'
    xml = xml.replace("</body>", fan, 1).replace(
        "<actuator>",
        '<tendon><spatial name="rope"><site site="rotor1"/><site site="end"/></spatial>'
        '<fixed name="flexor"><joint joint="fan" coef=".011"/></fixed>'
        '<fixed name="pair"><joint joint="fan" coef="-1"/></fixed></tendon><actuator>',
    )
    (place,) = (p for p in places_of(mujoco.MjModel.from_xml_string(xml)) if p.kind == "command")
    assert unit_name(1.0, place) == unit


# --- columns of an arm ---

ARM = """<mujoco><worldbody><body name="turntable"><joint name="base_yaw" axis="0 0 1"/><geom size=".1"/>
  <body name="upper_arm"><joint name="shoulder" axis="0 1 0"/><geom size=".1"/>
    <body name="forearm"><joint name="elbow" axis="0 1 0"/><geom size=".1"/></body></body></body></worldbody>
  <actuator><position name="servo_1" joint="base_yaw" kp="9"/><position name="servo_2" joint="shoulder" kp="9"/>
    <position name="servo_3" joint="elbow" kp="9"/></actuator></mujoco>"""


def matches_of(folder: Path, frame: dict[str, np.ndarray], xml: str = ARM) -> dict[str, Match]:
    """What each number of a model is matched with, by its label."""
    model = mujoco.MjModel.from_xml_string(xml)
    pd.DataFrame(frame).to_csv(folder / "log.csv", index=False)
    columns = read_columns(folder / "log.csv", known_names(model))
    clock = find_clock(columns, model.opt.timestep)
    starts = clock.starts(len(columns), columns.parts)
    taken = [c for c in (clock.column, clock.episode) if c is not None]
    return {m.place.label: m for m in match_columns(columns, places_of(model), starts, taken).matches}


def matched(folder: Path, frame: dict[str, np.ndarray], xml: str = ARM) -> dict[str, str]:
    """The column of each number of a model, by its label."""
    return {label: m.column.entry for label, m in matches_of(folder, frame, xml).items()}


def swung(names: Sequence[str], *, of: str = "{}", rates: bool = False) -> dict[str, np.ndarray]:
    """Motions of joints, each at a frequency of its own, or their rates."""
    t = 0.02 * np.arange(200)
    waves = {name: 1.0 + 0.7 * i for i, name in enumerate(names)}
    return {of.format(name): w * np.cos(w * t) if rates else np.sin(w * t) for name, w in waves.items()}


#: A leg whose joints and actuators have words in common.
LEG = """<mujoco><worldbody><body><joint name="hip_flex" axis="0 1 0"/><geom size=".1"/>
  <body><joint name="knee_flex" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
  <actuator><motor name="hip_motor" joint="hip_flex"/><motor name="knee_motor" joint="knee_flex"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("names", [("hip_flex_tau", "knee_flex_tau"), ("knee_flex_tau", "hip_flex_tau")])
def test_a_word_that_all_joints_have_says_nothing(names: tuple[str, str], tmp_path: Path) -> None:
    joints = {"hip_flex_q": 1.0, "knee_flex_q": 1.7}
    t = 0.02 * np.arange(200)
    frame = {"time": t, **{n: np.sin(w * t) for n, w in joints.items()}, **dict(zip(names, (t, -t), strict=True))}
    found = matched(tmp_path, frame, LEG)
    assert (found["hip_motor"], found["knee_motor"]) == ("hip_flex_tau", "knee_flex_tau")


LABELS = ("base_yaw", "shoulder", "elbow")


@pytest.mark.parametrize(
    ("position", "velocity", "command"),
    [("J{}_pos(rad)", "J{}_spd(rad/s)", "J{}_goal(rad)"), ("dxl{}_present_position", "dxl{}_present_velocity",
      "dxl{}_goal_position"), ("m{}.current_angle", "m{}.current_speed", "m{}.target_angle")],
)  # fmt: skip
def test_three_numbered_joints_are_no_axes(position: str, velocity: str, command: str, tmp_path: Path) -> None:
    frame = {"time": 0.02 * np.arange(200)} | swung("123", of=position)
    frame |= swung("123", of=velocity, rates=True) | swung("123", of=command)
    found = matched(tmp_path, frame)
    for i, joint in enumerate(LABELS, 1):
        assert found[f"{joint}.position"] == position.format(i)
        assert found[f"{joint}.velocity"] == velocity.format(i)
        assert found[f"servo_{i}"] == command.format(i)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("pan", "lift", "flex"), ("pan", "lift", "flex")),  # no name is the model's: in order
        (("pan", "shoulder_lift", "elbow_flex"), ("pan", "shoulder_lift", "elbow_flex")),
        (("elbow", "pan", "shoulder"), ("pan", "shoulder", "elbow")),  # a single one is left
        (("elbow", "pan", "tilt"), None),  # names say that the order is not the model's
    ],
)
def test_names_that_nobody_knows_follow_the_order(
    names: tuple[str, ...], expected: tuple[str, ...] | None, tmp_path: Path
) -> None:
    frame = {"time": 0.02 * np.arange(200)} | swung(names, of="{}.pos") | swung(names, of="{}.cmd")
    frame["row_number"] = np.arange(200.0)
    found = matched(tmp_path, frame)
    if expected is None:
        assert found.keys().isdisjoint({"servo_1", "servo_2"})
        assert found["servo_3"] == "elbow.cmd"
        return
    assert [found[f"{joint}.position"] for joint in LABELS] == [f"{name}.pos" for name in expected]
    assert [found[f"servo_{i}"] for i in (1, 2, 3)] == [f"{name}.cmd" for name in expected]


def test_a_grippers_position_is_told_in_hundredths_of_its_range(tmp_path: Path) -> None:
    """As LeRobot logs arms: joints in degrees, the gripper from 0 to 100; its command, too, and no other joint."""
    xml = """<mujoco><worldbody><body><joint name="elbow" range="-2 2"/><geom size=".1"/>
      <body pos="0 0 .3"><joint name="gripper" range="-0.2 1.8"/><geom size=".05"/></body></body></worldbody>
      <actuator><position name="elbow" joint="elbow"/><position name="gripper" joint="gripper"/></actuator>
    </mujoco>""".replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
    time, names = 0.02 * np.arange(200), ("elbow", "gripper")
    turns = {"elbow": 90 * np.sin(time), "gripper": 50 + 45 * np.sin(3 * time)}
    frame = {f"observation.state[{n}.pos]": turns[n] for n in names}
    frame |= {f"action[{n}.pos]": turns[n] + 1 for n in names}
    pd.DataFrame({"timestamp": time, **frame}).to_csv(tmp_path / "log.csv", index=False)
    columns = read_columns(tmp_path / "log.csv")
    starts = np.arange(200) == 0
    taken = [c for c in columns.columns if c.entry == "timestamp"]
    found = match_columns(columns, places_of(mujoco.MjModel.from_xml_string(xml)), starts, taken)
    told = {m.place.label: m for m in found.matches}
    np.testing.assert_allclose(told["gripper.position"].values, -0.2 + 0.02 * turns["gripper"])
    np.testing.assert_allclose(told["gripper"].values, -0.2 + 0.02 * (turns["gripper"] + 1))
    np.testing.assert_allclose(told["elbow.position"].values, np.radians(turns["elbow"]))
    assert [told[f"{n}.position"].unit for n in names] == ["degrees", "% of the joint's range"]
    entry = {"signal": told["gripper"].column.entry, "scale": pytest.approx(0.02), "offset": -0.2}
    assert told["gripper"].entry == entry


EXCAVATOR = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="boom" axis="0 1 0"/><geom size=".1"/>
  <body pos="0 0 .3"><joint name="stick" axis="0 1 0" range="-1 2"/><geom size=".05"/></body></body></worldbody>
  <actuator><motor name="boom_cyl" joint="boom" gear="100" ctrlrange="{boom}"/>
  <position name="stick_cyl" joint="stick" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("boom", "lowest", "told"), [("-2 2", -80.0, 0.02), ("0 4", 0.0, 0.04), ("-2 2", 0.0, 0.02), ("", -80.0, 1.0)]
)
def test_percent_are_of_what_an_actuator_takes(boom: str, lowest: float, told: float, tmp_path: Path) -> None:
    """Forces from zero on, targets from the lower end; of an actuator without a range, nobody knows."""
    xml = EXCAVATOR.format(boom=boom).replace(' ctrlrange=""', "")
    wave = np.sin(5 * TIME)
    frame = {"boom_angle": 0.3 * np.sin(TIME), "stick_angle": 0.5 + np.cos(3 * TIME)}
    frame |= {"boom_valve_pct": lowest + (80 - lowest) * (0.5 + 0.5 * wave), "stick_valve_pct": 50 + 40 * wave}
    found = matches_of(tmp_path, frame | {"time": TIME}, xml)
    np.testing.assert_allclose(found["boom_cyl"].values, told * frame["boom_valve_pct"])
    np.testing.assert_allclose(found["stick_cyl"].values, 0.8 * wave, atol=1e-9)
    assert found["stick_cyl"].unit == "% of the command's range"


@pytest.mark.parametrize(("name", "role"), [("throttle_1_pct", "command"), ("battery_pct", ""), ("grip_percent", "")])
def test_percent_are_no_part_of_a_name(name: str, role: str) -> None:
    words = read_name(name)
    assert words.percent
    assert words.scale is None
    assert words.role in (role, "other")
    assert not {"pct", "percent"} & set(words.objects)


DRIVES = """<mujoco><worldbody><body><joint name="base_x" type="slide" axis="1 0 0"/><geom size=".1"/>
  <body><joint name="base_y" type="slide" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
  <actuator><motor name="drive_fx" joint="base_x" ctrlrange="-40 40"/>
  <motor name="drive_fy" joint="base_y" ctrlrange="-40 40"/></actuator></mujoco>"""


def test_percent_columns_are_called_after_their_actuators(tmp_path: Path) -> None:
    frame = {"time": TIME, "base_x_pos": np.sin(TIME), "base_y_pos": np.cos(3 * TIME)}
    frame |= {"drive_fx_pct": 50 * np.sin(5 * TIME), "drive_fy_pct": 30 * np.cos(7 * TIME)}
    found = matches_of(tmp_path, frame, DRIVES)
    np.testing.assert_allclose(found["drive_fx"].values, 0.4 * frame["drive_fx_pct"])
    np.testing.assert_allclose(found["drive_fy"].values, 0.4 * frame["drive_fy_pct"])


@pytest.mark.parametrize("factor", [1.0, 8.0])
def test_efforts_tell_which_command_of_a_list_was_whose(factor: float, tmp_path: Path) -> None:
    """A controller's list is in an order of its own; what is eight times as large is in another unit."""
    waves = {name: np.sin((5 + 2 * i) * TIME) for i, name in enumerate(("a", "b", "c"))}
    noise = np.random.default_rng(0).standard_normal((3, len(TIME)))
    frame = {"time": TIME} | {f"{name}_pos": np.sin((1 + i) * TIME) for i, name in enumerate(waves)}
    frame |= {f"{name}_effort": wave + 0.05 * e for (name, wave), e in zip(waves.items(), noise, strict=True)}
    frame |= {f"commands[{i}]": factor * waves[name] for i, name in enumerate(("c", "a", "b"))}
    joints = "".join(
        f'<body><joint name="{name}" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/></body>' for name in waves
    )
    motors = "".join(f'<motor name="m_{name}" joint="{name}"/>' for name in waves)
    xml = f"<mujoco><worldbody>{joints}</worldbody><actuator>{motors}</actuator></mujoco>"
    found = matches_of(tmp_path, frame, xml)
    for name, wave in waves.items():
        assert (np.abs(found[f"m_{name}"].values - wave).max() < 1e-6) == (factor == 1), name


def test_a_joints_number_is_not_its_fingers(tmp_path: Path) -> None:
    xml = ARM
    for i, joint in enumerate(LABELS, 1):
        xml = xml.replace(f'"{joint}"', f'"joint{i}"')
    frame = {"time": 0.02 * np.arange(200), "position[panda_finger_joint1]": np.full(200, 0.04)}
    frame |= swung("123", of="position[panda_joint{}]")
    found = matched(tmp_path, frame, xml)
    assert [found[f"joint{i}.position"] for i in (1, 2, 3)] == [f"position[panda_joint{i}]" for i in (1, 2, 3)]


# --- columns that are called after actuators ---

PUSHER = """<mujoco><worldbody><body name="carriage"><joint name="finger_x" type="slide" axis="1 0 0"/><geom size=".1"/>
    <body name="finger"><joint name="finger_y" type="slide" axis="0 1 0"/><geom size=".1"/></body></body>
  <body name="box"><freejoint name="box_free"/><geom size=".1"/></body></worldbody>
  <actuator><position name="servo_x" joint="finger_x"/><position name="servo_y" joint="finger_y"/></actuator>
</mujoco>"""
POSE = [f"box_{part}" for part in ("px", "py", "pz", "qw", "qx", "qy", "qz")]
TIME = 0.02 * np.arange(200)


@pytest.mark.parametrize(
    "called", ["servo_{}", "Servo-{}", "servo.{}", "servo_{}_mm", "servo_{}_target", "servo_{}_pos_cmd_mm"]
)
@pytest.mark.parametrize("rates", [False, True])
def test_a_column_called_after_an_actuator_is_its_command(called: str, rates: bool, tmp_path: Path) -> None:
    """Whatever else the words of its name could be, in whatever unit, and whether velocities are logged or not."""
    commands = [called.format(axis) for axis in "xy"]
    frame = {"time": TIME} | swung(["finger_x", "finger_y", *POSE, *commands])
    if rates:
        frame |= swung(["finger_x", "finger_y"], of="{}_vel", rates=True)
    found = matched(tmp_path, frame, PUSHER)
    assert [found.get("servo_x"), found.get("servo_y")] == commands
    assert not any(label.startswith("box_free.velocity") for label in found)


def test_of_two_columns_called_after_an_actuator_the_command_is_it(tmp_path: Path) -> None:
    frame = {"time": TIME} | swung(["finger_x", "finger_y", *POSE, "servo_x", "servo_x_cmd", "servo_y_cmd", "servo_y"])
    found = matched(tmp_path, frame, PUSHER)
    assert (found["servo_x"], found["servo_y"]) == ("servo_x_cmd", "servo_y_cmd")


@pytest.mark.parametrize("called", ["servo_{}_nm", "servo_{}_rpm", "servo_{}_pos", "servo_{}_temp", "servo_{}_vel_cmd"])
def test_what_else_is_measured_of_an_actuator_is_no_target(called: str, tmp_path: Path) -> None:
    """A torque, a speed or a temperature is not, nor is the command of another kind."""
    frame = {"time": TIME} | swung(LABELS) | swung("123", of=called)
    assert not set(matched(tmp_path, frame)) & {"servo_1", "servo_2", "servo_3"}


def test_what_is_called_after_actuators_is_measured_where_nothing_else_is(tmp_path: Path) -> None:
    names = ("hip_motor", "knee_motor")
    frame = {"time": TIME} | swung(names) | swung(("hip", "knee"), of="{}_vel", rates=True)
    found = matched(tmp_path, frame, LEG.replace("_flex", ""))
    assert [found["hip.position"], found["knee.position"]] == list(names)
    found = matched(tmp_path, frame | swung(("hip", "knee")), LEG.replace("_flex", ""))
    assert [found["hip_motor"], found["knee_motor"]] == list(names)


@pytest.mark.parametrize(("rates", "place"), [(False, "rail"), (True, "rail.velocity")])
def test_motion_tells_what_a_column_is_that_joint_and_actuator_are_called(
    rates: bool, place: str, tmp_path: Path
) -> None:
    """Beside the joint's position: its velocity if it moves so, and else the command."""
    xml = CART.replace('name="pusher"', 'name="rail"')
    other = swung(["rail"], rates=True) if rates else {"rail": np.sin(3 * TIME)}
    found = matched(tmp_path, {"time": TIME} | swung(["rail_pos"]) | other, xml)
    assert found == {"rail.position": "rail_pos", place: "rail"}


@pytest.mark.parametrize("moves", [False, True])
def test_a_velocity_by_part_of_its_name_moves_as_its_position(moves: bool, tmp_path: Path) -> None:
    xml = PUSHER[: PUSHER.index("<actuator>")] + "</mujoco>"
    frame = {"time": TIME} | swung(["finger_x", "finger_y", *POSE])
    t = TIME if moves else TIME[::-1]
    frame["vx"] = 2.4 * np.cos(2.4 * t) if moves else np.sin(9 * t)
    found = matched(tmp_path, frame, xml)
    assert [label for label, column in found.items() if column == "vx"] == ["box_free.velocity[vx]"] * moves


@pytest.mark.parametrize(("lost", "pieces"), [(6, 3), (2, 1)])
def test_rows_that_are_missing_end_an_episode_where_commands_are_unknown(
    lost: int, pieces: int, tmp_path: Path
) -> None:
    kept = np.delete(np.arange(400), np.r_[150 : 150 + lost, 300 : 300 + lost])
    pd.DataFrame({"time": 0.01 * kept, "q": np.sin(0.01 * kept)}).to_csv(tmp_path / "log.csv", index=False)
    columns = read_columns(tmp_path / "log.csv")
    clock = find_clock(columns, 0.005)
    assert clock.starts(len(columns), columns.parts).sum() == pieces


@pytest.mark.parametrize(("left", "refused"), [("servo_2_raw", True), ("servo_2_temp", False), ("light", False)])
def test_targets_are_not_made_up_beside_columns_called_after_servos(
    left: str, refused: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    frame = {"time": TIME} | swung([*LABELS, left])
    assert main(["init", *written(tmp_path, frame, ARM), "--out", str(tmp_path / "robot.yaml")]) == (
        2 if refused else 0
    )
    error = capfd.readouterr().err
    assert ("(targets), although some are called after it: servo_2_raw" in error) == refused


# --- rates and episodes ---


@pytest.mark.parametrize(
    ("name", "unit"),
    [("t", 1.0), ("time", 1e-3), ("stamp", 1e-9), ("t_us", 1e-6), ("epoch_ms", 1e-3), ("host_us", 1e-6)],
)
def test_the_unit_of_time_stamps_is_found(name: str, unit: float, tmp_path: Path) -> None:
    stamps = 0.02 * np.arange(50)
    pd.DataFrame({name: stamps / unit, "q": np.sin(stamps)}).to_csv(tmp_path / "log.csv", index=False)
    clock = find_clock(read_columns(tmp_path / "log.csv"), 0.005)
    assert (clock.unit, clock.dt) == (unit, pytest.approx(0.02))


def test_a_log_that_runs_backwards_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    frame = {"stamp": TIME[::-1]} | swung(LABELS) | {f"servo_{i}": np.zeros(200) for i in (1, 2, 3)}
    assert main(["init", *written(tmp_path, frame, ARM), "--out", str(tmp_path / "robot.yaml")]) == 2
    error = capfd.readouterr().err.splitlines()[-1]
    assert "stamp falls from row to row; sort the rows by it" in error


def test_episodes_begin_where_a_column_changes_or_time_begins_anew(tmp_path: Path) -> None:
    t = np.tile(0.02 * np.arange(30), 3)
    frame = pd.DataFrame({"t": t, "trial": np.repeat([4, 5, 6], 30), "q": np.sin(t)})
    for columns, episode, breaks in ((frame, "trial", ()), (frame.drop(columns="trial"), None, (30, 60))):
        columns.to_csv(tmp_path / "log.csv", index=False)
        clock = find_clock(read_columns(tmp_path / "log.csv"), 0.005)
        assert (clock.episode.entry if clock.episode else None, clock.breaks) == (episode, breaks)
        assert np.flatnonzero(clock.starts(90, (0,))).tolist() == [0, 30, 60]
        assert ("trial parts the rows into 3 episodes" in clock.why) == (episode is not None)


def test_a_velocity_is_told_from_others_by_motion() -> None:
    t = 0.01 * np.arange(400)
    rng = np.random.default_rng(0)
    q, v = np.sin(3 * t) + 1e-2 * rng.standard_normal(400), 3 * np.cos(3 * t)
    share, seconds = motion(q, v, np.arange(400) == 0)
    assert share > 0.9
    assert seconds == pytest.approx(0.01, rel=0.03)
    assert motion(q, np.sin(3 * t), np.arange(400) == 0)[0] < 0.2


# --- the largest set that is told apart ---


def candidate(name: str, kind: str = "mass") -> Candidate:
    return Candidate(name, kind, {"field": "body_mass", "name": name, "bounds": [0.5, 2.0]}, 1.0, 1.0, "")  # type: ignore[arg-type]


def gram_of(*columns: Sequence[float]) -> np.ndarray:
    matrix = np.array(columns).T
    return matrix.T @ matrix


def test_of_two_that_are_tied_the_one_that_models_have_right_goes() -> None:
    gram = gram_of([100, 0, 0], [0, 80, 0], [99.99, 0, 0.2], [0, 0, 0.01])
    found = choose([candidate("a"), candidate("b"), candidate("gear", "gear"), candidate("none")], gram)
    states = {t.candidate.name: t.state for t in found.told}
    assert states == {"a": "stands for", "b": "chosen", "gear": "confounded", "none": "unseen"}
    (group,) = found.groups
    assert set(group.names) == {"a", "gear"}
    assert len(group.directions) == 1
    tied = next(t for t in found.told if t.candidate.name == "gear")
    assert tied.with_ == (("a", pytest.approx(1.0, rel=1e-2)),)


def test_a_scale_common_to_all_is_no_information() -> None:
    """Masses and gains times one factor move nothing; differences of a step make it seem to move a little."""
    rng = np.random.default_rng(2)
    matrix = 300 * rng.standard_normal((200, 6))
    matrix[:, 5] = -matrix[:, :5].sum(1) + 0.02 * rng.standard_normal(200)
    names = [candidate(f"mass{i}") for i in range(5)] + [candidate("gain", "gain")]
    found = choose(names, matrix.T @ matrix)
    assert [t.candidate.name for t in found.told if not t.is_in] == ["gain"]
    (group,) = found.groups
    assert (len(group.names), len(group.directions)) == (6, 5)


def test_nothing_is_left_out_that_is_told() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        matrix = rng.standard_normal((40, 8)) * 10 ** rng.uniform(-1.5, 1.5, 8)
        matrix[:, 7] = matrix[:, 6] * 3 + 0.02 * matrix[:, 5]
        gram = matrix.T @ matrix
        found = choose([candidate(f"p{i}") for i in range(8)], gram)
        assert all(t.error <= 0.25 for t in found.chosen)
        assert not [t for t in found.told if not t.is_in and t.error < 0.1]


def test_friction_is_decided_as_mujoco_decides_it() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='.1' friction='.5'/><geom size='.1' friction='.8'/>"
        "<geom size='.1' friction='.5'/><geom size='.1' friction='.1' priority='1'/></worldbody></mujoco>"
    )
    assert decides(model, 0, 1) == [1]
    assert decides(model, 0, 2) == [0, 2]
    assert decides(model, 1, 3) == [3]


# --- whole proposals ---


def test_a_proposed_config_is_checked_and_fitted_as_it_is(
    tmp_path: Path, log: tuple[np.ndarray, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    t, q, v, u = log
    files = written(tmp_path, {
        "speed_theta": DEG * v[:, 1], "x_mm": 1000 * q[:, 0], "stamp": 1000 * t, "force_cmd": u[:, 0],
        "theta_deg": DEG * q[:, 1], "x_dot": v[:, 0],
    })  # fmt: skip
    path = tmp_path / "robot.yaml"
    assert main(["init", *files, "--out", str(path)]) == 0
    output, _ = capfd.readouterr()
    document = yaml.safe_load(path.read_text())
    assert document["frame_skip"] == 4
    assert document["data"]["time"] == {"signal": "stamp", "scale": 0.001}
    assert document["data"]["observations"][0] == {"signal": "x_mm", "scale": 0.001}
    assert document["observation"] == ["slider.position", "hinge.position", "slider.velocity", "hinge.velocity"]
    assert document["noise"] == pytest.approx([1e-3, 1e-3, 5e-3, 5e-3], rel=0.25)
    assert {"cart_mass", "pole_mass", "slider_damping", "slider_friction"} <= set(document["parameters"])
    page = path.with_suffix(".html").read_text()
    for words in ("cart_mass", "slider_friction", "x_mm", "told apart from all others"):
        assert words in page
    assert "identifiable" in output
    assert main(["check", str(path)]) == 0
    assert main(["fit", str(path), "--out", str(tmp_path / "fit"), "--samples", "20"]) == 0
    fit = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert fit["verdict"] == "explained"
    truth = {"cart_mass": 1.3, "pole_mass": 0.25, "slider_damping": 0.5, "slider_friction": 0.25}
    for name, value in truth.items():
        error = fit["standard_errors"][name]["mean"]
        assert abs(fit["parameters"][name]["mean"] - value) < 3 * error, name
        assert error < 0.1 * value
    assert main(["init", *files, "--out", str(path)]) == 2  # nothing of the user's is replaced


def test_several_files_are_episodes(tmp_path: Path) -> None:
    """Given one by one, or as a pattern; they have the same columns, and rows may be missing between them only."""
    model, rng = mujoco.MjModel.from_xml_string(SERVOS), np.random.default_rng(6)
    names, logs = ("t", "lift_pos", "bend_pos", "lift_target", "bend_target"), []
    for number in range(3):
        data, rows = mujoco.MjData(model), []
        for row in range(400):
            target = 0.3 * np.sin(0.05 * row * np.array((1, 1.7)) + number)
            rows.append((0.02 * row, *data.qpos, *target))
            data.ctrl[:] = target
            mujoco.mj_step(model, data, 10)
        log = np.array(rows)
        log[:, 1:3] += 2e-4 * rng.standard_normal((400, 2))
        logs.append(log)
    files = [tmp_path / f"run_{number}.csv" for number in range(3)]
    for file, log in zip(files, logs, strict=True):
        np.savetxt(file, log, delimiter=",", header=",".join(names), comments="")
    (tmp_path / "robot.xml").write_text(SERVOS)
    robot, out = str(tmp_path / "robot.xml"), tmp_path / "robot.yaml"
    assert main(["init", robot, *map(str, files), "--out", str(out)]) == 0
    document = yaml.safe_load(out.read_text())
    assert document["data"]["path"] == [f.name for f in files]
    assert dropo.make_problem(dropo.load_config(out)).trajectories.num_episodes == 3
    assert dropo.propose_config(robot, tmp_path / "run_*.csv", out=out).document["data"] == document["data"]
    np.savetxt(files[1], np.delete(logs[1], range(100, 150), 0), delimiter=",", header=",".join(names), comments="")
    with pytest.raises(dropo.InputError, match=r"run_0\.csv and 2 more: rows are missing within one of these files"):
        dropo.propose_config(robot, files, out=out)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n3,4\n")
    with pytest.raises(dropo.InputError, match="nothing in all of them has a number"):
        dropo.propose_config(robot, [files[0], tmp_path / "other.csv"], out=out)


HELD_DOWN = """<mujoco><option timestep="0.005"/><worldbody><body pos="0 0 1">
  <joint name="lift" axis="0 1 0" damping=".2"/>
  <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="1"/></body></worldbody>
  <actuator><motor name="lift_motor" joint="lift"/></actuator></mujoco>"""


SERVOS = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body><joint name="roll" axis="1 0 0" damping=".05" armature=".01"/><geom type="box" size=".02 .2 .02" mass=".2"/>
  <body><joint name="pitch" axis="0 1 0" damping=".05" armature=".01"/><geom type="box" size=".2 .02 .02" mass=".4"/>
  </body></body></worldbody><actuator><position name="roll_servo" joint="roll" kp="12" kv=".8"/>
  <position name="pitch_servo" joint="pitch" kp="12" kv=".8"/></actuator></mujoco>"""


@pytest.mark.parametrize("late", [(0, 0), (15, 15), (10, 24)])
def test_what_late_commands_do_that_jump_is_no_noise(late: tuple[int, int], tmp_path: Path) -> None:
    """As of a controller that answers noisy measurements: steps of the physics by which each servo's come late."""
    model, rng = mujoco.MjModel.from_xml_string(SERVOS), np.random.default_rng(2)
    data, rows, sent = mujoco.MjData(model), [], np.zeros((2, 16_000))
    targets = 0.15 * np.sin(0.05 * np.arange(1500)[:, None] * (1, 1.7)) + 0.05 * rng.standard_normal((1500, 2))
    for row, target in enumerate(targets):
        rows.append((0.02 * row, *data.qpos, *target))
        for step in range(10 * row, 10 * row + 10):
            sent[:, step] = target
            data.ctrl[:] = [sent[i, max(step - late[i], 0)] for i in range(2)]
            mujoco.mj_step(model, data)
    log = np.array(rows)[10:]
    log[:, 1:3] += 2e-4 * rng.standard_normal((len(log), 2))
    names = ("t", "roll_pos", "pitch_pos", "roll_target", "pitch_target")
    files = written(tmp_path, dict(zip(names, log.T, strict=True)), SERVOS)
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    least, most = min(found.document["noise"][:2]), max(found.document["noise"][:2])
    assert least > 1.5e-4
    assert most < (1.5e-3 if late == (10, 24) else 2.5e-4)  # 4.7e-3 unless late ones are tried; a part stays between


@pytest.mark.parametrize(("flipped", "names"), [((-1, 1), ("lift_pos", "lift_vel")), ((1, -1), ("lift_tau",))])
def test_signs_that_are_surely_wrong_are_put_right(
    flipped: tuple[int, int], names: tuple[str, ...], tmp_path: Path
) -> None:
    """By its weight, a joint that counts the other way is told from a motor that is wired so."""
    model = mujoco.MjModel.from_xml_string(HELD_DOWN)
    t, q, v, u = recorded(model, 20, 4, lambda t: [-1.5 + 1.2 * math.sin(3 * t) + math.sin(7.1 * t)])
    frame = {
        "t": t,
        "lift_pos": flipped[0] * q[:, 0],
        "lift_vel": flipped[0] * v[:, 0],
        "lift_tau": flipped[1] * u[:, 0],
    }
    files = written(tmp_path, frame, HELD_DOWN)
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    assert found.document["data"]["scale"] == dict.fromkeys(names, -1.0)
    assert not [f for f in found.findings if f.sure]


def test_commands_that_are_surely_exchanged_are_put_right(tmp_path: Path) -> None:
    xml = HELD_DOWN.replace("</body>", """<body pos=".4 0 0"><joint name="bend" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".4"/></body></body>""").replace(
        "</actuator>", '<motor name="bend_motor" joint="bend"/></actuator>'
    )  # fmt: skip
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0)
    t, q, v, u = recorded(model, 20, 4, lambda t: rng.standard_normal(2) * (1, 0.3))
    columns = (t, q[:, 0], q[:, 1], v[:, 0], v[:, 1], u[:, 1], u[:, 0])
    names = ("t", "lift_pos", "bend_pos", "lift_vel", "bend_vel", "lift_tau", "bend_tau")
    files = written(tmp_path, dict(zip(names, columns, strict=True)), xml)
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    assert found.document["data"]["actions"] == ["bend_tau", "lift_tau"]
    assert not [f for f in found.findings if f.sure]


def unevenly(jitter: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A log whose rows were taken when their stamps say: these, positions, and commands in force."""
    rng = np.random.default_rng(3)
    t, q, _, u = recorded(cartpole(), 8, 4, push, noise=(0.0, 0.0))
    taken = t + jitter * rng.uniform(-1, 1, len(t))
    row = np.clip(np.searchsorted(t, taken, side="right") - 1, 0, len(t) - 1)
    return taken, CubicSpline(t, q)(taken) + 1e-3 * rng.standard_normal(q.shape), u[row]


def test_velocities_that_were_not_logged_are_derived_and_jitter_is_resampled(tmp_path: Path) -> None:
    late, q, u = unevenly(2e-3)
    model, data = written(tmp_path, {"time": late, "x": q[:, 0], "theta": q[:, 1], "u": u[:, 0]})
    found = dropo.propose_config(model, data, out=tmp_path / "robot.yaml")
    options = found.document["data"]["preprocess"]
    assert options["dt"] == pytest.approx(0.02)
    assert options["actions"] == "mean"
    assert options["velocities"] == []
    assert options["derive"] == ["x", "theta"]  # the filter is for these: positions stay as they were measured
    assert found.document["observation"] == ["slider.position", "hinge.position", "slider.velocity", "hinge.velocity"]
    assert not [f for f in found.findings if f.sure]
    assert dropo.make_problem(found.config).trajectories.observations.shape[1] == 4
    assert any(re.fullmatch(r"time stamps jitter by \d+% of 0.0\d+ s: resampled", n) for n in found.draft.notes)


@pytest.mark.parametrize("late", [0.0, 2e-3, 12e-3])
def test_velocities_that_follow_late_are_derived(late: float, tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """A filter and not the robot made them late. By a tenth of a row, they stay."""
    t, q, v, u = log
    passed = v.copy()
    for row in range(1, len(v)):
        passed[row] += (passed[row - 1] - v[row]) * np.exp(-(t[row] - t[row - 1]) / late) if late else 0.0
    passed += 1e-3 * np.random.default_rng(3).standard_normal(v.shape)
    frame = {"t": t, "x": q[:, 0], "theta": q[:, 1], "dx": passed[:, 0], "dtheta": passed[:, 1], "u": u[:, 0]}
    found = dropo.propose_config(*written(tmp_path, frame), out=tmp_path / "robot.yaml")
    derived = found.document["data"].get("preprocess", {}).get("derive", [])
    assert derived == (["x", "theta"] if late > 5e-3 else [])
    notes = [n for n in found.draft.notes if "all velocities are derived" in n]
    assert len(notes) == (late > 5e-3)
    assert all("the velocity comes" in n for n in notes)


@pytest.mark.parametrize(("jitter", "words"), [(0.0, ""), (2e-3, r"time stamps jitter by \d+% of 0.0\d+ s and ")])
def test_rows_that_are_missing_are_told_as_such(jitter: float, words: str, tmp_path: Path) -> None:
    late, q, u = unevenly(jitter)
    kept = np.setdiff1d(np.arange(len(late)), [50, 120, 121, 200])
    frame = {"time": late, "x": q[:, 0], "theta": q[:, 1], "u": u[:, 0]}
    files = written(tmp_path, {name: values[kept] for name, values in frame.items()})
    notes = dropo.propose_config(*files, out=tmp_path / "robot.yaml").draft.notes
    assert any(re.fullmatch(f"{words}4 rows are missing: resampled", note) for note in notes)


@pytest.mark.parametrize("gone", [(), (50, 120, 121, 200)])
def test_rows_that_were_taken_evenly_are_read_so_although_stamps_jitter(
    gone: tuple[int, ...], tmp_path: Path, log: tuple[np.ndarray, ...]
) -> None:
    """A logger that stamps rows when it receives them; where some are missing, an episode begins."""
    t, q, v, u = log
    stamps = t + 4e-3 * np.random.default_rng(3).uniform(-1, 1, len(t))
    kept = np.setdiff1d(np.arange(len(t)), gone)
    frame = {"time": stamps, "x": q[:, 0], "theta": q[:, 1], "dx": v[:, 0], "dtheta": v[:, 1], "u": u[:, 0]}
    files = written(tmp_path, {name: values[kept] for name, values in frame.items()})
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    data = found.document["data"]
    assert data["dt"] == pytest.approx(t[1] - t[0], rel=2e-3)
    assert "time" not in data
    assert "preprocess" not in data
    assert len(data.get("breaks", [])) == (3 if gone else 0)
    assert "what was measured is the smoother if rows are even" in " ".join(found.clock.why)
    assert not [f for f in found.findings if f.sure]


HOVER = """
<mujoco>
  <option timestep=".002" gravity="0 0 0"/>
  <worldbody>
    <body name="trunk">
      <freejoint name="root"/>
      <geom type="box" size=".2 .1 .05" mass="2"/>
      <site name="imu"{turned}/>
      <body pos=".2 0 0">
        <joint name="flap" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="flap" kp="5"/></actuator>
  <sensor><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize("turned", ["", ' euler="0 0 90"'])
def test_the_only_pose_is_that_of_the_only_free_body_and_a_gyroscope_turns_as_it(tmp_path: Path, turned: str) -> None:
    """Whatever measured them is called. What neither shows is derived, and compared nowhere."""
    model, rng = mujoco.MjModel.from_xml_string(HOVER.format(turned=turned)), np.random.default_rng(0)
    data, rows, speeds = mujoco.MjData(model), [], list[float]()
    data.qvel[:6] = [0.1, 0.2, -0.1, 0.5, -0.4, 0.8]
    for step in range(600):
        data.ctrl[0] = math.sin(0.16 * step) + 0.6 * math.sin(0.05 * step)
        mujoco.mj_forward(model, data)
        rows.append(np.concatenate([[data.time], data.qpos, data.qvel[6:], data.ctrl, data.sensordata / model.nu]))
        speeds.append(data.qvel[0])
        mujoco.mj_step(model, data, 5)
    table = np.array(rows)
    table[:, 1:4] += 1e-3 * rng.standard_normal((600, 3))
    table[:, 8:10] += [2e-4, 5e-3] * rng.standard_normal((600, 2))
    table[:, 11:] = DEG * (table[:, 11:] + 3e-3 * rng.standard_normal((600, 3)))
    names = "t,vicon_px,vicon_py,vicon_pz,vicon_qw,vicon_qx,vicon_qy,vicon_qz,flap_q,flap_dq,flap_qdes,imu_gyro_x,"
    frame = dict(zip((names + "imu_gyro_y,imu_gyro_z").split(","), table.T, strict=True))
    files = written(tmp_path, frame, HOVER.format(turned=turned))
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    label = {m.column.entry: m.place.label for m in found.matching.matches}
    assert (label["vicon_px"], label["vicon_qz"]) == ("root.position[x]", "root.position[qz]")
    assert label["flap_qdes"] == "servo"
    options, linear = found.document["data"]["preprocess"], [f"root.velocity[v{axis}]" for axis in "xyz"]
    assert "flap_dq" in options["velocities"]
    assert options["derive"][:3] == ["vicon_px", "vicon_py", "vicon_pz"]
    if turned:  # it is not along the body's axes
        assert "imu_gyro_x" not in label
        assert found.document["mask"] == [*linear, *(f"root.velocity[w{axis}]" for axis in "xyz")]
    else:
        assert label["imu_gyro_y"] == "root.velocity[wy]"
        gyro = next(m for m in found.matching.matches if m.column.entry == "imu_gyro_y")
        assert gyro.scale == pytest.approx(1 / DEG)
        assert found.document["mask"] == linear
    log = dropo.make_problem(found.config).trajectories
    columns = dict(zip(found.labels, log.observations.T, strict=True))
    moved = np.gradient(columns["root.position[x]"], log.dt)
    assert np.corrcoef(moved, columns["root.velocity[vx]"])[0, 1] > 0.3
    count, flap = len(log.observations), columns["flap.velocity"]  # a filter leaves rows out at either end
    first = min(range(600 - count), key=lambda k: float(np.abs(table[k : k + count, 9] - flap).sum()))
    if not turned:  # compared nowhere, so it may lose of the motion what is less than the noise
        assert np.std(columns["root.velocity[vx]"] - speeds[first : first + count]) < 0.03
    assert columns["flap.velocity"].std() == pytest.approx(table[:, 9].std(), rel=0.05)


FLOATING = """<mujoco>
  <option timestep=".002" gravity="0 0 0" integrator="RK4"/>
  <worldbody><body name="hull">
    <freejoint name="hull_free"/><geom type="box" size=".2 .1 .05" mass="2"/><site name="bow" pos=".1 .05 0"/>
  </body></worldbody>
  <actuator>
    <motor name="surge" site="bow" gear="1 0 0 0 0 0"/><motor name="turn" site="bow" gear="0 0 0 .02 .05 .1"/>
  </actuator>
</mujoco>"""


def floated(seconds: float = 6.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A hull that turns over, exactly: times, positions, velocities, commands."""
    start, rng = [0, 0, 0, 1, 0, 0, 0], np.random.default_rng(0)
    phases = rng.uniform(0, 6, 2)
    t, q, v, u = recorded(
        mujoco.MjModel.from_xml_string(FLOATING), seconds, 5,
        lambda t: (np.sin(3 * t + phases) + 0.5).tolist(), start=start, noise=(0.0, 0.0),
    )  # fmt: skip
    q[:, :3] += 1e-3 * rng.standard_normal((len(q), 3))
    return t, q, v, u


def rolled_pitched_yawed(names: Sequence[str], unit: float = 1.0, sequence: str = "xyz") -> dict[str, np.ndarray]:
    """The log of such a hull with its orientation as angles of these names, with some noise."""
    t, q, v, u = floated()
    angles = Rotation.from_quat(q[:, 3:], scalar_first=True).as_euler(sequence) / unit
    angles += 1e-3 / unit * np.random.default_rng(1).standard_normal(angles.shape)
    frame = {"t": t} | dict(zip(("x_m", "y_m", "z_m", *names), np.hstack([q[:, :3], angles]).T, strict=True))
    gyro = DEG * (v[:, 3:] + 3e-3 * np.random.default_rng(2).standard_normal((len(t), 3)))
    frame |= {f"gyro_{axis}_dps": gyro[:, i] for i, axis in enumerate("xyz")}
    return frame | {"surge_cmd": u[:, 0], "turn_cmd": u[:, 1]}


@pytest.mark.parametrize(
    ("names", "unit", "name", "told"),
    [
        (("roll_deg", "pitch_deg", "yaw_deg"), 1 / DEG, "orientation", "degrees"),
        (("Roll", "Pitch", "Yaw"), 1 / DEG, "orientation", "degrees"),
        (("att.roll", "att.pitch", "att.yaw"), 1.0, "orientation", "rad"),
        (("hull_phi", "hull_theta", "hull_psi"), 1.0, "hull", "rad"),
        (("imu_roll_mrad", "imu_pitch_mrad", "imu_yaw_mrad"), 1e-3, "imu", "mrad"),
    ],
)
def test_roll_pitch_and_yaw_are_the_orientation_of_a_free_body(
    names: tuple[str, str, str], unit: float, name: str, told: str, tmp_path: Path
) -> None:
    files = written(tmp_path, rolled_pitched_yawed(names, unit), FLOATING)
    found = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    label = {m.column.entry: m.place.label for m in found.matching.matches}
    assert [label[f"{name}[{axis}]"] for axis in "wxyz"] == [f"hull_free.position[q{axis}]" for axis in "wxyz"]
    assert label["gyro_y_dps"] == "hull_free.velocity[wy]"
    angles = [{"signal": n, "scale": pytest.approx(unit)} if unit != 1 else n for n in names]
    assert found.document["data"]["orientations"] == {name: {"angles": angles, "sequence": "xyz"}}
    said = f"{', '.join(names)} are hull's orientation: roll, pitch, yaw in {told} about the fixed axes x, y, z"
    assert said in " ".join(found.text.replace("\n# ", " ").split())
    assert found.draft.turned == (said,)
    assert not any("not used" in note for note in found.draft.notes)
    assert found.config == dropo.make_config(yaml.safe_load(found.text), base=tmp_path)
    log = dropo.make_problem(found.config).trajectories
    read = {label: log.observations[:, i] for i, label in enumerate(found.labels)}
    quaternion = np.stack([read[f"hull_free.position[q{axis}]"] for axis in "wxyz"], axis=1)
    t, q, v, _ = floated()
    near = [int(np.abs(v[:, 3:] - row).sum(axis=1).argmin()) for row in rates_of(read)]
    wrong = Rotation.from_quat(quaternion, scalar_first=True) * Rotation.from_quat(q[near, 3:], scalar_first=True).inv()
    assert len(near) > 0.8 * len(t)
    assert np.median(wrong.magnitude()) < 0.02


@pytest.mark.parametrize("wrong", ["linear", "angular", "neither"])
def test_velocities_along_other_axes_are_not_taken_for_the_models(wrong: str, tmp_path: Path) -> None:
    """An odometry's twist is in the body's frame, and a motion capture's angular velocity in the world's."""
    t, q, v, u = floated()
    turns, names = (
        Rotation.from_quat(q[:, 3:], scalar_first=True),
        [f"{a}.{b}" for a in ("linear", "angular") for b in "xyz"],
    )
    frame = {"t": t} | dict(zip(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"), q.T, strict=True))
    told = np.hstack([
        turns.inv().apply(v[:, :3]) if wrong == "linear" else v[:, :3],
        turns.apply(v[:, 3:]) if wrong == "angular" else v[:, 3:],
    ]) + 1e-3 * np.random.default_rng(3).standard_normal((len(t), 6))  # fmt: skip
    frame |= {f"twist.{name}": column for name, column in zip(names, told.T, strict=True)}
    frame |= {"surge_cmd": u[:, 0], "turn_cmd": u[:, 1]}
    found = dropo.propose_config(*written(tmp_path, frame, FLOATING), out=tmp_path / "robot.yaml")
    label = {m.column.entry: m.place.label for m in found.matching.matches}
    own = {f"twist.{name}": f"hull_free.velocity[{'v' if name[0] == 'l' else 'w'}{name[-1]}]" for name in names}
    assert {c: p for c, p in label.items() if c in own} == {c: p for c, p in own.items() if wrong not in c}
    assert ("along other axes than the model's" in " ".join(found.draft.notes)) == (wrong != "neither")


def rates_of(read: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([read[f"hull_free.velocity[w{axis}]"] for axis in "xyz"], axis=1)


@pytest.mark.parametrize(
    ("sequence", "told"),
    [
        ("xyz", "the fixed axes x, y, z"),
        ("XYZ", "axes that turn with it, x, y, z"),
        ("zyx", "the fixed axes z, y, x"),
        ("ZYX", "axes that turn with it, z, y, x"),
    ],
)
def test_a_gyroscope_tells_the_sequence_of_angles(sequence: str, told: str, tmp_path: Path) -> None:
    """Angles without one are roll, pitch and yaw as everybody's are; of others the config says why."""
    frame = rolled_pitched_yawed(("roll_deg", "pitch_deg", "yaw_deg"), 1 / DEG, sequence)
    files = written(tmp_path, frame, FLOATING)
    found = read_turned(files)
    assert found[0].sequence == sequence
    assert told in found[0].said_of("hull")
    assert ("as the gyroscope shows" in found[0].said_of("hull")) == (sequence != "xyz")
    for axis in "xyz":
        del frame[f"gyro_{axis}_dps"]
    assert read_turned(written(tmp_path, frame, FLOATING))[0].sequence == "xyz"


def read_turned(files: Sequence[str]) -> tuple[Angles, ...]:
    """The angles in a log that may be orientations of a model."""
    model = load_model(Path(files[0]))
    columns = read_columns(files[1], known_names(model))
    return find_angles(columns, model, np.arange(len(columns)) == 0)


def test_angles_that_are_no_orientation_stay_what_they_are(tmp_path: Path) -> None:
    """Commands, rates, the model's own hinges, and angles beside a quaternion."""
    angles = ("roll", "pitch", "yaw")
    frame = rolled_pitched_yawed(angles)
    others = [f"{name}_{what}" for what in ("cmd", "rate", "des", "vel") for name in angles]
    assert len(read_turned(written(tmp_path, frame | dict.fromkeys(others, frame["roll"]), FLOATING))) == 1
    quaternion = {f"mocap_q{axis}": np.full(len(frame["t"]), 0.5) for axis in "wxyz"}
    assert not read_turned(written(tmp_path, frame | quaternion, FLOATING))
    hinges = "".join(f'<body><joint name="{name}"/><geom size=".1"/></body>' for name in angles)
    own = FLOATING.replace("</worldbody>", f"{hinges}</worldbody>")
    assert not read_turned(written(tmp_path, frame, own))
    gimbal = own.replace('name="roll"', 'name="gimbal_roll"').replace('name="pitch"', 'name="gimbal_pitch"')
    gimbal = gimbal.replace('name="yaw"', 'name="gimbal_yaw"')
    both = frame | {f"gimbal_{name}": frame[name] for name in angles}
    (found,) = read_turned(written(tmp_path, both, gimbal))
    assert [c.entry for c in found.columns] == list(angles)
    hinged = "<mujoco><worldbody>" + hinges + "</worldbody></mujoco>"
    plain = {"t": frame["t"]} | {name: np.sin((i + 1) * frame["t"]) for i, name in enumerate(angles)}
    label = matched(tmp_path, plain, hinged)
    assert [label.get(f"{name}.position") for name in angles] == list(angles)


PLANAR = """
<mujoco><worldbody><body name="body0">
  <joint name="rootx" type="slide" axis="1 0 0"/><joint name="rootz" type="slide" axis="0 0 1"/>
  <joint name="rooty" axis="0 1 0"/><geom size=".1" mass="1"/>
  <body><joint name="hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("base", ["base_", "torso_", ""])
def test_columns_of_the_base_are_the_joints_by_which_all_of_a_robot_moves(tmp_path: Path, base: str) -> None:
    """Whatever a planar base is called, its axes and its pitch tell which is which, in any order."""
    names = [f"{base}{n}" for n in ("z", "pitch", "x")] + ["hip_q"]
    names += [f"{base}{n}_vel" for n in ("z", "pitch", "x")] + ["hip_dq"]
    files = written(tmp_path, dict(zip(names, np.random.default_rng(0).standard_normal((8, 9)), strict=True)), PLANAR)
    columns, places = (
        read_columns(files[1], ["rootx", "rootz", "rooty", "hip"]),
        places_of(mujoco.MjModel.from_xml_string(PLANAR)),
    )
    found = match_columns(columns, places, np.arange(9) == 0, ())
    label = {m.column.entry: m.place.label for m in found.matches}
    for name, joint in (("x", "rootx"), ("z", "rootz"), ("pitch", "rooty")):
        assert label[f"{base}{name}"] == f"{joint}.position"
        assert label[f"{base}{name}_vel"] == f"{joint}.velocity"


DROP = """
<mujoco><option timestep=".001"/>
  <worldbody><geom type="plane" size="9 9 1" solref=".01 .3"/>
    <body name="ball" pos="0 0 .3"><freejoint name="ball"/>
      <geom type="sphere" size=".05" mass=".2" solref=".01 .3"/></body>
  </worldbody></mujoco>"""


def test_derived_velocities_are_compared_nowhere(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """They say nothing that positions do not, and at an impact within a row a difference of these is no velocity."""
    model, rng = mujoco.MjModel.from_xml_string(DROP), np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = [0.3, 0.2, 0, 1, -2, 0.5]
    for _ in range(200):
        rows.append([data.time, *data.qpos[:3] + 3e-4 * rng.standard_normal(3), *data.qpos[3:]])
        mujoco.mj_step(model, data, 10)
    names = ("t", *(f"ball_p{axis}" for axis in "xyz"), *(f"ball_q{axis}" for axis in "wxyz"))
    frame = dict(zip(names, np.array(rows).T, strict=True))
    found = dropo.propose_config(*written(tmp_path, frame, DROP), out=tmp_path / "robot.yaml")
    assert found.document["mask"] == [f"ball.velocity[{kind}{axis}]" for kind in "vw" for axis in "xyz"]
    assert "derived velocities say where windows begin, and are compared nowhere" in found.draft.notes
    t, q, _, u = log
    frame = {"t": t, "x": q[:, 0], "theta": q[:, 1], "u": u[:, 0]}  # nothing touches
    found = dropo.propose_config(*written(tmp_path, frame), out=tmp_path / "robot.yaml")
    assert found.document["mask"] == [f"{joint}.velocity" for joint in ("slider", "hinge")]


@pytest.mark.parametrize("name", sorted(UNSEEN))
def test_columns_of_robots_with_logs_of_all_kinds_are_matched(name: str, tmp_path: Path) -> None:
    """An azimuth may be called az, and a free body otherwise in the log."""
    path, log = write(UNSEEN[name], tmp_path, 5, 4.0)
    model = load_model(path)
    columns = read_columns(log, known_names(model))
    robot = propose._robot(model, path, tmp_path / "robot.yaml", columns)
    matching = propose._reading(robot, columns, None, None).matching
    assert len(matching.of("position")) >= len(UNSEEN[name].log.positions)


RAIL = """
<mujoco><option timestep=".002" integrator="implicitfast"/>
  <worldbody><body name="cart">
    <joint name="slider" type="slide" axis="1 0 0" range="-.4 .4" damping="2" frictionloss="1.5" solreflimit=".03 1"/>
    <geom type="box" size=".1 .05 .04" mass="1.5" contype="0"/>
    <body name="pole"><joint name="hinge" axis="0 1 0" damping=".004"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".01" mass=".3" contype="0"/></body></body></worldbody>
  <actuator><motor name="push" joint="slider"/></actuator></mujoco>"""
COUNTS = np.array([2e-4, 2 * np.pi / 2048])


def rolled(folder: Path, force: float) -> tuple[Path, Path]:
    """Write the log of a cart whose encoders count, and which meets the ends of its rail if the force is large."""
    model, rng, rows = mujoco.MjModel.from_xml_string(RAIL), np.random.default_rng(12), []
    for episode in range(4):
        data, phase = mujoco.MjData(model), rng.uniform(0, 6, 2)
        data.qpos[:] = rng.uniform(-0.2, 0.2), rng.uniform(-0.5, 0.5)
        for _ in range(500):
            wave = np.sin(2 * np.pi * 0.4 * data.time + phase[0]) + 0.6 * np.sin(2 * np.pi * 0.9 * data.time + phase[1])
            data.ctrl[0] = force * wave - 10 * data.qpos[0]
            rows.append([episode, data.time, *np.round(data.qpos / COUNTS) * COUNTS, data.ctrl[0]])
            mujoco.mj_step(model, data, 5)
    frame = dict(zip(("episode", "t", "slider", "hinge", "push"), np.array(rows).T, strict=True))
    return written(folder, frame, RAIL)


@pytest.mark.parametrize("force", [7.0, 2.0])
def test_a_right_model_is_right_although_encoders_count_and_stops_are_struck(tmp_path: Path, force: float) -> None:
    found = dropo.propose_config(*rolled(tmp_path, force), out=tmp_path / "robot.yaml")
    assert (np.array(found.document["noise"][:2]) >= 0.999 * COUNTS / np.sqrt(12)).all()
    (tmp_path / "robot.yaml").write_text(found.text)
    problem = dropo.make_problem(dropo.load_config(tmp_path / "robot.yaml"), general=True)
    assert find_gap(as_given(problem)).verdict == "no gap"


def _capsule_inertia(model: mujoco.MjModel) -> float:
    """Inertia of the arm's only body about its center of mass, about the axis of its joint."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[1])
    axis = turn.reshape(3, 3)[1]
    return float((model.body_inertia[1] * axis**2).sum())


def test_what_is_not_used_is_said(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """A column that is nothing of the model's, and a hole in another, are no silent matter."""
    t, q, v, u = log
    theta = q[:, 1].copy()
    theta[40] = np.nan
    frame = {"t": t, "x": q[:, 0], "theta": theta, "x_dot": v[:, 0], "theta_dot": v[:, 1], "u": u[:, 0]}
    for name in ("pressure", "acc_y", "motor_current"):
        frame[name] = np.random.default_rng(1).standard_normal(len(t))
    found = dropo.propose_config(*written(tmp_path, frame), out=tmp_path / "robot.yaml")
    assert "not used, for nothing of the model is called so: pressure" in found.draft.notes
    assert "not used, for the motion tells accelerations: acc_y" in found.draft.notes
    assert "not used, for commands are known: motor_current" in found.draft.notes
    assert any(note.endswith("short gaps are bridged: 1 of theta") for note in found.draft.notes)


#: Two links with servos, and no ranges.
SERVOS = """<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body><joint name="lift" axis="0 1 0" damping=".1" armature=".01"/>
    <geom type="capsule" fromto="0 0 0 0 0 .12" size=".015" mass=".15"/>
    <body pos="0 0 .12"><joint name="bend" axis="0 1 0" damping=".1" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 .12 0 0" size=".015" mass=".12"/></body></body></worldbody>
  <actuator><position name="lift" joint="lift" kp="20" kv=".8"/><position name="bend" joint="bend" kp="20" kv=".8"/>
  </actuator></mujoco>"""


@pytest.mark.parametrize("in_degrees", [("pos",), ("pos", "goal"), ()])
def test_targets_are_in_degrees_with_their_angles_if_the_model_says_so(
    in_degrees: tuple[str, ...], tmp_path: Path
) -> None:
    """No range and no name tells it; and what the filter leaves of the noise is told in radians."""
    model = mujoco.MjModel.from_xml_string(SERVOS)
    t, q, _, u = recorded(
        model, 20, 10, lambda t: [0.6 * math.sin(7 * t), 0.5 * math.sin(4.1 * t) + 0.2], noise=(2e-3, 0)
    )
    turned = {kind: DEG if kind in in_degrees else 1.0 for kind in ("pos", "goal")}
    frame = {"time": t}
    for i, name in enumerate(("lift", "bend")):
        frame |= {f"{name}.pos": turned["pos"] * q[:, i], f"{name}.goal": turned["goal"] * u[:, i]}
    found = dropo.propose_config(*written(tmp_path, frame, SERVOS), out=tmp_path / "robot.yaml")
    scale = {f"{name}.{kind}": pytest.approx(1 / DEG) for kind in in_degrees for name in ("lift", "bend")}
    assert found.document["data"].get("scale", {}) == scale
    told = [note.endswith("so are the targets lift.goal, bend.goal") for note in found.draft.notes]
    assert any(told) == ("goal" in in_degrees)
    assert (found.noise[:2] < 5e-3).all()


@pytest.mark.parametrize("ratio", [50, 9])
def test_angles_of_motors_are_divided_by_their_gears(ratio: int, tmp_path: Path) -> None:
    """One of 50 is about as many as a radian has degrees; rates that are called rpm are in no other unit."""
    motors = "".join(f'<motor name="{n}_motor" joint="{n}" gear="{ratio}"/>' for n in ("lift", "bend"))
    xml = SERVOS[: SERVOS.index("<actuator>")] + f"<actuator>{motors}</actuator></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    t, q, v, u = recorded(
        model, 20, 10, lambda t: [0.9 / ratio * math.sin(7 * t), 0.5 / ratio * math.sin(4.1 * t)], noise=(1e-5, 1e-3)
    )
    frame = {"time": t}
    for i, name in enumerate(("lift", "bend")):
        frame |= {
            f"{name}_pos": ratio * q[:, i], f"{name}_rpm": ratio * v[:, i] * 30 / np.pi, f"{name}_motor_torque": u[:, i]
        }  # fmt: skip
    found = dropo.propose_config(*written(tmp_path, frame, xml), out=tmp_path / "robot.yaml")
    scale = found.document["data"]["scale"]
    assert scale["bend_pos"] == pytest.approx(1 / ratio)
    assert scale["bend_rpm"] == pytest.approx(1 / ratio)
    assert any(note.startswith("motor_side") for note in found.draft.notes)


def test_text_in_a_few_cells_is_not_measured(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """A sensor that reports an error once has a column of numbers; one that mostly does has none."""
    t, q, v, u = log
    frame = {
        "time": t, "x": q[:, 0], "theta": q[:, 1], "x_dot": v[:, 0], "theta_dot": v[:, 1], "force_cmd": u[:, 0],
        "x_state": v[:, 0],
    }  # fmt: skip
    files = written(tmp_path, frame)
    cells = pd.read_csv(files[1], dtype=str)
    cells.loc[[70, 90], "theta_dot"] = "ERR"
    cells.loc[cells.index % 3 > 0, "x_state"] = "OK"
    cells.to_csv(files[1], index=False)
    proposal = dropo.propose_config(*files, out=tmp_path / "robot.yaml")
    assert proposal.matching.at("hinge.velocity") is not None
    told = [note for note in proposal.draft.notes if "not measured" in note]
    assert len(told) == 1
    assert told[0].endswith("2 of theta_dot; theta_dot is 'ERR' at row 70 (counted from 0)")
    columns = read_columns(files[1])
    (states,) = (c for c in columns.columns if c.entry == "x_state")
    assert not states.values.size


def comments(config: str) -> dict[str, str]:
    """What the comments of a config say that columns are, by column."""
    lines = [
        line.removeprefix("# ").split(" is ", 1) for line in config.splitlines() if "# " in line and " is " in line
    ]
    return {column: rest for column, rest in lines if ", by " in rest}


def test_comments_tell_columns_as_the_config_reads_them(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """A cure of the examination moves a column or gives it another unit, and the comment says where it then is."""
    t, q, v, u = log
    frame = {"time": t, "x": q[:, 0], "theta": v[:, 1], "x_dot": v[:, 0], "theta_dot": q[:, 1], "force_cmd": u[:, 0]}
    proposal = dropo.propose_config(*written(tmp_path, frame), out=tmp_path / "robot.yaml")
    entries = [e if isinstance(e, str) else e["signal"] for e in proposal.document["data"]["observations"]]
    read = dict(zip(entries, proposal.document["observation"], strict=True))
    assert read["theta"] == "hinge.velocity"
    told = comments(proposal.text)
    assert {c: told[c].split(" in ")[0] for c in read} == read
    assert told["theta"].startswith("hinge.velocity in rad/s: ")
    assert told["theta_dot"].startswith("hinge.position in rad: ")
    assert [m.place.label for m in proposal.matching.matches][:4] == [
        "slider.position", "hinge.position", "slider.velocity", "hinge.velocity",
    ]  # fmt: skip


def test_even_rows_of_a_rate_that_the_model_has_not_stay_as_they_are(tmp_path: Path) -> None:
    """Thirty rows a second are no whole number of steps of 5 ms: resampled, rows would see parts of two commands."""
    model = mujoco.MjModel.from_xml_string(CARTPOLE)
    model.opt.timestep = 1 / 1200
    data, rng = mujoco.MjData(model), np.random.default_rng(4)
    rows = []
    for row in range(400):
        command = 0.6 * np.sin(0.35 * row) + 0.3 * rng.standard_normal()
        rows.append([row / 30, *data.qpos, *data.qvel, command])
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 40)
    log = dict(zip(("time", "x", "theta", "x_dot", "theta_dot", "u"), np.array(rows).T, strict=True))
    found = dropo.propose_config(*written(tmp_path, log), out=tmp_path / "robot.yaml")
    copy = mujoco.MjModel.from_xml_path(str(tmp_path / "robot_step.xml"))
    assert (found.document["model"], found.document["frame_skip"]) == ("robot_step.xml", 7)
    assert copy.opt.timestep == pytest.approx(1 / 210, rel=1e-5)  # no coarser than the model's
    assert "preprocess" not in found.document["data"]
    assert any("no whole number" in note and "robot_step.xml" in note for note in found.draft.notes)
    resampled = {"dt": 0.035, "velocities": ["x_dot", "theta_dot"], "actions": "mean"}
    other = {**found.document, "model": "robot.xml", "data": {**found.document["data"], "preprocess": resampled}}
    errors = []
    for document in (found.document, other):
        problem = dropo.make_problem(dropo.make_config(document, base=tmp_path))
        simulated = problem.objective.simulated(problem.space.nominal[None])[:, 0]
        errors.append(float((simulated - problem.objective.measured)[:, 2].std()))
    assert errors[0] < 0.1 * errors[1]


def test_a_urdf_without_actuators_gets_motors_for_the_efforts_of_a_log(tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_string(URDF)
    for joint in ("arm_joint1", "arm_joint2"):
        spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model = spec.compile()
    t, q, v, u = recorded(model, 4, 5, lambda s: [3 * math.sin(4 * s), math.sin(7 * s)])
    frame = {"stamp": t} | {
        f"{what}[{i}]": values[:, i] for what, values in (("position", q), ("velocity", v), ("effort", u))
        for i in range(2)
    }  # fmt: skip
    robot, data = written(tmp_path, frame, URDF, "robot.urdf")
    found = dropo.propose_config(robot, data, out=tmp_path / "robot.yaml")
    assert found.document["model"] == "robot_motors.xml"
    assert [m.column.entry for m in found.matching.of("command")] == ["effort[0]", "effort[1]"]
    assert dropo.make_problem(found.config).space.names
    assert yaml.safe_load(found.text) | {"seed": 0} == found.document


def test_a_passive_motion_tells_ratios_only(tmp_path: Path) -> None:
    xml = CARTPOLE.replace('<joint name="slider" type="slide" axis="1 0 0"/>', "").partition("<actuator>")[0]
    xml += "</mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    model.joint("hinge").damping[0] = 0.004
    t, q, v, _ = recorded(model, 6, 4, lambda s: [], start=[1.2])
    robot, data = written(tmp_path, {"t": t, "hinge": q[:, 0], "hinge_rate": v[:, 0]}, xml)
    found = dropo.propose_config(robot, data, out=tmp_path / "robot.yaml")
    states = {told.candidate.name: told.state for told in found.choice.told}
    assert states["hinge_damping"] in ("chosen", "stands for")
    assert "chosen" not in (states["pole_mass"], states["pole_centre_z"]) or found.choice.groups
    assert states["pole_centre_y"] == "unseen"


@pytest.mark.parametrize(
    ("renamed", "words"),
    [
        ({"theta": ""}, ("no column is hinge.position", "every column of numbers is something else already")),
        ({"force_cmd": "light"}, ("command of push", "(there are: light)")),
        ({"time": "row", "x_dot": "", "theta_dot": ""}, ("--dt SECONDS",)),
    ],
)
def test_what_a_log_lacks_is_named_with_what_it_has(
    renamed: dict[str, str], words: tuple[str, ...], tmp_path: Path, log: tuple[np.ndarray, ...],
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    t, q, v, u = log
    frame = {
        "time": t, "x": q[:, 0], "theta": q[:, 1], "x_dot": v[:, 0], "theta_dot": v[:, 1], "force_cmd": u[:, 0]
    }  # fmt: skip
    if "time" in renamed:
        frame["time"] = np.arange(len(t))
    named = {renamed.get(name, name): values for name, values in frame.items()}
    files = written(tmp_path, {name: values for name, values in named.items() if name})
    assert main(["init", *files, "--out", str(tmp_path / "robot.yaml")]) == 2
    _, error = capfd.readouterr()
    assert error.count("\n") == 1
    assert all(word in error for word in words), error
    assert not (tmp_path / "robot.yaml").exists()


def test_a_body_without_an_orientation_in_the_log_is_named_with_what_to_do(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nobody who has a ball knows of a joint that has no name."""
    xml = '<mujoco><worldbody><body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    frame = {"time": 0.02 * np.arange(200)} | swung(["ball_x", "ball_y", "ball_z", "throw"])
    assert main(["init", *written(tmp_path, frame, xml), "--out", str(tmp_path / "robot.yaml")]) == 2
    error = capfd.readouterr().err
    assert (
        "the orientation of ball is not in the log; log it as ball_qw, ball_qx, ball_qy, ball_qz, or as ball_roll, "
        in error
    )
    assert "three slides" in error
    assert "joint0" not in error
    del frame["ball_z"]
    assert main(["init", *written(tmp_path, frame, xml), "--out", str(tmp_path / "robot.yaml")]) == 2
    assert "no column is ball.position[z]" in capfd.readouterr().err


def test_a_robot_with_an_imu_and_without_a_position_is_told_of_sensors(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    xml = '<mujoco><worldbody><body name="trunk"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    half = 0.2 * np.sin(TIME)
    frame = {"time": TIME, "imu_qw": np.cos(half), "imu_qx": np.sin(half), "imu_qy": 0 * half, "imu_qz": 0 * half}
    frame |= {f"gyro_{axis}": np.gradient(2 * half, TIME) * (axis == "x") for axis in "xyz"}
    assert main(["init", *written(tmp_path, frame, xml), "--out", str(tmp_path / "robot.yaml")]) == 2
    error = capfd.readouterr().err
    assert "where trunk is, is not in the log; log it as trunk_px, trunk_py, trunk_pz" in error
    assert "sensor[gyro]" in error
    assert "orientation" not in error


def test_what_a_column_was_found_by_is_said_once(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    t, q, v, u = log
    frame = {"time": t, "x": q[:, 0], "theta": q[:, 1], "spin": v[:, 1], "force_cmd": u[:, 0]}
    model = cartpole()
    pd.DataFrame(frame).to_csv(tmp_path / "log.csv", index=False)
    columns = read_columns(tmp_path / "log.csv", ["slider", "hinge"])
    starts = np.arange(len(t)) == 0
    found = match_columns(columns, places_of(model), starts, [c for c in columns.columns if c.entry == "time"])
    spun = found.at("hinge.velocity")
    assert spun is not None
    assert spun.why.startswith("its motion (r²")


def test_an_interactive_run_takes_corrections(
    tmp_path: Path, log: tuple[np.ndarray, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    from rich.prompt import FloatPrompt, Prompt

    t, q, v, u = log
    files = written(tmp_path, {
        "time": t, "x": q[:, 0], "colour": q[:, 1], "x_dot": v[:, 0], "theta_dot": v[:, 1], "force_cmd": u[:, 0]
    })  # fmt: skip
    answers = iter(["hinge.position", "colour", "", "-pole_centre_x"])
    monkeypatch.setattr(Prompt, "ask", lambda *_, **__: next(answers))
    monkeypatch.setattr(FloatPrompt, "ask", lambda *_, default, **__: default)
    path = tmp_path / "robot.yaml"
    assert main(["init", *files, "--out", str(path), "--interactive"]) == 0
    document = yaml.safe_load(path.read_text())
    assert document["data"]["observations"][1] == "colour"
    assert "pole_centre_x" not in document["parameters"]


# --- logs whose signals have names, and stamps, of their own ---


def test_a_bag_tells_joints_by_name_and_commands_by_receipt(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    pytest.importorskip("rosbags")
    import bags

    t, q, v, u = log
    made = bags.Messages()
    rows = {float(time): row for row, time in enumerate(t)}

    def state(time: float) -> object:
        row = rows[time]
        names, order = ["hinge", "slider"], [1, 0]
        return made.joint_state(bags.START + time, names, q[row][order], v[row][order])

    sent = bags.sent("/joint_states", "sensor_msgs/msg/JointState", rows, state)
    sent += bags.sent("/push_controller/commands", "std_msgs/msg/Float64MultiArray", rows,
                      lambda time: made.numbers(u[rows[time]]), late=0.0)  # fmt: skip
    bag = bags.write(tmp_path / "log", sent)
    (tmp_path / "robot.xml").write_text(CARTPOLE)
    found = dropo.propose_config(tmp_path / "robot.xml", bag, out=tmp_path / "robot.yaml")
    data = found.document["data"]
    assert data["observations"] == [
        "/joint_states.position[slider]", "/joint_states.position[hinge]", "/joint_states.velocity[slider]",
        "/joint_states.velocity[hinge]",
    ]  # fmt: skip
    assert data["actions"] == ["/push_controller/commands.data[0]"]
    assert data["stamps"] == {"/push_controller/commands": "received"}
    assert data["preprocess"]["dt"] == pytest.approx(0.02)
    assert len(dropo.make_problem(found.config).trajectories) > 300


def test_a_bag_with_a_clock_follows_simulated_time(tmp_path: Path, log: tuple[np.ndarray, ...]) -> None:
    """Stamps of a simulator begin at zero, and wall time runs faster; commands come more often than states."""
    pytest.importorskip("rosbags")
    import bags

    t, q, v, u = log
    made = bags.Messages()
    every = 0.005 * np.arange(4 * len(t) - 4)
    rows = {float(time): row for row, time in enumerate(t)}

    def wall(simulated: float) -> float:
        return bags.START + 1.2 * simulated

    sent = [
        ("/joint_states", "sensor_msgs/msg/JointState", wall(time),
         made.joint_state(3.0 + time, ["slider", "hinge"], q[row], v[row])) for time, row in rows.items()
    ]  # fmt: skip
    sent += [
        ("/push_controller/commands", "std_msgs/msg/Float64MultiArray", wall(time), made.numbers(u[i // 4]))
        for i, time in enumerate(every)
    ]
    sent += [
        ("/clock", "rosgraph_msgs/msg/Clock", wall(time), made.new("rosgraph_msgs/msg/Clock", made.time(3.0 + time)))
        for time in every
    ]
    (tmp_path / "robot.xml").write_text(CARTPOLE)
    columns = read_columns(bags.write(tmp_path / "log", sent))
    assert columns.apart == pytest.approx(0.02)
    assert columns.stamps == {"/push_controller/commands": "/clock"}
    (command,) = (c for c in columns.columns if c.words.role == "command")
    assert float(np.abs(command.values[5:-5] - u[5 : len(columns) - 5, 0]).max()) < 0.2


def test_columns_of_a_dataset_have_names(tmp_path: Path) -> None:
    from test_readers import write_lerobot

    folder, _ = write_lerobot(tmp_path)
    columns = read_columns(folder)
    known = {c.entry: c.words for c in columns.columns}
    assert known["observation.state[elbow.pos]"].role == "position"
    assert known["observation.state[elbow.vel]"].objects == ("elbow",)
    clock = find_clock(columns, 0.005)
    assert clock.column is not None
    assert clock.column.entry == "timestamp"
    assert clock.episode is not None
    assert clock.episode.entry == "episode_index"


def test_the_point_at_which_a_log_is_asked_is_the_models() -> None:
    """Values of logarithmic parameters by their logarithms; within the search box, where the model is outside of it."""
    entries = {"field": "body_mass", "name": "cart"}
    model = cartpole()
    boxes = {"inside": [0.5, 5.0], "above": [0.5, 1.2], "below": [2.0, 5.0]}
    for (where, bounds), scale in itertools.product(boxes.items(), ("linear", "log")):
        space = ParameterSpace(model, {"mass": {**entries, "bounds": bounds, "scale": scale}})
        found = nominal_point(SimpleNamespace(simulator=SimpleNamespace(parameters=space)))  # type: ignore[arg-type]
        expected = {"inside": 1.3, "above": 1.2, "below": 2.0}[where]
        assert found == pytest.approx(np.log(expected) if scale == "log" else expected)


def test_a_config_that_exists_is_kept_unless_told_otherwise(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "robot.yaml"
    out.write_text("mine")
    assert main(["init", "robot.xml", "log.csv", "--out", str(out)]) == 2
    assert capfd.readouterr().err == f"dropo: --out: {out} already exists; choose another name or pass --overwrite\n"
    assert out.read_text() == "mine"


def test_the_noise_of_an_orientation_is_told_as_that_of_its_angular_velocity() -> None:
    rate, cutoff, size, rows = 100.0, 18.0, 1e-3, 20_000
    turn = size * np.random.default_rng(0).normal(size=(rows, 3))  # small rotations: a quaternion has half of each
    density = {f"base.position[q{axis}]": (size / 2) ** 2 / (rate / 2) for axis in "xyz"} | {"base.position[qw]": 0.0}
    frequency = np.fft.rfftfreq(rows, 1 / rate)[:, None]
    kept = np.where(frequency <= cutoff, np.fft.rfft(turn, axis=0), 0.0)
    rates = np.fft.irfft(2j * np.pi * frequency * kept, rows, axis=0)
    assert Filter(cutoff, density).turning_noise("base") == pytest.approx(rates.std(), rel=0.03)
    assert Filter(cutoff, density).turning_noise("other") == 0.0


def test_commands_by_a_clock_of_their_own_are_put_back(tmp_path: Path) -> None:
    """A controller at 30 Hz beside rows at 100 Hz: whether or not anything else needs resampling."""
    model = mujoco.MjModel.from_xml_string(CLOCKED)
    data, rng, rows, told = mujoco.MjData(model), np.random.default_rng(0), [], 0.0
    for i in range(6000):
        if i % 33 == 0:
            told = rng.uniform(-1, 1)
        data.ctrl[0] = told
        if i % 10 == 0:
            rows.append([data.time, data.qpos[0], data.qvel[0], told])
        mujoco.mj_step(model, data)
    frame = pd.DataFrame(rows, columns=["time", "slide_pos", "slide_vel", "push_cmd"])
    found = dropo.propose_config(*written(tmp_path, frame, CLOCKED), out=tmp_path / "robot.yaml")
    assert found.draft.document["data"]["preprocess"]["command_clock"] is True
    assert any("commands change every 0.033 s" in note for note in found.draft.notes)
    stamps = (pd.Timestamp("2025-03-11") + pd.to_timedelta(frame["time"], unit="s")).dt.strftime(
        "%Y-%m-%dT%H:%M:%S.%fZ"
    )
    dated = dropo.propose_config(
        *written(tmp_path, frame.assign(time=stamps), CLOCKED), out=tmp_path / "dated.yaml"
    ).draft.document
    assert dated["data"]["time"] == "time"
    assert dated["data"]["preprocess"]["command_clock"] is True
    frame["push_cmd"] = np.repeat(rng.uniform(-1, 1, 200), 3)
    steady = dropo.propose_config(*written(tmp_path, frame, CLOCKED), out=tmp_path / "steady.yaml")
    assert "command_clock" not in steady.draft.document["data"].get("preprocess", {})


CLOCKED = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="slide" type="slide" axis="1 0 0"/>
  <geom size=".1"/></body></worldbody><actuator><motor name="push" joint="slide" gear="5"/></actuator></mujoco>"""


@pytest.mark.parametrize("comment", ["# of 3 May\n# {}\n", "% {}\n", "// of 3 May, at noon\n{}\n"])
def test_blanks_may_separate_columns_that_a_comment_names(comment: str, tmp_path: Path) -> None:
    t = np.arange(400) * 0.01
    data, model = mujoco.MjData(compiled := mujoco.MjModel.from_xml_string(CLOCKED)), tmp_path / "robot.xml"
    rows = []
    for i in t:
        data.ctrl[0] = np.sin(7 * i)
        rows.append([i, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(compiled, data, 10)
    model.write_text(CLOCKED)
    with (tmp_path / "log.txt").open("w") as file:
        file.write(comment.format("time  slide_pos slide_vel   push_cmd"))
        np.savetxt(file, rows, fmt="%.9g")
    found = dropo.propose_config(model, tmp_path / "log.txt", out=tmp_path / "robot.yaml").draft
    assert found.document["data"]["separator"] == " "
    np.testing.assert_allclose(found.logged.trajectories.observations, np.array(rows)[:-1, 1:3], rtol=1e-8)


def test_columns_of_decimal_commas_are_told_as_text(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    frame = {"time": np.arange(50) * 0.01, "slide_pos": [f"0,{i:03d}" for i in range(50)], "push_cmd": np.ones(50)}
    assert main(["init", *written(tmp_path, frame, CLOCKED), "--out", str(tmp_path / "robot.yaml")]) == 2
    assert "these hold text, and no numbers: slide_pos such as '0,000'" in capfd.readouterr().err


def test_beside_what_was_measured_a_lone_d_is_desired(tmp_path: Path) -> None:
    """``tau_d`` beside ``tau`` is the command; ``hinge_d`` beside ``hinge`` is its derivative."""
    model = mujoco.MjModel.from_xml_string(CARTPOLE)
    t, q, v, u = recorded(model, 6, 4, lambda s: [3 * math.sin(4 * s) + math.sin(9 * s)])
    noise = 0.3 * np.random.default_rng(0).standard_normal(len(t))
    frame = {"t": t, "slider": q[:, 0], "hinge": q[:, 1], "slider_d": v[:, 0], "hinge_d": v[:, 1]}
    frame |= {"tau_J": u[:, 0] + noise, "tau_J_d": u[:, 0]}
    found = dropo.propose_config(*written(tmp_path, frame, CARTPOLE), out=tmp_path / "robot.yaml")
    assert [m.column.entry for m in found.matching.of("command")] == ["tau_J_d"]
    assert [m.column.entry for m in found.matching.of("velocity")] == ["slider_d", "hinge_d"]


def test_what_an_encoder_counts_is_in_no_unit(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(CARTPOLE)
    t, q, _, u = recorded(model, 6, 4, lambda s: [3 * math.sin(4 * s)])
    frame = {"t": t, "slider": q[:, 0], "hinge_ticks": np.round(q[:, 1] * 4096 / (2 * np.pi)), "force": u[:, 0]}
    with pytest.raises(dropo.InputError, match=r"hinge_ticks .hinge.position. is what an encoder counts.*in rad"):
        dropo.propose_config(*written(tmp_path, frame, CARTPOLE), out=tmp_path / "robot.yaml")


def test_an_angle_that_wraps_has_the_noise_of_one_that_does_not(tmp_path: Path) -> None:
    xml = CLOCKED.replace('type="slide" axis="1 0 0"', 'axis="0 0 1" damping="0.5"')
    t, q, _, u = recorded(mujoco.MjModel.from_xml_string(xml), 5, 20, lambda s: [2 + math.sin(2 * s) + math.sin(5 * s)])
    angle = q[:, 0] + 2e-3 * np.random.default_rng(0).standard_normal(len(t))
    known = []
    for name, values in (("whole", angle), ("wrapped", np.mod(angle + np.pi, 2 * np.pi) - np.pi)):
        (tmp_path / name).mkdir()
        frame = {"t": t, "slide_rad": values, "push_cmd": u[:, 0]}
        found = dropo.propose_config(*written(tmp_path / name, frame, xml), out=tmp_path / name / "robot.yaml")
        known.append((found.document["data"]["preprocess"], found.document["noise"]))
    (whole, noise), (wrapped, other) = known
    assert np.ptp(angle) > 4 * np.pi
    assert wrapped["derive"] == whole["derive"] == ["slide_rad"]
    np.testing.assert_allclose(other, noise, rtol=0.05)


def test_odometry_is_of_what_all_of_a_robot_moves_by(tmp_path: Path) -> None:
    xml = """<mujoco><worldbody><body name="car"><joint name="base_x" type="slide" axis="1 0 0" damping="2"/>
      <joint name="base_y" type="slide" axis="0 1 0" damping="2"/><joint name="base_yaw" axis="0 0 1" damping=".3"/>
      <geom size=".1" mass="2"/></body></worldbody><actuator><motor name="push" joint="base_x"/>
      <motor name="turn" joint="base_yaw"/></actuator></mujoco>"""
    t, q, _, u = recorded(mujoco.MjModel.from_xml_string(xml), 5, 5, lambda s: [math.sin(3 * s), 0.1 * math.sin(2 * s)])
    frame = {"time": t, "odom_x": q[:, 0], "odom_y": q[:, 1], "odom_yaw_deg": np.degrees(q[:, 2])}
    frame |= {"push_cmd": u[:, 0], "turn_cmd": u[:, 1]}
    found = dropo.propose_config(*written(tmp_path, frame, xml), out=tmp_path / "robot.yaml")
    assert [m.column.entry for m in found.matching.of("position")] == ["odom_x", "odom_y", "odom_yaw_deg"]


def test_seconds_and_nanoseconds_of_a_header_are_one_clock(tmp_path: Path) -> None:
    t, q, v, u = recorded(mujoco.MjModel.from_xml_string(CARTPOLE), 6, 4, lambda s: [3 * math.sin(4 * s)])
    stamps = np.round((t + 0.37) * 1e9).astype(np.int64)
    frame = {"header.stamp.sec": 1700000000 + stamps // 10**9, "header.stamp.nanosec": stamps % 10**9}
    frame |= {"slider": q[:, 0], "hinge": q[:, 1], "slider_vel": v[:, 0], "hinge_vel": v[:, 1], "force": u[:, 0]}
    found = dropo.propose_config(*written(tmp_path, frame, CARTPOLE), out=tmp_path / "robot.yaml")
    data = found.document["data"]
    assert data["time"] == ["header.stamp.sec", {"signal": "header.stamp.nanosec", "scale": 1e-9}]
    assert "breaks" not in data
    log = dropo.make_problem(found.config).trajectories
    assert (log.num_episodes, len(log)) == (1, len(t) - 1)
    assert log.dt == pytest.approx(t[1] - t[0], rel=1e-4)
