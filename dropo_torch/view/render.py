"""Draw a video of robots: ``render.py SCENE.npz VIDEO.mp4``; prints how many frames of how many are done.

A program of its own, since a broken OpenGL driver ends the process that asks it for a picture. It needs no more than
MuJoCo, numpy, Pillow, imageio and PyAV.
"""

from __future__ import annotations

import sys
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np
from PIL import Image, ImageDraw

WIDTH, HEIGHT = 640, 480
#: Colors of the logged robot, of what is fixed, of lines on the floor, and of the wall behind all.
GHOST, FIXED = (0.12, 0.16, 0.20, 0.45), (0.93, 0.94, 0.95, 1.0)
LINE, WALL = (0.72, 0.76, 0.80, 1.0), (1.0, 1.0, 1.0, 1.0)
#: Distance of the wall from what is looked at, relative to the camera's, and its width.
FAR, WIDE = 8.0, 200.0
#: How much larger the logged robot is drawn, so that surfaces at one place do not flicker.
LARGER = 1.02
FLAGS = ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE")


class Pane:
    """One model with its renderer: the simulated robot, and the logged one over it."""

    def __init__(self, model: mujoco.MjModel, given: dict[str, Any], number: int) -> None:
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, WIDTH)
        model.vis.global_.offheight = max(model.vis.global_.offheight, HEIGHT)
        model.vis.quality.offsamples = 2
        model.light_active[:], model.vis.headlight.active = 0, 1  # of the same brightness in every model
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
        model.vis.map.zfar = 4 * FAR * self._distance(model, given) / model.stat.extent
        self._model, self._given = model, given
        self._qpos, self._color = given[f"qpos{number}"], given["colors"][number]
        self._simulated, self._logged = mujoco.MjData(model), mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        self._options = mujoco.MjvOption()
        if given["hidden"]:
            self._options.geomgroup[:] = 1

    def picture(self, frame: int) -> np.ndarray:
        """Return the picture of a frame, ``(HEIGHT, WIDTH, 3)`` uint8; where the simulation diverged, without it."""
        given, scene = self._given, self._renderer.scene
        self._place(self._logged, given["logged"][frame], frame)
        finite = bool(np.isfinite(self._qpos[frame]).all())
        shown = ((self._simulated, self._qpos[frame], self._color),) if finite else ()
        self._renderer.update_scene(self._logged, self._camera(frame), self._options)
        scene.ngeom, fixed = 0, int(mujoco.mjtCatBit.mjCAT_STATIC)
        self._add_wall(scene, frame)
        first = scene.ngeom
        mujoco.mjv_addGeoms(self._model, self._logged, self._options, mujoco.MjvPerturb(), fixed, scene)
        _paint(scene, first, FIXED)
        for start, end in given["lines"]:
            _connect(scene, mujoco.mjtGeom.mjGEOM_LINE, start, end, 1.0, LINE)
        for data, qpos, color in (*shown, (self._logged, given["logged"][frame], GHOST)):
            self._place(data, qpos, frame)
            self._add(scene, data, color)
        for flag in FLAGS:
            scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        return self._renderer.render().copy()

    def _add(self, scene: mujoco.MjvScene, data: mujoco.MjData, color: tuple[float, ...]) -> None:
        """Add a robot in one color; its links as capsules, where it has no geoms."""
        first, moving = scene.ngeom, int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(self._model, data, self._options, mujoco.MjvPerturb(), moving, scene)
        for body, start, end, radius in self._given["rods"]:
            begin, finish = np.stack([start, end]) @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
            _connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, begin, finish, radius, color)
        _paint(scene, first, color)

    def _place(self, data: mujoco.MjData, qpos: np.ndarray, frame: int) -> None:
        data.qpos[:] = qpos
        data.mocap_pos[:], data.mocap_quat[:] = self._given["mocap_pos"][frame], self._given["mocap_quat"][frame]
        mujoco.mj_forward(self._model, data)

    def _camera(self, frame: int) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.lookat[:] = self._given["centers"][frame]
        camera.azimuth, camera.elevation = self._given["direction"]
        camera.distance = self._distance(self._model, self._given)
        return camera

    @staticmethod
    def _distance(model: mujoco.MjModel, given: dict[str, Any]) -> float:
        """Distance of the camera from what it looks at."""
        return float(given["size"]) / float(np.tan(np.radians(model.vis.global_.fovy) / 2))

    def _add_wall(self, scene: mujoco.MjvScene, frame: int) -> None:
        """Add a white wall far behind what is looked at: what is translucent would be black before nothing."""
        azimuth, elevation = np.radians(self._given["direction"])
        ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        distance = self._distance(self._model, self._given)
        wide, turn, frame_of = WIDE * distance, np.empty(4), np.empty(9)
        mujoco.mju_quatZ2Vec(turn, ahead)
        mujoco.mju_quat2Mat(frame_of, turn)
        place = self._given["centers"][frame] + FAR * distance * ahead
        geom, size = scene.geoms[scene.ngeom], np.array([wide, wide, 0.01 * distance])
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_BOX, size, place, frame_of, np.array(WALL, dtype=np.float32))
        geom.emission, geom.specular = 1.0, 0.0
        scene.ngeom += 1


