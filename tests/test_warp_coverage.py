"""The coverage benchmark's own arithmetic: what it finds, counts, keeps and calls a failure."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.warp_coverage import (
    Model,
    compiled_models,
    examine,
    judged,
    kept,
    package_folder,
    random_states,
    reason_table,
    relative_errors,
    report,
    resumed,
    varied,
)

PENDULUM = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="bob" pos="0 0 .3">
<joint name="hinge" axis="0 1 0" limited="true" range="-30 30"/><geom name="bob" size=".1" pos="0 0 -.2"/></body>
<body name="fixed"><geom size=".1" pos="3 0 0"/></body></worldbody></mujoco>"""


def pendulum() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


def test_folders_are_found_without_import(tmp_path: Path) -> None:
    (tmp_path / "mujoco_playground").mkdir()
    assert package_folder("playground", tmp_path) == tmp_path / "mujoco_playground"
    assert package_folder("brax", tmp_path) is None
    assert package_folder("no_such_package", None) is None
    loaded = set(sys.modules)
    found = package_folder("wsgiref", None)
    assert found is not None
    assert (found / "util.py").exists()
    assert "wsgiref" not in set(sys.modules) - loaded


def test_only_whole_models_with_joints_are_tried(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "good.xml").write_text(PENDULUM)
    (tmp_path / "part.xml").write_text("<mujocoinclude/>")
    (tmp_path / "rigid.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    assert [path for path, _ in compiled_models(tmp_path, "*")] == ["sub/good.xml"]
    assert not list(compiled_models(tmp_path, "other*"))


def test_what_can_matter_varies() -> None:
    assert varied(pendulum()).names == ("mass bob", "friction floor", "friction bob", "friction geom2", "damping hinge")


def test_a_model_that_is_taken_has_no_reasons() -> None:
    assert examine("x.xml", pendulum()).taken
    lacking = mujoco.MjModel.from_xml_string(PENDULUM.replace("<worldbody>", "<worldbody><flexcomp type='grid' "
                                             "count='2 2 1' spacing='.1 .1 .1' name='f' dim='2'/>"))  # fmt: skip
    assert not examine("x.xml", lacking).taken


def test_states_are_within_limits_at_the_start_and_repeatable() -> None:
    model = pendulum()
    states = random_states(model, 30, seed=3)
    assert states.shape == (30, 2)
    assert np.isfinite(states).all()
    assert np.abs(states[:, 0]).max() < np.radians(40)
    assert np.unique(states[:, 0]).size == 30
    np.testing.assert_array_equal(states, random_states(model, 30, seed=3))


def test_derivatives_that_are_zero_on_both_sides_do_not_count() -> None:
    true = np.array([[0.0, 2.0], [0.0, -4.0]])
    np.testing.assert_allclose(relative_errors(true * 1.01, true), 0.01, rtol=1e-3)
    assert relative_errors(np.zeros(3), np.zeros(3)).size == 0
    assert relative_errors(np.array([1.0]), np.array([0.0]))[0] > 1e5
    assert np.isinf(relative_errors(np.array([np.nan]), np.array([1.0]))).all()
    assert relative_errors(np.array([np.nan]), np.array([np.nan])).size == 0


def test_reasons_are_counted_by_models() -> None:
    models = [Model("a", 1, ["x", "y"]), Model("b", 1, ["x"]), Model("c", 1, ["z"]), Model("d", 1)]
    assert reason_table(models) == [("x", 2, 1), ("y", 1, 0), ("z", 1, 1)]


def test_results_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    assert resumed(out) == {}
    results = {"brax": {"a.xml": Model("a.xml", 3, ["x"], "x (1)"), "b.xml": Model("b.xml", 2, fault="died")}}
    kept(out, results)
    assert resumed(out) == results
    assert "1 fail, 100.0% of those taken" in report(results)


def test_states_at_a_tie_are_judged_apart() -> None:
    ties, gradient = (
        np.array([True, True, False, False, False]),
        {"mass": np.array([1e-7, 1e-6]), "friction": np.zeros(0)},
    )
    good = judged(np.array([1e-7, 1e-7, 1e-12, 1e-12, 1e-3]), ties, gradient)
    assert (good["passed"], good["off"], good["ties"]) == (True, 1, 2)
    assert good["gradients"]["friction"] is None
    assert not judged(np.array([1e-5, 1e-5, 0, 0, 0]), ties, gradient)["passed"]
    assert not judged(np.array([0, 0, 1e-7, 1e-7, 0]), ties, gradient)["passed"]
    assert judged(np.zeros(5), ties, {"mass": np.full(3, 1e-4)})["wrong"] == ["mass"]
