"""The Warp backend against C MuJoCo: the same states, and gradients against central differences of MuJoCo.

The reference is stepped with the solver's tolerance at zero, so that what differs is the backend.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.parameters import ParameterSpace, object_names
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

ASSETS = Path(gymnasium.__file__).parent / "envs/mujoco/assets"


def rollouts(
    model: mujoco.MjModel,
    count: int,
    *,
    seed: int = 0,
    length: int = 25,
    every: int = 4,
    spread: float = 0.1,
    push: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """States ``(count, nq + nv)`` on the way of random controls from random starts, and controls ``(count, 1, nu)``."""
    rng = np.random.default_rng(seed)
    model = copy.copy(model)
    data = mujoco.MjData(model)
    states, controls = [], []
    while len(states) < count:
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-spread, spread, model.nv), 1.0)
        data.qvel[:] = rng.uniform(-10 * spread, 10 * spread, model.nv)
        for k in range(length):
            control = push * rng.uniform(-1, 1, model.nu)
            data.ctrl[:] = control
            if k % every == every - 1:
                states.append(np.r_[data.qpos, data.qvel])
                controls.append(control)
            for _ in range(4):
                mujoco.mj_step(model, data)
    return np.array(states[:count]), np.array(controls[:count]).reshape(count, 1, model.nu)


@dataclass(frozen=True)
class Case:
    """A system, what varies, and how closely it must agree."""

    name: str
    xml: str
    parameters: dict
    skip: int = 2
    states: float = 1e-9
    median: float = 1e-6
    most: float = 1e-3  # nine in ten
    spread: float = 0.3
    push: float = 1.0
    length: int = 25
    seed: int = 0
    lag: int = 1
    idle: tuple[str, ...] = ()  # parameters without effect on this motion

    def model(self) -> mujoco.MjModel:
        if self.xml.endswith(".xml"):
            return mujoco.MjModel.from_xml_path(str(ASSETS / self.xml))
        return mujoco.MjModel.from_xml_string(self.xml)


def check(case: Case, count: int = 12) -> None:
    model = case.model()
    space = ParameterSpace(model, case.parameters)
    states, controls = rollouts(model, count, spread=case.spread, push=case.push, length=case.length, seed=case.seed)
    if case.lag > 1:
        later = np.random.default_rng(case.seed).uniform(-case.push, case.push, (count, case.lag - 1, model.nu))
        controls = np.concatenate([controls, later], 1)
    simulator = WarpSimulator(model, parameters=space, frame_skip=case.skip, num_threads=1)
    report = check_simulator(
        simulator,
        torch.from_numpy(states),
        torch.from_numpy(controls),
        torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), case.skip),
        tolerance=Tolerance(states=case.states, worst=1e3 * case.states, gradient=case.median, most=case.most),
        idle=case.idle,
    )
    assert "gradients are those of central differences" in report.checked


def gym_parameters(file: str) -> dict:
    """All masses and dampings of a Gymnasium model, each pair of bodies and joints thinned to keep the test quick."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / file))
    out = {}
    for b in range(1, model.nbody):
        name = object_names(model, "body")[b]
        out[f"mass_{name}"] = {"field": "body_mass", "name": name, "bounds": [0.001, 100]}
    for j in range(model.njnt):
        name = object_names(model, "jnt")[j]
        if model.jnt_type[j] >= 2 and model.dof_damping[model.jnt_dofadr[j]] > 0:
            out[f"damping_{name}"] = {"field": "dof_damping", "name": name, "bounds": [0, 10]}
    return out


GYMNASIUM = [
    "hopper.xml", "walker2d_v5.xml", "half_cheetah.xml", "inverted_pendulum.xml", "inverted_double_pendulum.xml",
    "ant.xml", "reacher.xml", "swimmer.xml",
]  # fmt: skip


@pytest.mark.parametrize("file", GYMNASIUM)
def test_gymnasium_models(file, capfd):
    idle = ("mass_target",)
    check(Case(file, file, gym_parameters(file), spread=0.1, states=1e-10, idle=idle), count=8)


