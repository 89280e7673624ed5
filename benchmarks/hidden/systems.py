"""The systems in whose logs effects are hidden: models, commands, starts and what a user would declare."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

#: Seconds of a logged transition.
DT = 0.01
HOPPER_XML = Path(__file__).parents[2] / "sims" / "hopper" / "hopper.xml"


@dataclass(frozen=True)
class Command:
    """What drives one actuator: a smooth random multi-sine or chirp, and a weak hold of a posture.

    Attributes:
        amplitude: of the excitation, in command units.
        offset: what it is centered on.
        band: lowest and highest frequency, Hz.
        hold: gains on position and velocity of ``joint`` around ``offset``: a feedback that a torque needs to stay put.
        joint: the joint that is held.
        limit: the command is clipped to ± this.
    """

    amplitude: float
    offset: float = 0.0
    band: tuple[float, float] = (0.2, 2.5)
    hold: tuple[float, float] = (0.0, 0.0)
    joint: str = ""
    limit: float = np.inf


@dataclass(frozen=True)
class Scale:
    """Typical sizes at one joint, from which strengths are drawn: torque, velocity, and effective inertia."""

    torque: float
    velocity: float
    inertia: float


@dataclass(frozen=True)
class System:
    """A model and how its logs are made.

    Attributes:
        name: what it is called.
        xml: the model that a user has.
        declared: name → mapping of the project's ``parameters``: what the user lets vary.
        commands: one for each actuator.
        start: joint → half width of the positions, half width of the velocities at the start.
        start_mean: joint → what the start's positions are centered on, where that is not ``qpos0``.
        scales: joint → typical sizes.
        equivalents: groups of (effect, target) that are the same thing here, by construction of the mechanism.
        observation: what the log's columns are.
        episodes, transitions: size of the log; the length of an episode is drawn from a range.
        free: the name of a free joint which starts with random velocities, on a table or in the air.
        airborne: whether it starts in the air.
        height: of a free joint that starts upright on its feet; 0 for one that does not.
        substeps: steps of the truth in one logged transition.
        coarse: whether the user's model takes steps too large to be right.
    """

    name: str
    xml: str
    declared: Mapping[str, Mapping[str, object]]
    commands: tuple[Command, ...]
    start: Mapping[str, tuple[float, float]]
    scales: Mapping[str, Scale]
    start_mean: Mapping[str, float] = field(default_factory=dict)
    equivalents: tuple[frozenset[tuple[str, str | None]], ...] = ()
    observation: tuple[str, ...] = ("qpos", "qvel")
    episodes: int = 8
    transitions: tuple[int, int] = (300, 450)
    free: str = ""
    airborne: bool = False
    height: float = 0.0
    substeps: int = 40
    coarse: bool = False

    @property
    def frame_skip(self) -> int:
        """Steps of the model in one logged transition."""
        return round(DT / load(self.xml).opt.timestep)


@cache
def load(xml: str) -> mujoco.MjModel:
    """Return the compiled model; shared, so never written to."""
    return mujoco.MjModel.from_xml_string(xml)


def mass(body: str, own: float) -> dict[str, object]:
    """Declare a link's mass, its inertia in proportion, with bounds around the model's own value."""
    return {
        "field": "body_mass", "name": body, "bounds": [round(0.6 * own, 4), round(1.6 * own, 4)], "unit": "kg",
        "scale_inertia": True,
    }  # fmt: skip


def groups(*found: tuple[tuple[str, str | None], ...]) -> tuple[frozenset[tuple[str, str | None]], ...]:
    """Return groups of (effect, target) as sets."""
    return tuple(frozenset(g) for g in found)


def coarse(system: System, timestep: float) -> System:
    """Return the system with a model that a careless user has: Euler's method, a large step."""
    xml = re.sub(r"<option[^>]*?/>|<option[^>]*?>", lambda m: _euler(m[0], timestep), system.xml, count=1)
    return replace(system, name=f"coarse_{system.name}", xml=xml, coarse=True)


