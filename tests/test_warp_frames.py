"""Frames of bodies, joints and geoms as parameters of the Warp backend: states and gradients against C MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from test_warp_convex import touching, two

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.fields import Fields
from dropo_torch.simulators.warp.pairs import candidate_pairs
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

#: A base with two hinges and a slide, a ball beyond it, and a bracket that is welded to the last body.
ARM = """<mujoco><option integrator="{integrator}" timestep="0.004" density="{density}"/>
<default><geom contype="0" conaffinity="{touch}" friction=".7 .02 .003"/></default><worldbody>
<body name="plate" pos="0 0 -.3" quat="1 .05 .1 0">
 <geom name="plate" type="plane" size="3 3 1" contype="{touch}"/></body>
<body name="a" pos="0.1 0 .1" quat=".9 .1 .2 -.1" gravcomp=".3">
 <joint name="j1" axis="0 1 .2" pos=".02 0 .01" damping=".3"/>
 <joint name="j2" axis="1 0 .3" pos="0 .03 0" stiffness="2"/>
 <joint name="s" type="slide" axis=".1 .2 1" damping="2" stiffness="60" armature=".1"/>
 <geom name="ga" type="capsule" fromto="0 0 0 .3 0 .1" size=".03" mass="1.2"/>
 <body name="b" pos=".3 0 .1" quat=".8 .2 0 .1"><joint name="ball" type="ball" pos=".01 .02 0" damping=".05"/>
  <geom name="gb" type="box" pos=".1 .02 0" size=".1 .05 .04" mass=".7"/>
  <body name="bracket" pos=".1 .1 0" quat=".9 0 .3 .1"><geom name="gc" type="sphere" size=".05" mass=".3"/>
   <body name="tip" pos=".1 0 0"><joint name="j3" axis="0 0 1" pos="0 .02 0" limited="true" range="-15 15"/>
    <geom name="gd" type="cylinder" size=".04 .06" mass=".3"/></body></body></body></body>
</worldbody><actuator><motor joint="j1" gear="3"/><position joint="j3" kp="2"/></actuator></mujoco>"""


def entry(field: str, name: str, index: int) -> dict:
    return {"field": field, "name": name, "index": index, "bounds": [1e-3, 1.0]}


FRAMES = {
    "a_quat": entry("body_quat", "a", 2), "b_pos": entry("body_pos", "b", 2),
    "b_quat0": entry("body_quat", "b", 0), "b_quat": entry("body_quat", "b", 3),
    "bracket": entry("body_pos", "bracket", 1), "bracket_quat": entry("body_quat", "bracket", 1),
    "j1_axis": entry("jnt_axis", "j1", 2), "j2_axis": entry("jnt_axis", "j2", 1), "s_axis": entry("jnt_axis", "s", 0),
    "j1_pos": entry("jnt_pos", "j1", 0), "j2_pos": entry("jnt_pos", "j2", 2), "ball_pos": entry("jnt_pos", "ball", 1),
    "j3_pos": entry("jnt_pos", "j3", 0), "j3_axis": entry("jnt_axis", "j3", 0),
    "mass": {"field": "body_mass", "name": "b", "bounds": [1e-3, 10.0]},
}  # fmt: skip
PLATE = {"plate_pos": entry("body_pos", "plate", 2), "plate_quat": entry("body_quat", "plate", 1)}


def start(model: mujoco.MjModel, count: int, seed: int, spread: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    states = np.zeros((count, model.nq + model.nv))
    for row in states:
        mujoco.mj_integratePos(model, qpos := model.qpos0.copy(), rng.uniform(-spread, spread, model.nv), 1.0)
        row[: model.nq], row[model.nq :] = qpos, rng.uniform(-2, 2, model.nv)
    return states


def check(
    model: mujoco.MjModel, parameters: dict, states: np.ndarray, seed: int, shift: float = 0.0, near: float = 1e-9,
    slope: float = 1e-6, most: float = 1e-3,
) -> None:  # fmt: skip
    """Frames are moved by ``shift`` from the model's: of those that coincide MuJoCo ignores the smallest changes."""
    space = ParameterSpace(model, parameters)
    controls = np.random.default_rng(seed).uniform(-1, 1, (len(states), 1, model.nu))
    report = check_simulator(
        WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1),
        torch.from_numpy(states), torch.from_numpy(controls), torch.from_numpy(space.nominal[None] + shift),
        reference=mujoco_reference(converged(space), 2),
        tolerance=Tolerance(states=near, worst=1e3 * near, gradient=slope, most=most),
    )  # fmt: skip
    assert "gradients are those of central differences" in report.checked


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast", "implicit"])
@pytest.mark.parametrize("touch", [0, 1])
def test_frames_of_bodies_and_joints(integrator: str, touch: int) -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator=integrator, touch=touch, density="30"))
    check(model, FRAMES | (PLATE if touch else {}), start(model, 12, 3, 0.6), 3)


