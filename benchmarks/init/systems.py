"""The systems: a model as a user has it (``robots/``), a true one that differs, and how it moves and is logged."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

ROBOTS = Path(__file__).parent / "robots"
DEG = 180 / math.pi
#: What is measured and commanded of a recording: time, qpos, qvel, ctrl, episode.
Samples = dict[str, np.ndarray]
#: Controls at a time in an episode of a number, drawn with a generator.
Command = Callable[[float, int, np.random.Generator], Sequence[float]]


@dataclass(frozen=True)
class System:
    """A robot, its truth, and how it is logged.

    Attributes:
        robot: file of the user's model.
        truth: field → object → value, or component of it as ``field[0]``, in the true one.
        command: controls.
        columns: what the log holds of samples.
        every: physics steps a row.
        seconds: of each episode.
        episodes: how many.
        noise: standard deviation of positions and of velocities.
        start: initial state of an episode.
        suffix: of the log's file.
        motors: joints that motors drive which the model lacks.
    """

    robot: str
    truth: Mapping[str, Mapping[str, float]]
    command: Command
    columns: Callable[[Samples], Mapping[str, np.ndarray]]
    every: int
    seconds: float = 12.0
    episodes: int = 1
    noise: tuple[float, float] = (1e-3, 1e-2)
    start: Callable[[mujoco.MjModel, mujoco.MjData, np.random.Generator], None] | None = None
    suffix: str = ".csv"
    motors: tuple[str, ...] = ()

    @property
    def model(self) -> str:
        """The user's model, as XML."""
        return (ROBOTS / self.robot).read_text(encoding="utf-8")


def named(values: np.ndarray, names: str, factor: float = 1.0) -> dict[str, np.ndarray]:
    """The first columns of an array by their names, which stand in one text."""
    return {name: factor * values[:, i] for i, name in enumerate(names.split())}


def numbered(values: np.ndarray, name: str, factor: float = 1.0, first: int = 0) -> dict[str, np.ndarray]:
    """All columns of an array by one name with their number in it."""
    return {name.format(i + first): factor * column for i, column in enumerate(values.T)}


def axes(values: np.ndarray, name: str, letters: str = "xyz") -> dict[str, np.ndarray]:
    """The first columns of an array by one name and letters."""
    return {name + letter: values[:, i] for i, letter in enumerate(letters)}


def sines(*about: tuple[float, Sequence[float]]) -> Command:
    """Commands of several sines each: amplitude, and frequencies in Hz."""

    def at(t: float, episode: int, _: np.random.Generator) -> Sequence[float]:
        return [
            a * sum(math.sin(2 * math.pi * f * t + 1.3 * i + 0.7 * k + 2 * episode) for k, f in enumerate(fs)) / len(fs)
            for i, (a, fs) in enumerate(about)
        ]

    return at


def still(t: float, episode: int, rng: np.random.Generator) -> Sequence[float]:
    return []


