"""Welds, connects, tendons and mocap bodies: next states of C MuJoCo, and its central differences as gradients."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from test_warp_conformance import Case, check, p

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.hidden import prescribed_bodies
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.fields import Fields
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

#: An arm with two branches beside a body on a rail, a mocap body that moves nothing by itself, and sites on them all.
RIG = """<mujoco><option integrator="{integrator}" timestep="0.004"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<site name="w0" pos="-.1 .1 1.2"/><site name="w1" pos=".3 .2 .7"/>
<body name="hand" mocap="true" pos=".35 .1 1.1" quat=".9 .2 .1 .3"/>
<body name="a" pos="0 0 1"><joint name="ja" axis="0 1 .2" damping=".3"/>
 <geom type="capsule" fromto="0 0 0 .3 0 .1" size=".03"/><site name="sa" pos=".1 .1 .05"/>
 <body name="b" pos=".3 0 .1"><joint name="jb" type="{second}" axis=".3 1 0" armature=".02" damping=".1"/>
  <geom type="box" pos=".1 .02 0" size=".1 .03 .02"/><site name="sb" pos=".05 .1 0" euler="10 20 30"/>
  <body name="c" pos=".2 0 0" quat=".9 .1 .3 .2"><joint name="jc" axis="0 0 1"/>
   <geom type="ellipsoid" size=".05 .04 .08"/><site name="sc" pos=".05 .06 .02"/></body></body>
 <body name="e" pos=".1 -.1 0"><joint name="je" axis="1 0 .3"/><geom type="box" pos="0 -.1 0" size=".03 .1 .02"/>
  <site name="se" pos="0 -.15 .04"/></body></body>
<body name="d" pos="0 .3 1"><joint name="jd" type="slide"/><joint axis="0 1 0"/><geom type="box" size=".1 .05 .03"/>
 <site name="sd" pos=".02 .1 0" euler="70 20 30"/></body>
