"""Measured and published logs, read as their publishers say: nothing is wrong with them.

They lie in the folder that DROPO_DATA names, each where docs/check.md says; those that are not there are left out.
"""

from __future__ import annotations

import runpy
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
Named = tuple[str, dict[str, Any], Path]

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="pivot" axis="0 1 0" damping=".01"/>
      <geom type="sphere" size=".03" pos="0 0 -.5" mass=".5"/>
    </body>
  </worldbody>
  <actuator><motor joint="pivot"/></actuator>
</mujoco>"""

DOUBLE_PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="first" axis="0 1 0" damping=".001"/>
      <geom type="sphere" size=".03" pos="0 0 -.2" mass=".6"/>
      <body pos="0 0 -.2">
        <joint name="second" axis="0 1 0" damping=".001"/>
        <geom type="sphere" size=".03" pos="0 0 -.25" mass=".6"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="first"/><motor joint="second"/></actuator>
</mujoco>"""

CUBE = """
<mujoco>
  <option timestep="0.0017" cone="elliptic"/>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body pos="0 0 .1"><freejoint name="cube"/><geom type="box" size=".05 .05 .05" mass=".37"/></body>
  </worldbody>
</mujoco>"""

PUSH = """
<mujoco>
  <option timestep="0.003" cone="elliptic"/>
  <worldbody>
    <body name="object">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" axis="0 0 1"/>
      <geom type="box" size=".025 .0175 .01" mass=".1"/>
    </body>
  </worldbody>
</mujoco>"""