def _euler(option: str, timestep: float) -> str:
    option = re.sub(r'integrator="\w+"', 'integrator="Euler"', option)
    return re.sub(r'timestep="[\d.]+"', f'timestep="{timestep}"', option)


TORQUE_ARM = System(
    name="torque_arm",
    xml="""
<mujoco model="torque_arm">
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="0.002"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="turret" pos="0 0 1">
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.6" armature="0.06"/>
      <geom name="turret" type="cylinder" size=".08 .06" mass="2"/>
      <body name="upper" pos="0.05 0 0">
        <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.3" armature="0.01"/>
        <geom name="upper" type="capsule" size=".035" fromto="0 0 0 0 .02 -.35" mass="1.8"/>
        <body name="fore" pos="0 .02 -.35">
          <joint name="elbow" type="hinge" axis="0 1 0" damping="0.2" armature="0.005" limited="true" range="-1.1 1.3"
                 solreflimit="0.08 1" solimplimit="0 0.9 0.3 0.5 2"/>
          <geom name="fore" type="capsule" size=".03" fromto="0 0 0 .02 0 -.3" mass="1.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="yaw_motor" joint="yaw" gear="4"/>
    <motor name="shoulder_motor" joint="shoulder" gear="8"/>
    <motor name="elbow_motor" joint="elbow" gear="3"/>
  </actuator>
</mujoco>""",
    declared={"upper_mass": mass("upper", 1.8), "fore_mass": mass("fore", 1.1)},
    commands=(
        Command(0.9, hold=(0.2, 0.0), joint="yaw", band=(0.3, 2.0)),
        Command(1.0, band=(0.3, 2.0)),
        Command(0.9, band=(0.3, 2.0)),
    ),
    start={"yaw": (1.0, 1.0), "shoulder": (1.2, 1.5), "elbow": (0.9, 1.5)},
    scales={
        "yaw": Scale(3.0, 3.0, 0.08),
        "shoulder": Scale(6.0, 4.0, 0.3),
        "elbow": Scale(2.0, 5.0, 0.04),
    },
    equivalents=groups(
        (("armature", "yaw"), ("inertia", "turret"), ("payload", "turret"), ("center_of_mass", "turret")),
    ),
)

SERVO_ARM = System(
    name="servo_arm",
    xml="""
<mujoco model="servo_arm">
  <option integrator="RK4" timestep="0.0025"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.5" armature="0.05"/>
      <geom name="upper" type="capsule" size=".04" fromto="0 0 0 .4 0 0" mass="2.5"/>
      <body name="fore" pos=".4 0 0">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.3" armature="0.02"/>
        <geom name="fore" type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1.2"/>
        <body name="hand" pos=".3 0 0">
          <joint name="wrist" type="hinge" axis="1 0 0" damping="0.02" armature="0.002"/>
          <geom name="hand" type="box" size=".05 .04 .015" pos=".05 0 .02" mass=".5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_servo" joint="shoulder" kp="90" kv="6"/>
    <position name="elbow_servo" joint="elbow" kp="40" kv="2"/>
    <position name="wrist_servo" joint="wrist" kp="2" kv="0.06"/>
  </actuator>
</mujoco>""",
    declared={"upper_mass": mass("upper", 2.5), "fore_mass": mass("fore", 1.2)},
    commands=(
        Command(0.7, offset=-0.2, band=(0.2, 1.5)),
        Command(0.8, offset=0.3, band=(0.2, 2.0)),
        Command(0.9, band=(0.2, 2.5)),
    ),
    start={"shoulder": (0.5, 1.0), "elbow": (0.6, 1.0), "wrist": (0.8, 2.0)},
    start_mean={"shoulder": -0.2, "elbow": 0.3},
    scales={
        "shoulder": Scale(25.0, 3.0, 0.6),
        "elbow": Scale(6.0, 4.0, 0.12),
        "wrist": Scale(0.4, 5.0, 0.003),
    },
    equivalents=groups(
        (("armature", "shoulder"), ("inertia", "upper")),
        (("fluid_drag", "upper"), ("joint_quadratic_damping", "shoulder")),
        (("armature", "wrist"), ("inertia", "hand")),
    ),
)

