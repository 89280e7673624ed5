"""What ``dropo init`` makes of logs of systems whose truth is known, as plain MuJoCo simulates them.

    python benchmarks/init_systems.py --out out/init                 # all systems; --systems pendulum,hopper for some
    python benchmarks/init_systems.py --out out/init --seeds 3       # as many logs of each

Each system has a model as a user would have it, a true one that differs, and a log with columns, units and rate of its
own. The proposed config goes through ``dropo check`` and ``dropo fit`` unedited. Written are a folder a log and
``init_systems.md``: whether both pass, how many parameters were chosen, how many of their 90 % intervals (mean ± 1.64
standard errors) hold the truth, and what was left out although its standard error beside the chosen ones would be
below 10 % of its true value.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd

import dropo_torch as dropo
from dropo_torch.commands.cli import main as command
from dropo_torch.gap.refit import Z90
from dropo_torch.proposal import Proposal, propose_config

DEG = 180 / math.pi
#: What is measured and commanded of a recording: time, qpos, qvel, ctrl, ...
Samples = dict[str, np.ndarray]


@dataclass(frozen=True)
class System:
    """A robot, its truth, and how it is logged.

    Attributes:
        model: the user's model, as XML.
        truth: field → object → value, or component of it as ``field[0]``, in the true one.
        command: controls at a time in an episode of a number, drawn with a generator.
        columns: what the log holds of samples.
        every: physics steps a row.
        seconds: of each episode.
        episodes: how many.
        noise: standard deviation of positions and of velocities.
        start: initial state of an episode.
        suffix: of the log's file; ``.urdf`` of the model where it is one.
    """

    model: str
    truth: Mapping[str, Mapping[str, float]]
    command: Callable[[float, int, np.random.Generator], Sequence[float]]
    columns: Callable[[Samples], Mapping[str, np.ndarray]]
    every: int
    seconds: float = 12.0
    episodes: int = 1
    noise: tuple[float, float] = (1e-3, 1e-2)
    start: Callable[[mujoco.MjModel, mujoco.MjData, np.random.Generator], None] | None = None
    suffix: str = ".csv"
    model_suffix: str = ".xml"
    motors: tuple[str, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)


def true_model(system: System) -> mujoco.MjModel:
    """Return the true model; masses take their inertias along."""
    if system.motors:
        spec = mujoco.MjSpec.from_string(system.model)
        for joint in system.motors:
            spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        model = spec.compile()
    else:
        model = mujoco.MjModel.from_xml_string(system.model)
    for name, values in system.truth.items():
        key, _, component = name.partition("[")
        for thing, value in values.items():
            array = getattr(model, key)
            if key == "body_mass":
                row = model.body(thing).id
                model.body_inertia[row] *= value / model.body_mass[row]
                array[row] = value
            elif key == "actuator_kp":
                row = model.actuator(thing).id
                model.actuator_gainprm[row, 0], model.actuator_biasprm[row, 1] = value, -value
            elif key.startswith("dof_"):
                array[model.joint(thing).dofadr[0]] = value
            else:
                row = getattr(model, key.split("_")[0].replace("jnt", "joint"))(thing).id
                array.reshape(len(array), -1)[row, int(component[:-1]) if component else 0] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def record(system: System, seed: int) -> Samples:
    """Simulate a system, and return its noisy samples, one row each ``every`` steps."""
    model, rng = true_model(system), np.random.default_rng([seed, 5])
    step, rows = model.opt.timestep, []
    for episode in range(system.episodes):
        data = mujoco.MjData(model)
        if system.start is not None:
            system.start(model, data, rng)
        memory = np.random.default_rng([seed, episode, 8])
        for row in range(int(system.seconds / step / system.every)):
            if model.nu:
                data.ctrl[:] = system.command(row * system.every * step, episode, memory)
            rows.append((row * system.every * step, data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), episode))
            for _ in range(system.every):
                mujoco.mj_step(model, data)
    t, q, v, u, e = (np.array(x) for x in zip(*rows, strict=True))
    q = q + system.noise[0] * rng.standard_normal(q.shape)
    for j in np.flatnonzero(np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))):
        first = model.jnt_qposadr[j] + (3 if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else 0)
        q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
    v = v + system.noise[1] * rng.standard_normal(v.shape)
    return {"t": t, "q": q, "v": v, "u": u, "episode": e}


def write(system: System, folder: Path, seed: int) -> tuple[Path, Path]:
    """Write a system's model and log, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    model, log = folder / f"robot{system.model_suffix}", folder / f"log{system.suffix}"
    model.write_text(system.model)
    columns = dict(system.columns(record(system, seed)))
    if system.suffix == ".npz":
        np.savez(log, **columns)  # type: ignore[arg-type]
    elif system.suffix == ".parquet":
        pd.DataFrame({k: list(v) if v.ndim > 1 else v for k, v in columns.items()}).to_parquet(log)
    else:
        pd.DataFrame(columns).to_csv(log, index=False, float_format="%.7g" if "stamp_ns" not in columns else None)
    return model, log


