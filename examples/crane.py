"""A crane whose model lacks two things, and a log of it for ``dropo gap``.

python examples/crane.py --out out/crane             # writes crane.xml, log.npz, the same as log.csv, and crane.yaml
dropo gap out/crane/crane.yaml --out out/crane/gap
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

MODEL = """
<mujoco>
  <option integrator="RK4" timestep="0.005"/>
  <worldbody>
    <body name="trolley">
      <joint name="rail" type="slide" axis="1 0 0" damping="4"/>
      <geom type="box" size=".2 .1 .05" mass="6"/>
      <body name="load">
        <joint name="rope" type="hinge" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.8" mass="2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="rail" gear="40"/></actuator>
</mujoco>"""
CONFIG = """
model: crane.xml
data: log.npz
frame_skip: 4
parameters:
  load_mass: {field: body_mass, name: load, bounds: [1.0, 4.0], unit: kg, scale_inertia: true}
"""
#: What the real crane has besides: friction of the rail in N·s/m, and physics steps by which a command is late.
FRICTION, LATE = 6.0, 3
SKIP, STEPS, EPISODES = 4, 150, 4
NOISE = np.array([1e-4, 1e-4, 1e-3, 1e-3])


def record(seed: int = 0) -> dict[str, np.ndarray]:
    """Return a log of the real crane, with noise on every measurement."""
    real = mujoco.MjModel.from_xml_string(MODEL)
    real.dof_damping[0] += FRICTION
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(STEPS)
    parts: dict[str, list[np.ndarray]] = {
        name: [] for name in ("observations", "next_observations", "actions", "terminals")
    }
    for _ in range(EPISODES):
        data = mujoco.MjData(real)
        data.qpos[:], data.qvel[:] = rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.5, 0.5, 2)
        waves = [rng.uniform(0.1, 0.4) * np.sin(f * time + rng.uniform(0, 6)) for f in (2.0, 5.0, 9.0, 13.0)]
        commands = np.sum(waves, axis=0)
        acting = np.concatenate([np.full(LATE, commands[0]), np.repeat(commands, SKIP)])
        path = [np.concatenate([data.qpos, data.qvel])]
        for step in range(STEPS):
            for command in acting[SKIP * step : SKIP * (step + 1)]:
                data.ctrl[:] = command
                mujoco.mj_step(real, data)
            path.append(np.concatenate([data.qpos, data.qvel]))
        measured = np.array(path) + NOISE * rng.standard_normal((STEPS + 1, 4))
        parts["observations"].append(measured[:-1])
        parts["next_observations"].append(measured[1:])
        parts["actions"].append(commands[:, None])
        parts["terminals"].append(np.arange(STEPS) == STEPS - 1)
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}


def write_csv(path: Path, log: dict[str, np.ndarray]) -> None:
    """Write a log as a recorder would: a row for every instant, episodes ten seconds apart."""
    rows = []
    for episode, end in enumerate(np.flatnonzero(log["terminals"])):
        own = slice(end + 1 - STEPS, end + 1)
        states = np.concatenate([log["observations"][own], log["next_observations"][end : end + 1]])
        commands = np.append(log["actions"][own], log["actions"][end])
        rows.append(np.column_stack([10 * episode + 0.02 * np.arange(STEPS + 1), states, commands]))
    header = "time,rail_position,rope_angle,rail_velocity,rope_velocity,drive_cmd"
    np.savetxt(path, np.concatenate(rows), "%.8g", delimiter=",", header=header, comments="")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/crane"), help="folder of model, log and config")
    out = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    (out / "crane.xml").write_text(MODEL)
    (out / "crane.yaml").write_text(CONFIG)
    log = record()
    np.savez(out / "log.npz", **log)
    write_csv(out / "log.csv", log)
    print(f"{out / 'crane.yaml'}")


if __name__ == "__main__":
    main()
