"""Contacts of convex geoms of the Warp backend against C MuJoCo: two free bodies that touch, of every pair of shapes.

MuJoCo's iteration leaves the normal of curved shapes undecided in its last digits, and its central differences are then
those of an unfinished iteration. So their states are compared with MuJoCo's, and their gradients with those of shapes
that are the same where they touch and have formulas.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

STONE = " ".join(f"{x:.4f}" for x in np.random.default_rng(3).normal(0, 0.12, 75))
CUBE = " ".join(f"{0.1 * x} {0.15 * y} {0.2 * z}" for z in (-1, 1) for y in (-1, 1) for x in (-1, 1))
GEOMS = {
    "sphere": 'type="sphere" size=".12"', "capsule": 'type="capsule" size=".08 .15"',
    "ellipsoid": 'type="ellipsoid" size=".1 .15 .2"', "cylinder": 'type="cylinder" size=".12 .15"',
    "box": 'type="box" size=".1 .15 .2"', "stone": 'type="mesh" mesh="stone"', "cube": 'type="mesh" mesh="cube"',
}  # fmt: skip
PARAMETERS = {
    "mass": {"field": "body_mass", "name": "a", "bounds": [0.1, 100]},
    "friction": {"field": "geom_friction", "name": "a", "bounds": [0.1, 2]},
}
#: An iteration that hardly changes anything any more when it ends.
FINISHED = 'ccd_tolerance="1e-12" ccd_iterations="200"'
TURNS = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1]], dtype=float)


def two(a: str, b: str, option: str = "", geom: str = "", flag: str = "") -> mujoco.MjModel:
    """Two bodies without gravity, the second on its way."""
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option gravity="0 0 0" {option}><flag {flag}/></option>
<asset><mesh name="stone" vertex="{STONE}"/><mesh name="cube" vertex="{CUBE}"/></asset><worldbody>
<body name="a"><freejoint/><geom name="a" {GEOMS[a]} {geom}/></body>
<body name="b"><freejoint/><geom name="b" {GEOMS[b]}/></body></worldbody></mujoco>""")


def touching(model: mujoco.MjModel, count: int, seed: int, jitter: float | None, depth: float = 0.03) -> torch.Tensor:
    """States in which the two touch, ``(count, nq + nv)``: turned at random, or by quarter turns and a little more."""
    rng, data, states = np.random.default_rng(seed), mujoco.MjData(model), []
    while len(states) < count:
        data.qpos[:3] = rng.uniform(-0.3, 0.3, 3)
        for start in (3, 10):
            quat = rng.normal(size=4)
            if jitter is not None:
                quat = TURNS[rng.integers(4)] + jitter * quat
            data.qpos[start : start + 4] = quat / np.linalg.norm(quat)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon and data.contact.dist.min() > -depth:
            states.append(np.r_[data.qpos, rng.normal(0, 0.2, model.nv)])
    return torch.from_numpy(np.array(states))


#: How close states, derivatives at the median and nine in ten of them must be: of polytopes, and of curved shapes.
EXACT = Tolerance(states=1e-9, worst=1e-6, gradient=1e-5, most=1e-3)
UNFINISHED = Tolerance(states=1e-5, worst=1e-2, gradient=1e-3, most=0.2)


def compare(model: mujoco.MjModel, states: torch.Tensor, tolerance: Tolerance = EXACT) -> None:
    """Check two steps from ``states`` and their derivatives."""
    space = ParameterSpace(model, PARAMETERS)
    check_simulator(
        WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1),
        states,
        torch.zeros(len(states), 1, 0, dtype=torch.float64),
        torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), 2),
        tolerance=tolerance,
    )


POLYTOPES = [("box", "cube"), ("box", "stone"), ("stone", "stone"), ("sphere", "stone"), ("capsule", "stone")]
CURVED = [
    ("cylinder", "box"), ("cylinder", "cylinder"), ("cylinder", "stone"), ("capsule", "cylinder"),
    ("ellipsoid", "box"), ("ellipsoid", "ellipsoid"), ("capsule", "ellipsoid"),
]  # fmt: skip