HOPPER = {
    "damping": {"field": "dof_damping", "name": "leg_joint", "bounds": [0.1, 3]},
    "armature": {"field": "dof_armature", "name": "leg_joint", "bounds": [0.1, 3]},
    "gear": {"field": "actuator_gear", "name": "leg_joint", "bounds": [100, 300]},
    "gain": {"field": "actuator_gainprm", "name": "foot_joint", "bounds": [0.1, 3]},
    "inertia": {"field": "body_inertia", "name": "leg", "index": 1, "bounds": [0.01, 1]},
    "ipos": {"field": "body_ipos", "name": "leg", "index": 0, "bounds": [-1, 1]},
    "friction": {"field": "geom_friction", "name": "foot_geom", "bounds": [0.5, 3]},
    "gravity": {"field": "opt.gravity", "index": 2, "bounds": [-12, -8]},
    "solref": {"field": "geom_solref", "name": "foot_geom", "index": 0, "bounds": [0.01, 0.1]},
    "solimp": {"field": "geom_solimp", "name": "foot_geom", "index": 0, "bounds": [0.5, 0.95]},
    "margin": {"field": "geom_margin", "name": "foot_geom", "bounds": [0, 0.1]},
}


def test_hopper_through_four_substeps():
    check(Case("hopper", "hopper.xml", HOPPER, skip=4, states=1e-10, spread=0.05, length=100), count=14)


ARM = """<mujoco><option integrator="{integrator}" timestep="0.004" {option}/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
 <body name="a" pos="0 0 1" gravcomp="0.3"><joint name="ja" type="hinge" axis="0 1 0.2" damping="0.3"
   stiffness="3" springref="20" frictionloss="{loss}" limited="true" range="-12 12"/>
  <geom type="capsule" fromto="0 0 0 .3 0 .1" size=".03" mass="1.2"/>
  <body name="b" pos=".3 0 .1" gravcomp="0.6"><joint name="jb" type="{second}" axis="0.3 1 0" armature=".02"
    damping="0.1" {limit}/>
   <geom type="box" pos=".1 .02 0" size=".1 .03 .02" mass=".7"/>
   <body name="c" pos=".2 0 0" quat="0.9 0.1 0.3 0.2"><joint name="jc" type="slide" axis="0 0 1" pos=".1 0 .05"
     damping="2" stiffness="50"/>
    <geom type="ellipsoid" size=".05 .04 .08" mass=".4"/></body></body></body>
</worldbody>
<actuator>{actuators}</actuator>{extra}</mujoco>"""
SERVOS = """<position name="pa" joint="ja" kp="20" kv="1.5" ctrlrange="-.6 .6" forcerange="-4 4"/>
<velocity name="vc" joint="jc" kv="3" gear="2" ctrllimited="true" ctrlrange="-.5 .5"/>
<general name="gc" joint="jc" gaintype="affine" biastype="affine" gainprm="2 .5 -.3" biasprm=".2 -1 -.5" gear="1.5"/>"""


TURNED = """<motor name="turn" joint="jb" gear="1 .5 -.3" forcerange="-.4 .4"/>
<general name="damp" joint="jb" gaintype="affine" biastype="affine" gainprm="2 0 -.3" biasprm=".2 0 -.5" gear=".3 0 1"/>
<position name="pa" joint="ja" kp="20" kv="1.5"/>"""


FILTERED = """<general name="pa" joint="ja" dyntype="filter" dynprm=".02" gaintype="affine" biastype="affine"
 gainprm="9 .5 -.3" biasprm=".2 -9 -.5" ctrlrange="-.9 .9"/>
<general name="vb" joint="jb" dyntype="filterexact" dynprm=".015" gainprm="2" actlimited="true" actrange="-.4 .5"
 actearly="true"/>
<general name="gc" joint="jc" dyntype="filterexact" dynprm=".03" gaintype="affine" gainprm="2 0 -1.5" gear="1.5"
 forcerange="-1 1.2"/><motor name="plain" joint="jc"/>"""

GEARED = """<position name="pa" joint="ja" kp="20" gear="1.5" damping=".3 .2 .1"/>
<motor name="gc" joint="jc" gear="2" armature=".1" damping=".2"/>
<motor name="mc" joint="jc" gear=".5" armature=".3"/>"""


