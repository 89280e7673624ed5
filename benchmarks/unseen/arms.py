"""Arms and hands."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from benchmarks.unseen.drives import backlash, gain
from benchmarks.unseen.motions import Waves
from benchmarks.unseen.robot import EULER, IMPLICIT, Command, Hidden, Log, Robot, columns


def row_numbers(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 1000.0 + np.arange(len(times))


def scara_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 4, 0.2, 1.3), np.array([1.1, 1.2, 0.12, 2.5])
    stiff, damp, weight = np.array([260, 90, 900, 2.0]), np.array([32, 9, 90, 0.12]), np.array([0, 0, 18.6, 0])
    data.qpos[:] = 0.1, -0.3, 0, 0.5
    return lambda t, q, v: stiff * (size * waves(t) - q) + damp * (size * waves.slope(t) - v) + weight


SCARA = Robot(
    summary="SCARA arm as a URDF: the elbow's motor gives 82 % of the commanded torque",
    file="scara.urdf",
    start=scara_start,
    log=Log(
        positions=columns("shoulder_pos_deg elbow_pos_deg lift_pos_mm wrist_pos_deg"),
        velocities=columns("shoulder_vel elbow_vel lift_vel wrist_vel"),
        commands=columns("shoulder_torque elbow_torque lift_force wrist_torque"),
        noise=((6e-5, 2e-4, 2e-5, 8e-4), (4e-3, 1e-2, 1e-3, 3e-2)),
        cutoff=50.0,
        time="t",
        decimals=(3, 4),
        extras={"seq": (row_numbers, 0)},
    ),
    hidden=(Hidden((("actuator_gain", "elbow"),), values={"gain": 0.82}, drives={"elbow": gain(0.82)}),),
    motors=("shoulder", "elbow", "lift", "wrist"),
    seconds=22.0,
    warm=0.4,
)


def arm_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 7, 0.15, 0.9), np.array([0.8, 0.5, 0.8, 0.6, 1, 0.7, 1.2])
    data.qpos[:] = posture = np.array([0, 0.4, 0, 1.4, 0, 1.2, 0])
    return lambda t, q, v: posture + size * waves(t)


def loaded_hand(spec: mujoco.MjSpec) -> None:
    load = spec.body("hand").add_body(pos=[0.01, -0.02, 0.1], mass=1.15, explicitinertial=True)
    load.ipos, load.inertia = [0, 0, 0], [1e-6, 1e-6, 1e-6]


def stiff_grease(spec: mujoco.MjSpec) -> None:
    spec.joint("joint4").damping[0] += 7.0


ARM = Robot(
    summary="seven-joint arm with servos: 1.15 kg in the hand, and 7 N·m·s/rad of viscous friction in joint 4",
    file="arm.xml",
    start=arm_start,
    log=Log(
        positions=columns("q1 q2 q3 q4 q5 q6 q7"),
        velocities=columns("dq1 dq2 dq3 dq4 dq5 dq6 dq7"),
        commands=columns("q_des1 q_des2 q_des3 q_des4 q_des5 q_des6 q_des7"),
        noise=(
            (7.5e-5, 7.5e-5, 9e-5, 9e-5, 1.5e-4, 1.5e-4, 2.25e-4),
            (2e-3, 2e-3, 3e-3, 3e-3, 6e-3, 6e-3, 8e-3),
        ),
        decimals=(4, 5),
    ),
    hidden=(
        Hidden(
            (("payload", "hand"),),
            equals=(("payload", "link6"),),
            values={"mass": 1.15, "x": 0.01, "y": -0.02, "z": 0.1},
            edit=loaded_hand,
        ),
        Hidden(
            (("joint_damping", "joint4"), ("actuator_damping", "servo4")),
            values={"damping": 7.0},
            edit=stiff_grease,
        ),
    ),
    beside=(("center_of_mass", "hand"),),
    seconds=17.0,
    warm=0.5,
)


def gripper_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 3, 0.15, 1.2), np.array([0.15, 0.9, 0.02])
    stiff, damp, weight = np.array([900, 3.2, 250]), np.array([90, 0.12, 9]), np.array([31.2, 0, 0])
    last = None

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        nonlocal last
        moved, speed = last or (q[:3], np.zeros(3))
        speed = speed + 0.4 * ((q[:3] - moved) / 0.01 - speed)
        last = (q[:3], speed)
        return stiff * (size * waves(t) - q[:3]) + damp * (size * waves.slope(t) - speed) + weight

    return command


GRIPPER = Robot(
    summary="nothing is missing: gripper with coupled jaws on a lift, encoders only",
    file="gripper.xml",
    start=gripper_start,
    log=Log(
        positions=columns("lift_pos_mm wrist_angle jaw_l_pos_mm jaw_r_pos_mm"),
        velocities=(),
        commands=columns("lift_force wrist_torque jaw_force"),
        noise=((2e-5, 2e-4, 1e-5, 1e-5), (1e-3,) * 4),
        encoder=(5e-5, 2 * math.pi / 16384, 2e-5, 2e-5),
        time="timestamp",
        decimals=(2, 4),
    ),
    step=0.00025,
    integrator=EULER,
    seconds=34.0,
    warm=0.2,
)


def finger_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves = Waves.draw(rng, 2, 0.1, 0.9)
    return lambda t, q, v: np.array([0.013, 0]) + np.array([0.018, 0.3]) * waves(t)


FINGER = Robot(
    summary="finger on a tendon: 3 mm of play in the flexor's winch",
    file="finger.xml",
    start=finger_start,
    log=Log(
        positions=columns("abduction_deg mcp_deg pip_deg dip_deg"),
        velocities=(),
        commands=columns("winch_target_mm abduction_target_deg"),
        noise=((4e-4, 3e-4, 3e-4, 6e-4), (1e-3,) * 4),
        encoder=2 * math.pi / 8192,
        time="time_ms",
        decimals=(0, 3),
    ),
    hidden=(Hidden((("actuator_backlash", "winch"),), values={"width": 0.003}, drives={"winch": backlash(0.003)}),),
    integrator=IMPLICIT,
    seconds=38.0,
    warm=0.5,
)

ROBOTS = (SCARA, ARM, GRIPPER, FINGER)
