"""Draw states of a model as one picture: ``render.py MODEL.mjb STATES.npy PICTURE.png COLUMNS``.

A program of its own, since a broken OpenGL driver ends the process that asks it for a picture. It needs no more than
MuJoCo, numpy and Pillow.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np
from PIL import Image

WIDTH, HEIGHT = 176, 220


def draw(model: mujoco.MjModel, states: np.ndarray, columns: int) -> np.ndarray:
    """Return pictures of states ``(F, nq + nv)`` side by side, ``columns`` a row, as one ``(h, w, 3)`` uint8."""
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, WIDTH)
    model.vis.global_.offheight = max(model.vis.global_.offheight, HEIGHT)
    data = mujoco.MjData(model)
    camera = _camera(model)
    frames = []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for state in states:
            data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            frames.append(renderer.render().copy())
    rows = [np.concatenate(frames[i : i + columns], 1) for i in range(0, len(frames), columns)]
    return np.concatenate(rows, 0)


def _camera(model: mujoco.MjModel) -> int | mujoco.MjvCamera:
    """The model's first camera, or one that follows the first body."""
    if model.ncam:
        return 0
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if model.nbody > 1:
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = 1
    return camera


def main(arguments: list[str]) -> None:
    """Read the model and the states, write the picture."""
    model, states, picture, columns = arguments
    drawn = draw(mujoco.MjModel.from_binary_path(model), np.load(states, allow_pickle=False), int(columns))
    Image.fromarray(drawn).quantize(128).save(picture, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