@pytest.mark.parametrize("pair", POLYTOPES, ids="-".join)
def test_polytopes_that_touch_anyhow(pair: tuple[str, str]) -> None:
    model = two(*pair)
    compare(model, touching(model, 6, seed=0, jitter=None))


@pytest.mark.parametrize("pair", [("box", "cube"), ("cube", "cube"), ("capsule", "cube"), ("cylinder", "cube")],
                         ids="-".join)  # fmt: skip
def test_faces_and_edges_that_are_nearly_aligned_touch_at_their_corners(pair: tuple[str, str]) -> None:
    model = two(*pair, option=FINISHED if "cylinder" in pair else "")
    states = touching(model, 6, seed=1, jitter=0.01)
    compare(model, states, UNFINISHED if "cylinder" in pair else EXACT)


@pytest.mark.parametrize("pair", CURVED, ids="-".join)
def test_curved_geoms_move_as_in_mujoco(pair: tuple[str, str]) -> None:
    model = two(*pair)
    space = ParameterSpace(model, PARAMETERS)
    states = touching(model, 60, seed=2, jitter=None)
    control, values = torch.zeros(60, 1, 0, dtype=torch.float64), torch.from_numpy(space.nominal[None])
    simulator = WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1)
    found = simulator.simulate(states, control, values)[:, 0].numpy()
    expected = mujoco_reference(converged(space), 2)(states, control, values)[:, 0, -1].numpy()
    error = np.abs(found - expected).max(1)
    assert np.median(error) < 1e-9
    assert np.quantile(error, 0.9) < 1e-5