def sines(*about: tuple[float, Sequence[float]]) -> Callable[[float, int, np.random.Generator], Sequence[float]]:
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


PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.002"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".8"/>
    </body>
  </worldbody>
</mujoco>"""

CARTPOLE = """
<mujoco model="cartpole">
  <option timestep="0.004"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .05 .05" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.6" size=".02" mass=".25"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
</mujoco>"""

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.5"/>
      <body name="lower" pos="0 0 -.4">
        <joint name="elbow" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass=".8"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/></actuator>
</mujoco>"""

SERVO = """
<mujoco model="servo">
  <compiler angle="degree"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="base_link"><geom type="cylinder" size=".05 .05"/>
    <body name="link1" pos="0 0 .1">
      <joint name="joint1" axis="0 0 1" range="-160 160" damping=".3"/>
      <geom type="capsule" fromto="0 0 0 0 0 .2" size=".03" mass="1"/>
      <body name="link2" pos="0 0 .2">
        <joint name="joint2" axis="0 1 0" range="-90 90" damping=".3"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".025" mass=".7"/>
        <body name="link3" pos=".3 0 0">
          <joint name="joint3" axis="0 1 0" range="-120 120" damping=".2"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".4"/>
        </body>
      </body>
    </body></body>
  </worldbody>
  <actuator>
    <position name="servo1" joint="joint1" kp="20" kv=".5"/>
    <position name="servo2" joint="joint2" kp="30" kv=".5"/>
    <position name="servo3" joint="joint3" kp="15" kv=".3"/>
  </actuator>
</mujoco>"""

GANTRY = """
<mujoco model="gantry">
  <option timestep="0.005"/>
  <worldbody>
    <body name="bridge" pos="0 0 2">
      <joint name="bridge_x" type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .6 .05" mass="8"/>
      <body name="trolley">
        <joint name="trolley_y" type="slide" axis="0 1 0"/>
        <geom type="box" size=".1 .1 .05" mass="3"/>
        <body name="load">
          <joint name="sway_x" type="hinge" axis="0 1 0"/>
          <joint name="sway_y" type="hinge" axis="1 0 0"/>
          <geom type="sphere" pos="0 0 -.8" size=".08" mass="2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="bridge_drive" joint="bridge_x" gear="10"/>
    <motor name="trolley_drive" joint="trolley_y" gear="5"/>
  </actuator>
</mujoco>"""

