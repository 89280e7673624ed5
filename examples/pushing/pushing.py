"""Where does a robot's push leave a rectangle, and how sure can that be?

    python examples/pushing/pushing.py FOLDER

FOLDER holds the measured pushes (see docs/real-robots.md): bigrect_3pts and bigrect_ridge, each with three conditions.
Friction of the fingers and of turning, softness and size of the contact, and how late the camera is are fitted to two
conditions; the table has the errors of predictions of the third, each push from its first pose to its end. Then last
poses are predicted as distributions: by the parameters with an error term, with ε by several rules, and drawn from all
of their box. Only the ε said to be known afterwards is chosen by the condition that it predicts.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from scipy.signal import medfilt
from scipy.stats.qmc import LatinHypercube

sys.path.insert(0, str(Path(__file__).parent))

from error_term import SAMPLES, ErrorTerm, energy_scores, error_term, holds, point

import dropo_torch as dropo
from dropo_torch.problem import Problem

HERE = Path(__file__).parent
SUPPORTS, CONDITIONS = ("bigrect_3pts", "bigrect_ridge"), ("20_neg30_90", "30_50_60", "60_20_150")
#: s between two pushes of a file, at least; before the object is seen, and without it within a push, at most.
PAUSE, SOON, LOST = 0.5, 0.2, 0.8
#: m and rad from the running median at which a pose is no measurement, and samples of that median.
OUTLIERS, MEDIAN = (3e-3, 3e-3, 0.1), 7
#: s of a push that a window has, and before which it waits, so that windows of equal length end at several times.
WINDOW, WAITS = 3.15, (0.0, 1.05, 2.1)
#: s between the commands of a prediction.
STEP = 0.03
#: ε that suits the errors as they turned out, in m, m and rad; m up to which a rectangle has not moved.
HINDSIGHT, STILL = (1e-3, 1e-3, 0.017), 1e-4
#: Draws from the box of parameters.
DRAWS = 40


@dataclass(frozen=True)
class Push:
    """One push: times ``(T,)``, poses of the object with NaN where it was not seen and of the hand, ``(T, 3)`` each."""

    condition: str
    repeat: str
    number: int
    time: np.ndarray
    object: np.ndarray
    hand: np.ndarray

    @property
    def group(self) -> tuple[str, int]:
        """What repeats of a push have in common: the support with the condition, and the number in its file."""
        return f"{self.repeat.split()[0]} {self.condition}", self.number

    @property
    def seen(self) -> np.ndarray:
        """Where the camera saw the object, ``(T,)`` bool."""
        return np.isfinite(self.object).all(1)


def read(folder: Path, condition: str) -> Iterator[Push]:
    """Yield the pushes of a condition that the camera saw from the start, without a long loss."""
    for support in SUPPORTS:
        for path in sorted(folder.glob(f"{support}/{support}_{condition}/*.txt")):
            rows = np.loadtxt(path, delimiter=",")[1:]
            breaks = np.flatnonzero(np.diff(rows[:, 0]) > PAUSE) + 1
            rests = None
            for number, part in enumerate(np.split(rows, breaks)):
                push = _push(condition, f"{support} {path.stem}", number, part)
                if rests is not None and not push.seen[0]:  # nothing moved it since the push before
                    turn = 2 * np.pi * np.round((push.object[push.seen][0, 2] - rests[2]) / (2 * np.pi))
                    push.object[0] = rests + [0, 0, turn]
                when = push.time[push.seen]
                rests = push.object[push.seen][-1]
                if len(when) > MEDIAN and when[0] < SOON and np.diff(when).max() < LOST:
                    yield push


def _push(condition: str, repeat: str, number: int, rows: np.ndarray) -> Push:
    """A push from the file's rows, without outliers; in meters, angles without jumps."""
    time, scale = rows[:, 0] - rows[0, 0], np.array([1e-3, 1e-3, 1.0])
    pose, hand = rows[:, 1:4] * scale, rows[:, 4:7] * scale
    seen = (rows[:, 1:4] != 0).any(1)
    pose[seen, 2], hand[:, 2] = np.unwrap(pose[seen, 2]), np.unwrap(hand[:, 2])
    for column, far in enumerate(OUTLIERS):
        filled = np.interp(time, time[seen], pose[seen, column])
        seen = seen & (np.abs(filled - medfilt(filled, MEDIAN)) < far)
    pose[~seen] = np.nan
    return Push(condition, repeat, number, time, pose, hand)