GEOMS = {
    "capsule": {"p": entry("geom_pos", "ga", 1), "q": entry("geom_quat", "ga", 1),
                "radius": entry("geom_size", "ga", 0), "length": entry("geom_size", "ga", 1)},
    "box": {"p": entry("geom_pos", "gb", 2), "q": entry("geom_quat", "gb", 1), "x": entry("geom_size", "gb", 0),
            "z": entry("geom_size", "gb", 2)},
    "sphere": {"p": entry("geom_pos", "gc", 0), "radius": entry("geom_size", "gc", 0)},
    "cylinder": {"p": entry("geom_pos", "gd", 0), "q": entry("geom_quat", "gd", 2),
                 "radius": entry("geom_size", "gd", 0), "length": entry("geom_size", "gd", 1)},
    "plane": {"p": entry("geom_pos", "plate", 2), "q": entry("geom_quat", "plate", 1)},
}  # fmt: skip


@pytest.mark.parametrize("kind", GEOMS)
def test_frames_and_sizes_of_geoms(kind: str) -> None:
    """Of every kind on a plane, whose derivatives are those of where it touches."""
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="Euler", touch=1, density="0"))
    check(model, GEOMS[kind], start(model, 40, 5, 0.7), 5, shift=0.01)


PILE = """<mujoco><option timestep="0.004" cone="{cone}"/><worldbody>
<body name="table"><geom name="table" type="box" size=".5 .5 .1" quat="1 .02 .05 0"/></body>
<body name="one" pos="0 0 .2"><freejoint/>
 <geom name="one" type="capsule" size=".1 .15" quat=".7 .7 0 .1" mass="1"/></body>
<body name="two" pos=".05 0 .37"><freejoint/>
 <geom name="two" type="capsule" size=".08 .1" quat=".7 0 .7 .2" mass="1"/></body>
<body name="ball" pos=".05 .22 .18"><freejoint/>
 <geom name="ball" size=".09" mass="1" contype="3" conaffinity="3"/></body>
<body name="can" pos=".05 .405 .2">
 <geom name="can" type="cylinder" size=".1 .12" contype="2" conaffinity="2"/></body>
</worldbody></mujoco>"""
ROUND = {
    "p": entry("geom_pos", "one", 1), "q": entry("geom_quat", "one", 3), "radius": entry("geom_size", "one", 0),
    "length": entry("geom_size", "one", 1), "other": entry("geom_size", "two", 0),
    "can": entry("geom_size", "can", 0), "ball": entry("geom_size", "ball", 0), "table": entry("geom_size", "table", 2),
    "tilt": entry("geom_quat", "table", 1), "moved": entry("body_pos", "table", 2),
}  # fmt: skip


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_sizes_of_geoms_that_touch_each_other(cone: str) -> None:
    model = mujoco.MjModel.from_xml_string(PILE.format(cone=cone))
    check(model, ROUND, start(model, 20, 1, 0.02), 1, shift=0.005, near=1e-8)