CART_POLE = System(
    name="cart_pole",
    xml="""
<mujoco model="cart_pole">
  <option integrator="RK4" timestep="0.005"/>
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="rail" type="slide" axis="1 0 0" damping="1.0"/>
      <geom name="cart" type="box" size=".12 .08 .05" mass="1.5"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom name="pole" type="capsule" size=".02" fromto="0 0 0 0 0 -.6" mass=".4"/>
        <geom name="bob" type="sphere" size=".03" pos="0 0 -.6" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" gear="10"/></actuator>
</mujoco>""",
    declared={"pole_mass": mass("pole", 0.5)},
    commands=(Command(0.9, hold=(0.15, 0.0), joint="rail", band=(0.3, 2.5)),),
    start={"rail": (0.3, 0.5), "hinge": (2.0, 3.0)},
    scales={"rail": Scale(7.0, 1.5, 1.8), "hinge": Scale(0.6, 5.0, 0.06)},
    equivalents=groups(
        (("actuator_bias", "push"), ("external_force", "cart")),
        (("fluid_drag", "cart"), ("joint_quadratic_damping", "rail")),
        (("armature", "rail"), ("payload", "cart")),
        (("armature", "hinge"), ("inertia", "pole")),
    ),
    substeps=20,
)

FURUTA = System(
    name="furuta",
    xml="""
<mujoco model="furuta">
  <option integrator="RK4" timestep="0.0025"/>
  <worldbody>
    <body name="arm" pos="0 0 .5">
      <joint name="turn" type="hinge" axis="0 0 1" damping="0.004" armature="0.0005"/>
      <geom name="arm" type="capsule" size=".012" fromto="0 0 0 .2 0 0" mass=".2"/>
      <body name="pendulum" pos=".2 0 0">
        <joint name="swing" type="hinge" axis="1 0 0" damping="0.0005"/>
        <geom name="pendulum" type="capsule" size=".008" fromto=".01 0 0 .01 0 -.24" mass=".12"/>
        <geom name="tip" type="sphere" size=".015" pos=".01 0 -.24" mass=".03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="turn" gear="0.15"/></actuator>
</mujoco>""",
    declared={"pendulum_mass": mass("pendulum", 0.15)},
    commands=(Command(0.9, hold=(0.15, 0.02), joint="turn", band=(0.4, 3.0)),),
    start={"turn": (1.5, 2.0), "swing": (2.0, 3.0)},
    scales={"turn": Scale(0.1, 5.0, 0.006), "swing": Scale(0.15, 7.0, 0.004)},
    equivalents=groups(
        (("armature", "turn"), ("inertia", "arm"), ("payload", "arm"), ("center_of_mass", "arm")),
        (("fluid_drag", "arm"), ("joint_quadratic_damping", "turn")),
    ),
    substeps=20,
)

PUCK = System(
    name="puck",
    xml="""
<mujoco model="puck">
  <option integrator="RK4" timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 .1" friction="0.02 0.005 0.0001" solref="0.04 1"
          solimp="0 0.9 0.01 0.5 2"/>
    <body name="puck" pos="0 0 0.03">
      <freejoint name="root"/>
      <geom name="puck" type="box" size=".12 .1 .03" mass="1.4" friction="0.25 0.005 0.0001" solref="0.04 1"
            solimp="0 0.9 0.01 0.5 2"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push_x" joint="root" gear="6 0 0 0 0 0"/>
    <motor name="push_y" joint="root" gear="0 6 0 0 0 0"/>
  </actuator>
</mujoco>""",
    declared={"puck_mass": mass("puck", 1.4)},
    commands=(Command(1.0, band=(0.3, 1.5)), Command(1.0, band=(0.3, 1.5))),
    start={"root": (0.0, 1.5)},
    scales={"root": Scale(4.0, 1.0, 1.4)},
    equivalents=groups(
        (("gravity_tilt", None), ("external_force", "puck")),
        (("contact_friction", "puck"), ("contact_friction", "floor")),
        (("contact_stiffness", "puck"), ("contact_stiffness", "floor")),
        (("contact_margin", "puck"), ("contact_margin", "floor"), ("sensor_bias", "root.position[z]")),
    ),
    free="root",
    substeps=30,
)


