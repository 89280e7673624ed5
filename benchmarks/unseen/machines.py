"""Machines that stand in one place: a crane, carts, mounts, a valve, pendulums and a closed chain."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from benchmarks.unseen.drives import lag
from benchmarks.unseen.motions import Waves
from benchmarks.unseen.robot import DEG, Command, Hidden, Log, Robot, around, columns


def gantry_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 2, 0.03, 0.25), np.array([2.0, 1.2])
    stiff, damp = np.array([150, 80]), np.array([120, 60])
    data.qvel[:] = 0.2, -0.1, 0.1, 0.2

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        jolts = 10 * np.sign(np.sin(2 * math.pi * 0.31 * t + np.array([0, 1])))
        held = stiff * (size * waves(t) - q[:2]) + damp * (size * waves.slope(t) - v[:2])
        return np.clip(held + jolts, -200, 200)

    return command


def rusty_bridge(spec: mujoco.MjSpec) -> None:
    bridge = spec.joint("bridge")
    bridge.frictionloss, bridge.solref_friction = 24.0, [0.004, 1]
    bridge.solimp_friction[:3] = 0.99, 0.999, 0.001


GANTRY = Robot(
    summary="gantry crane: dry friction of 24 N at the bridge, and a lag of 70 ms in the trolley's drive",
    file="gantry.xml",
    start=gantry_start,
    log=Log(
        positions=columns("bridge_pos trolley_pos sway_x_deg sway_y_deg"),
        velocities=columns("bridge_vel trolley_vel"),
        commands=columns("bridge_force trolley_force"),
        noise=((2e-4, 5e-4, 4e-4, 8e-4), (2e-3, 4e-3, 1e-2, 1e-2)),
        time="stamp_ms",
        decimals=(0, 2),
        extras={"wind_speed": (around(2.0, 0.3), 1)},
    ),
    hidden=(
        Hidden((("joint_friction", "bridge"),), values={"friction": 24.0}, edit=rusty_bridge),
        Hidden(
            (("actuator_lag", "trolley_drive"),),
            values={"time_constant": 0.07},
            drives={"trolley_drive": lag(0.07)},
        ),
    ),
    row=0.02,
    seconds=44.0,
)


def cart_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    slow, fast = Waves.draw(rng, 1, 0.2, 0.8, 4), Waves.draw(rng, 1, 1, 5, 4)

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        force = 60 * (0.95 * slow(t) - q[:1]) + 16 * (0.95 * slow.slope(t) - v[:1]) + 3 * fast(t)
        return np.clip(force, -30, 30)

    return command


def near_stop(spec: mujoco.MjSpec) -> None:
    spec.joint("rail").range = [-0.5, 0.405]


CART = Robot(
    summary="cart between stops: the right one is 95 mm nearer, and commands are logged a row late",
    file="cart.xml",
    start=cart_start,
    log=Log(
        positions=columns("rail_mm sprung_mm"),
        velocities=columns("rail_vel_mm_s sprung_vel_mm_s"),
        commands=columns("force_cmd"),
        noise=((1e-4, 3e-4), (4e-3, 1e-2)),
        time="time_s",
        decimals=(3, 4),
        late=1,
    ),
    hidden=(Hidden((("joint_limit", "rail"),), values={"upper": -0.095}, edit=near_stop),),
    beside=(("actuator_delay", "belt"),),
    step=0.00025,
    row=0.005,
    seconds=20.0,
)


def telescope_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    slow, fast = Waves.draw(rng, 2, 0.03, 0.2), Waves.draw(rng, 2, 0.5, 3, 4)
    size, middle = np.array([1.2, 0.6]), np.array([0, 0.5])
    stiff, damp = np.array([12, 9]), np.array([7, 5])

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return stiff * (middle + size * slow(t) - q) + damp * (size * slow.slope(t) - v) + 0.5 * fast(t)

    return command


def cogging(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qfrc_applied[0] = 0.32 * math.sin(24 * data.qpos[0] + 0.7)


TELESCOPE = Robot(
    summary="mount of a telescope: cogging of 0.32 N·m in azimuth, 24 times a turn",
    file="telescope.xml",
    start=telescope_start,
    log=Log(
        positions=columns("az_deg alt_deg"),
        velocities=columns("az_rate alt_rate"),
        commands=columns("az_torque alt_torque"),
        noise=((2e-5, 3e-5), (8e-4, 1e-3)),
        time="utc",
        decimals=(2, 4),
        from_zero=False,
        extras={"dome_temp_c": (around(11.0, 0.02), 2)},
    ),
    hidden=(
        Hidden(
            (("joint_cogging", "azimuth"),),
            values={"amplitude": 0.32, "poles": 24.0, "phase": 0.7},
            push=cogging,
        ),
    ),
    step=0.001,
    seconds=42.0,
    warm=1.0,
    hold=4,
)


def opening(t: float | np.ndarray) -> float | np.ndarray:
    """What the valve is to be opened by at a time (s), rad."""
    return 0.75 + 0.6 * np.sin(2 * math.pi * 0.11 * t) + 0.25 * np.sin(2 * math.pi * 0.37 * t + 1)


def valve_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, summed = Waves.draw(rng, 1, 0.3, 3), 0.0

    def command(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        nonlocal summed
        off = float(opening(t) - q[0])
        summed = min(max(summed + 14 * 0.005 * off, -3.0), 3.0)
        return (9 * off + summed + 0.5 * waves(t) - 0.3 * v[:1]) / 20

    return command


def packing(spec: mujoco.MjSpec) -> None:
    stem = spec.joint("stem")
    stem.frictionloss, stem.solref_friction = 3.1, [0.002, 1]
    stem.solimp_friction[:3] = 0.99, 0.9999, 0.001


def stick_and_slip(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    model.dof_frictionloss[0] = 1.8 + 1.3 * math.exp(-((data.qvel[0] / 0.15) ** 2))


def setpoint(times: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return DEG * np.asarray(opening(times))


VALVE = Robot(
    summary="valve with a geared motor: friction of 3.1 N·m at rest and 1.8 N·m in motion",
    file="valve.xml",
    start=valve_start,
    log=Log(
        positions=columns("stem_deg"),
        velocities=columns("stem_vel"),
        commands=columns("motor_torque"),
        noise=((1.5e-4,), (4e-3,)),
        time="t",
        decimals=(3, 4),
        extras={"setpoint_deg": (setpoint, 2)},
    ),
    hidden=(
        Hidden(
            (("joint_stribeck", "stem"),),
            values={"static": 3.1, "coulomb": 1.8, "velocity": 0.15},
            edit=packing,
            push=stick_and_slip,
        ),
    ),
    step=0.00025,
    row=0.005,
    seconds=26.0,
)


def beam_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    slow, fast = Waves.draw(rng, 1, 0.1, 0.7), Waves.draw(rng, 1, 1, 12, 6)
    return lambda t, q, v: 4.5 * (0.9 * slow(t) - q[:1]) + 1.3 * (0.9 * slow.slope(t) - v[:1]) + 0.9 * fast(t)


def rotor(spec: mujoco.MjSpec) -> None:
    spec.joint("hub").armature = 0.025


BEAM = Robot(
    summary="flexible beam of six segments: the hub's motor has a rotor of 0.025 kg·m²",
    file="beam.xml",
    start=beam_start,
    log=Log(
        positions=("theta_hub", *(f"theta_flex{i}" for i in range(1, 7))),
        velocities=columns("omega_hub"),
        commands=columns("u"),
        noise=((5e-5, 1e-4, 1e-4, 1.5e-4, 2e-4, 2e-4, 3e-4), (2e-3,) + (0.01,) * 6),
        time="t",
        decimals=(3, 4),
    ),
    hidden=(Hidden((("armature", "hub"),), (("inertia", "hub"),), values={"armature": 0.025}, edit=rotor),),
    step=0.00025,
    row=0.005,
    seconds=18.0,
    warm=1.0,
)


def paddle_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    data.qpos[0], data.qvel[0] = rng.choice([-1, 1]) * rng.uniform(0.8, 2.9), rng.uniform(-2, 2)
    return lambda t, q, v: np.zeros(0)


def air(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qfrc_applied[0] = -0.035 * abs(data.qvel[0]) * data.qvel[0]


PADDLE = Robot(
    summary="pendulum with a blade: air drags by 0.035 N·m·s²/rad²",
    file="paddle.xml",
    start=paddle_start,
    log=Log(
        positions=columns("angle_deg"),
        velocities=(),
        commands=(),
        noise=((3e-4,), (1e-3,)),
        encoder=2 * math.pi / 8192,
        time="t",
        episode="run",
        extras={"temperature": (around(21.0, 0.1), 1)},
    ),
    hidden=(
        Hidden(
            (("joint_quadratic_damping", "pivot"),),
            equals=(("fluid_drag", "paddle"),),
            values={"coefficient": 0.035},
            push=air,
        ),
    ),
    seconds=12.0,
    warm=0.3,
    episodes=5,
    jitter=0.05,
)


def five_bar_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves = Waves.draw(rng, 2, 0.2, 1.4)
    return lambda t, q, v: 22 * (0.35 * waves(t) - q[::2]) + 1.6 * (0.35 * waves.slope(t) - v[::2])


FIVE_BAR = Robot(
    summary="nothing is missing: two arms that hold one tool, a closed chain",
    file="five_bar.xml",
    start=five_bar_start,
    log=Log(
        positions=columns("q_motor_l q_passive_l q_motor_r q_passive_r"),
        velocities=columns("dq_motor_l dq_passive_l dq_motor_r dq_passive_r"),
        commands=columns("tau_motor_l tau_motor_r"),
        noise=((4e-5, 8e-5, 4e-5, 8e-5), (3e-3, 8e-3, 3e-3, 8e-3)),
        encoder=2 * math.pi / 65536,
        time="t",
        decimals=(2, 4),
        extras={"tool_x": (around(0.0, 0.01), 3)},
    ),
    step=0.00025,
    seconds=24.0,
    warm=0.5,
)


def jib_start(data: mujoco.MjData, rng: np.random.Generator) -> Command:
    waves, size = Waves.draw(rng, 3, 0.08, 0.5), np.array([0.8, 0.35, 0.6])
    stiff, damp = np.array([60, 90, 8]), np.array([30, 40, 1.2])
    return lambda t, q, v: stiff * (size * waves(t) - q) + damp * (size * waves.slope(t) - v)


#: Gusts at the jib, the same in all logs.
GUSTS = Waves.draw(np.random.default_rng(7), 1, 0.1, 3, 14)


def wind(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qfrc_applied[0] = 3.5 * math.sin(2 * math.pi * 0.83 * data.time + 0.4) + 4 * GUSTS(data.time)[0]


JIB = Robot(
    summary="outside the vocabulary: camera jib in gusts, a torque at its pan that depends on time alone",
    file="jib.xml",
    start=jib_start,
    log=Log(
        positions=columns("pan boom tilt"),
        velocities=columns("pan_vel boom_vel tilt_vel"),
        commands=columns("pan_torque boom_torque tilt_torque"),
        noise=((1e-4, 1e-4, 3e-4), (2e-3, 2e-3, 6e-3)),
        time="t",
        decimals=(2, 4),
    ),
    hidden=(Hidden(push=wind),),
    seconds=24.0,
    warm=1.0,
)

ROBOTS = (GANTRY, CART, TELESCOPE, VALVE, BEAM, PADDLE, FIVE_BAR, JIB)
