"""Free bodies: in the air, under water, and pushed or rolling on a surface."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from benchmarks.unseen.motions import GRAVITY, Waves
from benchmarks.unseen.robot import IMPLICIT, Command, Hidden, Log, Robot, columns, pose, twist

#: How the four rotors of the quadrotor make thrust and torques: its arms are 0.14 m, its drag 18 mm.
ROTORS = np.array(
    [[1, 1, 1, 1], [-0.14, 0.14, 0.14, -0.14], [-0.14, 0.14, -0.14, 0.14], [0.018, 0.018, -0.018, -0.018]]
)


def turned(q: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's rotation matrix, and the rotation vector by which it is off thrusting along ``force``."""
    numbers = np.zeros(9)
    mujoco.mju_quat2Mat(numbers, q)
    own = numbers.reshape(3, 3)
    up = force / np.linalg.norm(force)
    side = np.cross(up, [1, 0, 0])
    side /= np.linalg.norm(side)
    wanted = np.column_stack([np.cross(side, up), side, up])
    off = 0.5 * (wanted.T @ own - own.T @ wanted)
    return own, np.array([off[2, 1], off[0, 2], off[1, 0]])


def quadrotor_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    path, shaking = Waves.draw(rng, 3, 0.1, 0.4, 4), Waves.draw(rng, 4, 1, 4, 4)
    size, middle = np.array([3.0, 3.0, 0.8]), np.array([0, 0, 2])
    data.qpos[2] = 1

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        away, slow = middle + size * path(t) - q[:3], size * path.slope(t) - v[:3]
        force = 1.12 * (np.clip(5 * away + 3.5 * slow, -6, 6) + [0, 0, GRAVITY])
        own, off = turned(q[3:7], force)
        torque = -np.array([1.6, 1.6, 0.7]) * off - np.array([0.22, 0.22, 0.2]) * v[3:6]
        return np.linalg.solve(ROTORS, [force @ own[:, 2], *torque]) + 0.12 * shaking(t)

    return command


def drag(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.xfrc_applied[1, :3] = -0.42 * data.qvel[:3]


QUADROTOR = Robot(
    summary="quadrotor: air drags by 0.42 N·s/m",
    file="quadrotor.xml",
    start=quadrotor_start,
    log=Log(
        positions=pose("quad"),
        velocities=twist("quad"),
        commands=columns("thrust_1 thrust_2 thrust_3 thrust_4"),
        noise=((1e-3, 1e-3, 2e-3, 6e-4, 6e-4, 1.5e-3), (0.012, 0.012, 0.02, 5e-3, 5e-3, 8e-3)),
        time="time_s",
    ),
    hidden=(Hidden((("linear_drag", "quad"),), values={"coefficient": 0.42}, push=drag),),
    beside=(("fluid_drag", "quad"),),
    seconds=19.0,
    warm=1.0,
    jitter=0.03,
)


def glider_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves = Waves.draw(rng, 3, 0.03, 0.15, 4)
    data.qpos[2], data.qvel[0] = -5, 0.4
    return lambda t, q, v: np.array([6, 0, 0]) + np.array([6, 2.5, 0.07]) * waves(t)


def buoyancy(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.xfrc_applied[1, 2] = 1.4


def depth(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 0.02 * rng.standard_normal(len(times)) - positions[:, 2]


GLIDER = Robot(
    summary="underwater glider: the hull is too buoyant, by 1.4 N",
    file="glider.xml",
    start=glider_start,
    log=Log(
        positions=pose("glider") + columns("battery_pos"),
        velocities=twist("glider"),
        commands=columns("thruster_u yaw_thruster_u battery_target"),
        noise=((2e-3, 2e-3, 1e-3, 5e-4, 5e-4, 8e-4, 1e-4), (4e-3, 4e-3, 3e-3, 1e-3, 1e-3, 1e-3, 2e-3)),
        time="t_s",
        decimals=(2, 4),
        extras={"depth_m": (depth, 2)},
    ),
    hidden=(Hidden((("external_force", "hull"),), values={"z": 1.4}, push=buoyancy),),
    beside=(("external_force", "battery"),),
    step=0.001,
    row=0.04,
    seconds=55.0,
    warm=2.0,
    window=2.0,
)


def pusher_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    turn, reach, phase = rng.uniform(-0.3, 0.3), 0.4 * rng.uniform(0.9, 1.1, 2), rng.uniform(0, 0.3)
    data.qpos[:3] = rng.uniform(-0.05, 0.05), rng.uniform(-0.02, 0.02), 0.0499
    data.qpos[3], data.qpos[6] = math.cos(turn / 2), math.sin(turn / 2)

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        since = np.array([(t + phase) % 2.0, (t + phase) % 2.0 - 1.0])
        moving = (since > 0) & (since < 0.55)
        return np.where(moving, np.minimum(reach * since / 0.55, 0.4), 0.0)

    return command


def smooth_table(spec: mujoco.MjSpec) -> None:
    for geom in ("box", "table"):
        spec.geom(geom).friction[0] = 0.27


PUSHER = Robot(
    summary="box between two pushers: it slides on the table with a friction of 0.27 in place of 0.45",
    file="pusher.xml",
    start=pusher_start,
    log=Log(
        positions=pose("box") + columns("left_pusher right_pusher"),
        velocities=twist("box") + columns("left_pusher_vel right_pusher_vel"),
        commands=columns("left_target right_target"),
        noise=(
            (3e-4, 3e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4),
            (5e-3, 5e-3, 3e-3, 0.02, 0.02, 0.02, 2e-3, 2e-3),
        ),
        time="t",
        decimals=(2, 4),
        episode="trial",
    ),
    hidden=(
        Hidden(
            (("contact_friction", "box"), ("contact_friction", "table")),
            values={"friction": 0.27},
            edit=smooth_table,
        ),
    ),
    step=0.00025,
    integrator=IMPLICIT,
    seconds=4.0,
    episodes=5,
)


def ball_plate_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    path = Waves.draw(rng, 2, 0.1, 0.5, 4)
    data.qpos[2:5] = 0.03, -0.02, 0.5259

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = 2.2 * (0.11 * path(t) - q[2:4]) + 2.0 * (0.11 * path.slope(t) - v[2:4])
        return np.clip(np.array([-y, x]) / 7, -0.2, 0.2)

    return command


BALL_PLATE = Robot(
    summary="ball on a plate: the encoder of the plate's roll is off by 1.3°",
    file="ball_plate.xml",
    start=ball_plate_start,
    log=Log(
        positions=columns("roll_deg pitch_deg") + pose("ball"),
        velocities=columns("roll_rate pitch_rate") + twist("ball"),
        commands=columns("roll_ref_deg pitch_ref_deg"),
        noise=(
            (2e-4, 2e-4, 3e-4, 3e-4, 1.5e-4, 3e-3, 3e-3, 3e-3),
            (4e-3, 4e-3, 5e-3, 5e-3, 3e-3, 0.05, 0.05, 0.05),
        ),
        decimals=(2, 4),
    ),
    hidden=(
        Hidden(
            (("sensor_bias", "roll.position"),),
            values={"bias": math.radians(1.3)},
            offsets={"roll": math.radians(1.3)},
        ),
    ),
    step=0.00025,
    integrator=IMPLICIT,
    seconds=16.0,
    warm=0.8,
)

ROBOTS = (QUADROTOR, GLIDER, PUSHER, BALL_PLATE)