def make(pushes: Sequence[Push], out: Path, waits: Sequence[float], length: float, **changes: object) -> Problem:
    """Write pushes as a log, each after some waits, with model and config; return the problem.

    Args:
        pushes: the pushes.
        out: folder to write into.
        waits: seconds that the hand waits before a push, by one episode each.
        length: seconds of an episode.
        changes: entries of the config that differ.
    """
    rows = []
    for number, (push, wait) in enumerate((p, w) for p in pushes for w in waits):
        begin = int(np.flatnonzero(push.seen)[0])
        at, path = push.time[begin:] - push.time[begin] + wait, np.hstack([push.object, push.hand])[begin:]
        waiting = np.arange(0, wait, STEP)
        at, path = np.append(waiting, at), np.vstack([np.repeat(path[:1], len(waiting), 0), path])
        rows += [[t, number, *pose] for t, pose in zip(at, path, strict=True) if t <= length + LOST]
    with (out / "pushes.csv").open("w", newline="") as stream:
        names = ("x", "y", "yaw", "hand_x", "hand_y", "hand_yaw")
        csv.writer(stream).writerows([("time", "push", *names), *rows])
    for name in ("rectangle.xml", "rectangle.yaml"):
        (out / name).write_text((HERE / name).read_text())
    return dropo.make_problem(dropo.load_config(out / "rectangle.yaml", changes))


def predict(problem: Problem, pushes: Sequence[Push], values: np.ndarray) -> list[np.ndarray]:
    """Return the poses that the camera would have shown at the times of each push, ``(K, T, 3)`` for K vectors."""
    found = []
    for push in pushes:
        begin = int(np.flatnonzero(push.seen)[0])
        at = push.time[begin:] - push.time[begin]
        count = int(at[-1] / STEP)
        targets = np.stack([np.interp(STEP * np.arange(1, count + 1), at, h) for h in push.hand[begin:].T], 1)
        start = np.concatenate([push.object[begin, :2], [0.0], push.object[begin, 2:], push.hand[begin], np.zeros(7)])
        states = problem.simulator.rollout(
            torch.from_numpy(start[None]), torch.from_numpy(np.vstack([targets[:1], targets])[None]),
            torch.from_numpy(np.atleast_2d(values)),
        )[0].numpy()  # fmt: skip
        path = np.concatenate([np.repeat(start[None, None], len(states), 0), states], 1)[..., [0, 1, 3]]
        grid = STEP * np.arange(path.shape[1])
        shown = np.array([[np.interp(at, grid, p[:, c]) for c in range(3)] for p in path]).swapaxes(1, 2)
        found.append(np.concatenate([np.full((len(shown), begin, 3), np.nan), shown], 1))
    return found


