"""A view shows what was measured and what is simulated: poses by MuJoCo's kinematics, residuals as a fit has them."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from arm import DT, TRUTH, Folder, record
from conftest import ARM_XML, BOX_XML, TENDON_XML, compiled

from dropo_torch.commands.cli import main
from dropo_torch.data.trajectory import make_replay
from dropo_torch.report import write_view_page
from dropo_torch.view import View, make_view, read_run, scene, write_video
from dropo_torch.view.scene import Shape, aim, arms, axes_of, direction, geom_points, make_scene, poses, turned

#: A ball and a hinged rod on a cart that is pulled over a floor; and the same seen from above.
CART_XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="0 0 .1"/>
    <body name="cart" pos="0 0 .3">
      <joint name="track" type="slide" axis="1 0 0"/>
      <geom type="box" size=".2 .1 .05" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="swing" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 .6" size=".03" mass=".3" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="pull" joint="track" gear="5"/></actuator>
</mujoco>"""
MODELS = {"arm without geoms": ARM_XML, "free box": BOX_XML, "ball joint": TENDON_XML, "cart": CART_XML}


def logged(folder: Path, xml: str, *, steps: int = 40, scale: float = 0.3, **config: Any) -> Path:
    """A config with a model and a log of it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(xml)
    model = compiled(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qvel[:] = rng.normal(0, scale, model.nv)
    states, actions = [np.concatenate([data.qpos, data.qvel])], rng.uniform(-1, 1, (steps, model.nu))
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, 2)
        states.append(np.concatenate([data.qpos, data.qvel]))
    log = {"observations": states[:-1], "next_observations": states[1:], "actions": actions}
    np.savez(folder / "log.npz", **log, terminals=np.arange(steps) == steps - 1)
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump({"model": "model.xml", "data": "log.npz", "frame_skip": 2, **config}))
    return path


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fit of the arm's masses."""
    folder = Folder(tmp_path_factory.mktemp("arm"))
    out = folder.path / "out"
    assert main(["fit", str(folder.config()), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a gap: a viscous friction of 0.2 in the elbow, which the model lacks."""
    folder = Folder(tmp_path_factory.mktemp("gap"))
    xml = (folder.path / "arm.xml").read_text()
    (folder.path / "rubbing.xml").write_text(xml.replace('damping=".1"', 'damping=".3"'))
    folder.log("log.npz", **record(xml=(folder.path / "rubbing.xml").read_text()))
    before = yaml.safe_load(folder.config().read_text())
    out = folder.path / "gap"
    out.mkdir()
    config = {
        key: str((folder.path / value).resolve()) if key in ("model", "data") else value
        for key, value in before.items()
    }
    declared = {name: {"given": 1.0, "alone": 0.9 * mass, "with_effects": mass} for name, mass in TRUTH.items()}
    noise = dict.fromkeys(("shoulder.position", "elbow.position", "shoulder.velocity", "elbow.velocity"), 1e-3)
    document = {"schema": "dropo-torch/gap/1", "declared": declared, "noise": noise, "config": config}
    (out / "gap.json").write_text(json.dumps(document))
    friction = {"effect": "joint_damping", "name": "elbow", "index": "damping", "bounds": [0.1, 0.5]}
    amended = config | {
        "effects": [{"effect": "joint_damping", "target": "elbow", "damping": 0.2}],
        "parameters": before["parameters"] | {"elbow_damping": friction},
    }
    (out / "config.yaml").write_text(yaml.safe_dump(amended))
    return out


def page_of(view: View, path: Path) -> tuple[str, dict[str, Any]]:
    """A page, and the data in it."""
    write_view_page(path / "view.html", view)
    text = (path / "view.html").read_text()
    return text, json.loads(re.findall(r'id="view-data">(.*?)</script>', text, re.DOTALL)[0])


def floats(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(shape)


def small_view(path: Path, xml: str = CART_XML, **options: float) -> View:
    return make_view(read_run(logged(path, xml)), **options)


# --- what is simulated ---


def test_residuals_are_those_of_a_replay(fitted: Path) -> None:
    """Windows of 10 steps of the second episode, against the evaluator's own replay of them."""
    view = make_view(read_run(fitted), episode=1, horizon=10 * DT)
    problem = view.run.candidates[-1].problem
    replay = make_replay(problem.trajectories, problem.observation, 10)
    for take in view.takes:
        kept: list[torch.Tensor] = []

        def keep(features: torch.Tensor, measured: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
            kept.append(measured - features[:, 0])  # noqa: B023
            return torch.zeros(1)

        problem.objective.evaluator.map_replay(replay, take.candidate.values[None], keep)
        difference = torch.cat(kept)[3:].flatten(0, 1).numpy() / np.sqrt(problem.config.epsilon)
        np.testing.assert_allclose(take.residuals[1:], difference, rtol=1e-9, atol=1e-9)
        assert not take.residuals[0].any()


def test_windows_of_one_step_are_the_transitions_of_a_fit(fitted: Path) -> None:
    view = make_view(read_run(fitted), horizon=DT)
    candidate = view.run.candidates[0]
    objective, rows = candidate.problem.objective, view.stretch.rows
    simulated = objective.simulated(candidate.values[None])[rows, 0].numpy()
    measured = objective.evaluator.columns[rows].numpy()
    np.testing.assert_allclose(view.takes[0].residuals[1:] * view.noise, measured - simulated, atol=1e-12)


def test_the_truth_leaves_nothing_and_the_model_as_given_does(fitted: Path) -> None:
    own, best = make_view(read_run(fitted)).takes
    assert (own.name, best.name) == ("the model's own values", "fitted")
    assert best.overall < 1e-3 < 1 < own.overall


def test_a_gap_is_seen_before_and_after(found: Path) -> None:
    """After has the effect's number and the masses that were found beside it; the noise is the gap's."""
    view = make_view(read_run(found))
    before, after = view.takes
    assert (before.name, after.name) == ("before", "after")
    assert after.overall < 1e-6
    assert before.overall > 1
    assert view.noise == pytest.approx(np.full(4, 1e-3))
    values = zip(after.candidate.problem.space.names, after.candidate.values, strict=True)
    assert dict(values) == TRUTH | {"elbow_damping": 0.2}


def test_a_stretch_is_cut_as_asked(fitted: Path) -> None:
    view = make_view(read_run(fitted), episode=1, start=0.1, seconds=0.3, horizon=0.14)
    assert view.times == pytest.approx(0.1 + DT * np.arange(16))
    assert view.starts == pytest.approx([0.1, 0.24, 0.38])  # the last window is one step long
    log = view.run.candidates[0].problem.trajectories
    np.testing.assert_array_equal(view.logged[:-1], log.observations[35:50])
    np.testing.assert_array_equal(view.logged[-1], log.next_observations[49])


def test_no_more_frames_than_a_screen_shows(tmp_path: Path) -> None:
    """A log of a kilohertz is thinned, with its first and last instants."""
    view = small_view(tmp_path)
    stretch = replace(view.stretch, steps=20_000, timestep=1e-3)
    frames = stretch.frames
    assert (frames[0], frames[-1]) == (0, 20_000)
    assert len(frames) <= 1500
    assert np.diff(frames)[:-1].tolist() == [17] * (len(frames) - 2)


# --- what is drawn ---


@pytest.mark.parametrize("name", MODELS)
def test_poses_are_those_of_mujoco(name: str, tmp_path: Path) -> None:
    view = small_view(tmp_path, MODELS[name], horizon=0.1)
    text, data = page_of(view, tmp_path)
    model, bodies = compiled(MODELS[name]), data["bodies"]
    assert len(data["robots"]) == 2
    assert data["frames"] == len(view.times) == len(floats(data["times"], -1))
    for robot, states in zip(data["robots"], (view.takes[0].states, view.logged), strict=True):
        drawn = floats(robot["poses"], data["frames"], bodies, 7)
        for state, pose in zip(states, drawn, strict=True):
            there = mujoco.MjData(model)
            there.qpos[:] = state[: model.nq]
            mujoco.mj_kinematics(model, there)
            expected = np.concatenate([there.xpos, there.xquat], 1)[-bodies:]
            np.testing.assert_allclose(pose, expected, atol=1e-6)
    assert data["shapes"]
    np.testing.assert_allclose(
        floats(data["takes"][0]["residuals"], data["frames"], -1), view.takes[0].residuals, atol=1e-5
    )
    assert text.count('data-column="') == len(view.labels)


def test_prescribed_bodies_are_where_the_log_has_them() -> None:
    """The pose of a hand that pushes stands in the log after the commands, and with it what it carries."""
    model = compiled(
        """<mujoco><worldbody>
        <body name="hand" mocap="true"><geom size=".1"/><body name="finger" pos="0 0 .2">
          <joint name="bend" axis="0 1 0"/><geom size=".05" mass=".1"/></body></body>
        </worldbody><actuator><motor joint="bend"/></actuator></mujoco>"""
    )
    rng = np.random.default_rng(0)
    pose = rng.normal(size=(4, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    found = poses(model, make_scene(model), np.zeros((4, 2)), np.concatenate([np.zeros((4, 1)), pose], 1))
    np.testing.assert_allclose(found[:, 0], pose, atol=1e-12)
    np.testing.assert_allclose(found[:, 1, :3], pose[:, :3] + turned(pose[:, 3:], np.array([0, 0, 0.2])), atol=1e-12)


def test_a_stretch_begins_where_the_commands_that_act_are_known(tmp_path: Path) -> None:
    """A delay of 60 ms acts on commands from before the log in its first three rows of 20 ms."""
    delay = {"effect": "actuator_delay", "target": "pull", "delay": 0.06}
    view = make_view(read_run(logged(tmp_path, CART_XML, effects=[delay])))
    assert view.stretch.first == 3
    assert view.times[0] == pytest.approx(0.06)


GEOMS = {
    "sphere": ('type="sphere" size=".2"', lambda d: 0.2),
    "capsule": ('type="capsule" size=".1 .3"', lambda d: 0.1 + 0.3 * abs(d[2])),
    "box": ('type="box" size=".1 .2 .3"', lambda d: np.abs(d) @ [0.1, 0.2, 0.3]),
    "cylinder": ('type="cylinder" size=".2 .3"', lambda d: 0.2 * np.hypot(d[0], d[1]) + 0.3 * abs(d[2])),
    "ellipsoid": ('type="ellipsoid" size=".1 .2 .3"', lambda d: np.linalg.norm(d * [0.1, 0.2, 0.3])),
    "mesh": ('type="mesh" mesh="brick"', lambda d: np.abs(d) @ [0.1, 0.2, 0.3]),
}


@pytest.mark.parametrize("kind", GEOMS)
def test_outlines_are_those_of_the_geoms(kind: str) -> None:
    """How far a shape reaches in any direction: the support function, which decides every outline."""
    text, reach = GEOMS[kind]
    corners = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3))
    quaternion = np.array([0.5, 0.5, -0.5, 0.5])
    model = compiled(
        f'<mujoco><asset><mesh name="brick" vertex="{corners}"/></asset><worldbody>'
        f'<geom {text} pos="1 2 3" quat="{" ".join(map(str, quaternion))}"/></worldbody></mujoco>'
    )
    points, radius = geom_points(model, 0)
    rng, turn = np.random.default_rng(0), turned(quaternion, np.eye(3))  # rows: the geom's axes
    for d in rng.normal(size=(50, 3)):
        d /= np.linalg.norm(d)
        expected = reach(turn @ d) + d @ [1, 2, 3]
        assert (points @ d).max() + radius == pytest.approx(expected, abs=0.04 * 0.3), kind


def test_a_bob_hangs_by_a_rod_and_what_touches_its_hinge_needs_none() -> None:
    bob = '<geom type="sphere" size=".03" pos="0 0 -.5"/>'
    rod = '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/>'
    text = '<mujoco><worldbody><body><joint axis="0 1 0"/>{}</body></worldbody></mujoco>'
    (added,) = make_scene(compiled(text.format(bob))).rods
    assert added.points.tolist() == [[0, 0, 0], [0, 0, -0.5]]
    assert not make_scene(compiled(text.format(rod))).rods
    assert not arms(compiled(text.format(rod)), [Shape(1, np.zeros((1, 3)), 0.1)])


@pytest.mark.parametrize(
    ("axes", "seen"),
    [
        ([[1, 0, 0], [0, 0, 1]], [0, 1, 0]),  # a vertical plane, from the side
        ([[0, 1, 0], [0, 0, 1]], [-1, 0, 0]),
        ([[1, 0, 0], [0, 1, 0]], [0, 0, -1]),  # a table, from above
        ([[1, 0, 0]], [0, 1, 0]),  # a rail
        ([[0, 0, 1]], [0, 1, 0]),
    ],
)
def test_a_planar_motion_is_seen_across_its_plane(axes: list[list[float]], seen: list[float]) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 5, len(axes))) @ np.array(axes, dtype=float)
    right, up = axes_of(*direction(points))
    np.testing.assert_allclose(np.cross(up, right), seen, atol=1e-6)


def test_other_motions_are_seen_from_above(tmp_path: Path) -> None:
    _, elevation = direction(np.random.default_rng(0).normal(size=(20, 5, 3)))
    assert elevation == scene.ELEVATION


def test_a_robot_that_walks_is_not_seen_from_straight_above():
    """Its trunk moves over the ground by more than its feet rise."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/><body pos='.1 0 -.2'><joint axis='0 1 0'/>"
        "<geom size='.03'/></body></body><body pos='1 0 0'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    assert make_scene(model).walks
    flat = np.random.default_rng(1).normal(size=(20, 5, 3)) * [1.0, 1.0, 0.01]
    assert direction(flat)[1] == -90.0
    assert -45.0 < direction(flat, walks=True)[1] < 0.0


def test_the_camera_follows_who_travels_and_sees_all_frames(tmp_path: Path) -> None:
    """What the log shows lies within the picture at every frame; a cart far down its track is followed."""
    for far, name in ((0.2, "near"), (20.0, "far")):
        view = small_view(tmp_path / name, CART_XML, seconds=5.0)
        model = view.takes[0].candidate.model
        assert model is not None
        states = view.logged.copy()
        states[:, 0] = np.linspace(0, far, len(states))
        drawn = make_scene(model)
        frames = poses(model, drawn, states, view.controls)
        camera = aim(drawn, frames)
        sides = np.stack(axes_of(camera.azimuth, camera.elevation))
        points = (scene.placed_points(drawn, frames) - camera.centers[:, None]) @ sides.T
        assert (np.abs(points).max((0, 1)) <= 0.5 * np.array([camera.width, camera.height])).all()
        assert (np.ptp(camera.centers[:, 0]) > 10) == (name == "far")
        assert camera.width < 5


# --- the page ---


def test_the_page_stands_on_its_own(fitted: Path, tmp_path: Path) -> None:
    view = make_view(read_run(fitted))
    text, _ = page_of(view, tmp_path)
    assert "http" not in text
    assert not re.findall(r"<(?:link|iframe|img)\b|@import|\bsrc=|\bfetch\(|import\(", text)
    assert not re.findall(r"href=", text)
    assert text == page_of(view, tmp_path)[0]


def test_what_diverges_is_told_and_not_drawn(tmp_path: Path) -> None:
    view = small_view(tmp_path, horizon=0.2)
    take = view.takes[0]
    states, residuals = take.states.copy(), take.residuals.copy()
    states[11:21], residuals[11:21] = np.nan, np.nan
    lost = replace(view, takes=(replace(take, states=states, residuals=residuals),))
    text, data = page_of(lost, tmp_path)
    assert "The model diverges, first in the window at 0.22 s; it is not drawn in 10 frames" in text
    assert "NaN" not in text
    drawn = floats(data["robots"][0]["poses"], data["frames"], -1)
    assert (np.flatnonzero(np.isnan(drawn).any(1)) == np.arange(11, 21)).all()
    assert np.isfinite(take.overall)


def test_a_simulator_without_a_model_has_residuals_alone(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    config = folder.config(
        backend="gymnasium", environment="adapter.py:make", model=..., frame_skip=...,
        parameters={n: {"bounds": p["bounds"]} for n, p in folder_parameters(folder).items()},
    )  # fmt: skip
    view = make_view(read_run(config))
    text, data = page_of(view, tmp_path)
    assert data["bodies"] == 0
    assert 'id="scene"' not in text
    assert "no robot to draw" in text
    assert write_video(tmp_path / "view.mp4", view).startswith("No video: ")


def folder_parameters(folder: Folder) -> dict[str, Any]:
    parameters: dict[str, Any] = yaml.safe_load(folder.config().read_text())["parameters"]
    return parameters


# --- the command ---


def no_drawing(*_: object) -> bool:
    return False


def test_the_command_writes_beside_the_run(
    fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where OpenGL does not draw, one line says so, and the page is written all the same; a fit moves it aside."""
    monkeypatch.setattr("dropo_torch.view.video.draw_offscreen", no_drawing)
    out = tmp_path / "out"
    shutil.copytree(fitted, out)
    assert main(["view", str(out), "--seconds", "0.3"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if line.startswith("No video: OpenGL cannot draw without a display here")]
    assert said[-1] == f"page: {out / 'view.html'}"
    text = (out / "view.html").read_text()
    assert 'href="report.html"' in text
    assert 'href="view.mp4"' not in text
    assert f"dropo view {out.name}" in (out / "report.html").read_text().replace(fitted.name, out.name)
    assert main(["fit", str(out / "fitted_config.yaml"), "--out", str(out), "--samples", "4"]) == 0
    assert (out / "previous-1" / "view.html").exists()
    assert not (out / "view.html").exists()


def test_a_check_and_a_config_are_seen_with_the_model_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dropo_torch.view.video.draw_offscreen", no_drawing)
    config, out = logged(tmp_path, CART_XML), tmp_path / "check"
    assert main(["check", str(config), "--out", str(out)]) == 0
    assert main(["view", str(out)]) == 0
    assert main(["view", str(config), "--out", str(tmp_path / "seen")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "times the noise" in line]
    assert lines == ["the model as it is: off by 0 times the noise (rms, open loop)"] * 2
    assert (out / "view.html").exists()
    assert (tmp_path / "seen" / "view.html").exists()


WRONG = {
    "nowhere": "view: no folder nowhere; expected that of a run",
    ".": "view: . has none of fit.json, gap.json, check.json",
    "run --episode 7": "--episode: 7 asked for; ",
    "run --start 3": "--start: 3 s asked for; episode 0 lasts 0.6 s",
    "run --horizon 0": "--horizon: '0' given; expected seconds, above 0",
    "run --episode -1": "--episode: ",
    "config.yaml": "--out: config.yaml is a config; name a folder",
    "old": "gap.json does not hold its config (an earlier version wrote it); run it again",
    "broken": "gap.json is no JSON",
    "other": "are not those of fitted_config.yaml beside it; fit again",
    "run --frames 3": "unknown option --frames",
}  # fmt: skip


@pytest.mark.parametrize("arguments", WRONG)
def test_what_cannot_be_seen_is_told_in_one_line(
    arguments: str, fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("run", "other"):
        shutil.copytree(fitted, tmp_path / name)
    document = json.loads((tmp_path / "other" / "fit.json").read_text())
    document["parameters"]["renamed"] = document["parameters"].pop("upper_mass")
    (tmp_path / "other" / "fit.json").write_text(json.dumps(document))
    shutil.copy(fitted / "fitted_config.yaml", tmp_path / "config.yaml")
    for name, text in (("old", "{}"), ("broken", "{")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "gap.json").write_text(text)
    assert main(["view", *arguments.split()]) == 2
    told = capsys.readouterr()
    assert WRONG[arguments] in told.err
    assert told.err.count("\n") == 1
    assert not list(tmp_path.glob("**/view.*"))


# --- where OpenGL and a browser are ---


def test_a_video_has_a_pane_for_each_simulation(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iio = pytest.importorskip("imageio.v3")
    pytest.importorskip("av")
    monkeypatch.setattr("dropo_torch.view.video.LEAST", 0.1)
    view = make_view(read_run(fitted), seconds=0.2)
    shown: list[tuple[int, int]] = []
    note = write_video(tmp_path / "view.mp4", view, lambda done, of: shown.append((done, of)))
    if note:
        pytest.skip(note)
    frames = iio.imread(tmp_path / "view.mp4", plugin="pyav")
    assert frames.shape == (6, 480, 2 * 640, 3)
    assert shown == [(i + 1, 6) for i in range(6)]
    left, right = frames[0, :, :640].astype(int), frames[0, :, 640:].astype(int)
    warmth = [side[..., 0] - side[..., 2] for side in (left, right)]  # orange of the model's own values, blue fitted
    assert warmth[0].max() > 25 > 15 > -warmth[0].min()
    assert -warmth[1].min() > 25 > 20 > warmth[1].max()


BROWSERS = [path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))]
#: Keys that are pressed one after the other, each followed by what the page says of the time.
HEAR = """<script>addEventListener("error", (event) => document.body.dataset.error = event.message);</script>"""
PRESS = """
<script>
setTimeout(() => {
  const said = [], [slider, clock] = ["slider", "clock"].map((id) => document.getElementById(id));
  const at = () => said.push(`${slider.value} ${clock.textContent}`);
  at();
  const keys = ["Home", "ArrowRight", "shifted ArrowRight", "ArrowLeft", "PageDown", "PageUp", "End"];
  for (const key of keys) {
    const [name, shifted] = key.split(" ").reverse();
    document.dispatchEvent(new KeyboardEvent("keydown", { key: name, shiftKey: Boolean(shifted) }));
    at();
  }
  const cursors = [...document.querySelectorAll(".cursor")].map((line) => line.getAttribute("x1"));
  const wide = document.documentElement.scrollWidth <= window.innerWidth;
  const pixels = (canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const drawn = [...document.querySelectorAll("canvas")].map((canvas) => pixels(canvas).some((value) => value > 0));
  const numbers = [...document.querySelectorAll("output")].map((o) => o.textContent);
  document.body.dataset.said = JSON.stringify({ said, cursors, wide, drawn, numbers });
}, 50);
</script>"""


@pytest.mark.skipif(not BROWSERS, reason="no headless browser")
@pytest.mark.parametrize("width", [390, 1280])
def test_in_a_browser_time_moves_by_keys_and_cursors_with_it(width: int, fitted: Path, tmp_path: Path) -> None:
    view = make_view(read_run(fitted), horizon=0.2)
    text, data = page_of(view, tmp_path)
    (tmp_path / "view.html").write_text(text.replace("<main>", f"{HEAR}<main>").replace("</body>", f"{PRESS}</body>"))
    command = [
        BROWSERS[0], "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900",
        f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000", "--dump-dom",
        (tmp_path / "view.html").as_uri(),
    ]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert "data-error" not in dom
    found = json.loads(re.findall(r"data-said='?\"?(\{.*?\})['\"]>", dom.replace("&quot;", '"'))[0])
    at = [0, 1, 11, 10, 20, 10, 30]
    assert found["said"][0].split()[0] == str(data["worst"])
    assert found["said"][1:] == [f"{frame} {view.times[frame]:.2f} s" for frame in at]
    assert [float(x) for x in found["cursors"]] == [1000.0] * len(view.labels)
    assert found["wide"]
    assert found["drawn"] == [True] * 7
    last = [take.residuals[-1, j] for j in range(len(view.labels)) for take in view.takes]
    for said, value in zip(found["numbers"], last, strict=True):
        assert float(said.replace("−", "-")) == pytest.approx(value, abs=0.051 if abs(value) < 100 else 0.51)