def _bent(angles: Sequence[float], spread: float = 0.3) -> Callable[..., None]:
    def start(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        data.qpos[: len(angles)] = np.asarray(angles) + spread * rng.uniform(-1, 1, len(angles))

    return start


def _pushes(t: float, episode: int, _: np.random.Generator) -> Sequence[float]:
    side = 0.03 * math.sin(2.1 * episode)
    return [min(0.35, 0.12 * t) * (1 if episode % 2 else 0.8), side + 0.01 * math.sin(2 * t)]


def _gait(t: float, episode: int, _: np.random.Generator) -> Sequence[float]:
    found = []
    for leg in range(4):
        phase = 2 * math.pi * 1.5 * t + math.pi * (leg in (1, 2)) + 0.4 * episode
        found += [0.35 * math.sin(phase), 0.3 * math.cos(phase + 0.3) + 0.1 * math.sin(5 * t)]
    return found


def _hop(t: float, episode: int, rng: np.random.Generator) -> Sequence[float]:
    return [0.5 * math.sin(9 * t + i + episode) + 0.35 * rng.uniform(-1, 1) for i in range(3)]


def _slide(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    data.qpos[2] = 0.0199
    data.qvel[:2] = rng.uniform(-1, 1, 2) * 0.8 + 0.3
    data.qvel[5] = rng.uniform(-3, 3)


SYSTEMS: dict[str, System] = {
    "pendulum": System(
        "pendulum.xml", {"dof_damping": {"pivot": 0.006}, "dof_frictionloss": {"pivot": 0.008}}, still,
        lambda s: {"t_ms": 1000 * s["t"], "angle_deg": DEG * s["q"][:, 0]},
        every=5, seconds=15, noise=(2e-3, 0), start=_bent([1.6], 0.2),
    ),
    "cartpole": System(
        "cartpole.xml",
        {"body_mass": {"cart": 1.3, "pole": 0.2}, "dof_damping": {"slider": 0.5, "hinge": 0.003},
         "dof_frictionloss": {"slider": 0.25}},
        sines((6.0, (0.3, 0.9, 1.7))),
        lambda s: {"time": s["t"], **named(s["q"], "x theta"), **named(s["v"], "x_dot theta_dot"),
                   **named(s["u"], "force_cmd")},
        every=5,
    ),
    "arm": System(
        "arm.xml",
        {"body_mass": {"upper": 1.8, "lower": 0.65}, "dof_damping": {"shoulder": 0.15, "elbow": 0.08},
         "dof_frictionloss": {"shoulder": 0.2, "elbow": 0.1}, "dof_armature": {"shoulder": 0.03, "elbow": 0.01}},
        sines((6.0, (0.4, 1.1, 2.3)), (2.0, (0.7, 1.6, 3.1))),
        lambda s: {"stamp_ns": (1e9 * s["t"]).astype(np.int64) + 1_700_000_000_000_000_000,
                   **numbered(s["q"], "q_{}", first=1), **numbered(s["v"], "dq_{}", first=1),
                   **numbered(s["u"], "tau_{}", first=1)},
        every=5,
    ),
    "servo": System(
        "servo.xml",
        {"body_mass": {"link2": 0.9, "link3": 0.3}, "dof_frictionloss": {"joint1": 0.2, "joint2": 0.3, "joint3": 0.15},
         "dof_armature": {"joint1": 0.02, "joint2": 0.03, "joint3": 0.015}},
        sines((0.8, (0.3, 0.8)), (0.6, (0.4, 1.0)), (0.8, (0.5, 1.3))),
        lambda s: {"timestamp": s["t"], **numbered(s["q"], "j{}_pos_deg", DEG, 1),
                   **numbered(s["v"], "j{}_vel_deg_s", DEG, 1), **numbered(s["u"], "j{}_target_deg", DEG, 1),
                   **{f"j{i}_temp": 30 + 0.01 * s["t"] for i in (1, 2, 3)}},
        every=5, noise=(5e-4, 5e-3),
    ),
    "gantry": System(
        "gantry.xml",
        {"body_mass": {"bridge": 9.5, "trolley": 2.5, "load": 3.0},
         "dof_damping": {"bridge_x": 6.0, "trolley_y": 4.0}, "dof_frictionloss": {"bridge_x": 5.0, "trolley_y": 2.0}},
        sines((4.0, (0.2, 0.5)), (4.0, (0.25, 0.6))),
        lambda s: {"time_us": np.round(1e6 * s["t"]), **named(s["q"], "bridgeX_mm trolleyY_mm", 1000),
                   **named(s["q"][:, 2:], "swayX swayY"),
                   **named(s["v"], "bridgeX_speed_mm_s trolleyY_speed_mm_s", 1000),
                   **named(s["v"][:, 2:], "swayX_rate swayY_rate"), **named(s["u"], "bridge_cmd trolley_cmd")},
        every=4, seconds=20,
    ),
    "pusher": System(
        "pusher.xml", {"body_mass": {"box": 0.8}, "geom_friction": {"table": 0.3, "box": 0.3}}, _pushes,
        lambda s: {"run": s["episode"], "t": s["t"], **named(s["q"], "hand.x hand.y"),
                   **axes(s["q"][:, 2:], "box_pos_"), **axes(s["q"][:, 5:], "box_quat_", "wxyz"),
                   **named(s["v"], "hand.vx hand.vy"),
                   **axes(s["v"][:, 2:], "box_vel_"), **axes(s["v"][:, 5:], "box_angvel_"),
                   **named(s["u"], "hand_x_ref hand_y_ref")},
        every=5, seconds=3.0, episodes=6, noise=(2e-4, 2e-3),
    ),
    "quadruped": System(
        "quadruped.xml",
        {"body_mass": {"trunk": 6.0}, "dof_damping": {f"{leg}_knee": 0.5 for leg in ("fl", "fr", "rl", "rr")},
         "dof_frictionloss": {f"{leg}_hip": 0.3 for leg in ("fl", "fr", "rl", "rr")}},
        _gait,
        lambda s: {"time": s["t"], **axes(s["q"], "base_p"), **axes(s["q"][:, 3:], "base_q", "wxyz"),
                   **numbered(s["q"][:, 7:], "position.{}"), **axes(s["v"], "base_v"), **axes(s["v"][:, 3:], "base_w"),
                   **numbered(s["v"][:, 6:], "velocity.{}"), **numbered(s["u"], "cmd.{}")},
        every=5, seconds=6, noise=(3e-4, 5e-3),
    ),
    "hopper": System(
        "hopper.xml", {"body_mass": {"torso": 3.0, "thigh": 4.6, "leg": 2.4, "foot": 5.8}}, _hop,
        lambda s: {"observations": np.concatenate([s["q"][:, 1:], s["v"]], 1), "actions": s["u"],
                   "terminals": np.append(np.diff(s["episode"]) != 0, True)},
        every=4, seconds=1.5, episodes=12, noise=(1e-4, 2e-3), suffix=".npz",
    ),
    "puck": System(
        "puck.xml", {"geom_friction": {"ice": 0.14, "puck": 0.14}}, still,
        lambda s: {"trial": s["episode"], "sec": s["t"], **axes(s["q"], "p"), **axes(s["q"][:, 3:], "q", "wxyz"),
                   **axes(s["v"], "v"), **axes(s["v"][:, 3:], "w")},
        every=5, seconds=0.7, episodes=10, noise=(1e-4, 2e-3), start=_slide,
    ),
    "urdf": System(
        "three.urdf",
        {"body_mass": {"panda_link2": 1.8, "panda_link3": 0.7},
         "dof_frictionloss": {"panda_joint1": 0.3, "panda_joint2": 0.4, "panda_joint3": 0.2},
         "dof_damping": {"panda_joint1": 0.4, "panda_joint2": 0.3, "panda_joint3": 0.2}},
        sines((3.0, (0.3, 0.8, 1.9)), (12.0, (0.4, 1.0, 2.2)), (4.0, (0.6, 1.4, 2.9))),
        lambda s: {"header.stamp": s["t"] + 1.7e9 % 1000, **numbered(s["q"], "joint_states.position[{}]"),
                   **numbered(s["v"], "joint_states.velocity[{}]"), **numbered(s["u"], "joint_states.effort[{}]")},
        every=5, motors=("panda_joint1", "panda_joint2", "panda_joint3"),
    ),
    "springs": System(
        "springs.xml",
        {"jnt_stiffness": {"a": 75.0, "b": 16.0}, "body_mass": {"first": 2.4, "second": 1.2},
         "dof_damping": {"a": 1.0, "b": 0.5}},
        sines((8.0, (0.5, 0.9, 1.6)), (4.0, (0.4, 1.1))),
        lambda s: {"t": s["t"], **named(s["q"], "pos_a_mm pos_b_mm", 1000), **named(s["v"], "vel_a vel_b"),
                   **named(s["u"], "u_a u_b")},
        every=4, noise=(5e-4, 5e-3),
    ),
    "furuta": System(
        "furuta.xml",
        {"body_mass": {"arm": 0.36, "bob": 0.12}, "dof_damping": {"arm_joint": 0.01, "bob_joint": 0.0008},
         "dof_frictionloss": {"arm_joint": 0.01}},
        sines((0.15, (0.5, 1.3, 2.1))),
        lambda s: {"time": s["t"], "position": s["q"], "velocity": s["v"], "command": s["u"]},
        every=5, suffix=".parquet",
    ),
}  # fmt: skip