</worldbody>{extra}</mujoco>"""
FIXED = """<tendon><fixed name="t" {t}><joint joint="ja" coef=".7"/><joint joint="jc" coef="-.4"/>
<joint joint="je" coef=".3"/></fixed>
<fixed name="s" {s}><joint joint="jc" coef="1.5"/><joint joint="jd" coef="1"/></fixed></tendon>"""
SPATIAL = """<tendon><spatial name="t" {t}><site site="w0"/><site site="sa"/><site site="sb"/><pulley divisor="2"/>
<site site="sc"/><site site="sd"/><pulley divisor="2"/><site site="se"/><site site="w1"/></spatial>
<spatial name="s" {s}><site site="sc"/><site site="se"/></spatial></tendon>"""
DRIVES = """<actuator><motor name="m" tendon="t" gear="2" forcerange="-3 3"/>
<position name="p" tendon="s" kp="1" kv=".2" gear=".7" forcerange="-4 4"/>
<general name="g" tendon="t" gaintype="affine" biastype="affine" gainprm="2 .5 -.3" biasprm=".2 -1 -.5" gear="1.5"/>
</actuator>"""
FILTERED = """<actuator><general name="m" tendon="t" gear="2" dyntype="filter" dynprm=".02" forcerange="-3 3"/>
<general name="g" tendon="t" gaintype="affine" biastype="affine" gainprm="2 .5 -.3" biasprm=".2 -1 -.5" gear="1.5"
 dyntype="filterexact" dynprm=".01" actearly="true"/></actuator>"""
SOFT = 'solref=".05 1" solimp=".7 .95 .5 .4 3"'
EQUAL = """<equality><tendon name="e" tendon1="t" tendon2="s" polycoef=".01 .5 .3 .2 .1" solref=".05 1"/>
<tendon name="f" tendon1="s" polycoef=".02 0 0 0 0" solref=".1 1"/></equality>"""


def rig(extra: str, integrator: str = "Euler", second: str = "hinge") -> str:
    return RIG.format(extra=extra, integrator=integrator, second=second)


def tendons(path: str, t: str = "", s: str = "") -> str:
    return path.format(t=t, s=s)


def positive(field: str, name: str) -> dict:
    return {"field": field, "name": name, "bounds": [0, 1e3]}


INERTIAL = {"mass": p("body_mass", "b"), "inertia": p("body_inertia", "b", 1), "armature": p("dof_armature", "ja")}
FORCES = {
    "stiffness": positive("tendon_stiffness", "t"), "damping": positive("tendon_damping", "t"),
    "high": p("tendon_lengthspring", "t", 1), "poly": p("tendon_stiffnesspoly", "t", 0),
}  # fmt: skip
LIMITS = {
    "high": p("tendon_range", "t", 1), "margin": p("tendon_margin", "s"),
    "solref": p("tendon_solref_lim", "t", 0),
}  # fmt: skip
LIMITED = f'limited="true" range="{{}}" {SOFT.replace("solref", "solreflimit").replace("solimp", "solimplimit")}'
CLAMPED = 'limited="true" range="{}" margin=".02" solreflimit="-300 -10"'
SERVOS = {
    "gear": p("actuator_gear", "m", 0), "gear_p": p("actuator_gear", "p", 0), "kp": p("actuator_kp", "p"),
    "kv": p("actuator_kv", "p"), "gain1": p("actuator_gainprm", "g", 1), "bias2": p("actuator_biasprm", "g", 2),
}  # fmt: skip
POLYNOMIAL = {"c1": p("eq_data", "e", 1), "c3": p("eq_data", "e", 3), "solref": p("eq_solref", "e", 0)}
WELD = {
    "anchor": p("eq_data", "e", 0), "place": p("eq_data", "e", 4), "turn": p("eq_data", "e", 7),
    "scale": p("eq_data", "e", 10), "solref": p("eq_solref", "e", 1), "gravity": p("opt.gravity", index=0),
}  # fmt: skip
TAUS = {
    "tau": p("actuator_dynprm", "m", 0, (1e-3, 1)), "exact": p("actuator_dynprm", "g", 0, (1e-3, 1)),
    "gain2": p("actuator_gainprm", "g", 2),
}  # fmt: skip
TO_HAND = f"""<equality><weld name="e" body1="hand" body2="c" relpose=".02 .03 .1 .9 .1 .2 .3" anchor=".05 .02 .1"
torquescale=".7" {SOFT}/></equality>"""
OF_BRANCHES = f"""<equality><weld name="e" body1="c" body2="d" relpose=".1 .3 .1 .9 .1 0 .2" anchor=".1 0 0" {SOFT}/>
</equality>"""
SITES = f'<equality><weld name="e" site1="sb" site2="sd" torquescale=".5" {SOFT}/></equality>'
CONNECT = f'<equality><connect name="e" body1="c" body2="d" anchor=".1 .02 .03" {SOFT}/></equality>'

CASES = [
    Case("weld across branches", rig(OF_BRANCHES, "implicitfast", "ball"), INERTIAL | WELD),
    Case("weld of sites", rig(SITES, "RK4"), INERTIAL | {"scale": p("eq_data", "e", 10)}),
    Case("connect", rig(CONNECT, second="ball"), INERTIAL | {"anchor": p("eq_data", "e", 2)}),
    Case(
        "fixed springs",
        rig(tendons(FIXED, 'stiffness="40" springlength=".05 .1" damping=".6"', 'damping="1"'), "implicitfast"),
        INERTIAL | FORCES,
    ),
    Case(
        "spatial springs",
        rig(tendons(SPATIAL, 'stiffness="40" springlength=".8 .9" damping=".6"'), "implicitfast", "ball"),
        INERTIAL | FORCES,
    ),
    Case(
        "fixed limits", rig(tendons(FIXED, LIMITED.format("-.05 .1"), CLAMPED.format("-.2 .05"))), INERTIAL | LIMITS
    ),
    Case(
        "spatial limits",
        rig(tendons(SPATIAL, LIMITED.format(".8 .85"), CLAMPED.format(".28 .3")), "RK4", "ball"),
        INERTIAL | LIMITS,
    ),
    Case(
        "friction loss",
        rig(tendons(SPATIAL, 'frictionloss=".5"')),
        INERTIAL | {"loss": positive("tendon_frictionloss", "t")},
        most=1e-2,
    ),
    Case("tendon equality", rig(tendons(SPATIAL) + EQUAL), INERTIAL | POLYNOMIAL),
    Case("fixed drives", rig(tendons(FIXED) + DRIVES, "implicitfast"), INERTIAL | SERVOS),
    Case("spatial drives", rig(tendons(SPATIAL) + DRIVES, "implicitfast", "ball"), INERTIAL | SERVOS, push=3.0),
    Case("filtered drives", rig(tendons(SPATIAL) + FILTERED, "implicitfast", "ball"), TAUS, push=3.0, lag=2),
    Case(
        "range of all actuators",
        rig(tendons(SPATIAL, 'actuatorfrcrange="-1 1"') + DRIVES).replace('"jc"', '"jc" actuatorfrcrange="-.5 .5"', 1),
        {"range": p("tendon_actfrcrange", "t", 1), "bias2": p("actuator_biasprm", "p", 2)},
        push=3.0,
    ),
    Case(
        "armature",
        rig(tendons(FIXED, 'armature=".3" damping=".5"', 'armature=".1"'), "implicitfast"),
        INERTIAL | {"one": positive("tendon_armature", "t"), "two": positive("tendon_armature", "s")},
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_couplings(case: Case) -> None:
    check(case, count=6)


def test_derived_weights_of_tendons_and_welds_are_mujocos() -> None:
    """Against ``mj_setConst`` after inertial parameters have changed, armature of tendons among them."""
    springs = tendons(FIXED, 'armature=".3" limited="true" range="0 1"', 'stiffness="1"')
    model = mujoco.MjModel.from_xml_string(rig(springs + OF_BRANCHES, second="ball"))
    space = ParameterSpace(model, INERTIAL | {"tendon": positive("tendon_armature", "t")})
    values = space.nominal * np.random.default_rng(0).uniform(0.5, 2.0, len(space.nominal))
    fields = Fields(model, space, [])
    theta = fields(torch.from_numpy(values[None]))[0].numpy()
    model.body_mass[model.body("b").id] = values[0]
    model.body_inertia[model.body("b").id, 1] = values[1]
    model.dof_armature[0] = values[2]
    model.tendon_armature[0] = values[3]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    welded = model.body_invweight0[[model.body("c").id, model.body("d").id]].sum(0)
    np.testing.assert_allclose(theta[fields.columns("ten_invweight")], model.tendon_invweight0, rtol=1e-9)
    np.testing.assert_allclose(theta[fields.columns("weld_invweight")], welded, rtol=1e-9)


def test_filters_are_replayed_beside_poses_of_mocap_bodies() -> None:
    """Controls come first in the inputs of a step, before a transition, too."""
    driven = '<actuator><general joint="ja" gear="3" dyntype="filterexact" dynprm=".02" ctrlrange="-1 1"/></actuator>'
    model = mujoco.MjModel.from_xml_string(rig(TO_HAND + driven))
    space, rng, count = ParameterSpace(model, INERTIAL), np.random.default_rng(0), 4
    (hand,) = prescribed_bodies(model)
    states = np.concatenate([model.qpos0, np.zeros(model.nv)]) + rng.normal(0, 0.1, (count, model.nq + model.nv))
    pose = np.concatenate([model.body_pos[hand], model.body_quat[hand]])
    controls = np.concatenate([np.zeros(model.nu), pose]) + rng.normal(0, 0.02, (count, 5, model.nu + 7))
    controls[..., 0] = rng.uniform(-2, 2, (count, 5))
    found, expected = (
        kind(converged(space).model, parameters=converged(space), frame_skip=2, num_threads=1, history=3).rollout(
            torch.from_numpy(states), torch.from_numpy(controls), torch.from_numpy(space.nominal[None])
        )
        for kind in (WarpSimulator, MujocoSimulator)
    )
    np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-9)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_poses_of_mocap_bodies_are_inputs_of_a_step(integrator: str) -> None:
    """As with C MuJoCo, with gradients in them: an arm that is welded to one, and a ball that another one touches."""
    ball = '<body name="ball" pos="1 0 .1"><freejoint/><geom size=".1" contype="1"/></body>'
    paddle = (
        '<body name="paddle" mocap="true" pos="1 0 -.09"><geom type="capsule" size=".1 .2" conaffinity="1"/></body>'
    )
    xml = rig(TO_HAND, integrator, "ball").replace("</worldbody>", f"{paddle}{ball}</worldbody>")
    model = mujoco.MjModel.from_xml_string(xml)
    space, rng, count = ParameterSpace(model, INERTIAL | WELD), np.random.default_rng(0), 6
    states = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (count, 1))
    states[:, model.nq :] = rng.normal(0, 0.3, (count, model.nv))
    poses = [np.concatenate([model.body_pos[b], model.body_quat[b]]) for b in prescribed_bodies(model)]
    controls = np.concatenate([np.zeros(model.nu), *poses]) + rng.normal(0, 0.02, (count, 2, model.nu + 14))
    simulator, other = (
        kind(model, parameters=space, frame_skip=2, num_threads=1) for kind in (WarpSimulator, MujocoSimulator)
    )
    report = check_simulator(
        simulator, torch.from_numpy(states), torch.from_numpy(controls), torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), 2),
        tolerance=Tolerance(states=1e-9, worst=1e-6, gradient=1e-5, most=1e-3),
    )  # fmt: skip
    assert "gradients are those of central differences" in report.checked
    assert simulator.num_controls == other.num_controls == model.nu + 14