def arm(**changes: str) -> str:
    settings = {"integrator": "Euler", "option": "", "loss": "0", "second": "hinge", "limit": "", "extra": "",
                "actuators": SERVOS} | changes  # fmt: skip
    return ARM.format(**settings)


def p(field_: str, name: str | None = None, index: int | None = None, bounds=(-1e3, 1e3)) -> dict:
    low = (
        0
        if field_.startswith(("dof_", "actuator_k", "jnt_stiffness", "body_gravcomp", "geom_fric", "opt.d", "opt.v"))
        else bounds[0]
    )
    low = 1e-6 if field_ in ("body_mass", "body_inertia", "pair_friction") else low
    out = {"field": field_, "bounds": [low, bounds[1]]}
    return out | ({"name": name} if name else {}) | ({"index": index} if index is not None else {})


JOINTS = {
    "mass": p("body_mass", "b"), "inertia": p("body_inertia", "b", 0), "ipos": p("body_ipos", "b", 1),
    "gravcomp": p("body_gravcomp", "b"), "stiffness": p("jnt_stiffness", "ja"),
    "poly": p("jnt_stiffnesspoly", "ja", 1), "springref": p("qpos_spring", "ja"), "damping": p("dof_damping", "jc"),
    "dpoly0": p("dof_dampingpoly", "ja", 0), "dpoly1": p("dof_dampingpoly", "ja", 1),
    "armature": p("dof_armature", "jc"), "range": p("jnt_range", "ja", 1), "jnt_solref": p("jnt_solref", "ja", 0),
    "gravity": p("opt.gravity", index=0),
}  # fmt: skip
DRIVES = {
    "kp": p("actuator_kp", "pa"), "kv": p("actuator_kv", "pa"), "gear": p("actuator_gear", "gc"),
    "gain1": p("actuator_gainprm", "gc", 1), "gain2": p("actuator_gainprm", "gc", 2),
    "bias0": p("actuator_biasprm", "gc", 0), "bias2": p("actuator_biasprm", "gc", 2),
    "forcerange": p("actuator_forcerange", "pa", 1), "ctrlrange": p("actuator_ctrlrange", "vc", 0),
}  # fmt: skip
FILTERS = {
    "tau": p("actuator_dynprm", "pa", 0, (1e-3, 1)), "early": p("actuator_dynprm", "vb", 0, (1e-3, 1)),
    "exact": p("actuator_dynprm", "gc", 0, (1e-3, 1)), "actrange": p("actuator_actrange", "vb", 1),
    "gain2": p("actuator_gainprm", "gc", 2), "mass": p("body_mass", "b"),
}  # fmt: skip
GEARS = {
    "damping": p("actuator_damping", "gc", bounds=(0, 10)), "poly": p("actuator_dampingpoly", "pa", 1),
    "armature": p("actuator_armature", "mc", bounds=(0, 10)), "gear": p("actuator_gear", "gc"),
    "inertia": p("body_inertia", "c", 1),
}  # fmt: skip
LOSS = {"loss": p("dof_frictionloss", "ja"), "mass": p("body_mass", "b")}
STUCK = {"dof_solref": p("dof_solref", "ja", 0), "dof_solimp": p("dof_solimp", "ja", 0), "mass": p("body_mass", "b")}
EQUALITY = '<equality><joint joint1="jc" joint2="ja" polycoef=".01 .05 .1 .02 .03"/></equality>'
DRAG = {"density": p("opt.density"), "viscosity": p("opt.viscosity"), "wind": p("opt.wind", index=1)}