PUSHER = """
<mujoco model="pusher">
  <option timestep="0.002" cone="elliptic" impratio="5"/>
  <worldbody>
    <geom name="table" type="plane" size="2 2 .1" friction=".4 .005 .0001"/>
    <body name="hand" pos="0 0 .04">
      <joint name="hand_x" type="slide" axis="1 0 0"/>
      <joint name="hand_y" type="slide" axis="0 1 0"/>
      <geom name="finger" type="sphere" size=".03" mass=".5" friction=".1 .005 .0001"/>
    </body>
    <body name="box" pos=".1 0 .05">
      <freejoint name="box_free"/>
      <geom name="box" type="box" size=".05 .05 .05" mass=".6" friction=".4 .005 .0001"/>
    </body>
  </worldbody>
  <actuator>
    <position name="hand_x_servo" joint="hand_x" kp="200" kv="20"/>
    <position name="hand_y_servo" joint="hand_y" kp="200" kv="20"/>
  </actuator>
</mujoco>"""


def _quadruped() -> str:
    legs, motors = [], []
    for name, x, y in (("fl", 0.2, 0.12), ("fr", 0.2, -0.12), ("rl", -0.2, 0.12), ("rr", -0.2, -0.12)):
        legs.append(f"""
      <body name="{name}_thigh" pos="{x} {y} 0">
        <joint name="{name}_hip" axis="0 1 0" damping=".3"/>
        <geom type="capsule" fromto="0 0 0 -.08 0 -.15" size=".02" mass=".6" contype="0" conaffinity="0"/>
        <body name="{name}_calf" pos="-.08 0 -.15">
          <joint name="{name}_knee" axis="0 1 0" damping=".3"/>
          <geom type="capsule" fromto="0 0 0 .06 0 -.16" size=".012" mass=".2" contype="0" conaffinity="0"/>
          <geom name="{name}_foot" type="sphere" pos=".06 0 -.16" size=".02" mass=".05"/>
        </body>
      </body>""")
        motors += [f'<position name="{name}_{j}" joint="{name}_{j}" kp="40" kv="1"/>' for j in ("hip", "knee")]
    return f"""
<mujoco model="quadruped">
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .33">
      <freejoint name="base"/>
      <geom type="box" size=".25 .1 .05" mass="5" contype="0" conaffinity="0"/>{"".join(legs)}
    </body>
  </worldbody>
  <actuator>{"".join(motors)}</actuator>
</mujoco>"""


HOPPER = """
<mujoco model="hopper">
  <compiler angle="degree"/>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 .1" conaffinity="1" friction="1 .1 .1"/>
    <body name="torso" pos="0 0 1.25">
      <joint name="rootx" type="slide" axis="1 0 0" armature="0" damping="0"/>
      <joint name="rootz" type="slide" axis="0 0 1" armature="0" damping="0"/>
      <joint name="rooty" type="hinge" axis="0 1 0" armature="0" damping="0"/>
      <geom type="capsule" fromto="0 0 .2 0 0 -.2" size=".05" mass="3.6" contype="0"/>
      <body name="thigh" pos="0 0 -.2">
        <joint name="thigh_joint" axis="0 -1 0" range="-150 60" damping="1" armature="1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.45" size=".05" mass="4" contype="0"/>
        <body name="leg" pos="0 0 -.45">
          <joint name="leg_joint" axis="0 -1 0" range="-150 60" damping="1" armature="1"/>
          <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".04" mass="2.8" contype="0"/>
          <body name="foot" pos="0 0 -.5">
            <joint name="foot_joint" axis="0 -1 0" range="-60 60" damping="1" armature="1"/>
            <geom name="foot" type="capsule" fromto="-.13 0 -.1 .26 0 -.1" size=".06" mass="5" friction="2 .1 .1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="thigh_joint" gear="200" ctrllimited="true" ctrlrange="-1 1"/>
    <motor joint="leg_joint" gear="200" ctrllimited="true" ctrlrange="-1 1"/>
    <motor joint="foot_joint" gear="200" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""

PUCK = """
<mujoco model="puck">
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="ice" type="plane" size="5 5 .1" friction=".1 .005 .0001"/>
    <body name="puck" pos="0 0 .02">
      <freejoint/>
      <geom name="puck" type="box" size=".06 .05 .02" mass=".3" friction=".1 .005 .0001"/>
    </body>
  </worldbody>
