"""What does a model need to predict where a tossed cube goes?

    python examples/tosses/tosses.py FOLDER

FOLDER holds the publishers' tosses of an acrylic cube onto a board, 0.pt to 549.pt (see docs/real-robots.md). Friction,
softness of contacts, moments of inertia and height of the board are fitted to a hundred of them; the table has the
errors of predictions of the second half, each from its first state to its end. Then the friction that suits impacts is
compared with the one that suits sliding.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import dropo_torch as dropo
from dropo_torch.problem import Problem

HERE = Path(__file__).parent
#: Tosses to which the model is fitted, and those that are predicted.
FITTED, UNSEEN = range(100), range(275, 550)
#: Of the friction alone, as the publishers' papers have it.
PUBLISHED = 0.18
HALF_WIDTH = 0.05
#: Logged rows of a window in which the cube first touches the board, or slides on it.
WINDOW = 15
#: m from the board within which a corner touches it, and m/s above which the cube slides.
TOUCHES, SLIDES = 2e-3, 0.1
FRICTIONS = np.linspace(0.08, 0.32, 49)


def read(folder: Path, number: int) -> np.ndarray:
    """Return a toss: position, quaternion, velocity and, in the cube's frame, angular velocity, ``(T, 13)``."""
    rows = torch.load(folder / f"{number}.pt", weights_only=True).double().numpy()
    return np.hstack([rows[:, 4:7], rows[:, :4], rows[:, 10:13], rows[:, 7:10]])


def make(tosses: Sequence[np.ndarray], out: Path) -> Problem:
    """Write tosses as a log, with model and config, and return the problem."""
    ends = np.concatenate([np.arange(len(toss)) == len(toss) - 1 for toss in tosses])
    np.savez(out / "tosses.npz", observations=np.concatenate(tosses), terminals=ends)
    for name in ("cube.xml", "cube.yaml"):
        (out / name).write_text((HERE / name).read_text())
    return dropo.make_problem(dropo.load_config(out / "cube.yaml"))