TREES = [
    Case("Euler", arm(), JOINTS | DRIVES),
    Case("RK4", arm(integrator="RK4"), JOINTS | DRIVES),
    Case("implicitfast", arm(integrator="implicitfast"), JOINTS | DRIVES),
    Case("filters", arm(actuators=FILTERED), FILTERS, lag=3),
    Case("filters RK4", arm(actuators=FILTERED, integrator="RK4"), FILTERS, lag=3),
    Case("filters implicitfast", arm(actuators=FILTERED, integrator="implicitfast"), FILTERS, lag=3),
    Case("geared damping", arm(actuators=GEARED), GEARS),
    Case("geared damping RK4", arm(actuators=GEARED, integrator="RK4"), GEARS),
    Case("geared damping implicitfast", arm(actuators=GEARED, integrator="implicitfast"), GEARS),
    Case(
        "gravity compensation by actuators",
        arm().replace('gravcomp="0.6"', 'gravcomp="-.4"').replace('name="ja"', 'name="ja" actuatorgravcomp="true"'),
        {"mass": p("body_mass", "b"), "kp": p("actuator_kp", "pa")},
    ),
    Case("frictionloss", arm(loss="0.8"), JOINTS | LOSS, most=1e-2),
    Case("frictionloss RK4", arm(loss="0.8", integrator="RK4"), JOINTS | LOSS, most=1e-2),
    Case("stuck", arm(loss="30"), STUCK, most=1e-2),
    Case(
        "equality",
        arm(extra=EQUALITY),
        {
            "c1": p("eq_data", "equality0", 1),
            "c3": p("eq_data", "equality0", 3),
            "eq_solref": p("eq_solref", "equality0", 0),
            "mass": p("body_mass", "b"),
        },
    ),
    Case(
        "ball",
        arm(second="ball", limit='limited="true" range="0 25" stiffness="2"'),
        {
            "stiffness": p("jnt_stiffness", "jb"),
            "damping": p("dof_damping", "jb"),
            "range": p("jnt_range", "jb", 1),
            "mass": p("body_mass", "b"),
        },
    ),
    Case(
        "ball RK4",
        arm(second="ball", integrator="RK4", limit='stiffness="2"'),
        {
            "stiffness": p("jnt_stiffness", "jb"),
            "poly": p("jnt_stiffnesspoly", "jb", 0),
            "inertia": p("body_inertia", "b", 2),
        },
    ),
    Case(
        "ball driven",
        arm(second="ball", actuators=TURNED),
        {
            "gear": p("actuator_gear", "turn", 1),
            "damp_gear": p("actuator_gear", "damp", 2),
            "bias2": p("actuator_biasprm", "damp", 2),
            "gain2": p("actuator_gainprm", "damp", 2),
            "forcerange": p("actuator_forcerange", "turn", 1),
        },
    ),
    Case(
        "drag",
        arm(option='density="200" viscosity="2" wind="1 2 -3"'),
        DRAG | {"mass": p("body_mass", "b"), "inertia": p("body_inertia", "b", 2), "ipos": p("body_ipos", "b", 0)},
    ),
    Case(
        "total force",
        arm(actuators=SERVOS).replace('stiffness="50"', 'stiffness="50" actuatorfrcrange="-3 3"'),
        {"frcrange": p("jnt_actfrcrange", "jc", 0), "gear": p("actuator_gear", "gc")},
        push=3.0,
    ),
]


@pytest.mark.parametrize("case", TREES, ids=lambda c: c.name)
def test_trees(case):
    check(case)


SCENE = """<mujoco><option timestep="0.004" cone="{cone}" integrator="{integrator}" impratio="{impratio}"/>
<default><geom condim="{condim}" friction=".6 .02 .003" {geom}/></default>
<worldbody><geom name="floor" type="plane" size="5 5 1" zaxis="{slope} 0 1" friction=".5 .01 .001"/>
{bodies}</worldbody>{extra}</mujoco>"""
FREE = '<body name="{name}" pos="{pos}" quat="{quat}"><freejoint/><geom name="g{name}" {geom}/></body>'


def free(name: str, pos: str, geom: str, quat: str = "1 0 0 0") -> str:
    return FREE.format(name=name, pos=pos, geom=geom, quat=quat)


def scene(bodies: str, **changes: str) -> str:
    settings = {
        "cone": "pyramidal",
        "integrator": "Euler",
        "impratio": "1",
        "condim": "3",
        "geom": "",
        "slope": ".1",
        "extra": "",
    } | changes
    return SCENE.format(bodies=bodies, **settings)


