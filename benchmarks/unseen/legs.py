"""Legs: one on a boom, four under a body, one of six, and one that a person wears."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from benchmarks.unseen.drives import delay
from benchmarks.unseen.motions import Waves
from benchmarks.unseen.robot import IMPLICIT, Command, Hidden, Log, Robot, columns


def boom_leg_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves = Waves.draw(rng, 2, 0.3, 1.0, 4)
    data.qpos[:] = 0, 0.05, 0.5, -1.0

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        stretched = 0.35 if 1.5 * t % 1.0 < 0.3 else 0.0
        posture = np.array([0.5 - 0.5 * stretched, -1.05 + 1.6 * stretched]) + np.array([0.12, 0.1]) * waves(t)
        return 110 * (posture - q[2:4]) - 2.2 * v[2:4]

    return command


def soft_foot(spec: mujoco.MjSpec) -> None:
    for geom in ("foot", "floor"):
        spec.geom(geom).solref = [0.045, 1.0]


BOOM_LEG = Robot(
    summary="hopping leg on a boom: contact of the foot has a time constant of 45 ms in place of 17.5 ms",
    file="boom_leg.xml",
    start=boom_leg_start,
    log=Log(
        positions=columns("boom_yaw boom_pitch hip knee"),
        velocities=columns("boom_yaw_dot boom_pitch_dot hip_dot knee_dot"),
        commands=columns("hip_torque_cmd knee_torque_cmd"),
        noise=((2e-4, 1e-4, 2e-4, 4e-4), (4e-3, 2e-3, 1e-2, 2e-2)),
        time="t_us",
        decimals=(0, 3),
    ),
    hidden=(
        Hidden(
            (("contact_stiffness", "foot"), ("contact_stiffness", "floor")),
            values={"time_constant": 0.045, "damping_ratio": 1.0},
            edit=soft_foot,
        ),
    ),
    step=0.00025,
    integrator=IMPLICIT,
    row=0.005,
    seconds=13.0,
)


def quadruped_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, posture = Waves.draw(rng, 12, 0.3, 1.2, 4), np.tile([0, 0.75, -1.5], 4)
    data.qpos[2], data.qpos[7:] = 0.335, posture

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        lifted = np.maximum(0, np.sin(2 * math.pi * 1.6 * t + np.array([0, math.pi, math.pi, 0])))
        return posture + 0.07 * waves(t) + np.outer(lifted, [0, 0.25, -0.5]).ravel()

    return command


QUADRUPED = Robot(
    summary="nothing is missing: quadruped with twelve servos, four arrays of a state in an npz",
    file="quadruped.xml",
    start=quadruped_start,
    log=Log(
        positions=("base_pos",) * 3 + ("base_quat",) * 4 + ("joint_pos",) * 12,
        velocities=("base_lin_vel",) * 3 + ("base_ang_vel",) * 3 + ("joint_vel",) * 12,
        commands=("joint_pos_target",) * 12,
        noise=(
            (3e-4, 3e-4, 1.5e-4, 3e-4, 3e-4, 3e-4) + (2e-4,) * 12,
            (6e-3, 6e-3, 6e-3, 5e-3, 5e-3, 5e-3) + (0.02,) * 12,
        ),
        suffix=".npz",
    ),
    step=0.00025,
    integrator=IMPLICIT,
    row=0.02,
    seconds=20.0,
    warm=1.0,
)


def hexapod_leg_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 3, 0.3, 1.6), np.array([0.7, 0.9, 0.9])
    data.qpos[:] = posture = np.array([0, -0.3, 1.2])
    jump = np.array([0, 0.25, 0])
    return lambda t, q, v: posture + size * waves(t) + jump * np.sign(math.sin(2 * math.pi * 0.43 * t))


def weak_femur(spec: mujoco.MjSpec) -> None:
    spec.actuator("femur_servo").forcerange = [-0.62, 0.62]


HEXAPOD_LEG = Robot(
    summary="leg of a hexapod with servos: the femur's gives 0.62 N·m at most",
    file="hexapod_leg.xml",
    start=hexapod_leg_start,
    log=Log(
        positions=columns("coxa_deg femur_deg tibia_deg"),
        velocities=(),
        commands=columns("coxa_goal_deg femur_goal_deg tibia_goal_deg"),
        noise=((5e-4, 5e-4, 8e-4), (1e-3,) * 3),
        encoder=math.radians(0.088),
        time="ms",
        decimals=(0, 2),
    ),
    hidden=(Hidden((("actuator_saturation", "femur_servo"),), values={"limit": 0.62}, edit=weak_femur),),
    integrator=IMPLICIT,
    seconds=38.0,
    warm=0.4,
    hold=2,
)


def exoskeleton_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size, middle = Waves.draw(rng, 2, 0.3, 1.4), np.array([0.45, 0.5]), np.array([0.25, 0.7])
    stiff, damp = np.array([130, 80]), np.array([14, 6])
    data.qpos[:] = 0.2, 0.5, 0

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        weight = np.array([20 * math.sin(q[0]), 0])
        return stiff * (middle + size * waves(t) - q[:2]) + damp * (size * waves.slope(t) - v[:2]) + weight

    return command


def stiff_knee(spec: mujoco.MjSpec) -> None:
    knee = spec.joint("knee_flex")
    knee.stiffness[0], knee.springref = 15.0, math.degrees(0.55)


def muscle(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 0.2 * np.abs(rng.standard_normal(len(times)))


def stride(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 0.7 * times % 1


EXOSKELETON = Robot(
    summary="leg of an exoskeleton: a spring of 15 N·m/rad in the knee, and hip commands that act after 18 ms",
    file="exoskeleton.xml",
    start=exoskeleton_start,
    log=Log(
        positions=columns("hip_flex_q knee_flex_q ankle_q"),
        velocities=columns("hip_flex_dq knee_flex_dq ankle_dq"),
        commands=columns("hip_flex_tau knee_flex_tau"),
        noise=((2e-4, 2e-4, 6e-4), (5e-3, 5e-3, 2e-2)),
        time="t",
        decimals=(2, 3),
        extras={"emg_quad": (muscle, 3), "gait_phase": (stride, 3)},
    ),
    hidden=(
        Hidden((("joint_stiffness", "knee_flex"),), values={"stiffness": 15.0, "reference": 0.55}, edit=stiff_knee),
        Hidden((("actuator_delay", "hip_motor"),), values={"delay": 0.018}, drives={"hip_motor": delay(0.018)}),
    ),
    seconds=26.0,
    warm=0.7,
)

ROBOTS = (BOOM_LEG, QUADRUPED, HEXAPOD_LEG, EXOSKELETON)
