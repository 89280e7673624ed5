"""What do the joints of a measured Panda arm have that its model lacks?

    python examples/panda/panda.py FOLDER

FOLDER holds the publishers' files (see docs/real-robots.md): exciting_traj_time.txt, _positions.txt, _velocity.txt and
_torques.txt. The arm is driven by torques and drifts in open loop, so the forces at its joints decide what is named.
The table has the torque that is unexplained in the last quarter, which the search has not seen; beside it, what the
friction law leaves that the publishers identified.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import dropo_torch as dropo
from dropo_torch.gap import add, find_gap, prepare
from dropo_torch.gap.forces.motion import highest_frequency, stretches
from dropo_torch.gap.forces.terms import needed
from dropo_torch.problem import Problem
from dropo_torch.report.gap_words import answer, change

HERE = Path(__file__).parent
FILES = {"q": "positions", "dq": "velocity", "tau": "torques"}
COUNT = 7
#: The friction law of Gaz et al. (IEEE Robotics and Automation Letters, 2019): size in N·m, steepness, shift.
SIZE = np.array([0.54615, 0.87224, 0.64068, 1.2794, 0.83904, 0.30301, 0.56489])
STEEPNESS = np.array([5.1181, 9.0657, 10.136, 5.5903, 8.3469, 17.133, 10.336])
SHIFT = np.array([0.039533, 0.025882, -0.04607, 0.036194, 0.026226, -0.021047, 0.0035526])


def publishers_friction(velocity: np.ndarray) -> np.ndarray:
    """Return the publishers' friction torque ``(N, 7)`` at velocities ``(N, 7)``."""
    at_rest = SIZE / (1 + np.exp(-STEEPNESS * SHIFT))
    return SIZE / (1 + np.exp(-STEEPNESS * (velocity + SHIFT))) - at_rest


def write(folder: Path, out: Path) -> Path:
    """Write the log as a table, without rows that repeat the one before, with model and config; return the config."""
    times = np.loadtxt(folder / "exciting_traj_time.txt")
    columns = [np.loadtxt(folder / f"exciting_traj_{name}.txt").reshape(-1, COUNT) for name in FILES.values()]
    fresh = np.append(True, np.abs(np.diff(columns[0], axis=0)).max(1) > 0)
    header = ",".join(["time", *(f"{kind}{joint + 1}" for kind in FILES for joint in range(COUNT))])
    rows = np.column_stack([times, *columns])[fresh]
    np.savetxt(out / "log.csv", rows, delimiter=",", header=header, comments="")
    for name in ("panda.xml", "panda.yaml"):
        (out / name).write_text((HERE / name).read_text())
    return out / "panda.yaml"


def make(folder: Path, out: Path) -> Problem:
    """Write everything, and return the problem."""
    return dropo.make_problem(dropo.load_config(write(folder, out)), general=True)


def published(problem: Problem) -> np.ndarray:
    """Return the torque of each joint that the publishers' friction leaves unexplained in unseen motion, ``(7,)``."""
    scene = prepare(problem)
    left = []
    for part in stretches(scene.held, scene.setting, highest_frequency(scene.train, scene.setting)):
        missing = part.force - needed(scene.setting.model, part) - publishers_friction(part.velocity)
        left.append(part.compared(missing))
    return np.sqrt((np.concatenate(left) ** 2).mean(0))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds the publishers' files")
    parser.add_argument("--out", type=Path, default=Path("out/panda"))
    given = parser.parse_args(arguments)
    for name in ("time", *FILES.values()):
        if not (path := given.folder / f"exciting_traj_{name}.txt").is_file():
            parser.error(f"{path}: no such file; expected the folder of the publishers' exciting trajectory")
    given.out.mkdir(parents=True, exist_ok=True)
    problem = make(given.folder, given.out)
    print("looking for what the model lacks", file=sys.stderr, flush=True)
    gap = find_gap(problem)
    gap = replace(gap, notes=(*gap.notes, *add(problem, gap, given.out)))
    headline, items = answer(gap)
    print(headline, *(f"  - {item}" for item in items), change(gap), *gap.notes, sep="\n")
    print(f"\nunexplained torque in the unseen quarter, N·m\n{'joint':<8}{'as given':>10}{'published':>11}{'found':>9}")
    left = np.array([(f.before, theirs, f.after) for f, theirs in zip(gap.forces, published(problem), strict=True)])
    joints = [*(force.joint for force in gap.forces), "all"]
    for joint, row in zip(joints, [*left, np.sqrt((left**2).mean(0))], strict=True):
        print(f"{joint:<8}{row[0]:>10.3f}{row[1]:>11.3f}{row[2]:>9.3f}")


if __name__ == "__main__":
    main()