BODY = '<body name="a"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia=".02 .03 .04"/><geom name="a" {}/></body>'
OTHER = (
    '<body name="b"><freejoint/><inertial pos="0 0 0" mass="2" diaginertia=".05 .03 .04"/><geom name="b" {}/></body>'
)
ROOM = "<geom name='b' type='{}' size='4 4 1' pos='0 0 {}'/>"
CROSSED = 'type="{}" size=".05 .4"'
#: The same shapes twice: for the general collision, and with a formula; and how they are turned.
SAME = {
    "balls": (
        (BODY.format('type="ellipsoid" size=".1 .1 .1"'), OTHER.format('type="ellipsoid" size=".2 .2 .2"')),
        (BODY.format('type="sphere" size=".1"'), OTHER.format('type="sphere" size=".2"')),
        None,
    ),
    "ellipsoid on a floor": (
        (BODY.format('type="ellipsoid" size=".1 .15 .2"'), ROOM.format("box", -1)),
        (BODY.format('type="ellipsoid" size=".1 .15 .2"'), ROOM.format("plane", 0)),
        None,
    ),
    "rim on a floor": (
        (BODY.format('type="cylinder" size=".1 .15"'), ROOM.format("box", -1)),
        (BODY.format('type="cylinder" size=".1 .15"'), ROOM.format("plane", 0)),
        None,
    ),
    "crossed rods": (
        (BODY.format(CROSSED.format("cylinder")), OTHER.format(CROSSED.format("cylinder"))),
        (BODY.format(CROSSED.format("capsule")), OTHER.format(CROSSED.format("capsule"))),
        ((1, 0.1, 0.1, 0), (1, 1, 0.2, 0.1)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("same", SAME)
def test_gradients_are_those_of_the_same_shapes_with_a_formula(same: str) -> None:
    *worlds, turns = SAME[same]
    option = f'<option cone="elliptic" gravity="0 0 0" {FINISHED}/>'
    models = [
        mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{''.join(w)}</worldbody></mujoco>") for w in worlds
    ]
    rng, data, states = np.random.default_rng(5), mujoco.MjData(models[1]), []
    while len(states) < 6:
        data.qpos[:3] = rng.uniform(-0.3, 0.3, 3)
        for i, start in enumerate(range(3, models[1].nq, 7)):
            data.qpos[start : start + 4] = rng.normal(size=4) if turns is None else turns[i]
        mujoco.mj_normalizeQuat(models[1], data.qpos)
        mujoco.mj_kinematics(models[1], data)
        mujoco.mj_collision(models[1], data)
        if data.ncon == 1 and -0.02 < data.contact.dist[0] < 0:
            states.append(np.r_[data.qpos, rng.normal(0, 0.2, models[1].nv)])
    results = []
    for model in models:
        space = ParameterSpace(model, PARAMETERS)
        simulator = WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1)
        values = torch.from_numpy(space.nominal[None])
        results.append(
            simulator.jacobian(torch.from_numpy(np.array(states)), torch.zeros(6, 1, 0, dtype=torch.float64), values)
        )
    for found, expected in zip(*results, strict=True):
        scale = expected.abs().max()
        assert float((found - expected).abs().max() / scale) < 1e-4


#: Shapes, how they lie on a floor, and how high: a drum's side touches along a line, and points above the diagonal of a
#: square may be found on that instead of the face.
LYING = {
    "drum along y": ('type="cylinder" size=".1 .15"', (1, 1, 0, 0), 0.1),
    "drum along x": ('type="cylinder" size=".1 .15"', (1, 1, 1, 1), 0.1),
    "rolled drum": ('type="cylinder" size=".1 .15"', (0.3, 0.3, 0.2, -0.2), 0.1),
    "egg": ('type="ellipsoid" size=".1 .15 .2"', (1, 0, 0, 0), 0.2),
    "rolled egg": ('type="ellipsoid" size=".1 .15 .2"', (1, 1, 0.1, 0.1), 0.1513),
}


@pytest.mark.parametrize("lying", LYING)
def test_what_lies_on_a_box_rolls_as_on_a_plane(lying: str) -> None:
    shape, quat, height = LYING[lying]
    results = []
    for room in (ROOM.format("box", -1), ROOM.format("plane", 0)):
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option cone="elliptic" {FINISHED}/><worldbody>{room}{BODY.format(shape)}</worldbody></mujoco>'
        )
        space = ParameterSpace(model, PARAMETERS)
        pose = [0.03, 0.03, height - 5e-4, *np.array(quat) / np.linalg.norm(quat)]
        state = torch.tensor([[*pose, 0.1, -0.2, -0.1, 0.3, -0.2, 0.1]], dtype=torch.float64)
        simulator = WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1)
        values = torch.from_numpy(space.nominal[None])
        results.append(simulator.jacobian(state, torch.zeros(1, 1, 0, dtype=torch.float64), values))
    for found, expected in zip(*results, strict=True):
        assert float((found - expected).abs().max() / expected.abs().max()) < 1e-5


@pytest.mark.parametrize("pair", [("box", "stone"), ("capsule", "stone"), ("cylinder", "cube")], ids="-".join)
def test_margin_and_gap(pair: tuple[str, str]) -> None:
    model = two(*pair, option=FINISHED if "cylinder" in pair else "", geom='margin=".02" gap=".01"')
    compare(model, touching(model, 6, seed=3, jitter=None), UNFINISHED if "cylinder" in pair else EXACT)


def test_one_contact_without_multiccd() -> None:
    model = two("box", "cube", flag='multiccd="disable"')
    compare(model, touching(model, 6, seed=4, jitter=0.1))


def test_the_legacy_pipeline_is_refused() -> None:
    model = two("box", "cube", flag='nativeccd="disable"')
    with pytest.raises(InputError, match="contacts of box with mesh without the flag nativeccd"):
        WarpSimulator(model, parameters=ParameterSpace(model, PARAMETERS), frame_skip=1)