def _connect(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, start: np.ndarray, end: np.ndarray, width: float,
    color: tuple[float, ...],
) -> None:  # fmt: skip
    """Add a line or a capsule from one point to another, as long as there is room."""
    if scene.ngeom < scene.maxgeom:
        geom, zero = scene.geoms[scene.ngeom], np.zeros(3)
        mujoco.mjv_initGeom(geom, kind, zero, zero, np.zeros(9), np.array(color, dtype=np.float32))
        mujoco.mjv_connector(geom, kind, width, start, end)
        scene.ngeom += 1


def _paint(scene: mujoco.MjvScene, first: int, color: tuple[float, ...]) -> None:
    """Give the geoms from one on a color, and the logged robot's a little more size."""
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:], geom.matid = color, -1
        is_floor = geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        geom.emission, geom.specular, geom.reflectance = 0.9 if is_floor else 0.15, 0.1, 0.0
        if color is GHOST and geom.type != mujoco.mjtGeom.mjGEOM_MESH:
            geom.size[:] *= LARGER


def labeled(picture: np.ndarray, text: str) -> np.ndarray:
    """Return a picture with a text in its upper left corner."""
    image = Image.fromarray(picture)
    drawing = ImageDraw.Draw(image)
    left, top, right, bottom = drawing.textbbox((14, 10), text, font_size=20)
    drawing.rectangle((left - 6, top - 5, right + 6, bottom + 5), fill=(255, 255, 255))
    drawing.text((14, 10), text, fill=(31, 41, 51), font_size=20)
    return np.asarray(image)


def main(arguments: list[str]) -> None:
    """Read what is drawn, write the video."""
    source, video = arguments
    with np.load(source, allow_pickle=False) as file:
        given: dict[str, Any] = dict(file)
    names, texts = given["names"].tolist(), given["texts"].tolist()
    given["colors"] = [tuple(color) for color in given["colors"]]
    given["rods"] = [(int(s[0]), s[1:4], s[4:7], float(s[7])) for s in given["rods"]]
    models = [mujoco.MjModel.from_binary_path(f"{source}.{i}.mjb") for i in range(len(names))]
    panes = [Pane(model, given, i) for i, model in enumerate(models)]
    with iio.imopen(video, "w", plugin="pyav") as out:
        out.init_video_stream("libx264", fps=int(given["rate"]))
        for frame, text in enumerate(texts):
            pictures = [labeled(p.picture(frame), f"{n}   {text}") for p, n in zip(panes, names, strict=True)]
            out.write_frame(np.concatenate(pictures, 1))
            print(frame + 1, len(texts), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