def _hopper_xml() -> str:
    """The bundled Hopper with a soft ground, whose force sets in smoothly, and a slippery floor geom."""
    xml = HOPPER_XML.read_text()
    xml = re.sub(r"<!--.*?-->|<visual>.*?</visual>|<asset>.*?</asset>|<light.*?/>|<camera.*?/>", "", xml, flags=re.S)
    xml = xml.replace(' material="floor"', "").replace(' rgba="0.25 0.45 0.65 1"', "")
    xml = xml.replace('timestep="0.002"', 'timestep="0.001"')
    xml = xml.replace('solimp="0.8 0.8 0.01" solref="0.02 1"', 'solimp="0 0.9 0.03 0.5 2" solref="0.05 1"')
    xml = xml.replace('limited="true"/>', 'limited="true" solreflimit="0.08 1" solimplimit="0 0.9 0.1 0.5 2"/>', 1)
    xml = xml.replace('margin="0.001"', "").replace('friction="1 0.005 0.0001"', 'friction="0.1 0.005 0.0001"')
    return re.sub(r"\n\s*\n", "\n", xml)


HOPPER = System(
    name="hopper",
    xml=_hopper_xml(),
    declared={
        "thigh_mass": {"field": "body_mass", "name": "thigh", "bounds": [2.0, 7.0], "unit": "kg"},
        "leg_mass": {"field": "body_mass", "name": "leg", "bounds": [1.4, 5.0], "unit": "kg"},
    },
    commands=(
        Command(0.35, -0.3, (0.5, 3.0), (0.7, 0.05), "thigh_joint", 1.0),
        Command(0.35, -0.6, (0.5, 3.0), (0.7, 0.05), "leg_joint", 1.0),
        Command(0.25, 0.3, (0.5, 3.0), (0.7, 0.05), "foot_joint", 1.0),
    ),
    start={
        "rootz": (0.05, 0.3), "rooty": (0.05, 0.2), "thigh_joint": (0.1, 0.5), "leg_joint": (0.1, 0.5),
        "foot_joint": (0.1, 0.5),
    },
    start_mean={"rootz": 1.3, "thigh_joint": -0.3, "leg_joint": -0.6, "foot_joint": 0.3},
    scales={
        "rootx": Scale(60.0, 1.0, 15.0), "rootz": Scale(100.0, 1.0, 15.0), "rooty": Scale(40.0, 2.0, 1.0),
        "thigh_joint": Scale(60.0, 3.0, 2.0), "leg_joint": Scale(60.0, 4.0, 1.5), "foot_joint": Scale(40.0, 4.0, 1.2),
    },
    equivalents=groups(
        (("contact_friction", "foot_geom"), ("contact_friction", "floor")),
        (("contact_stiffness", "foot_geom"), ("contact_stiffness", "floor")),
        (("contact_margin", "foot_geom"), ("contact_margin", "floor"), ("sensor_bias", "rootz.position")),
    ),
    observation=("qpos[1:]", "qvel"),
    episodes=20,
    transitions=(80, 110),
    substeps=60,
)  # fmt: skip

# --- passive systems: no actuator, only what they were given at the start ------------------------------------


def _released(system: System, **changes: object) -> System:
    """A system without its actuators."""
    xml = re.sub(r"<actuator>.*?</actuator>", "", system.xml, flags=re.S)
    return replace(system, xml=xml, commands=(), **changes)  # type: ignore[arg-type]


