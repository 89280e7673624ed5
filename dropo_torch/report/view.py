"""The page of a view: measured and simulated motion that one scrubs through, with the residuals under it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import mujoco
import numpy as np

from dropo_torch.report.figures.drawing import BLUE, ORANGE
from dropo_torch.report.formatting import joined, short, whole
from dropo_torch.report.page import Frame, write_page
from dropo_torch.view.replay import Take, View
from dropo_torch.view.scene import Camera, Scene, aim, floor_lines, make_scene, poses

#: Fill, edge and opacity of the logged robot and of one or two simulated ones.
GHOST = ("#1f2933", "#000000", 0.42)
COLORS = {1: ((BLUE, "#004a75"),), 2: ((ORANGE, "#8c3d00"), (BLUE, "#004a75"))}
#: Simulations as subjects of sentences.
NAMES = {
    "before": "the model before", "after": "the model with what it lacked", "fitted": "the fitted model",
    "the model's own values": "the model with its own values", "the model as it is": "the model",
}  # fmt: skip
#: Pictures under the scene, and the least and largest height of one relative to its width.
STILLS = 6
RATIOS = (0.4, 0.85)


def write_view_page(
    path: str | Path, view: View, *, links: Sequence[tuple[str, str]] = (), **frame: Unpack[Frame]
) -> None:
    """Write the page of a view as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        view: what is shown.
        links: files beside the page, and what they are.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    drawing, worst = _drawing(view), _worst(view)
    takes = [
        {"name": take.name, "color": color, "residuals": packed(take.residuals)}
        for take, (color, _) in zip(view.takes, COLORS[len(view.takes)], strict=True)
    ]
    data = {
        "frames": len(view.times), "times": packed(view.times), "labels": view.labels, "takes": takes, "worst": worst,
        "starts": view.starts.tolist(), **drawing,
    }  # fmt: skip
    camera, stills = drawing["camera"], np.linspace(0, len(view.times) - 1, STILLS).round().astype(int)
    content = {
        "title": view.run.title, "headline": _headline(view), "worst": worst, "worst_words": _worst_words(view, worst),
        "notes": _notes(view), "drawn": bool(drawing["bodies"]), "frames": len(view.times),
        "ratio": f"{1 / np.clip(camera['height'] / camera['width'], *RATIOS):.3f}",
        "robots": drawing["robots"], "takes": takes, "links": links, "data": data,
        "stills": [{"frame": int(f), "time": _seconds(view.times[f])} for f in np.unique(stills)],
        "noise_source": view.run.noise_source, "horizon": _seconds(view.stretch.horizon * view.stretch.timestep),
        "columns": [
            {"name": name, "unit": unit, "noise": float(noise), "rms": [float(take.rms[i]) for take in view.takes]}
            for i, (name, unit, noise) in enumerate(zip(view.labels, view.units, view.noise, strict=True))
        ],
        "facts": _facts(view),
    }  # fmt: skip
    write_page(path, "view.html", content, frame)


def packed(array: np.ndarray) -> str:
    """Return an array as base64 of little-endian single-precision numbers, row by row."""
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f4").tobytes()).decode("ascii")


def _drawing(view: View) -> dict[str, Any]:
    """What the page draws: shapes, floors, poses and the camera; nothing for a simulator that is no MuJoCo model."""
    names = ["measured", *(take.name for take in view.takes)]
    looks = [GHOST, *((*colors, 1.0) for colors in COLORS[len(view.takes)])]
    models = [take.candidate.model for take in view.takes]
    if models[-1] is None:
        scene, centers = None, np.zeros((len(view.times), 3))
        frames = [np.zeros((len(view.times), 0, 7))] * len(names)
        camera = Camera(90.0, 0.0, centers, 1.0, 1.0)
    else:
        scene = make_scene(models[-1])
        logged = poses(models[-1], scene, view.logged, view.controls)
        frames = [logged, *(poses(m, scene, t.states, view.controls) for m, t in zip(models, view.takes, strict=True))]
        camera = aim(scene, *frames)
    robots = [
        {"name": name, "fill": fill, "edge": edge, "alpha": alpha, "poses": packed(pose)}
        for name, (fill, edge, alpha), pose in zip(names, looks, frames, strict=True)
    ]
    return {
        "robots": robots[1:] + robots[:1],  # the log's on top of all
        "bodies": 0 if scene is None else len(scene.bodies),
        "shapes": [] if scene is None else _shapes(models[-1], scene),
        "lines": [] if scene is None else [line.round(5).ravel().tolist() for line in floor_lines(models[-1], camera)],
        "centers": packed(camera.centers),
        "camera": {key: getattr(camera, key) for key in ("azimuth", "elevation", "width", "height")},
    }  # fmt: skip