#: A body that floats, is pushed and turned, beside a joint with a range of its own.
AFLOAT = """<body name="raft" pos="0 0 2"><freejoint name="root"/><geom type="box" size=".3 .2 .1" density="100"/>
<body pos=".1 0 0"><joint name="hinge" axis="0 1 .2" {range}/><geom type="capsule" fromto="0 0 0 .4 .1 0" size=".04"/>
</body></body>"""
PUSHED = """<actuator><motor name="push" joint="root" gear="3 .5 0 .1 0 -.2"/>
<general name="brake" joint="root" gaintype="affine" biastype="affine" gainprm="1 .7 -.1" biasprm=".1 .8 -.4"
gear="0 1 .5 0 .2 .1" ctrlrange="-.5 .5"/><motor joint="hinge"/></actuator>"""
RAFT = {
    "gear": p("actuator_gear", "push", 0), "gear4": p("actuator_gear", "brake", 4), "mass": p("body_mass", "raft"),
    "gain2": p("actuator_gainprm", "brake", 2), "bias2": p("actuator_biasprm", "brake", 2),
}  # fmt: skip
#: A vehicle of four propellers, one of them behind a filter, that carries something on a hinge.
FLOWN = """<body name="drone" pos="0 0 1"><freejoint/><geom type="box" size=".2 .15 .03" mass="1.2"/>
<site name="p1" pos=".2 .15 .02" quat="1 .05 0 0"/><site name="p2" pos="-.2 .15 .02" quat="1 0 -.05 0"/>
<site name="p3" pos="-.2 -.15 .02"/><body pos="0 0 -.05"><joint name="swing" axis="0 1 0" damping=".02"/>
<geom type="capsule" fromto="0 0 0 .05 0 -.2" size=".02" mass=".2"/><site name="p4" pos="0 .1 -.2" quat=".8 0 .1 .2"/>
</body></body>"""
FLYING = """<actuator><general name="t1" site="p1" gear="0 0 4 0 0 -.1" ctrlrange="-.7 .8" forcerange="-.6 .6"/>
<general name="t2" site="p2" gear="0 0 4 0 0 .1" dyntype="filterexact" dynprm=".03" biastype="affine" biasprm=".3"/>
<motor name="t3" site="p3" gear=".2 -.1 3 .1 .2 .3"/><motor name="t4" site="p4" gear="1 2 0 0 .1 0"/></actuator>"""
FLIGHT = {
    "gear": p("actuator_gear", "t1", 2), "torque": p("actuator_gear", "t3", 4), "gain": p("actuator_gainprm", "t2"),
    "bias": p("actuator_biasprm", "t2", 0), "mass": p("body_mass", "drone"), "range": p("actuator_forcerange", "t1", 1),
    "tau": p("actuator_dynprm", "t2", 0, (1e-3, 1)),
}  # fmt: skip
BOX = free("box", "0 0 .11", 'type="box" size=".15 .1 .1"')
CYLINDER = free("cylinder", "0 0 .13", 'type="cylinder" size=".1 .12"', "0.9 0.2 0 0.1")
ELLIPSOID = free("ellipsoid", "0 0 .1", 'type="ellipsoid" size=".15 .1 .08"', "0.9 0.2 0.1 0.1")
#: Lengthwise on each other and free in all that keeps them parallel.
PARALLEL = "".join(
    f'''<body name="{name}" pos="{pos}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
    <joint type="slide" axis="0 0 1"/><joint type="hinge" axis="1 0 0"/>
    <geom name="g{name}" type="capsule" size="{size}" euler="0 90 0" friction=".6 .01 .01"/></body>'''
    for name, pos, size in (("one", "0 0 .1", ".1 .15"), ("two", ".05 .02 .27", ".08 .1"))
)
CAPSULES = free("one", "0 0 .1", 'type="capsule" size=".1 .15"', "0.7 0.7 0 0.1") + free(
    "two", "0.05 0 .28", 'type="capsule" size=".08 .1"', "0.7 0 0.7 0.2"
)
PUSH = free("ball", "0 0 .1", 'type="sphere" size=".1"') + free("box", ".23 0 .1", 'type="box" size=".13 .1 .1"')
SPHERES = free("one", "0 0 .1", 'type="sphere" size=".1"') + free("two", ".15 0 .1", 'type="sphere" size=".07"')