</mujoco>"""

URDF = """<?xml version="1.0"?>
<robot name="three">
  <link name="world_link"/>
  {links}
</robot>"""


def _urdf() -> str:
    parts, parent = [], "world_link"
    for i, (mass, length, axis) in enumerate(((2.0, 0.0, "0 0 1"), (1.5, 0.35, "0 1 0"), (0.9, 0.3, "0 1 0")), 1):
        origin = ("0 0 0.2", "0 0 0.1", "0.35 0 0")[i - 1]
        inertia = mass * (0.01 + length**2 / 12)
        parts.append(f"""
  <joint name="panda_joint{i}" type="revolute">
    <parent link="{parent}"/><child link="panda_link{i}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>
    <limit lower="-2.8" upper="2.8" effort="80" velocity="5"/>
  </joint>
  <link name="panda_link{i}">
    <inertial><origin xyz="{length / 2} 0 0.02"/><mass value="{mass}"/>
      <inertia ixx="{0.004 * mass}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>""")
        parent = f"panda_link{i}"
    return URDF.format(links="".join(parts))


SPRINGS = """
<mujoco model="springs">
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="first"><joint name="a" type="slide" axis="1 0 0" stiffness="60"/>
      <geom type="box" size=".1 .1 .1" mass="2" contype="0" conaffinity="0"/></body>
    <body name="second" pos=".5 0 0"><joint name="b" type="slide" axis="1 0 0" stiffness="20"/>
      <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor name="drive_a" joint="a"/><motor name="drive_b" joint="b"/></actuator>
</mujoco>"""

