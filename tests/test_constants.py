"""What is derived from a model's numbers is what plain MuJoCo derives when it compiles them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import pytest
import torch

import dropo_torch as dropo
from dropo_torch.models.constants import derive, derive_all, slide_alone
from dropo_torch.models.load import load_model
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.simulators.warp.simulator import WarpSimulator

SLIDE = '<joint type="slide" axis="{}" armature="0.3" pos="{}"/>'
GEOM = '<geom size=".1" mass="2" pos="{}"/>'
CENTERED, ALONG = GEOM.format("0 0 0"), SLIDE.format("1 0 0", "0 0 0")
#: A body of each kind, beside what decides whether MuJoCo compiles it as one that only slides.
BODIES = {
    "one slide": ALONG + CENTERED,
    "two slides": ALONG + SLIDE.format("0 0 -1", "0 0 0") + CENTERED,
    "slide off an axis": SLIDE.format("1 1 0", "0 0 0") + CENTERED,
    "slide beside the frame": SLIDE.format("1 0 0", "0 .1 0") + CENTERED,
    "center beside the frame": ALONG + GEOM.format("0 0 .1"),
    "slide and hinge": ALONG + '<joint axis="0 0 1"/>' + CENTERED,
    "body of its own": f"{ALONG}{CENTERED}<body>{CENTERED}</body>",
    "on a fixed one": f"{CENTERED}<body>{ALONG}{CENTERED}</body>",
    "on a slide": f"{ALONG}{CENTERED}<body>{SLIDE.format('0 1 0', '0 0 0')}{CENTERED}</body>",
    "free": f"<freejoint/>{CENTERED}",
}
WEIGHTS = ("body_invweight0", "dof_invweight0")
#: A carriage between a wall that it touches and a limit of its joint.
PRESSED = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom name="wall" type="plane" pos="0.3 0 0" zaxis="-1 0 0" size="1 1 .1"/>
  <body name="carriage" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0" limited="true" range="-0.2 5"/>
    <geom type="sphere" size=".1" mass="2"/></body></worldbody>
  <actuator><motor joint="x"/></actuator></mujoco>"""


def write(folder: Path, text: str) -> Path:
    path = folder / "model.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", BODIES)
def test_models_whose_centers_may_move_have_the_weights_of_plain_mujoco(kind: str, tmp_path: Path) -> None:
    path = write(tmp_path, f"<mujoco><worldbody><body>{BODIES[kind]}</body></worldbody></mujoco>")
    plain, general = load_model(path), load_model(path, general=True)
    assert not general.body_simple[1:].any()
    np.testing.assert_array_equal(slide_alone(plain), plain.body_simple == 2)
    np.testing.assert_array_equal(slide_alone(general), plain.body_simple == 2)
    for model in (plain, general):
        model.body_mass[1:] *= 1.7
        model.body_inertia[1:] *= 1.7
    mujoco.mj_setConst(plain, mujoco.MjData(plain))
    derive(general)
    for field in WEIGHTS:
        np.testing.assert_allclose(getattr(general, field), getattr(plain, field), rtol=1e-12, atol=1e-15)
    batch = mujoco.batch.Batch(general, 3, 1)
    batch.expand("body_mass")[1] *= 2
    derive_all(batch, general, np.array([0, 1]))
    plain.body_mass[1:] *= 2
    mujoco.mj_setConst(plain, mujoco.MjData(plain))
    if (plain.body_simple == 2).any():
        np.testing.assert_allclose(batch.expanded("body_invweight0")[1], plain.body_invweight0, rtol=1e-12)


def test_a_center_that_moves_has_the_weight_of_such_a_body(tmp_path: Path) -> None:
    model = load_model(write(tmp_path, PRESSED), general=True)
    model.body_ipos[1, 2] = 0.05
    derive(model)
    assert not slide_alone(model).any()
    assert model.body_invweight0[1, 0] == pytest.approx(1 / 6)


@pytest.mark.parametrize("kind", [MujocoSimulator, WarpSimulator])
@pytest.mark.parametrize("mass", [2.0, 3.1])
def test_slides_touch_and_stop_as_in_plain_mujoco(kind: type, mass: float, tmp_path: Path) -> None:
    path = write(tmp_path, PRESSED)
    general = load_model(path, general=True)
    space = dropo.ParameterSpace(general, {"mass": {"field": "body_mass", "name": "carriage", "bounds": [1, 5]}})
    simulator = kind(general, parameters=space, frame_skip=5)
    plain = load_model(path)
    plain.body_mass[1] = mass
    plain.body_inertia[1] *= mass / 2
    data = mujoco.MjData(plain)
    mujoco.mj_setConst(plain, data)
    mujoco.mj_resetData(plain, data)
    force, expected = np.where(np.arange(120) < 60, 8.0, -8.0), []
    for value in force:
        data.ctrl[0] = value
        mujoco.mj_step(plain, data, 5)
        expected.append([data.qpos[0], data.qvel[0]])
    found = simulator.rollout(
        torch.zeros(1, 2, dtype=torch.float64), torch.from_numpy(force)[None, :, None],
        torch.tensor([[mass]], dtype=torch.float64),
    )  # fmt: skip
    np.testing.assert_allclose(found[0, 0].numpy(), expected, atol=1e-9)
    assert np.ptp(np.array(expected)[:, 0]) > 0.3  # it reached both ends
