"""A fitted model as MJCF: plain MuJoCo loads it, and it simulates like the fitted parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from arm import Folder
from dropo_sims.hopper import SIM

from dropo_torch.commands.cli import main
from dropo_torch.errors import InputError
from dropo_torch.models.export import export_model
from dropo_torch.parameters import ParameterSpace, read_field

#: A sledge on the floor, pulled by a geared motor, with an arm that a position servo holds.
SLEDGE = """
<mujoco>
  <compiler angle="degree"/>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <default><default class="arm"><joint damping=".2" frictionloss=".05" armature=".01"/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction="0.1 0.005 0.0001"/>
    <body name="sledge" pos="0 0 .05">
      <joint name="along" type="slide" axis="1 0 0" damping=".5"/>
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom name="sledge" type="box" size=".2 .1 .05" density="400" friction="0.6 0.005 0.0001"/>
      <body name="pole" pos="0 0 .05" childclass="arm">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom name="pole" type="capsule" size=".02" fromto="0 0 0 0 0 .4" density="900"/>
        <geom name="knob" type="sphere" size=".04" pos=".02 0 .4" density="700"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="pull" joint="along" gear="4"/>
    <position name="hold" joint="hinge" kp="8" kv="0.4"/>
  </actuator>
</mujoco>"""

CASES: dict[str, tuple[dict[str, Any], float]] = {
    "mass": ({"field": "body_mass", "name": "pole", "bounds": [0.5, 3]}, 1.7),
    "mass and inertia": ({"field": "body_mass", "name": "pole", "bounds": [0.5, 3], "scale_inertia": True}, 1.7),
    "tied masses": ({"field": "body_mass", "name": ["sledge", "pole"], "bounds": [0.5, 2], "relative": True}, 1.4),
    "damping": ({"field": "dof_damping", "name": "hinge", "bounds": [0.01, 2]}, 1.1),
    "frictionloss": ({"field": "dof_frictionloss", "name": "hinge", "bounds": [0, 1]}, 0.4),
    "armature": ({"field": "dof_armature", "name": "hinge", "bounds": [0, 1]}, 0.13),
    "gear": ({"field": "actuator_gear", "name": "pull", "bounds": [1, 9]}, 7.5),
    "friction": ({"field": "geom_friction", "name": "sledge", "bounds": [0.1, 2]}, 1.3),
    "gravity": ({"field": "opt.gravity", "index": 2, "bounds": [-20, -1]}, -5.0),
    "servo gain": ({"field": "actuator_kp", "name": "hold", "bounds": [1, 40]}, 21.0),
    "servo damping": ({"field": "actuator_kv", "name": "hold", "bounds": [0.1, 4]}, 1.9),
    "center of mass": ({"field": "body_ipos", "name": "pole", "index": 0, "bounds": [-0.2, 0.2]}, 0.11),
}  # fmt: skip


def motion(model: mujoco.MjModel, steps: int = 250) -> np.ndarray:
    """Positions and velocities from a push; the same controls for every model."""
    data = mujoco.MjData(model)
    data.qvel[:] = 0.5
    states = []
    for step in range(steps):
        data.ctrl[:] = np.sin(0.02 * step + np.arange(model.nu))
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "robot" / "sledge.xml"
    path.parent.mkdir()
    path.write_text(SLEDGE)
    return path


@pytest.mark.parametrize("name", CASES)
def test_an_exported_model_moves_like_the_fitted_one(name: str, source: Path, tmp_path: Path) -> None:
    entry, value = CASES[name]
    space = ParameterSpace(source, {"p": entry})
    path = tmp_path / "model.xml"
    export_model(source, space, np.array([value]), path)
    written = mujoco.MjModel.from_xml_path(str(path))
    expected = motion(space.apply(np.array([value])))
    moved = np.abs(expected - motion(space.model)).max()
    assert moved > 1e-3  # the parameter shows in this motion
    assert np.abs(motion(written) - expected).max() < max(0.002 * moved, 2e-5)


def test_several_parameters_are_exported_together(source: Path, tmp_path: Path) -> None:
    space = ParameterSpace(source, {name: CASES[name][0] for name in CASES if name not in ("mass and inertia", "mass")})
    values = np.array([CASES[name][1] for name in space.names])
    export_model(source, space, values, tmp_path / "model.xml")
    written, wanted = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), space.apply(values)
    for field in space.fields:
        np.testing.assert_allclose(read_field(written, field), read_field(wanted, field), rtol=1e-4, atol=1e-6)


def test_a_direction_is_exported_with_length_one(source: Path, tmp_path: Path) -> None:
    space = ParameterSpace(source, {"a": {"field": "jnt_axis[0]", "name": "hinge", "bounds": [0.1, 0.9]}})
    export_model(source, space, np.array([0.5]), tmp_path / "model.xml")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    np.testing.assert_allclose(written.jnt_axis, space.apply([0.5]).jnt_axis, atol=1e-6)


def test_a_model_with_meshes_and_includes_loads_from_another_folder(tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    (robot / "meshes").mkdir(parents=True)
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)]
    faces = [(1, 3, 2), (1, 2, 4), (2, 3, 4), (1, 4, 3)]
    (robot / "meshes" / "wedge.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {a} {b} {c}\n" for a, b, c in faces)
    )
    (robot / "assets.xml").write_text('<mujoco><asset><mesh name="wedge" file="wedge.obj"/></asset></mujoco>')
    (robot / "robot.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><include file="assets.xml"/><worldbody><body name="b">'
        '<joint name="j" axis="0 1 0"/><geom type="mesh" mesh="wedge"/></body></worldbody>'
        '<actuator><motor name="m" joint="j"/></actuator></mujoco>'
    )
    space = ParameterSpace(robot / "robot.xml", {"m": {"field": "body_mass", "name": "b", "bounds": [0.1, 9]}})
    out = tmp_path / "far" / "away"
    out.mkdir(parents=True)
    export_model(robot / "robot.xml", space, np.array([3.0]), out / "model.xml")
    written = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    np.testing.assert_allclose(motion(written), motion(space.apply(np.array([3.0]))), rtol=1e-3, atol=1e-4)


def test_the_hopper_at_its_truth_is_exported(tmp_path: Path) -> None:
    space = ParameterSpace(SIM.model, SIM.parameters)
    export_model(SIM.model, space, space.vector(SIM.truth), tmp_path / "model.xml")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    np.testing.assert_allclose(written.body_mass[1:], list(SIM.truth.values()), rtol=1e-5)
    np.testing.assert_allclose(written.body_inertia, space.model.body_inertia, rtol=1e-4)


def test_what_mjcf_cannot_express_is_said_and_leaves_no_file(source: Path, tmp_path: Path) -> None:
    space = ParameterSpace(source, {"p": {"field": "body_inertia[0]", "name": "pole", "bounds": [0.1, 9]}})
    with pytest.raises(InputError, match="export"):  # no body has one moment of inertia above the sum of the others
        export_model(source, space, np.array([5.0]), tmp_path / "model.xml")
    assert not (tmp_path / "model.xml").exists()
    binary = tmp_path / "sledge.mjb"
    mujoco.mj_saveModel(space.model, str(binary), None)
    with pytest.raises(InputError, match="no XML model"):
        export_model(binary, space, np.array([5.0]), tmp_path / "model.xml")


def test_a_fit_of_a_binary_model_says_why_there_is_no_model_xml(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "robot")
    binary = folder.path / "arm.mjb"
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_path(str(folder.path / "arm.xml")), str(binary), None)
    assert main(["fit", str(folder.config(model="arm.mjb")), "--out", str(tmp_path / "out")]) == 0
    assert not (tmp_path / "out" / "model.xml").exists()
    assert "No model.xml was written" in (tmp_path / "out" / "report.html").read_text()
