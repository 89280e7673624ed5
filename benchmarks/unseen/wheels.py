"""Robots that roll: three that balance or carry a pendulum, and a rover."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from benchmarks.unseen.drives import deadband
from benchmarks.unseen.motions import Balanced, Waves, roll_pitch_yaw
from benchmarks.unseen.robot import IMPLICIT, Command, Hidden, Log, Robot, columns, pose, quaternion, twist


def ballbot_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    gains = Balanced((2.6, 0.4 * 2.6 * 0.11**2), 0.11, (11.5, 0.6), 0.36).gains([60, 20, 200, 20], 0.6)
    path, shaking = Waves.draw(rng, 2, 0.08, 0.35, 4), Waves.draw(rng, 2, 0.5, 2.5, 4)
    data.qpos[2] = 0.11

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        roll, pitch, yaw = roll_pitch_yaw(q[3:7])
        turned = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        ahead, left = turned @ (q[:2] - 0.7 * path(t))
        forward, sideways = turned @ (v[:2] - 0.7 * path.slope(t))
        torques = gains @ [-left, -sideways, roll, v[3]], gains @ [ahead, forward, pitch, v[4]]
        return np.array(torques) + 0.7 * shaking(t)

    return command


def lean(spec: mujoco.MjSpec) -> None:
    spec.body("torso").ipos = [0.012, 0, 0.36]


BALLBOT = Robot(
    summary="ballbot: the torso's center of mass is 12 mm further to its front",
    file="ballbot.xml",
    start=ballbot_start,
    log=Log(
        positions=pose("base") + columns(quaternion("ball")),
        velocities=twist("base") + columns("ball_wx ball_wy ball_wz"),
        commands=columns("tau_roll tau_pitch"),
        noise=(
            (3e-4, 3e-4, 1e-4, 4e-4, 4e-4, 6e-4, 1e-3, 1e-3, 1e-3),
            (4e-3, 4e-3, 2e-3, 3e-3, 3e-3, 3e-3, 0.02, 0.02, 0.02),
        ),
    ),
    hidden=(Hidden((("center_of_mass", "torso"),), values={"x": 0.012}, edit=lean),),
    beside=(("payload", "torso"),),
    integrator=IMPLICIT,
    seconds=15.0,
    warm=1.0,
)


def balancer_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    wheels, frame = (0.76, 0.5 * 0.76 * 0.08**2 + 0.003), (3.1, 3.1 * (0.26**2 + 0.08**2) / 12)
    gains = Balanced(wheels, 0.08, frame, 0.13).gains([30, 10, 100, 5], 3.0)
    path, shaking = Waves.draw(rng, 2, 0.08, 0.35, 4), Waves.draw(rng, 2, 0.6, 3, 4)
    data.qpos[2] = 0.0799

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        _, pitch, yaw = roll_pitch_yaw(q[3:7])
        ahead = 0.04 * (q[7] + q[8]) + 0.08 * pitch - 1.2 * path(t)[0]
        forward = math.cos(yaw) * v[0] + math.sin(yaw) * v[1] - 1.2 * path.slope(t)[0]
        both = gains @ [ahead, forward, pitch, v[4]] / 2 / 2.4
        turn = 0.08 * (3 * path.slope(t)[1] - v[5])
        return both + np.array([-turn, turn]) + 0.16 * shaking(t)

    return command


def battery(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 12.4 - 0.01 * times + 0.02 * rng.standard_normal(len(times))


BALANCER = Robot(
    summary="robot that balances on two wheels: the right motor does nothing below 5 % of its range",
    file="balancer.xml",
    start=balancer_start,
    log=Log(
        positions=pose("odom") + columns("left_wheel_pos right_wheel_pos"),
        velocities=twist("odom") + columns("left_wheel_vel right_wheel_vel"),
        commands=columns("left_pwm right_pwm"),
        noise=(
            (5e-4, 5e-4, 1e-4, 3e-4, 6e-4, 8e-4, 5e-4, 5e-4),
            (5e-3, 5e-3, 3e-3, 4e-3, 4e-3, 4e-3, 0.03, 0.03),
        ),
        decimals=(2, 4),
        extras={"battery_v": (battery, 2)},
    ),
    hidden=(
        Hidden((("actuator_deadband", "right_motor"),), values={"width": 0.05}, drives={"right_motor": deadband(0.05)}),
    ),
    integrator=IMPLICIT,
    seconds=17.0,
    warm=0.6,
)


def rover_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves = Waves.draw(rng, 2, 0.05, 0.4, 5)
    data.qpos[2] = 0.1

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        ahead, turn = np.array([9, 4.5]) * waves(t)
        return np.array([ahead - turn, ahead + turn])

    return command


def hill(spec: mujoco.MjSpec) -> None:
    mujoco.mju_euler2Quat(spec.geom("floor").quat, [math.radians(2.0), math.radians(-2.4), 0.0], "xyz")


ROVER = Robot(
    summary="rover with two driven wheels and a caster: the ground slopes by 2.0° about x and by −2.4° about y",
    file="rover.xml",
    start=rover_start,
    log=Log(
        positions=pose("mocap") + columns("wheel_l_pos wheel_r_pos"),
        velocities=twist("mocap") + columns("wheel_l_vel wheel_r_vel"),
        commands=columns("wheel_l_cmd wheel_r_cmd"),
        noise=(
            (6e-4, 6e-4, 2e-4, 5e-4, 5e-4, 5e-4, 1e-3, 1e-3),
            (5e-3, 5e-3, 3e-3, 3e-3, 3e-3, 3e-3, 0.02, 0.02),
        ),
        time="stamp",
        decimals=(3, 4),
        from_zero=False,
    ),
    hidden=(
        Hidden(
            (("ground_slope", None),),
            values={"roll": math.radians(2.0), "pitch": math.radians(-2.4)},
            edit=hill,
        ),
    ),
    integrator=IMPLICIT,
    row=0.02,
    seconds=32.0,
    warm=1.5,
    hold=5,
)


def rollbot_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    slow, fast = Waves.draw(rng, 1, 0.06, 0.3), Waves.draw(rng, 1, 0.5, 1.6, 3)
    data.qpos[2], data.qvel[1] = 0.1499, 0.02

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        turning = 0.175 * np.sign(slow.slope(t))
        return 0.45 * slow(t) + turning + 0.25 * fast(t) + 0.12 * q[0] + 0.35 * v[0]

    return command


def soft_ground(spec: mujoco.MjSpec) -> None:
    shell = spec.geom("shell")
    shell.friction, shell.condim = [0.9, 0.005, 0.006], 6


ROLLBOT = Robot(
    summary="robot in a rolling shell: its rolling resistance has a lever arm of 6 mm",
    file="rollbot.xml",
    start=rollbot_start,
    log=Log(
        positions=pose("shell") + columns("drive_pos"),
        velocities=twist("shell") + columns("drive_vel"),
        commands=columns("drive_torque"),
        noise=((4e-4, 4e-4, 1e-4, 8e-4, 8e-4, 8e-4, 3e-4), (4e-3, 4e-3, 2e-3, 8e-3, 8e-3, 8e-3, 0.01)),
        decimals=(2, 4),
    ),
    hidden=(
        Hidden(
            (("contact_rolling", "shell"), ("contact_rolling", "floor")),
            values={"rolling": 0.006, "torsional": 0.005},
            edit=soft_ground,
        ),
    ),
    integrator=IMPLICIT,
    seconds=20.0,
    warm=0.5,
)

ROBOTS = (BALLBOT, BALANCER, ROVER, ROLLBOT)
