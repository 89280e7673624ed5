"""A two-link arm, a log of it, and a folder with both and a config, for the tests of whole runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping=".3"/>
      <geom name="upper" type="capsule" size=".03" fromto="0 0 0 0 0 -.4" mass="1.2"/>
      <body name="lower" pos="0 0 -.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping=".1"/>
        <geom name="lower" type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass=".7"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="lift" joint="shoulder" gear="3"/><motor name="bend" joint="elbow"/></actuator>
</mujoco>"""
FRAME_SKIP = 2
DT = 0.02
TRUTH = {"upper_mass": 1.5, "lower_mass": 0.5}
PARAMETERS = {
    "upper_mass": {"field": "body_mass", "name": "upper", "bounds": [0.5, 3.0], "unit": "kg"},
    "lower_mass": {"field": "body_mass", "name": "lower", "bounds": [0.2, 2.0], "unit": "kg"},
}
CONFIG = {
    "model": "arm.xml", "data": "log.npz", "frame_skip": FRAME_SKIP, "samples": 20, "threads": 1,
    "parameters": PARAMETERS,
}  # fmt: skip

#: An adapter as a user would write it: MuJoCo behind three methods.
ADAPTER = f"""
import mujoco
import numpy as np


class Arm:
    num_states, num_controls, timestep = 4, 2, {DT}

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_path(PATH)
        self.data = mujoco.MjData(self.model)

    def set_parameters(self, values):
        for name, value in values.items():
            self.model.body(name.removesuffix("_mass")).mass = value
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def set_state(self, state):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = state[:2], state[2:]

    def step(self, control):
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data, {FRAME_SKIP})
        return np.concatenate([self.data.qpos, self.data.qvel])


def make(space):
    return Arm()
"""


def record(steps: int = 60, seed: int = 0, noise: float = 0.0, xml: str = XML, **truth: float) -> dict[str, np.ndarray]:
    """A log of the arm in two episodes; every transition is one of a cold solver."""
    model = mujoco.MjModel.from_xml_string(xml)
    for name, mass in (TRUTH | truth).items():
        model.body(name.removesuffix("_mass")).mass = mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    rng = np.random.default_rng(seed)
    state = np.array([0.3, -0.2, 0.0, 0.0])
    before, after, actions = [], [], rng.uniform(-1, 1, (steps, 2))
    for action in actions:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[:2], state[2:], action
        before.append(state)
        mujoco.mj_step(model, data, FRAME_SKIP)
        state = np.concatenate([data.qpos, data.qvel])
        after.append(state)
    terminals = np.zeros(steps, dtype=bool)
    terminals[[steps // 2 - 1, -1]] = True
    measured = np.array([*before, state]) + noise * rng.standard_normal((steps + 1, 4))
    return {
        "observations": measured[:-1], "next_observations": measured[1:] if noise else np.array(after),
        "actions": actions, "terminals": terminals,
    }  # fmt: skip


class Folder:
    """A folder with a model, a log and an adapter, in which configs are written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        (path / "arm.xml").write_text(XML)
        (path / "adapter.py").write_text(f"PATH = {str(path / 'arm.xml')!r}\n{ADAPTER}")
        self.log("log.npz")

    def log(self, name: str, **changes: np.ndarray | None) -> str:
        """Write a log with some arrays replaced, or left out where ``None``."""
        arrays = {**record(), **changes}
        np.savez(self.path / name, **{k: v for k, v in arrays.items() if v is not None})
        return name

    def config(self, text: str | None = None, **changes: Any) -> Path:
        """Write a config: a text, or the good one with some keys replaced, or left out where ``...``."""
        path = self.path / f"config-{sum(1 for _ in self.path.glob('config-*'))}.yaml"
        document = {k: v for k, v in {**CONFIG, **changes}.items() if v is not ...}
        path.write_text(yaml.safe_dump(document, sort_keys=False) if text is None else text, encoding="utf-8")
        return path