def guesses(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters of the model as given, and with the friction as published."""
    as_given = np.nan_to_num(problem.space.nominal, nan=1.0)  # the factor of inertia is no number of the model
    return as_given, np.where(np.array(problem.space.names) == "friction", PUBLISHED, as_given)


def predict(problem: Problem, starts: np.ndarray, steps: int, values: np.ndarray) -> np.ndarray:
    """Return positions and quaternions after each of some steps, for each parameter vector, ``(T, K, steps, 7)``."""
    nothing = torch.zeros(len(starts), steps, 0, dtype=torch.float64)
    states = problem.simulator.rollout(torch.from_numpy(starts), nothing, torch.from_numpy(np.atleast_2d(values)))
    return states.numpy()[..., :7]


def errors(problem: Problem, tosses: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
    """Return the mean error over each toss, of position in mm and of rotation in degrees, ``(T, 2)``."""
    poses = predict(problem, np.array([toss[0] for toss in tosses]), max(map(len, tosses)) - 1, values)[:, 0]
    found = []
    for toss, pose in zip(tosses, poses, strict=True):
        end = pose[: len(toss) - 1]
        away = np.linalg.norm(end[:, :3] - toss[1:, :3], axis=1)
        turned = (rotation(end).inv() * rotation(toss[1:])).magnitude()
        found.append((1e3 * away.mean(), np.degrees(turned).mean()))
    return np.array(found)


def rotation(poses: np.ndarray) -> Rotation:
    return Rotation.from_quat(poses[:, 3:7], scalar_first=True)


def corners(toss: np.ndarray) -> np.ndarray:
    """Return the heights of the corners above the board, lowest first, ``(T, 8)``."""
    signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
    turned = np.stack([rotation(toss).apply(HALF_WIDTH * corner)[:, 2] for corner in signs], 1)
    return np.sort(toss[:, 2:3] + turned, axis=1)


def windows(tosses: Sequence[np.ndarray]) -> dict[str, list[tuple[int, int]]]:
    """Return toss and first row of the windows with a first touch, and of those in which the cube slides on a face."""
    found: dict[str, list[tuple[int, int]]] = {"impacts": [], "sliding": []}
    for number, toss in enumerate(tosses):
        heights = corners(toss)
        touching = np.flatnonzero(heights[:, 0] < TOUCHES)
        if len(touching) and 2 <= touching[0] < len(toss) - WINDOW:
            found["impacts"].append((number, int(touching[0]) - 2))
        flat = (heights[:, 3] < TOUCHES) & (np.linalg.norm(toss[:, 7:9], axis=1) > SLIDES)
        row = 0
        while row + WINDOW < len(toss):
            slides = flat[row : row + WINDOW + 1].all()
            found["sliding"] += [(number, row)] if slides else []
            row += WINDOW if slides else 1
    return found


def best_friction(problem: Problem, tosses: Sequence[np.ndarray], where: Sequence[tuple[int, int]], values: np.ndarray,
                  draws: int = 500) -> np.ndarray:  # fmt: skip
    """Return the friction that predicts the positions at the ends of windows best, and the ends of its 90 % interval.

    The interval is of the bootstrap over windows.
    """
    tried = np.repeat(values[None], len(FRICTIONS), axis=0)
    tried[:, problem.space.names.index("friction")] = FRICTIONS
    starts, ends = (np.array([tosses[n][row + later] for n, row in where]) for later in (0, WINDOW))
    away = predict(problem, starts, WINDOW, tried)[:, :, -1, :3] - ends[:, None, :3]
    cost = np.minimum(np.linalg.norm(away, axis=-1), 0.02) ** 2
    chosen = np.random.default_rng(0).integers(len(where), size=(draws, len(where)))
    low, high = np.quantile(FRICTIONS[cost[chosen].sum(1).argmin(1)], (0.05, 0.95))
    return np.array([FRICTIONS[cost.sum(0).argmin()], low, high])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds 0.pt to 549.pt")
    parser.add_argument("--out", type=Path, default=Path("out/tosses"))
    parser.add_argument("--fitted", type=int, default=len(FITTED), help="tosses that are fitted, the first ones")
    parser.add_argument("--unseen", type=int, default=len(UNSEEN), help="tosses that are predicted, of the second half")
    given = parser.parse_args(arguments)
    fitted, unseen = range(given.fitted), range(UNSEEN.start, UNSEEN.start + given.unseen)
    for number in (*fitted, *unseen):
        if not (path := given.folder / f"{number}.pt").is_file():
            parser.error(f"{path}: no such file; expected the folder of the publishers' tosses, 0.pt to 549.pt")
    given.out.mkdir(parents=True, exist_ok=True)
    problem = make([read(given.folder, n) for n in fitted], given.out)
    print("fitting", file=sys.stderr, flush=True)
    fit = dropo.fit_problem(problem)
    for name, entry in fit.distribution.summary().items():
        print(f"{name:<10}{entry['mean']:>10.4g} {entry['unit']}")
    tosses = [read(given.folder, n) for n in unseen]
    as_given, published = guesses(problem)
    best = fit.distribution.center
    print(f"\nerrors over {len(tosses)} unseen tosses   mm, mean and median   degrees, mean and median")
    rows = {"model as given": as_given, "friction as published": published, "as fitted": best}
    for label, values in rows.items():
        found = errors(problem, tosses, values)
        (a, b), (c, d) = found.mean(0), np.median(found, axis=0)
        print(f"{label:<28}{a:>14.1f}{c:>8.1f}{b:>17.1f}{d:>8.1f}")
    print("\nfriction that predicts best, and 90 % interval")
    for kind, where in windows(tosses).items():
        at, low, high = best_friction(problem, tosses, where, best)
        print(f"{kind:<10}{at:.3f} ({low:.3f} to {high:.3f}), {len(where)} windows")


if __name__ == "__main__":
    main()