STONE = " ".join(f"{x:.4f}" for x in np.random.default_rng(3).normal(0, 0.12, 75))
#: Boxes on each other and a mesh on a plane, whose sizes are fixed.
HEAP = f"""<mujoco><option timestep="0.004"/><asset><mesh name="stone" vertex="{STONE}"/></asset>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<geom name="floor" type="plane" size="5 5 1" conaffinity="1"/>
<body name="low" pos="0 0 .099"><freejoint/>
 <geom name="low" type="box" size=".3 .25 .1" contype="3" conaffinity="2" mass="3"/></body>
<body name="high" pos=".05 .02 .298" quat="1 .01 .02 .2"><freejoint/>
 <geom name="high" type="box" size=".1 .12 .1" contype="2" mass="1"/></body>
<body name="stone" pos="1 0 .17"><freejoint/><geom name="stone" type="mesh" mesh="stone" contype="1" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("kind", ["low", "high", "stone"])
def test_frames_of_geoms_whose_sizes_are_fixed(kind: str) -> None:
    model = mujoco.MjModel.from_xml_string(HEAP)
    parameters = {"x": entry("geom_pos", kind, 0), "z": entry("geom_pos", kind, 2), "q": entry("geom_quat", kind, 1)}
    check(model, parameters, start(model, 20, 2, 0.01), 2, shift=0.004, near=1e-8, slope=1e-5, most=2e-2)


@pytest.mark.parametrize("pair", [("box", "stone"), ("capsule", "stone"), ("stone", "stone")], ids="-".join)
def test_frames_of_geoms_that_convex_collision_finds(pair: tuple[str, str]) -> None:
    model = two(*pair)
    parameters = {
        f"{name} {field} {k}": entry(field, name, k)
        for name in "ab"
        for field, k in (("geom_pos", 0), ("geom_pos", 2), ("geom_quat", 1), ("geom_quat", 3))
    }
    check(model, parameters, touching(model, 8, seed=0, jitter=None).numpy(), 0, shift=0.002)


def test_weights_follow_the_frames() -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="Euler", touch=1, density="0"))
    space, pairs = ParameterSpace(model, FRAMES), candidate_pairs(model)
    fields = Fields(model, space, pairs)
    values = space.nominal + np.random.default_rng(0).uniform(0.01, 0.1, (4, len(space)))
    for row, vector in zip(fields(torch.tensor(values)).numpy(), values, strict=True):
        applied = space.apply(vector)
        np.testing.assert_allclose(row[fields.columns("dof_invweight")], applied.dof_invweight0, rtol=1e-11)
        weights = [applied.body_invweight0[model.geom_bodyid[[g1, g2]], 0].sum() for g1, g2, _p in pairs]
        np.testing.assert_allclose(row[fields.columns("pair_invweight")], weights, rtol=1e-11)


@pytest.mark.parametrize(
    ("parameter", "words"),
    [
        (entry("body_pos", "one", 0), "effects of body_pos of a free or mocap body"),
        (entry("geom_size", "ball", 1), r"gradients of geom_size\[1\] of a sphere"),
    ],
)
def test_frames_that_do_nothing_are_named(parameter: dict, words: str) -> None:
    model = mujoco.MjModel.from_xml_string(PILE.format(cone="pyramidal"))
    with pytest.raises(InputError, match=words):
        WarpSimulator(model, parameters=ParameterSpace(model, {"p": parameter}), frame_skip=1)


BOAT = """<mujoco><option density="100"/><worldbody><site name="w" pos="0 0 1"/>
<body name="dock" pos="0 0 2"><geom name="dock" type="box" size=".1 .1 .1"/></body>
<body name="boat" pos="0 0 .5"><joint name="j" pos="0 .1 0"/><site name="s"/>
<geom name="hull" type="ellipsoid" size=".3 .1 .1" fluidshape="ellipsoid" contype="0" conaffinity="0"/>
<geom name="mast" type="cylinder" size=".1 .2" pos="0 0 .2"/></body></worldbody>{}</mujoco>"""
TIED = '<equality><connect body1="boat" anchor="0 0 .1"/></equality>'
ROPE = '<tendon><spatial stiffness="1"><site site="w"/><site site="s"/></spatial></tendon>'


@pytest.mark.parametrize(
    ("extra", "parameter", "words"),
    [
        ("", entry("geom_pos", "hull", 0), "gradients of geom_pos of a geom that a medium acts on as an ellipsoid"),
        ("", entry("geom_size", "hull", 0), "gradients of geom_size of a geom that a medium acts on as an ellipsoid"),
        ("", entry("geom_size", "mast", 0), "gradients of geom_size in contacts (1: 'mast' with 'dock')"),
        ("", entry("geom_size", "dock", 2), "gradients of geom_size in contacts (1: 'mast' with 'dock')"),
        (TIED, entry("body_pos", "boat", 0), "gradients of body_pos beside connect and weld equalities"),
        (TIED, entry("jnt_axis", "j", 0), "gradients of jnt_axis beside connect and weld equalities"),
        (ROPE, entry("body_quat", "boat", 1), "beside connect and weld equalities, or spatial tendons"),
        (ROPE, entry("jnt_pos", "j", 0), "beside connect and weld equalities, or spatial tendons"),
        ("", entry("site_pos", "s", 0), "gradients of site_pos"),
    ],
)
def test_frames_without_gradients_are_refused(extra: str, parameter: dict, words: str) -> None:
    model = mujoco.MjModel.from_xml_string(BOAT.format(extra))
    with pytest.raises(InputError) as caught:
        WarpSimulator(model, parameters=ParameterSpace(model, {"p": parameter}), frame_skip=1)
    assert words in str(caught.value)


#: Inertial frames and those of the geom and the site, that differ by less than 1e-6, and the marks that MuJoCo makes.
NEARLY = {
    "body": ("3e-7 -2e-7 4e-7", "1 4e-7 -3e-7 2e-7", "0 0 0", "1 0 0 0", 1),
    "inertia": (".02 .01 0", ".9 .1 .3 .2", ".0200004 .0099997 0", ".9 .1000004 .3 .2000003", 2),
    "turned as the body": ("3e-4 0 0", "1 4e-7 -3e-7 2e-7", "-.001 0 0", "1 3e-7 0 4e-7", 3),
    "turned as the inertia": (".02 .01 0", ".9 .1 .3 .2", "0 0 0", ".9 .1000004 .3 .2000003", 4),
}


@pytest.mark.parametrize("which", NEARLY)
def test_frames_that_mujoco_takes_as_the_same_are_the_same(which: str) -> None:
    pos, quat, geom_pos, geom_quat, mark = NEARLY[which]
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body name="b" pos="0 0 .1"><freejoint/><inertial pos="{pos}" quat="{quat}" mass="1" diaginertia=".02 .03 .04"/>
<geom name="g" type="box" size=".1 .1 .1" pos="{geom_pos}" quat="{geom_quat}"/>
<site name="s" pos="{geom_pos}" quat="{geom_quat}"/></body></worldbody>
<actuator><motor site="s" gear="1 2 3 .1 .2 .3"/></actuator></mujoco>""")
    assert model.geom_sameframe[1] == mark
    space = ParameterSpace(model, {"mass": {"field": "body_mass", "name": "b", "bounds": [0.1, 10]}})
    states = torch.zeros(8, 13, dtype=torch.float64)
    states[:, 2], states[:, 3] = 0.09, 1.0
    states += 0.05 * torch.from_numpy(np.random.default_rng(6).normal(size=(8, 13)))
    values, controls = torch.from_numpy(space.nominal[None]), torch.ones(8, 1, 1, dtype=torch.float64)
    found = WarpSimulator(model, parameters=space, frame_skip=3, num_threads=1).simulate(states, controls, values)
    expected = mujoco_reference(converged(space), 3)(states, controls, values)[:, 0, -1]
    assert float((found[:, 0] - expected).abs().max()) < 1e-11
