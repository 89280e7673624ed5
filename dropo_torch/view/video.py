"""A video of a view: the logged robot as a ghost over the simulated one, a pane for each simulation."""

from __future__ import annotations

import copy
import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.support.extras import MissingExtra, require
from dropo_torch.support.files import write_atomically
from dropo_torch.support.offscreen import REMEDY, draw_offscreen
from dropo_torch.view.replay import View
from dropo_torch.view.scene import Scene, aim, floor_lines, make_scene, poses, set_state

#: Frames a second of the video, and seconds that it lasts at least: short stretches are slowed down.
RATE, LEAST = 25, 4.0
#: Speeds of which the fastest is taken that makes a video last long enough.
SPEEDS = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01)
#: Colors of the simulated robots: of the model that was improved, and of the last or only one.
COLORS = ((0.835, 0.369, 0.0, 1.0), (0.0, 0.447, 0.698, 1.0))
#: How much farther away a camera with perspective stands than one without.
BACK = 1.15
#: Width of a pane over its height.
ASPECT = 4 / 3


def write_video(path: Path, view: View, on_progress: Callable[[int, int], None] = lambda done, of: None) -> str:
    """Write an mp4 of a view, whole or not at all.

    Args:
        path: the file.
        view: what is shown.
        on_progress: called with the frames that are done, and all.

    Returns:
        Why there is none, in a sentence; empty where it was written.
    """
    models = [take.candidate.model for take in view.takes]
    if any(model is None for model in models):
        return "No video: this simulator is no MuJoCo model."
    try:
        require("view", "a video")
    except MissingExtra as error:
        return f"No video: {error}."

    def told(line: str) -> None:
        words = line.split()
        if len(words) == 2 and all(word.isdecimal() for word in words):
            on_progress(int(words[0]), int(words[1]))

    with tempfile.TemporaryDirectory() as folder:
        source, video = Path(folder) / "scene.npz", Path(folder) / "view.mp4"
        for i, model in enumerate(models):
            mujoco.mj_saveModel(copy.copy(model), f"{source}.{i}.mjb")
        np.savez(source, **_drawing(view, [m for m in models if m is not None]))
        if not draw_offscreen(Path(__file__).with_name("render.py"), [str(source), str(video)], told):
            return f"No video: {REMEDY}"
        write_atomically(path, video.read_bytes())
    return ""


def video_frames(times: np.ndarray) -> tuple[np.ndarray, float]:
    """Return which frames of a view a video shows, one after another, ``(F,)``, and its speed."""
    lasts = float(times[-1] - times[0])
    speed = next((s for s in SPEEDS if lasts / s >= LEAST), SPEEDS[-1])
    wanted = times[0] + np.arange(0, lasts + 1e-9, speed / RATE)
    after = np.searchsorted(times, wanted).clip(1, len(times) - 1)
    return np.where(wanted - times[after - 1] < times[after] - wanted, after - 1, after), speed


def _drawing(view: View, models: list[mujoco.MjModel]) -> dict[str, Any]:
    """All that the program draws, as arrays."""
    model, (shown, speed) = models[-1], video_frames(view.times)
    scene, logged, controls = make_scene(model), view.logged[shown], view.controls[shown]
    simulated = [poses(m, scene, t.states[shown], controls) for m, t in zip(models, view.takes, strict=True)]
    camera = aim(scene, poses(model, scene, logged, controls), *simulated)
    data, mocap = mujoco.MjData(model), []
    for state, control in zip(logged, controls, strict=True):
        set_state(model, data, state, control)
        mocap.append((data.mocap_pos.copy(), data.mocap_quat.copy()))
    slower = "" if speed == 1 else f"   (speed {speed:g})"
    size = max(camera.width, camera.height)
    lines = [pair for line in floor_lines(model, camera, lift=0.003 * size) for pair in itertools.pairwise(line)]
    return {
        "logged": logged[:, : model.nq],
        **{f"qpos{i}": take.states[shown][:, : model.nq] for i, take in enumerate(view.takes)},
        "mocap_pos": np.array([p for p, _ in mocap]), "mocap_quat": np.array([q for _, q in mocap]),
        "centers": camera.centers, "direction": np.array([camera.azimuth, camera.elevation]),
        "size": BACK * max(camera.height, camera.width / ASPECT) / 2,
        "names": np.array([take.name for take in view.takes]),
        "colors": np.array(COLORS[-len(view.takes) :]), "lines": np.array(lines).reshape(-1, 2, 3),
        "texts": np.array([f"{view.times[f]:.2f} s{slower}" for f in shown]),
        "rate": RATE, "hidden": scene.hidden, "rods": _rods(scene),
    }  # fmt: skip


def _rods(scene: Scene) -> np.ndarray:
    """Rows of body, two ends and radius, ``(L, 8)``; a ball's ends lie next to each other."""
    rows = [
        [s.body, *s.points[0], *(s.points[-1] + (1e-6 if len(s.points) == 1 else 0.0)), s.radius] for s in scene.rods
    ]
    return np.array(rows).reshape(-1, 8)