PASSIVE_PUCK = _released(
    replace(PUCK, xml=PUCK.xml.replace('friction="0.25 ', 'friction="0.12 ')),
    name="passive_puck",
    declared={
        "puck_inertia": {
            "field": "body_inertia", "name": "puck", "index": 2, "bounds": [0.006, 0.02], "unit": "kg m²",
        },
    },
    episodes=16,
    transitions=(100, 140),
    equivalents=(),
)  # fmt: skip

DOUBLE_PENDULUM = System(
    name="double_pendulum",
    xml="""
<mujoco model="double_pendulum">
  <option integrator="RK4" timestep="0.0025"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom name="upper" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".8"/>
      <body name="lower" pos="0 0 -.4">
        <joint name="knee" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom name="lower" type="capsule" size=".015" fromto="0 0 0 0 0 -.3" mass=".4"/>
      </body>
    </body>
  </worldbody>
</mujoco>""",
    declared={"lower_mass": mass("lower", 0.4)},
    commands=(),
    start={"pivot": (1.5, 2.0), "knee": (1.5, 3.0)},
    scales={"pivot": Scale(2.5, 4.0, 0.15), "knee": Scale(0.6, 6.0, 0.015)},
    substeps=30,
)

TUMBLER = System(
    name="tumbler",
    xml="""
<mujoco model="tumbler">
  <option integrator="RK4" timestep="0.002"/>
  <worldbody>
    <body name="brick">
      <freejoint name="root"/>
      <geom name="brick" type="box" size=".15 .1 .04" mass=".6"/>
    </body>
  </worldbody>
</mujoco>""",
    declared={
        "brick_inertia": {
            "field": "body_inertia", "name": "brick", "index": 0, "bounds": [0.001, 0.01], "unit": "kg m²",
        },
    },
    commands=(),
    start={"root": (0.5, 4.0)},
    scales={"root": Scale(6.0, 4.0, 0.6)},
    free="root",
    airborne=True,
    episodes=12,
    transitions=(100, 140),
    substeps=30,
)  # fmt: skip

# --- a fast legged system -------------------------------------------------------------------------------------


def _leg(side: str, x: float) -> str:
    return f"""
      <body name="{side}_thigh" pos="{x} 0 0">
        <joint name="{side}_hip" type="hinge" axis="0 1 0" range="-1.2 1.2"/>
        <geom name="{side}_thigh" type="capsule" size=".045" fromto="0 0 0 .05 0 -.28" mass="1.4"/>
        <body name="{side}_shin" pos=".05 0 -.28">
          <joint name="{side}_knee" type="hinge" axis="0 1 0" range="-1.2 1.2"/>
          <geom name="{side}_shin" type="capsule" size=".04" fromto="0 0 0 -.05 0 -.26" mass=".9"/>
        </body>
      </body>"""


