"""Pushes that are no part of the robot are told with their time, and nothing else is told by their rows."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.gap import add, find_gap, prepare
from dropo_torch.gap.disturbed import find_spans, undisturbed
from dropo_torch.gap.result import Disturbance
from dropo_torch.gap.scene import Scene
from dropo_torch.report.gap_words import answer, pushes

ARM = """<mujoco><compiler angle="radian"/><option timestep=".005" integrator="implicitfast"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 0 1" damping=".3" armature=".02" {friction}/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="2" contype="0"/>
    <body name="lower" pos=".4 0 0"><joint name="elbow" axis="0 0 1" damping=".2" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" contype="0"/></body></body></worldbody>
  <actuator><position name="s" joint="shoulder" kp="60" kv="3"/><position name="e" joint="elbow" kp="30" kv="1"/>
  </actuator></mujoco>"""
NOISE, ROWS, SKIP = np.array([2e-4, 2e-4, 4e-3, 4e-3]), 2400, 2
#: Rows in which somebody pushes the lower arm with so many newtons.
PUSHED = {(600, 640): (0.0, 6.0, 0.0), (2050, 2095): (4.0, -4.0, 0.0)}


def logged(
    pushed: dict[tuple[int, int], tuple[float, ...]], friction: float = 0.0, stop: float = 0.0, cable: float = 0.0
) -> np.ndarray:
    """Return a log of the arm that is pushed; with friction, a stop or a cable that pulls beyond 1.1 rad."""
    joint = f'frictionloss="{friction}"' + (f' range="-9 {stop}" solreflimit=".1 1"' if stop else "")
    model = mujoco.MjModel.from_xml_string(ARM.format(friction=joint))
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(4), []
    tones = rng.uniform(0.3, 1.6, (2, 4)), rng.uniform(0, 6, (2, 4))
    for row in range(ROWS):
        data.ctrl[:] = 0.35 * np.sin(2 * np.pi * tones[0] * row * 0.01 + tones[1]).sum(1)
        data.xfrc_applied[2, :3] = next((f for (a, b), f in pushed.items() if a <= row < b), (0, 0, 0))
        data.qfrc_applied[0] = -cable * max(data.qpos[0] - 1.1, 0.0)
        rows.append([0.01 * row, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(model, data, SKIP)
    log = np.array(rows)
    log[:, 1:5] += NOISE * rng.standard_normal((ROWS, 4))
    return log


def scene_of(folder: Path, **truth: Any) -> Scene:
    """Return what a search works on, of a log and the arm without friction and stops."""
    names = "t,q1,q2,v1,v2,u1,u2"
    np.savetxt(folder / "log.csv", logged(**truth), delimiter=",", header=names, comments="")
    (folder / "arm.xml").write_text(ARM.format(friction=""))
    (folder / "arm.yaml").write_text(
        "model: arm.xml\ndata: {path: log.csv, time: t, observations: [q1, q2, v1, v2], actions: [u1, u2]}\n"
        f"frame_skip: {SKIP}\n"
    )
    return prepare(dropo.make_problem(dropo.load_config(folder / "arm.yaml"), general=True))


def test_pushes_are_dated_and_the_force_is_that_of_the_push(tmp_path: Path) -> None:
    """In both parts of the log; what is left is without these rows, to a window's length."""
    scene = scene_of(tmp_path, pushed=PUSHED)
    spans = find_spans(scene, scene.begin, scene.noise)
    assert len(spans) == len(PUSHED)
    for span, ((first, last), force) in zip(spans, PUSHED.items(), strict=True):
        told = span.told
        assert told.begin == pytest.approx(0.01 * first, abs=0.09)
        assert told.end == pytest.approx(0.01 * last, abs=0.09)
        assert span.first <= first
        assert span.last >= last
        assert told.body == "lower"
        assert told.force is not None
        assert told.force[:2] == pytest.approx(force[:2], abs=1.0)
    calm, told_too = undisturbed(scene, scene.begin, scene.noise)
    assert told_too == tuple(span.told for span in spans)
    assert len(calm.train) + len(calm.held) == ROWS - 1 - sum(s.last - s.first for s in spans)


def test_many_small_wrongs_do_not_hide_a_push(tmp_path: Path) -> None:
    small = {(first, first + 20): (0.0, 0.5, 0.0) for first in range(100, 2000, 150) if not 550 < first < 690}
    scene = scene_of(tmp_path, pushed={**PUSHED, **small})
    spans = find_spans(scene, scene.begin, scene.noise)
    assert [span.told.begin for span in spans] == pytest.approx([6.0, 20.5], abs=0.09)


@pytest.mark.parametrize(
    "truth", [{}, {"friction": 0.4}, {"stop": 1.2}, {"cable": 3.0}], ids=["right", "friction", "stop", "cable"]
)
def test_what_the_same_motion_shows_again_is_no_push(truth: dict[str, Any], tmp_path: Path) -> None:
    """Nor what only shows at the end of the range, however seldom the robot comes there."""
    scene = scene_of(tmp_path, pushed={}, **truth)
    assert find_spans(scene, scene.begin, scene.noise) == ()
    assert undisturbed(scene, scene.begin, scene.noise) == (scene, ())


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_the_rest_of_the_log_names_what_is_missing(friction: float, tmp_path: Path) -> None:
    """Also where the pushes stand out only beside what is named."""
    scene = scene_of(tmp_path, pushed=PUSHED, friction=friction)
    gap = find_gap(scene.problem, scene=scene)
    (tmp_path / "out").mkdir()
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_friction", "shoulder")] * (friction > 0)
    if friction:
        assert gap.effects[0].parameters["friction"].value == pytest.approx(friction, rel=0.05)
    assert gap.remaining is None
    assert len(gap.disturbances) == len(gap.document()["disturbances"]) == len(PUSHED)
    add(scene.problem, gap, tmp_path / "out")
    if friction:  # a fit is not told by the pushes either
        config = dropo.load_config(tmp_path / "out" / "config.yaml")
        assert [episode for episode, *_ in config.leave_out] == [0] * len(PUSHED)
        fitted = dropo.make_problem(config).trajectories
        assert ROWS - 200 < len(fitted) < ROWS - sum(b - a for a, b in PUSHED)
        assert fitted.num_episodes == len(PUSHED) + 1
    sentence, _ = answer(gap)
    assert sentence.startswith("Something pushed that is no part of the robot: from ")


def test_pushes_are_told_in_words() -> None:
    one = Disturbance(0, 16.42, 16.92, "forearm", (0.0, 14.0, 0.0), "waist", 6.851, "N·m")
    two = dataclasses.replace(one, episode=2, body=None, force=None)
    assert pushes([one]) == (
        "Something pushed that is no part of the robot: from 16.42 to 16.92 s at waist, up to 6.851 N·m, as a force of "
        "some 14 N on forearm would. Without that span of the log:"
    )
    assert "from 16.42 to 16.92 s of episode 2 at waist, up to 6.851 N·m." in pushes([one, two])