def contact_parameters(body: str) -> dict:
    return {
        "mass": p("body_mass", body),
        "friction": p("geom_friction", f"g{body}"),
        "solref": p("geom_solref", "floor", 0),
        "margin": p("geom_margin", "floor"),
        "inertia": p("body_inertia", body, 1),
    }


CONTACTS = [
    Case("afloat", scene(AFLOAT.format(range=""), extra=PUSHED), RAFT),
    Case("afloat RK4", scene(AFLOAT.format(range='actuatorfrcrange="-.1 .1"'), extra=PUSHED, integrator="RK4"), RAFT),
    Case("flown", scene(FLOWN, extra=FLYING), FLIGHT, lag=2),
    Case("flown RK4", scene(FLOWN, extra=FLYING, integrator="RK4"), FLIGHT, lag=2),
    Case("flown implicitfast", scene(FLOWN, extra=FLYING, integrator="implicitfast"), FLIGHT, lag=2),
    Case("box slides", scene(BOX), contact_parameters("box"), length=40),
    Case("box, elliptic", scene(BOX, cone="elliptic", impratio="3"), contact_parameters("box"), length=40, states=1e-8),
    Case("box, condim 4", scene(BOX, condim="4"), contact_parameters("box"), length=40),
    Case(
        "box, condim 6 elliptic",
        scene(BOX, condim="6", cone="elliptic"),
        contact_parameters("box"),
        length=40,
        states=1e-8,
    ),
    Case("box, frictionless RK4", scene(BOX, condim="1", integrator="RK4"), {"mass": p("body_mass", "box")}, length=40),
    Case("cylinder", scene(CYLINDER), contact_parameters("cylinder"), length=40),
    Case("ellipsoid", scene(ELLIPSOID), contact_parameters("ellipsoid"), length=40),
    Case("capsules", scene(CAPSULES), contact_parameters("one"), length=40),
    Case(
        "capsules, parallel",
        scene(PARALLEL),
        contact_parameters("one"),
        length=40,
        push=0.3,
        idle=("inertia", "solref", "margin", "friction"),
    ),
    Case("capsules, elliptic", scene(CAPSULES, cone="elliptic"), contact_parameters("two"), length=40, states=1e-8),
    Case("sphere pushes box", scene(PUSH, slope="0"), contact_parameters("box"), length=40),
    Case(
        "sphere pushes box, elliptic",
        scene(PUSH, slope="0", cone="elliptic"),
        contact_parameters("box"),
        length=40,
        states=1e-8,
    ),
    Case("spheres, condim 6", scene(SPHERES, slope=".1", condim="6"), contact_parameters("one"), spread=0.02),
    Case(
        "margin, direct solref",
        scene(BOX, geom='margin=".01" gap=".005" solref="-5000 -90" solimp=".7 .9 .02 .4 3"'),
        {
            "mass": p("body_mass", "box"),
            "stiffness": p("geom_solref", "floor", 0),
            "damping": p("geom_solref", "floor", 1),
            "width": p("geom_solimp", "gbox", 2),
            "power": p("geom_solimp", "gbox", 4),
        },
        length=40,
    ),
    Case(
        "priority",
        scene(BOX.replace("<geom", '<geom priority="1" solmix="3" friction=".2 .01 .01"')),
        {"friction": p("geom_friction", "gbox"), "solref": p("geom_solref", "gbox", 0)},
        length=40,
    ),
    Case(
        "explicit pair",
        scene(
            BOX,
            cone="elliptic",
            extra='<contact><pair name="contact" geom1="floor" geom2="gbox" '
            'condim="4" friction=".4 .7 .01 .001 .001" solref=".03 .9" solreffriction=".05 .8" margin=".002"/>'
            "</contact>",
        ),
        {
            "mu1": p("pair_friction", "contact", 0),
            "mu2": p("pair_friction", "contact", 1),
            "solreffriction": p("pair_solreffriction", "contact", 0),
        },
        length=40,
        states=1e-8,
    ),
]