RUNNER = System(
    name="runner",
    xml=f"""
<mujoco model="runner">
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="0.001"/>
  <default>
    <joint armature="0.05" damping="2" limited="true" solreflimit="0.08 1" solimplimit="0 0.9 0.1 0.5 2"/>
    <geom contype="1" conaffinity="0" friction="0.7 0.005 0.0001" solref="0.05 1" solimp="0 0.9 0.03 0.5 2"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="40 40 .1" contype="0" conaffinity="1" friction="0.1 0.005 0.0001"/>
    <body name="torso" pos="0 0 0.6">
      <joint name="rootx" type="slide" axis="1 0 0" limited="false" damping="0" armature="0"/>
      <joint name="rootz" type="slide" axis="0 0 1" limited="false" damping="0" armature="0"/>
      <joint name="rooty" type="hinge" axis="0 1 0" limited="false" damping="0" armature="0"/>
      <geom name="torso" type="capsule" size=".06" fromto="-.45 0 0 .45 0 0" mass="6"/>
      {_leg("back", -0.45)}
      {_leg("front", 0.45)}
    </body>
  </worldbody>
  <actuator>
    <motor name="back_hip_motor" joint="back_hip" gear="60"/>
    <motor name="back_knee_motor" joint="back_knee" gear="40"/>
    <motor name="front_hip_motor" joint="front_hip" gear="60"/>
    <motor name="front_knee_motor" joint="front_knee" gear="40"/>
  </actuator>
</mujoco>""",
    declared={"torso_mass": mass("torso", 6.0)},
    commands=tuple(
        Command(0.8, 0.0, (2.0, 4.0), (0.8, 0.03), joint, 1.5)
        for joint in ("back_hip", "back_knee", "front_hip", "front_knee")
    ),
    start={
        "rootz": (0.04, 0.3), "rooty": (0.05, 0.5), "rootx": (0.0, 2.0),
        **dict.fromkeys(("back_hip", "back_knee", "front_hip", "front_knee"), (0.3, 3.0)),
    },
    scales={
        j: Scale(t, 8.0, i)
        for j, t, i in (
            ("back_hip", 50.0, 0.3), ("back_knee", 30.0, 0.1), ("front_hip", 50.0, 0.3), ("front_knee", 30.0, 0.1),
        )
    },
    observation=("qpos[1:]", "qvel"),
    episodes=16,
    transitions=(100, 130),
    substeps=60,
)  # fmt: skip

# --- systems that walk ------------------------------------------------------------------------------------------

_SOFT = 'solref="0.05 1" solimp="0 0.95 0.03 0.5 2"'
_FEET = f'contype="1" conaffinity="0" friction="0.1 0.005 0.0001" {_SOFT}'
_GROUND = (
    f'<geom name="floor" type="plane" size="40 40 .1" contype="0" conaffinity="1" friction="0.6 0.005 0.0001" {_SOFT}/>'
)

CARRIAGE_LEG = System(
    name="carriage_leg",
    xml=f"""
<mujoco model="carriage_leg">
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="0.001"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    {_GROUND}
    <body name="carriage" pos="0 0 0.42">
      <joint name="along" type="slide" axis="1 0 0" damping="0.5"/>
      <joint name="up" type="slide" axis="0 0 1" damping="0.5"/>
      <geom name="carriage" type="box" size=".08 .05 .05" mass="1.6"/>
      <body name="thigh">
        <joint name="hip" type="hinge" axis="0 1 0" damping="0.05" armature="0.02"/>
        <geom name="thigh" type="capsule" size=".025" fromto="0 0 0 0 0 -.22" mass=".8"/>
        <body name="shank" pos="0 0 -.22">
          <joint name="knee" type="hinge" axis="0 1 0" damping="0.05" armature="0.02"/>
          <geom name="shank" type="capsule" size=".015" fromto="0 0 0 0 0 -.2" mass=".3"/>
          <geom name="foot" type="sphere" size=".025" pos="0 0 -.21" mass=".1" {_FEET}/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip_servo" joint="hip" kp="50" kv="1.5"/>
    <position name="knee_servo" joint="knee" kp="50" kv="1.5"/>
  </actuator>
</mujoco>""",
    declared={"carriage_mass": mass("carriage", 1.6)},
    commands=(Command(0.35, 0.6, (1.0, 3.5)), Command(0.45, -1.2, (1.0, 3.5))),
    start={"along": (0.1, 0.3), "up": (0.02, 0.1), "hip": (0.05, 0.5), "knee": (0.05, 0.5)},
    start_mean={"up": -0.01, "hip": 0.6, "knee": -1.2},
    scales={
        "along": Scale(15.0, 0.6, 2.5), "up": Scale(30.0, 0.6, 2.5), "hip": Scale(8.0, 5.0, 0.03),
        "knee": Scale(6.0, 6.0, 0.02),
    },
    equivalents=groups(
        (("contact_friction", "foot"), ("contact_friction", "floor")),
        (("contact_stiffness", "foot"), ("contact_stiffness", "floor")),
        (("contact_margin", "foot"), ("contact_margin", "floor"), ("sensor_bias", "up.position")),
        (("armature", "up"), ("armature", "along"), ("payload", "carriage")),
    ),
    episodes=16,
    transitions=(110, 140),
    substeps=60,
)  # fmt: skip

