"""Why today's MuJoCo does not reproduce the Hopper log published with the paper, and what reproduces it.

    python examples/authors_hopper.py path/to/hopper10000

The log was recorded with a MuJoCo that took a capsule of radius r and length h for a cylinder of length h + r. Masses
and moments of inertia of the links come out smaller than today's. Each logged transition is simulated with the
published masses, once with today's moments of inertia and once with the cylinder's, and compared with the logged one.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from dropo_sims.hopper import LINKS, SIM

import dropo_torch as dropo

#: kg, as published.
MASSES = {"torso": 3.534, "thigh": 3.927, "leg": 2.714, "foot": 5.089}


def cylinder(model: mujoco.MjModel, link: str) -> tuple[float, np.ndarray]:
    """Return mass and moments of inertia of a link's capsule as a cylinder of length h + r."""
    radius, half = model.geom(f"{link}_geom").size[:2]
    length = 2 * half + radius
    mass = 1000 * np.pi * radius**2 * length
    across = mass * (3 * radius**2 + length**2) / 12
    return mass, np.array([across, across, mass * radius**2 / 2])


def errors(model: mujoco.MjModel, log: dropo.Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest error of each transition's next state, and whether a geom touched another on the way."""
    data = mujoco.MjData(model)
    found, touched = np.empty(len(log.observations)), np.zeros(len(log.observations), dtype=bool)
    for i, (start, action, end) in enumerate(zip(log.observations, log.actions, log.next_observations, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[1:], data.qvel[:], data.ctrl[:] = start[:5], start[5:], action
        for _ in range(SIM.frame_skip):
            mujoco.mj_step(model, data)
            touched[i] |= data.ncon > 0
        found[i] = np.abs(np.concatenate([data.qpos[1:], data.qvel]) - end).max()
    return found, touched


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--transitions", type=int, default=4000)
    given = parser.parse_args(arguments)
    log = dropo.read_trajectories(given.data)
    log = log.select(slice(0, given.transitions))
    for kind in ("today's", "the cylinder's"):
        model = mujoco.MjModel.from_xml_path(str(SIM.model))
        for link in LINKS:
            body, (_, inertia) = model.body(link), cylinder(model, link)
            factor = inertia[0] / body.inertia[0]
            body.mass[0] = MASSES[link]
            if kind == "the cylinder's":
                body.mass[0], body.inertia[:] = cylinder(model, link)
                print(f"{link}: mass {body.mass[0]:.3f} kg, moment of inertia {factor:.3f} of today's")
        mujoco.mj_setConst(model, mujoco.MjData(model))
        found, touched = errors(model, log)
        print(f"with {kind} moments of inertia, median error of a next state:")
        for where, rows in (("without contact", ~touched), ("in contact", touched)):
            if rows.any():
                print(f"  {np.median(found[rows]):.1e} {where} ({rows.sum()} transitions)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
