"""Logs of robots, as plain MuJoCo simulates their true models, with noise, encoders, filters and jitter."""

from __future__ import annotations

import csv
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count as counted
from itertools import islice
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.unseen.drives import Filter
from benchmarks.unseen.robot import Hidden, Robot, units

HINGE_OR_SLIDE = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)


@dataclass(frozen=True)
class Row:
    """A moment of an episode, and what follows until the next.

    Attributes:
        time: s.
        positions, velocities: the true ones.
        seen: measured positions and velocities.
        command: as sent.
        acting: what acts of it in each step until the next row ``(steps, nu)``.
    """

    time: float
    positions: np.ndarray
    velocities: np.ndarray
    seen: tuple[np.ndarray, np.ndarray]
    command: np.ndarray
    acting: np.ndarray


class Sensors:
    """What measures a robot's state: with noise, steps of encoders, offsets, and a filter of velocities."""

    def __init__(self, robot: Robot, model: mujoco.MjModel, rng: np.random.Generator) -> None:
        self.model, self.rng, log = model, rng, robot.log
        self.noise, self.offsets, self.steps = log.noise, offsets(robot.hidden, model), encoders(robot, model)
        self.share = 1.0 if log.cutoff is None else 1 - math.exp(-2 * math.pi * log.cutoff * robot.row)
        self.filtered: np.ndarray | None = None

    def read(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities as they are measured now."""
        positions, model = data.qpos.copy(), self.model
        error = self.offsets + self.noise[0] * self.rng.standard_normal(model.nv)
        mujoco.mj_integratePos(model, positions, error, 1.0)
        for joint in np.flatnonzero(np.isin(model.jnt_type, HINGE_OR_SLIDE)):
            at, step = model.jnt_qposadr[joint], self.steps[model.jnt_dofadr[joint]]
            positions[at] = step * np.round(positions[at] / step) if step else positions[at]
        raw = data.qvel + self.noise[1] * self.rng.standard_normal(model.nv)
        before = raw if self.filtered is None else self.filtered
        self.filtered = before + self.share * (raw - before)
        return positions, self.filtered


def offsets(hidden: Sequence[Hidden], model: mujoco.MjModel) -> np.ndarray:
    """Return what measured positions are too large by, at each degree of freedom ``(nv,)``."""
    found = np.zeros(model.nv)
    for one in hidden:
        for joint, value in one.offsets.items():
            found[model.joint(joint).dofadr[0]] = value
    return found


def encoders(robot: Robot, model: mujoco.MjModel) -> np.ndarray:
    """Return the steps of measured positions, at each degree of freedom ``(nv,)``."""
    return np.broadcast_to(np.asarray(robot.log.encoder, dtype=float), model.nv)


def record(robot: Robot, seed: int, seconds: float | None = None) -> list[list[Row]]:
    """Simulate a robot, and return the rows of its episodes.

    Args:
        robot: which one.
        seed: of noise, starts and motions.
        seconds: of an episode, in place of the robot's own.
    """
    rng = np.random.default_rng([seed, zlib.crc32(robot.name.encode())])
    count = round((robot.warm + (seconds or robot.seconds)) / robot.row) + 1
    first = round(robot.warm / robot.row)
    return [list(islice(_episode(robot, rng), first, count)) for _ in range(robot.episodes)]


def _episode(robot: Robot, rng: np.random.Generator) -> Iterator[Row]:
    model = robot.true()
    data, sensors = mujoco.MjData(model), Sensors(robot, model, rng)
    command = robot.start(data, rng)
    mujoco.mj_forward(model, data)
    sent, filters = np.zeros(model.nu), None
    factors = np.array([units(name) for name in robot.log.commands])
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf]).T
    for number in counted():
        now, before, seen = data.time, (data.qpos.copy(), data.qvel.copy()), sensors.read(data)
        if number % robot.hold == 0:
            wanted = np.clip(command(now, *seen), low, high)
            sent = np.round(wanted * factors, robot.log.decimals[1]) / factors
        if filters is None:
            filters = _filters(robot, model, sent)
        steps = max(1, round(robot.row / robot.step * (1 + robot.jitter * rng.uniform(-1, 1))))
        acting = np.tile(sent, (steps, 1))
        for actuator, act in filters:
            acting[:, actuator] = [act(value) for value in acting[:, actuator]]
        advance(model, data, acting, robot.hidden)
        if not np.isfinite(data.qpos).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise FloatingPointError(f"{robot.name}: diverged after {now:.2f} s")
        yield Row(now, *before, seen, sent, acting)


def _filters(robot: Robot, model: mujoco.MjModel, sent: np.ndarray) -> list[tuple[int, Filter]]:
    drives = [(model.actuator(name).id, d) for hidden in robot.hidden for name, d in hidden.drives.items()]
    return [(actuator, drive(robot.step, float(sent[actuator]))) for actuator, drive in drives]


def advance(model: mujoco.MjModel, data: mujoco.MjData, acting: np.ndarray, hidden: Sequence[Hidden]) -> None:
    """Step a model by the commands that act in each step, and by hidden forces."""
    pushes = [h.push for h in hidden if h.push is not None]
    if not pushes and (acting == acting[0]).all():
        data.ctrl[:] = acting[0]
        mujoco.mj_step(model, data, len(acting))
        return
    for controls in acting:
        data.ctrl[:] = controls
        for push in pushes:
            push(model, data)
        mujoco.mj_step(model, data)


# --- writing them -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """A column of a log: its name, numbers and decimals."""

    name: str
    values: np.ndarray
    decimals: int


def write(robot: Robot, folder: Path, seed: int, seconds: float | None = None) -> tuple[Path, Path]:
    """Write a robot's model and log as a user would have them, and return their paths; see ``record``."""
    folder.mkdir(parents=True, exist_ok=True)
    model, log = folder / f"robot{Path(robot.file).suffix}", folder / f"log{robot.log.suffix}"
    model.write_text(robot.text, encoding="utf-8")
    columns = table(robot, record(robot, seed, seconds), np.random.default_rng([seed, 1]))
    (_write_arrays if robot.log.suffix == ".npz" else _write_rows)(log, columns)
    return model, log


def table(robot: Robot, episodes: list[list[Row]], rng: np.random.Generator) -> list[Column]:
    """Return the columns of a robot's log."""
    log, model, rows = robot.log, robot.given(), [row for episode in episodes for row in episode]
    times = np.concatenate([_times(robot, episode) for episode in episodes])
    positions, velocities = (np.array([row.seen[i] for row in rows]) for i in (0, 1))
    true = np.array([row.positions for row in rows])
    commands = np.concatenate([_shifted(np.array([row.command for row in e]), log.late) for e in episodes])
    found = []
    if log.episode:
        numbers = np.concatenate([np.full(len(e), i) for i, e in enumerate(episodes)])
        found.append(Column(log.episode, numbers, 0))
    found.append(Column(log.time, times * units(log.time), log.decimals[0]))
    spread, degree = np.hypot(log.noise[0], encoders(robot, model) / math.sqrt(12)), coordinates(model)
    for i, name in enumerate(log.positions):
        found.append(_measured(name, positions[:, i], spread[degree[i]]))
    for i, name in enumerate(log.velocities):
        found.append(_measured(name, velocities[:, i], log.noise[1][i]))
    for i, name in enumerate(log.commands):
        found.append(Column(name, commands[:, i] * units(name), log.decimals[1]))
    return found + [Column(name, make(times, true, rng), d) for name, (make, d) in log.extras.items()]


def _times(robot: Robot, episode: list[Row]) -> np.ndarray:
    times = np.array([row.time for row in episode])
    return times - times[0] if robot.log.from_zero else times


def _shifted(commands: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([np.repeat(commands[:1], rows, 0), commands[: len(commands) - rows]])


def _measured(name: str, values: np.ndarray, spread: float) -> Column:
    """A measured column, with decimals that are a few times finer than its noise."""
    factor = units(name)
    return Column(name, values * factor, max(0, math.ceil(-math.log10(spread * factor / 4))))


def coordinates(model: mujoco.MjModel) -> list[int]:
    """Return the degree of freedom by whose noise each position is off ``(nq,)``; of quaternions, a near one."""
    found = []
    for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            found += [first, first + 1, first + 2]
        if kind not in HINGE_OR_SLIDE:
            turn = first + (3 if kind == mujoco.mjtJoint.mjJNT_FREE else 0)
            found += [turn, turn + 1, turn + 2, turn + 2]
        else:
            found.append(first)
    return [int(dof) for dof in found]


def _write_rows(path: Path, columns: list[Column]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(c.name for c in columns)
        writer.writerows(zip(*([f"{x:.{c.decimals}f}" for x in c.values] for c in columns), strict=True))


def _write_arrays(path: Path, columns: list[Column]) -> None:
    """Columns of one name as an array of 32-bit numbers; those with a name of their own, as times, with 64 bits."""
    names = dict.fromkeys(c.name for c in columns)
    arrays = {name: np.stack([c.values for c in columns if c.name == name], -1) for name in names}
    written = {n: a[:, 0] if a.shape[1] == 1 else a.astype(np.float32) for n, a in arrays.items()}
    np.savez_compressed(path, **written)  # type: ignore[arg-type]