FURUTA = """
<mujoco model="furuta">
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm" pos="0 0 .5">
      <joint name="arm_joint" type="hinge" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".3"/>
      <body name="bob" pos=".25 0 0">
        <joint name="bob_joint" type="hinge" axis="1 0 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".15"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="arm_motor" joint="arm_joint"/></actuator>
</mujoco>"""


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
        PENDULUM, {"dof_damping": {"pivot": 0.006}, "dof_frictionloss": {"pivot": 0.008}}, still,
        lambda s: {"t_ms": 1000 * s["t"], "angle_deg": DEG * s["q"][:, 0]}, every=5, seconds=15, episodes=1,
        noise=(2e-3, 0), start=_bent([1.6], 0.2),
    ),
    "cartpole": System(
        CARTPOLE,
        {"body_mass": {"cart": 1.3, "pole": 0.2}, "dof_damping": {"slider": 0.5, "hinge": 0.003},
         "dof_frictionloss": {"slider": 0.25}},
        sines((6.0, (0.3, 0.9, 1.7))),
        lambda s: {"time": s["t"], "x": s["q"][:, 0], "theta": s["q"][:, 1], "x_dot": s["v"][:, 0],
                   "theta_dot": s["v"][:, 1], "force_cmd": s["u"][:, 0]},
        every=5,
    ),
    "arm": System(
        ARM,
        {"body_mass": {"upper": 1.8, "lower": 0.65}, "dof_damping": {"shoulder": 0.15, "elbow": 0.08},
         "dof_frictionloss": {"shoulder": 0.2, "elbow": 0.1}, "dof_armature": {"shoulder": 0.03, "elbow": 0.01}},
        sines((6.0, (0.4, 1.1, 2.3)), (2.0, (0.7, 1.6, 3.1))),
        lambda s: {"stamp_ns": (1e9 * s["t"]).astype(np.int64) + 1_700_000_000_000_000_000, "q_1": s["q"][:, 0],
                   "q_2": s["q"][:, 1], "dq_1": s["v"][:, 0], "dq_2": s["v"][:, 1], "tau_1": s["u"][:, 0],
                   "tau_2": s["u"][:, 1]},
        every=5,
    ),
    "servo": System(
        SERVO,
        {"body_mass": {"link2": 0.9, "link3": 0.3}, "dof_frictionloss": {"joint1": 0.2, "joint2": 0.3, "joint3": 0.15},
         "dof_armature": {"joint1": 0.02, "joint2": 0.03, "joint3": 0.015}},
        sines((0.8, (0.3, 0.8)), (0.6, (0.4, 1.0)), (0.8, (0.5, 1.3))),
        lambda s: {"timestamp": s["t"], **{f"j{i + 1}_pos_deg": DEG * s["q"][:, i] for i in range(3)},
                   **{f"j{i + 1}_vel_deg_s": DEG * s["v"][:, i] for i in range(3)},
                   **{f"j{i + 1}_target_deg": DEG * s["u"][:, i] for i in range(3)},
                   **{f"j{i + 1}_temp": 30 + 0.01 * s["t"] for i in range(3)}},
        every=5, noise=(5e-4, 5e-3),
    ),
    "gantry": System(
        GANTRY,
        {"body_mass": {"bridge": 9.5, "trolley": 2.5, "load": 3.0},
         "dof_damping": {"bridge_x": 6.0, "trolley_y": 4.0}, "dof_frictionloss": {"bridge_x": 5.0, "trolley_y": 2.0}},
        sines((4.0, (0.2, 0.5)), (4.0, (0.25, 0.6))),
        lambda s: {"time_us": np.round(1e6 * s["t"]), "bridgeX_mm": 1000 * s["q"][:, 0],
                   "trolleyY_mm": 1000 * s["q"][:, 1], "swayX": s["q"][:, 2], "swayY": s["q"][:, 3],
                   "bridgeX_speed_mm_s": 1000 * s["v"][:, 0], "trolleyY_speed_mm_s": 1000 * s["v"][:, 1],
                   "swayX_rate": s["v"][:, 2], "swayY_rate": s["v"][:, 3], "bridge_cmd": s["u"][:, 0],
                   "trolley_cmd": s["u"][:, 1]},
        every=4, seconds=20,
    ),
    "pusher": System(
        PUSHER, {"body_mass": {"box": 0.8}, "geom_friction": {"table": 0.3, "box": 0.3}}, _pushes,
        lambda s: {"run": s["episode"], "t": s["t"], "hand.x": s["q"][:, 0], "hand.y": s["q"][:, 1],
                   **{f"box_pos_{a}": s["q"][:, 2 + i] for i, a in enumerate("xyz")},
                   **{f"box_quat_{a}": s["q"][:, 5 + i] for i, a in enumerate("wxyz")},
                   "hand.vx": s["v"][:, 0], "hand.vy": s["v"][:, 1],
                   **{f"box_vel_{a}": s["v"][:, 2 + i] for i, a in enumerate("xyz")},
                   **{f"box_angvel_{a}": s["v"][:, 5 + i] for i, a in enumerate("xyz")},
                   "hand_x_ref": s["u"][:, 0], "hand_y_ref": s["u"][:, 1]},
        every=5, seconds=3.0, episodes=6, noise=(2e-4, 2e-3),
    ),
    "quadruped": System(
        _quadruped(),
        {"body_mass": {"trunk": 6.0}, "dof_damping": {f"{leg}_knee": 0.5 for leg in ("fl", "fr", "rl", "rr")},
         "dof_frictionloss": {f"{leg}_hip": 0.3 for leg in ("fl", "fr", "rl", "rr")}},
        _gait,
        lambda s: {"time": s["t"],
                   **{f"base_p{a}": s["q"][:, i] for i, a in enumerate("xyz")},
                   **{f"base_q{a}": s["q"][:, 3 + i] for i, a in enumerate("wxyz")},
                   **{f"position.{i}": s["q"][:, 7 + i] for i in range(8)},
                   **{f"base_v{a}": s["v"][:, i] for i, a in enumerate("xyz")},
                   **{f"base_w{a}": s["v"][:, 3 + i] for i, a in enumerate("xyz")},
                   **{f"velocity.{i}": s["v"][:, 6 + i] for i in range(8)},
                   **{f"cmd.{i}": s["u"][:, i] for i in range(8)}},
        every=5, seconds=6, noise=(3e-4, 5e-3),
    ),
    "hopper": System(
        HOPPER, {"body_mass": {"torso": 3.0, "thigh": 4.6, "leg": 2.4, "foot": 5.8}}, _hop,
        lambda s: {"observations": np.concatenate([s["q"][:, 1:], s["v"]], 1), "actions": s["u"],
                   "terminals": np.append(np.diff(s["episode"]) != 0, True)},
        every=4, seconds=1.5, episodes=12, noise=(1e-4, 2e-3), suffix=".npz",
    ),
    "puck": System(
        PUCK, {"geom_friction": {"ice": 0.14, "puck": 0.14}}, still,
        lambda s: {"trial": s["episode"], "sec": s["t"], "px": s["q"][:, 0], "py": s["q"][:, 1], "pz": s["q"][:, 2],
                   **{f"q{a}": s["q"][:, 3 + i] for i, a in enumerate("wxyz")},
                   **{f"v{a}": s["v"][:, i] for i, a in enumerate("xyz")},
                   **{f"w{a}": s["v"][:, 3 + i] for i, a in enumerate("xyz")}},
        every=5, seconds=0.7, episodes=10, noise=(1e-4, 2e-3), start=_slide,
    ),
    "urdf": System(
        _urdf(),
        {"body_mass": {"panda_link2": 1.8, "panda_link3": 0.7},
         "dof_frictionloss": {"panda_joint1": 0.3, "panda_joint2": 0.4, "panda_joint3": 0.2},
         "dof_damping": {"panda_joint1": 0.4, "panda_joint2": 0.3, "panda_joint3": 0.2}},
        sines((3.0, (0.3, 0.8, 1.9)), (12.0, (0.4, 1.0, 2.2)), (4.0, (0.6, 1.4, 2.9))),
        lambda s: {"header.stamp": s["t"] + 1.7e9 % 1000,
                   **{f"joint_states.position[{i}]": s["q"][:, i] for i in range(3)},
                   **{f"joint_states.velocity[{i}]": s["v"][:, i] for i in range(3)},
                   **{f"joint_states.effort[{i}]": s["u"][:, i] for i in range(3)}},
        every=5, model_suffix=".urdf", motors=("panda_joint1", "panda_joint2", "panda_joint3"),
    ),
    "springs": System(
        SPRINGS, {"jnt_stiffness": {"a": 75.0, "b": 16.0}, "body_mass": {"first": 2.4, "second": 1.2},
                  "dof_damping": {"a": 1.0, "b": 0.5}},
        sines((8.0, (0.5, 0.9, 1.6)), (4.0, (0.4, 1.1))),
        lambda s: {"t": s["t"], "pos_a_mm": 1000 * s["q"][:, 0], "pos_b_mm": 1000 * s["q"][:, 1],
                   "vel_a": s["v"][:, 0], "vel_b": s["v"][:, 1], "u_a": s["u"][:, 0], "u_b": s["u"][:, 1]},
        every=4, noise=(5e-4, 5e-3), suffix=".csv",
    ),
    "furuta": System(
        FURUTA,
        {"body_mass": {"arm": 0.36, "bob": 0.12}, "dof_damping": {"arm_joint": 0.01, "bob_joint": 0.0008},
         "dof_frictionloss": {"arm_joint": 0.01}},
        sines((0.15, (0.5, 1.3, 2.1))),
        lambda s: {"time": s["t"], "position": s["q"], "velocity": s["v"], "command": s["u"]},
        every=5, suffix=".parquet",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What became of one log."""

    system: str
    seed: int
    checked: int
    fitted: int
    verdict: str
    chosen: int
    held: int
    single: int
    single_held: int
    missed: tuple[str, ...]
    outside: tuple[str, ...]
    candidates: int
    lag: int
    seconds: float
    fit_seconds: float
    summary: str


def true_values(proposal: Proposal, system: System) -> dict[str, float]:
    """Return the true value of every candidate, in its unit."""
    truth, own = true_model(system), None
    found = {}
    for told in proposal.choice.told:
        space = dropo.ParameterSpace(proposal.base / proposal.document["model"], {"it": told.candidate.spec})
        own = space.parameters[0]
        target = own.targets[0]
        found[told.candidate.name] = target.read(truth) / target.factor
    return found


def run(name: str, folder: Path, seed: int, fit: bool = True) -> Outcome:
    """Propose a config for a system's log, check and fit with it, and compare with the truth."""
    system, place = SYSTEMS[name], folder / f"{name}-{seed}"
    model, log = write(system, place, seed)
    began, path = time.perf_counter(), place / "robot.yaml"
    proposal = propose_config(model, log, out=path, seed=seed)
    path.write_text(proposal.text)
    seconds, truth = time.perf_counter() - began, true_values(proposal, system)
    missed = tuple(
        f"{t.candidate.name} ({100 * t.error / abs(truth[t.candidate.name]):.2g} %)" for t in proposal.choice.told
        if not t.is_in and t.candidate.kind != "centre" and t.error < 0.1 * abs(truth[t.candidate.name])
    )  # fmt: skip
    checked, began = command(["check", str(path)]), time.perf_counter()
    fitted = command(["fit", str(path), "--out", str(place / "fit")]) if fit else -1
    took, held, outside = time.perf_counter() - began, [], []
    document = json.loads((place / "fit" / "fit.json").read_text()) if fitted in (0, 3) else {}
    for told in proposal.choice.chosen if document else ():
        key = told.candidate.name
        mean, error = document["parameters"][key]["mean"], document["standard_errors"][key]["mean"]
        inside = error is not None and abs(mean - truth[key]) <= Z90 * error + 1e-12
        held.append((told.state == "chosen", inside))
        if not inside:
            outside.append(f"{key}: {mean:.4g} ± {error:.2g}, true {truth[key]:.4g}")
    single = [inside for alone, inside in held if alone]
    return Outcome(
        name, seed, checked, fitted, document.get("verdict", ""), len(held), sum(i for _, i in held), len(single),
        sum(single), missed, tuple(outside), len(proposal.choice.told), proposal.document["lag"], seconds, took,
        proposal.choice.summary,
    )  # fmt: skip


def markdown(found: Sequence[Outcome]) -> str:
    """Return the outcomes as a table, and what stands outside or was missed as lists."""
    lines = [
        "| system | log | check | fit | verdict | candidates | chosen | in 90 % | one by one | lag | init | fit |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for o in found:
        lines.append(
            f"| {o.system} | {o.seed} | {o.checked} | {o.fitted} | {o.verdict} | {o.candidates} | {o.chosen} "
            f"| {o.held} | {o.single_held} of {o.single} | {o.lag} | {o.seconds:.1f} s | {o.fit_seconds:.1f} s |"
        )
    total, held = sum(o.chosen for o in found), sum(o.held for o in found)
    single, inside = sum(o.single for o in found), sum(o.single_held for o in found)
    share, alone = 100 * held / max(total, 1), 100 * inside / max(single, 1)
    one = f"of those told one by one {inside} of {single} ({alone:.0f} %)"
    lines += ["", f"In their 90 % intervals: {held} of {total} ({share:.0f} %), {one}.", ""]
    for o in found:
        lines.append(f"- {o.system} {o.seed}: {o.summary}")
        lines += [f"  - outside: {text}" for text in o.outside]
        lines += [f"  - left out: {text}" for text in o.missed]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--no-fit", action="store_true")
    given = parser.parse_args(arguments)
    found = []
    for seed in range(given.first, given.first + given.seeds):
        for name in given.systems.split(","):
            found.append(run(name, given.out, seed, fit=not given.no_fit))
            print(markdown(found[-1:]), flush=True)
            (given.out / "init_systems.md").write_text(markdown(found))


if __name__ == "__main__":
    main()