def _shapes(model: mujoco.MjModel, scene: Scene) -> list[dict[str, Any]]:
    """Shapes as the page has them: of moving bodies in the body's frame, of others in the world's."""
    data, place = mujoco.MjData(model), {int(body): i for i, body in enumerate(scene.bodies)}
    mujoco.mj_kinematics(model, data)
    found = []
    for shape in scene.shapes:
        points = shape.points
        if shape.body not in place:
            points = points @ data.xmat[shape.body].reshape(3, 3).T + data.xpos[shape.body]
        found.append(
            {
                "body": place.get(shape.body, -1),
                "radius": round(shape.radius, 6),
                "points": points.round(6).ravel().tolist(),
            }
        )
    return found


def _headline(view: View) -> str:
    """How far each simulation is from the log, in a sentence."""
    horizon = _seconds(view.stretch.horizon * view.stretch.timestep)
    off = [f"{_named(take)} is off by {_size(take.overall)} times the noise" for take in view.takes]
    return f"Open loop over {horizon}, {joined(off)} (root mean square over all columns)."


def _size(value: float) -> str:
    return "less than 0.01" if value < 0.01 else short(value)


def _named(take: Take) -> str:
    """A simulation as the subject of a sentence."""
    return NAMES.get(take.name, take.name)


def _worst(view: View) -> int:
    """The frame at which the first simulation's residuals are largest."""
    size = np.where(np.isfinite(view.takes[0].residuals), np.abs(view.takes[0].residuals), 0.0).max(1)
    return int(np.argmax(size))


def _worst_words(view: View, frame: int) -> str:
    residuals = view.takes[0].residuals[frame]
    if not np.isfinite(residuals).any() or not np.nanmax(np.abs(residuals)):
        return ""
    column = int(np.nanargmax(np.abs(residuals)))
    of = f", {view.takes[0].name}" if len(view.takes) > 1 else ""
    return f"{short(abs(float(residuals[column])))} in {view.labels[column]} at {_seconds(view.times[frame])}{of}"


def _notes(view: View) -> list[str]:
    """What a reader should know of the picture."""
    notes, model = [], view.takes[-1].candidate.model
    for take in view.takes:
        lost = np.flatnonzero(~np.isfinite(take.states).all(1))
        if lost.size:
            name, where = _named(take), _seconds(view.times[lost[0]])
            notes.append(
                f"{name[0].upper()}{name[1:]} diverges, first in the window at {where}; it is not drawn in "
                f"{whole(len(lost), 'frame')}, which do not count in the root mean squares."
            )
    if model is None:
        notes.append("This simulator is no MuJoCo model: there is no robot to draw, only residuals.")
    elif view.unseen:
        joints = dict.fromkeys(_joint_of(model, column) for column in view.unseen)
        notes.append(
            f"The log does not have the position of {joined(list(joints))}: every window starts there at the model's "
            "default, where the measured robot is drawn."
        )
    return notes


def _joint_of(model: mujoco.MjModel, column: int) -> str:
    joint = int(np.searchsorted(model.jnt_qposadr, column, side="right")) - 1
    return model.joint(joint).name or f"joint{joint}"


def _facts(view: View) -> list[tuple[str, str]]:
    """What is shown."""
    log, shown = view.run.candidates[-1].problem.trajectories, view.stretch
    first = shown.times[0]
    return [
        ("Log", Path(log.source).name),
        ("Episode", f"{shown.episode} of {log.num_episodes}, counted from 0"),
        ("Stretch", f"{_seconds(first)} to {_seconds(shown.times[-1])}, {whole(shown.steps, 'logged step')}"),
        ("Open loop over", f"{_seconds(shown.horizon * shown.timestep)}, {whole(shown.horizon, 'logged step')}"),
        ("Frames", f"{len(view.times):,}"),
        ("Simulator", view.run.candidates[-1].problem.simulator.name),
    ]


def _seconds(value: float) -> str:
    return f"{short(float(value))} s"