_CORNERS = {"FL": (0.19, 0.12), "FR": (0.19, -0.12), "RL": (-0.19, 0.12), "RR": (-0.19, -0.12)}


def _quadruped_leg(name: str, x: float, y: float) -> str:
    return f"""
      <body name="{name}_thigh" pos="{x} {y} 0">
        <joint name="{name}_hip" type="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom name="{name}_thigh" type="capsule" size=".025" fromto="0 0 0 0 0 -.2" mass=".7"/>
        <body name="{name}_shank" pos="0 0 -.2">
          <joint name="{name}_knee" type="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
          <geom name="{name}_shank" type="capsule" size=".015" fromto="0 0 0 0 0 -.19" mass=".2"/>
          <geom name="{name}_foot" type="sphere" size=".025" pos="0 0 -.2" mass=".06" {_FEET}/>
        </body>
      </body>"""


def _servos(name: str) -> str:
    return f"""
    <position name="{name}_hip_servo" joint="{name}_hip" kp="80" kv="2.5"/>
    <position name="{name}_knee_servo" joint="{name}_knee" kp="80" kv="2.5"/>"""


QUADRUPED = System(
    name="quadruped",
    xml=f"""
<mujoco model="quadruped">
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="0.001"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    {_GROUND}
    <body name="trunk" pos="0 0 0.4">
      <freejoint name="root"/>
      <geom name="trunk" type="box" size=".2 .09 .05" mass="6"/>
      {"".join(_quadruped_leg(n, x, y) for n, (x, y) in _CORNERS.items())}
    </body>
  </worldbody>
  <actuator>{"".join(map(_servos, _CORNERS))}
  </actuator>
</mujoco>""",
    declared={"trunk_mass": mass("trunk", 6.0)},
    commands=tuple(c for _ in _CORNERS for c in (Command(0.12, 0.7, (1.0, 3.0)), Command(0.2, -1.4, (1.0, 3.0)))),
    start={"root": (0.1, 0.2), **{f"{n}_{j}": (0.03, 0.3) for n in _CORNERS for j in ("hip", "knee")}},
    start_mean={f"{n}_{j}": a for n in _CORNERS for j, a in (("hip", 0.7), ("knee", -1.4))},
    scales={
        "root": Scale(60.0, 0.6, 8.0),
        **{f"{n}_{j}": Scale(t, 5.0, 0.03) for n in _CORNERS for j, t in (("hip", 12.0), ("knee", 9.0))},
    },
    equivalents=groups((("contact_margin", "floor"), ("sensor_bias", "root.position[z]"))),
    free="root",
    height=0.33,
    episodes=16,
    transitions=(90, 120),
    substeps=60,
)  # fmt: skip

#: The systems of the plain list; those of the unusual cases besides.
CORE = (
    TORQUE_ARM, SERVO_ARM, CART_POLE, FURUTA, PUCK, HOPPER,
    coarse(TORQUE_ARM, 0.005), coarse(FURUTA, 0.01), coarse(CART_POLE, 0.01),
)  # fmt: skip
UNUSUAL = (PASSIVE_PUCK, DOUBLE_PENDULUM, TUMBLER, RUNNER, coarse(SERVO_ARM, 0.005), coarse(PUCK, 0.01))
WALKING = (CARRIAGE_LEG, QUADRUPED)
SYSTEMS = {s.name: s for s in (*CORE, *UNUSUAL, *WALKING)}


def fine(system: System) -> System:
    """Return the system whose model a coarse one was made from; itself, where it is not coarse."""
    return SYSTEMS[system.name.removeprefix("coarse_")]