def measured_logs(data: Path) -> Iterator[Named]:
    """Yield the name, the config and the folder of each log that is there."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for makers in (_hoppers, _emps, _pendulums, _double_pendulums, _chirps, _panda, _cubes, _pushes):
            yield from makers(data, folder)


def _hoppers(data: Path, folder: Path) -> Iterator[Named]:
    for name in ("dropo_hopper", "dropo_hopper_noisy"):
        if (data / name).is_dir():
            yield name, {"sim": "hopper", "data": str(data / name)}, folder


def _emps(data: Path, folder: Path) -> Iterator[Named]:
    import yaml

    log = data / "emps" / "DATA_EMPS.mat"
    if log.is_file():
        config = yaml.safe_load((ROOT / "examples" / "emps" / "gap.yaml").read_text())
        config["data"]["path"] = str(log)
        yield "emps", config, ROOT / "examples" / "emps"


def _pendulums(data: Path, folder: Path) -> Iterator[Named]:
    (folder / "pendulum.xml").write_text(PENDULUM)
    for log in sorted((data / "simple_pendulum").glob("*.csv")):
        source = {"path": str(log), "time": "time", "observations": ["position"], "actions": ["torque"]}
        derived = {**source, "preprocess": {"dt": 0.02, "cutoff": 10, "max_gap": 0.2}}
        both = {**source, "observations": ["position", "velocity"],
                "preprocess": {"dt": 0.02, "velocities": ["velocity"], "max_gap": 0.2}}  # fmt: skip
        yield f"pendulum {log.stem}, derived", {"model": "pendulum.xml", "data": derived, "frame_skip": 10}, folder
        yield f"pendulum {log.stem}", {"model": "pendulum.xml", "data": both, "frame_skip": 10}, folder


def _double_pendulums(data: Path, folder: Path) -> Iterator[Named]:
    (folder / "double.xml").write_text(DOUBLE_PENDULUM)
    for log in sorted((data / "double_pendulum").glob("*.csv")):
        for kind in ("meas", "filt"):
            speeds = [f"vel_{kind}1", f"vel_{kind}2"]
            source = {
                "path": str(log), "time": "time", "observations": [f"pos_{kind}1", f"pos_{kind}2", *speeds],
                "actions": ["tau_meas1", "tau_meas2"],
                "preprocess": {"dt": 0.004, "velocities": speeds, "max_gap": 0.1},
            }  # fmt: skip
            yield f"double pendulum {log.stem} {kind}", {"model": "double.xml", "data": source, "frame_skip": 2}, folder


def _chirps(data: Path, folder: Path) -> Iterator[Named]:
    import yaml

    example = runpy.run_path(str(ROOT / "examples" / "joint_chirps" / "joint_chirps.py"))
    for robot in example["JOINTS"]:
        if (data / "joint_chirps" / robot / "traj_0.pt").is_file():
            (folder / robot).mkdir(exist_ok=True)
            config = example["write"](data / "joint_chirps", robot, folder / robot, published=True)
            yield f"chirps {robot}", yaml.safe_load(config.read_text()), folder / robot


def _panda(data: Path, folder: Path) -> Iterator[Named]:
    log = data / "panda_excitation"
    if not log.is_dir():
        return
    time, q, dq, torque = (
        np.loadtxt(log / f"exciting_traj_{name}.txt").reshape(-1, width)
        for name, width in (("time", 1), ("positions", 7), ("velocity", 7), ("torques", 7))
    )
    inside = 1.0
    for i in range(7):
        axis = "0 0 1" if i % 2 == 0 else "0 1 0"
        inside = (
            f'<body name="b{7 - i}" pos="0 0 .15"><joint name="j{7 - i}" axis="{axis}" armature=".1"/>'
            f'<geom type="capsule" size=".05" fromto="0 0 0 0 0 .1" mass="2"/>{"" if i == 0 else inside}</body>'
        )
    motors = "".join(f'<motor joint="j{i + 1}"/>' for i in range(7))
    (folder / "panda.xml").write_text(
        f'<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{inside}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    fresh = np.append(True, np.diff(time[:, 0]) > 0)
    arrays = {"time": time[fresh, 0], "q": q[fresh], "dq": dq[fresh], "torque": torque[fresh]}
    np.savez(folder / "panda.npz", **arrays)
    source = {"path": "panda.npz", "time": "time", "actions": "torque", "terminals": []}
    filtered = {"dt": 0.01, "cutoff": 20, "max_gap": 0.1}
    derived = {**source, "observations": "q", "preprocess": filtered}
    both = {**source, "observations": ["q", "dq"], "preprocess": {**filtered, "velocities": ["dq"]}}
    yield "panda, derived", {"model": "panda.xml", "data": derived, "frame_skip": 5}, folder
    yield "panda", {"model": "panda.xml", "data": both, "frame_skip": 5}, folder


def _cubes(data: Path, folder: Path) -> Iterator[Named]:
    import torch

    logs = sorted((data / "cube_tosses" / "tosses").glob("*.pt"))[:40]
    if not logs:
        return
    (folder / "cube.xml").write_text(CUBE)
    tosses = [np.asarray(torch.load(log, weights_only=False)).reshape(-1, 13) for log in logs]
    rows = np.concatenate(tosses)
    ends = np.concatenate([np.arange(len(t)) == len(t) - 1 for t in tosses])
    np.savez(folder / "cube.npz", observations=rows, terminals=ends)
    source = {"path": "cube.npz", "actions": [], "dt": 0.0068}
    columns = ["qpos[3:7]", "qpos[0:3]", "qvel[3:6]", "qvel[0:3]"]
    config = {"model": "cube.xml", "data": source, "observation": columns, "frame_skip": 4}
    yield "cube tosses", config, folder


def _pushes(data: Path, folder: Path) -> Iterator[Named]:
    (folder / "push.xml").write_text(PUSH)
    for condition in sorted((data / "planar_pushing").glob("*/*"))[:6]:
        logs = sorted(condition.glob("*.txt"))[:1]
        for log in logs:
            rows = np.loadtxt(log, delimiter=_delimiter(log), skiprows=0, ndmin=2)[1:]
            pose = np.hstack([1e-3 * rows[:, 1:3], rows[:, 3:4]])
            seen = np.any(rows[:, 1:4] != 0, axis=1)
            time, pose = rows[seen, 0], pose[seen]
            kept = np.append(True, np.diff(time) > 0)
            run = np.cumsum(np.append(0, np.diff(time[kept]) > 0.2))
            counts = np.bincount(run)
            long = counts[run] > 20
            name = f"push-{condition.parent.name}-{condition.name}"
            np.savez(folder / f"{name}.npz", time=time[kept][long], pose=pose[kept][long], run=run[long])
            source = {
                "path": f"{name}.npz", "time": "time", "observations": "pose", "actions": [], "episode": "run",
                "preprocess": {"dt": 0.03, "cutoff": 5, "trim": 0, "max_gap": 0.25},
            }  # fmt: skip
            yield name, {"model": "push.xml", "data": source, "frame_skip": 10}, folder


def _delimiter(path: Path) -> str | None:
    return "," if "," in path.read_text().splitlines()[0] else None
