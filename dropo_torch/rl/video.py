"""An episode to look at: states along it, and pictures of them where OpenGL can draw without a display."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path

import mujoco
import numpy as np
import torch

from dropo_torch.rl.env import RandomizedEnv
from dropo_torch.rl.policy import Policy
from dropo_torch.support.offscreen import REMEDY, draw_offscreen

#: Pictures of a row.
COLUMNS = 8
#: Seconds between the pictures of the second row.
INTERVAL = 0.08


@torch.no_grad()
def record(policy: Policy, env: RandomizedEnv) -> np.ndarray:
    """Return the states ``(T + 1, nq + nv)`` of one episode of the first environment, acted without noise."""
    now = env.reset()
    states = [env.states[0]]
    while True:
        now.set("action", policy(now.get("observation")))
        after = env.step(now)
        states.append(env.states[0])
        if bool(after["next", "done"][0]):
            return torch.stack(states).cpu().numpy()
        now = after["next"].exclude("reward")


def chosen_frames(count: int, timestep: float) -> list[int]:
    """Return which of ``count`` states are shown: a row over the whole episode, a row of a stretch in its middle."""
    whole = np.linspace(0, count - 1, COLUMNS).round().astype(int)
    stride = max(1, round(INTERVAL / timestep))
    start = max(0, (count - stride * COLUMNS) // 2)
    stretch = np.minimum(start + stride * np.arange(COLUMNS), count - 1)
    return [*whole.tolist(), *stretch.tolist()]


def draw(model: mujoco.MjModel, states: np.ndarray) -> tuple[bytes | None, str]:
    """Return a PNG of states ``(F, nq + nv)``, :data:`COLUMNS` a row, and a note where there is none.

    What draws is as :func:`~dropo_torch.support.offscreen.draw_offscreen` has it.
    """
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / name) for name in ("model.mjb", "states.npy", "strip.png")]
        mujoco.mj_saveModel(copy.copy(model), paths[0])
        np.save(paths[1], states)
        program = Path(__file__).with_name("render.py")
        if draw_offscreen(program, [*paths, str(COLUMNS)]):
            return Path(paths[2]).read_bytes(), ""
    return None, f"No pictures: {REMEDY}"
