"""How far a model's predictions are off a recording, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np

from benchmarks.unseen.record import Row, advance, coordinates, encoders, offsets
from benchmarks.unseen.robot import Hidden, Robot


def misfit(robot: Robot, episodes: list[list[Row]], without: Sequence[Hidden] = (), windows: int = 16) -> float:
    """Return the root mean square of predicted minus measured positions by their noise, over random windows.

    Predictions begin at true states, take the truth's steps, and last for the robot's ``window``.

    Args:
        robot: whose true model predicts.
        episodes: its recording.
        without: leaves some of the things that are hidden away.
        windows: how many.
    """
    rng, length, model = np.random.default_rng(1), max(2, round(robot.window / robot.row)), robot.true(without)
    found = []
    for number in range(windows):
        episode = episodes[number % len(episodes)]
        first = int(rng.integers(len(episode) - length))
        found += _window(robot, model, episode[first : first + length + 1], without)
    return float(np.sqrt(np.mean(np.square(found))))


def _window(robot: Robot, model: mujoco.MjModel, rows: list[Row], without: Sequence[Hidden]) -> list[np.ndarray]:
    data, first, kept = mujoco.MjData(model), rows[0], [h for h in robot.hidden if h not in without]
    data.qpos[:], data.qvel[:], data.time = first.positions, first.velocities, first.time
    is_driven, bias = any(h.drives for h in kept), offsets(kept, model)
    noise = np.hypot(robot.log.noise[0], encoders(robot, model) / np.sqrt(12))
    seen = sorted(set(coordinates(model)[: len(robot.log.positions)]))
    found = []
    for row, after in pairwise(rows):
        acting = row.acting if is_driven else np.tile(row.command, (len(row.acting), 1))
        advance(model, data, acting, kept)
        predicted, off = data.qpos.copy(), np.zeros(model.nv)
        mujoco.mj_integratePos(model, predicted, bias, 1.0)
        mujoco.mj_differentiatePos(model, off, 1.0, predicted, after.seen[0])
        found.append((off / noise)[seen])
    return found