def errors(pushes: Sequence[Push], poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return root mean square errors over each push, of the position in mm and of the angle in degrees, ``(P, 2)``."""
    found = []
    for push, pose in zip(pushes, poses, strict=True):
        off = (pose - push.object)[push.seen]
        found.append((1e3 * np.sqrt((off[:, :2] ** 2).sum(1).mean()), np.degrees(np.sqrt((off[:, 2] ** 2).mean()))))
    return np.array(found)


def last_errors(pushes: Sequence[Push], poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return errors of the last poses seen, along the hand's heading, across it and of the angle, ``(K, P, 3)``."""
    found = []
    for push, pose in zip(pushes, poses, strict=True):
        end, heading = int(np.flatnonzero(push.seen)[-1]), push.hand[-1, 2]
        off = push.object[end] - pose[:, end]
        along = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        found.append(np.hstack([off[:, :2] @ along.T, off[:, 2:]]))
    return np.stack(found, 1)


def distances(poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return how far predictions go, in m, ``(P,)``, each by the first of its vectors."""
    return np.array([np.nansum(np.linalg.norm(np.diff(pose[0, :, :2], axis=0), axis=1)) for pose in poses])


def sensor_noise(pushes: Sequence[Push], poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard deviation of poses of a rectangle that no prediction has moved yet, ``(3,)``."""
    still = []
    for push, pose in zip(pushes, poses, strict=True):
        begin = int(np.flatnonzero(push.seen)[0])
        moved = np.linalg.norm(pose[0, :, :2] - pose[0, begin, :2], axis=1)
        rows = push.object[push.seen & (moved < STILL)]
        still.append(rows - rows.mean(0))
    every = np.concatenate(still)
    return np.asarray(np.sqrt((every**2).sum(0) / (len(every) - len(still))))


def fit(pushes: Sequence[Push], out: Path) -> tuple[Problem, np.ndarray]:
    """Return the problem of some pushes and the parameters that fit them."""
    print(f"fitting {len(pushes)} pushes", file=sys.stderr, flush=True)
    problem = make(pushes, out, WAITS, WINDOW)
    return problem, dropo.fit_problem(problem).distribution.center


def chosen(pushes: Sequence[Push], repeats: int) -> list[Push]:
    """Return the first repeats of each push, of each support and condition."""
    kept: Counter[tuple[str, int]] = Counter()
    found = []
    for push in pushes:
        kept[push.group] += 1
        found += [push] if kept[push.group] <= repeats else []
    return found


@dataclass
class Tally:
    """How a kind of prediction fared: energy scores ``(BATCHES,)``, and whether its 90 % region held, by push."""

    scores: list[np.ndarray] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)

    def row(self, label: str) -> str:
        """Return the row of the table."""
        batches = np.mean(self.scores, axis=0)
        error = batches.std(ddof=1) / np.sqrt(len(batches))
        inside = f"{sum(self.held)} of {len(self.held)}" if self.held else ""
        return f"{label:<46}{batches.mean():>8.3f} ± {error:.3f}{inside:>14}"


def error_terms(seen: Sequence[Push], poses: Sequence[np.ndarray]) -> dict[str, ErrorTerm]:
    """Return what may be added to the fitted parameters' predictions, from pushes that were fitted."""
    off = last_errors(seen, poses)[0]
    return {
        "with an error term": error_term(off, [p.group for p in seen], distances(poses)),
        "with ε, the likeliest for what was fitted": point(np.sqrt((off**2).mean(0))),
        "with ε of the camera's noise": point(sensor_noise(seen, poses)),
        "with ε of 1 mm and 1°, known afterwards": point(HINDSIGHT),
    }


def regions(
    problem: Problem, seen: Sequence[Push], unseen: Sequence[Push], best: np.ndarray, tallies: dict[str, Tally]
) -> None:
    """Add to tallies how predictions of the last poses of unseen pushes fare."""
    rng = np.random.default_rng(0)
    shares = LatinHypercube(len(best), rng=0).random(DRAWS)
    boxes = problem.space.low + shares * (problem.space.high - problem.space.low)
    poses = predict(problem, unseen, np.vstack([best, boxes]))
    off, far = last_errors(unseen, poses), distances(poses)
    terms = error_terms(seen, predict(problem, seen, best))
    for label, term in terms.items():
        draws, tally = term.draw(rng), tallies.setdefault(label, Tally())
        for own, distance in zip(off[0], far, strict=True):
            scales = term.scales(distance)
            tally.scores.append(energy_scores(draws * scales, own))
            tally.held.append(holds(draws, own / scales))
    likely = terms["with ε, the likeliest for what was fitted"]
    epsilon, which = likely.draw(rng) * likely.scale, rng.integers(len(boxes), size=SAMPLES)
    udr = tallies.setdefault("drawn from all of their box (UDR), with that ε", Tally())
    for own, others in zip(off[0], off[1:].swapaxes(0, 1), strict=True):
        udr.scores.append(energy_scores(own - others[which] + epsilon, own))


def _row(label: str, found: np.ndarray) -> str:
    millimeters, degrees = np.sqrt((found**2).mean(0))
    return f"{f'{label}, {len(found)} pushes':<46}{millimeters:>8.2f}{degrees:>9.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds bigrect_3pts and bigrect_ridge")
    parser.add_argument("--out", type=Path, default=Path("out/pushing"))
    parser.add_argument("--repeats", type=int, default=9, help="repeats of each push that are fitted, at most")
    parser.add_argument(
        "--conditions", nargs="+", choices=CONDITIONS, default=CONDITIONS, help="those left out in turn"
    )
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    every = {c: list(read(given.folder, c)) for c in CONDITIONS}
    if missing := [c for c, pushes in every.items() if not pushes]:
        parser.error(f"{given.folder}: no pushes of {missing[0]}; expected the folder that holds bigrect_3pts")
    tallies: dict[str, Tally] = {}
    table = [f"{'root mean square error over unseen pushes':<46}{'mm':>8}{'degrees':>9}"]
    all_errors: dict[str, list[np.ndarray]] = {"as given": [], "as fitted to the others": []}
    for left_out in given.conditions:
        seen, unseen = [p for c in CONDITIONS if c != left_out for p in every[c]], every[left_out]
        problem, best = fit(chosen(seen, given.repeats), given.out)
        numbers = (f"{p.name} {v:.4g} {p.unit}" for p, v in zip(problem.space.parameters, best, strict=True))
        print(f"{left_out} left out: {', '.join(n.strip() for n in numbers)}")
        as_given = np.nan_to_num(problem.space.nominal)  # neither late nor off
        for (label, every_error), values in zip(all_errors.items(), (as_given, best), strict=True):
            every_error.append(errors(unseen, [p[0] for p in predict(problem, unseen, values)]))
            table.append(_row(f"{left_out}, {label}", every_error[-1]))
        regions(problem, seen, unseen, best, tallies)
    table += [_row(f"all, {label}", np.concatenate(of)) for label, of in all_errors.items()]
    print("", *table, sep="\n")
    print(f"\n{'last poses of unseen pushes':<46}{'energy score, mm':>16}{'in 90 % region':>16}")
    print(*(tally.row(label) for label, tally in tallies.items()), sep="\n")


if __name__ == "__main__":
    main()