WELDED = """<mujoco><worldbody><body pos="0 0 .1" euler="4 0 0"><geom name="floor" type="plane" size="5 5 1"/></body>
<body name="a" pos="0 0 .3" quat=".9 .1 .2 0"><joint type="slide" axis="0 0 1"/><joint axis="1 .2 0"/>
<geom type="sphere" size=".1"/><body name="b" pos=".2 0 0" euler="10 20 30"><geom type="capsule" size=".05 .2"
pos="0 0.1 -.1"/><body name="c" pos="0 .1 0"><geom type="sphere" size=".08"/><body name="d" pos="0 0 -.1">
<joint axis="0 1 0"/><geom type="box" size=".05 .1 .05"/></body></body></body></body></worldbody></mujoco>"""
IN_BOX = """<mujoco><worldbody><geom name="floor" type="box" size=".5 .5 .5"/><body name="ball" pos=".1 .05 .55">
<freejoint/><geom name="gball" type="sphere" size=".1"/></body></worldbody></mujoco>"""
LOOP = """<mujoco><worldbody><body name="a"><joint name="a" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/><body name="b"
pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></body><body name="c" pos="0 2 0">
<joint name="c" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></worldbody><equality><joint joint1="b"
polycoef=".3 0 0 0 0"/><joint joint1="a" joint2="c" polycoef="0 1.5 .2 0 0"/></equality></mujoco>"""
OVER_EDGE = """<mujoco><worldbody><geom name="floor" type="box" size=".5 .4 .5"/><body name="rod" pos=".45 .05 .56"
euler="3 85 10"><freejoint/><geom name="grod" type="capsule" size=".05 .2" friction=".7 .01 .01"/></body></worldbody>
</mujoco>"""
STACK = BOX + free("upper", ".03 .02 .29", 'type="box" size=".1 .12 .08"', "0.95 0 0 0.1")
ON_EDGE = BOX + free("upper", ".1 .12 .33", 'type="box" size=".05 .04 .2"', "0.8 0.3 0.4 0.1")
DRUM = '<geom type="cylinder" size=".15 .1" pos="0 0 .1" euler="4 3 0" friction=".3 .01 .001"/>'
ROLLS = DRUM + free("ball", ".2 .05 .1", 'type="sphere" size=".08"')
BALL = {
    "mass": p("body_mass", "ball"), "friction": p("geom_friction", "gball"), "solref": p("geom_solref", "gball", 0),
}  # fmt: skip
BALANCED = DRUM + free("ball", ".08 .05 .27", 'type="sphere" size=".08"')
#: A hull with a flat bottom of five corners, started a little tilted.
HULL = '<asset><mesh name="hull" vertex="-.2 -.1 0 .2 -.1 0 .25 .1 0 -.2 .12 0 0 .2 0 .1 0 .3 -.15 -.05 .2"/></asset>'
MESH = free("hull", "0 0 .12", 'type="mesh" mesh="hull"', "0.99 0.05 0.02 0.1")
#: A finger of a box on two slides pushes a box on a table of a box.
FINGER = """<geom name="table" type="box" size=".6 .5 .05" pos="0 0 -.049"/><body name="finger" pos="-.18 .02 .06">
<joint name="x" type="slide" axis="1 0 0" damping="2"/><joint name="turn" axis="0 0 1" damping=".1"/>
<geom name="gfinger" type="box" size=".04 .06 .05"/></body>"""
PUSHED_BOX = FINGER + free("box", "0 0 .1", 'type="box" size=".13 .1 .1"')
FINGER_MOTORS = '<actuator><motor joint="x" gear="12"/><motor joint="turn" gear=".3"/></actuator>'
ON_BOX = BOX + free("rod", ".02 .03 .27", 'type="capsule" size=".06 .15"', "0.7 0.1 0.7 0.1")
CONTACTS += [
    Case(
        "capsule over an edge",
        OVER_EDGE,
        {
            "mass": p("body_mass", "rod"),
            "friction": p("geom_friction", "floor"),
            "solref": p("geom_solref", "floor", 0),
        },
        length=16,
        spread=0.1,
    ),
    Case("capsule on a box", scene(ON_BOX, slope="0"), contact_parameters("rod"), length=8, spread=0.1),
    Case(
        "capsule on a box, elliptic",
        scene(ON_BOX, slope="0", cone="elliptic", condim="6"),
        contact_parameters("rod"),
        length=8,
        spread=0.1,
        states=1e-8,
    ),
    Case("boxes, stacked", scene(STACK, slope=".05"), contact_parameters("upper"), length=24),
    Case(
        "boxes, stacked, elliptic RK4",
        scene(STACK, slope=".05", cone="elliptic", condim="4", integrator="RK4", geom='margin=".01" gap=".004"'),
        contact_parameters("upper"),
        length=24,
        states=1e-8,
    ),
    Case("boxes, edge on edge", scene(ON_EDGE, slope="0"), contact_parameters("upper"), length=32, spread=0.1),
    Case(
        "a box pushed by a box on a box",
        scene(PUSHED_BOX, slope="0", cone="elliptic", extra=FINGER_MOTORS),
        {
            "mass": p("body_mass", "box"),
            "friction": p("geom_friction", "gbox"),
            "solref": p("geom_solref", "table", 0),
            "finger": p("body_mass", "finger"),
        },
        length=24,
        spread=0.05,
        states=1e-8,
    ),
    Case("mesh", scene(MESH, extra=HULL), contact_parameters("hull"), length=40),
    Case(
        "mesh, elliptic RK4",
        scene(MESH, extra=HULL, cone="elliptic", condim="6", integrator="RK4", geom='margin=".02" gap=".01"'),
        contact_parameters("hull"),
        length=40,
        states=1e-8,
    ),
    Case("ball beside a cylinder", scene(ROLLS, slope="0"), BALL, length=16, spread=0.1),
    Case("ball on a cylinder", scene(BALANCED, slope="0"), BALL, length=16, spread=0.1),
    Case("welded bodies", WELDED, {"b": p("body_mass", "b"), "c": p("body_mass", "c")}, most=1e-2),
    Case("sphere in a box", IN_BOX, {"mass": p("body_mass", "ball"), "solref": p("geom_solref", "floor", 0)}, length=8),
    Case("equalities across trees", LOOP, {"b": p("body_mass", "b"), "c": p("body_mass", "c")}),
]


@pytest.mark.parametrize("case", CONTACTS, ids=lambda c: c.name)
@pytest.mark.parametrize("spread", [0.03, 0.3], ids=["resting and sliding", "falling"])
def test_contacts(case, spread):
    if spread < 0.1:  # started at rest on the ground; the parameters that then do nothing are tested by the other
        case = replace(case, spread=spread, idle=tuple(case.parameters), length=24)
    check(case)


def test_capsules_whose_axes_cross_part_across_both() -> None:
    """In a planar robot the nearest points of two limbs that overlap are one; their normal then is perpendicular."""
    rng = np.random.default_rng(5)
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option gravity="0 0 0"/><worldbody>
        <body name="a">{joints}<joint axis="0 1 0"/><geom type="capsule" size=".02 .2"/></body>
        <body name="b">{joints}<joint axis="0 1 0"/><geom type="capsule" size=".03 .25"/></body>
        </worldbody></mujoco>""")
    space = ParameterSpace(model, {"mass": {"field": "body_mass", "name": "a", "bounds": [0.01, 9]}})
    qpos = np.zeros((50, 8))
    qpos[:, [0, 2, 4, 6]] = rng.uniform(-0.03, 0.03, (50, 4))
    qpos[:, [3, 7]] = np.stack([rng.uniform(-3, 0, 50), rng.uniform(0.1, 3, 50)], axis=1)
    states = torch.from_numpy(np.concatenate([qpos, rng.normal(0, 0.1, (50, 8))], axis=1))
    controls, values = torch.zeros(50, 1, 0, dtype=torch.float64), torch.from_numpy(space.nominal)[None]
    found = WarpSimulator(model, parameters=space, frame_skip=1).simulate(states, controls, values)
    expected = mujoco_reference(space)(states, controls, values)[:, :, 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-11)
