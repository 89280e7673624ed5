"""Motion and forces of a log, free of what is faster than the robot moves.

Positions are filtered without a lag and differentiated twice. The forces that this motion needs are compared with
those that were logged after one and the same low-pass on both: noise, ripple and late samples are then gone from both
sides alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy import signal

from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Setting
from dropo_torch.gap.log import episode_bounds

#: Power of a frequency, relative to that of noise, from which on it is motion: chance makes as much once in 20,000.
ABOVE = 10.0
#: Share of the velocities' power that lies below the highest frequency of the motion.
POWER = 0.99
#: Cut-off of forces by that frequency, and of positions by the former.
FORCES, POSITIONS = 6.0, 4.0
#: Positions of a path that has a frequency.
SHORTEST = 3
#: Rows by cut-off: of what is filtered, and of what is kept.
ROWS, KEPT = 16.0, 4.0
#: Order of the filters, which run both ways, and the highest cut-off by the sampling frequency.
ORDER, HIGHEST = 4, 0.4


@dataclass(frozen=True)
class Stretch:
    """An episode's motion between its logged rows.

    Attributes:
        position, velocity, acceleration: of all joints, ``(N, nv)`` each.
        force: what was logged as acting at the joints, ``(N, nv)``.
        rate: rows per second.
        cutoff: in Hz, of what is compared.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    force: np.ndarray
    rate: float
    cutoff: float

    def compared(self, forces: np.ndarray) -> np.ndarray:
        """Return forces ``(N, ...)`` as they are compared, without the ends that a filter sees from one side only."""
        edge, every = int(np.ceil(self.rate / self.cutoff)), max(1, int(self.rate / (KEPT * self.cutoff)))
        return low_pass(forces, self.rate, self.cutoff)[edge : len(forces) - edge : every]


def has_forces(setting: Setting) -> bool:
    """Return whether the log has the force of every joint: a plain motor each, all positions seen, nothing touched."""
    m, seen = setting.model, np.isin(np.arange(setting.model.nq), setting.observation.index)
    single = np.isin(m.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)).all()
    plain = (
        (m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & (m.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE)
        & (m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
    )
    if not (single and plain.all() and m.nu == m.njnt and seen.all()) or setting.masked or m.neq:
        return False
    return bool((np.sort(m.actuator_trnid[:, 0]) == np.arange(m.njnt)).all() and not setting.signals.contacts.any())


def highest_frequency(log: Trajectories, setting: Setting) -> float:
    """Return the frequency in Hz below which the joints move, by the power of their velocities; 0 if none does.

    Episodes of one transition show none. White noise of the positions is no motion: over a short stretch, where a slow
    motion is a steady one, it would be most of what there is besides. The frequency of a steady motion is the lowest
    that a stretch can show.
    """
    frequencies, powers, turning = [], [], []
    for path, _ in _paths(log, setting):
        if len(path) < SHORTEST:
            continue
        speed, rate = np.diff(path, axis=0), 1 / setting.signals.timestep
        frequency, power = signal.periodogram(speed, rate, window="hann", axis=0)
        shape = np.sin(np.pi * frequency / rate)[:, None] ** 2  # of the velocities, where positions are noisy
        upper = frequency > rate / 4
        noise = np.median(power[upper] / shape[upper], axis=0) / np.log(2) * shape
        frequencies.append(frequency)
        power[0] = 0.0  # a mean that was taken out
        powers.append(np.where(power > ABOVE * noise, power, 0.0) * len(path))
        turning += [frequency[1]] * bool(speed.any())
    if not powers:
        return 0.0
    at, power = np.concatenate(frequencies), np.concatenate(powers)
    order = np.argsort(at)
    below = np.cumsum(power[order], axis=0) / np.maximum(power.sum(0), 1e-300)
    moving = [at[order][np.searchsorted(column, POWER)] for column in below.T if column[-1] > 0]
    return float(max(moving, default=min(turning, default=0.0)))


def stretches(log: Trajectories, setting: Setting, highest: float, rows: int = 1) -> list[Stretch]:
    """Return the motion of the episodes that are long enough; none where rows are too rare for a low-pass.

    Args:
        log: with the force of every joint.
        setting: the model and its columns.
        highest: frequency below which the joints move, in Hz.
        rows: of the log that are taken as one; more than one shows what its sampling makes of the forces.
    """
    dt, found = rows * setting.signals.timestep, []
    cutoff = FORCES * highest
    if not 0 < cutoff * dt < HIGHEST:
        return []
    every = max(1, int(1 / (ROWS * cutoff * dt)))
    for path, commands in _paths(log, setting, rows):
        if len(commands) * dt * cutoff < 4:
            continue
        smooth = low_pass(path, 1 / dt, POSITIONS * cutoff)
        speed = np.diff(smooth, axis=0) / dt
        force = low_pass(_forces(setting.model, path, commands), 1 / dt, POSITIONS * cutoff)
        kept = np.arange(1, len(speed) - 1, every)
        found.append(
            Stretch(
                position=0.5 * (smooth[kept] + smooth[kept + 1]),
                velocity=speed[kept],
                acceleration=(speed[kept + 1] - speed[kept - 1]) / (2 * dt),
                force=force[kept],
                rate=1 / (every * dt),
                cutoff=cutoff,
            )
        )  # fmt: skip
    return found


def low_pass(values: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Return signals ``(N, ...)`` without what is faster than a cut-off in Hz, and without a lag."""
    if cutoff >= HIGHEST * rate:
        return values
    sections = signal.butter(ORDER, cutoff, fs=rate, output="sos")
    return signal.sosfiltfilt(sections, values, axis=0, padlen=min(len(values) - 1, int(3 * rate / cutoff)))


def _paths(log: Trajectories, setting: Setting, rows: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions of the joints at all instants of each episode ``(N + 1, nv)``, and commands between them ``(N, nu)``.

    Of every so many rows one instant is taken, and the mean of the commands between.
    """
    states, after = (setting.observation.states(x)[:, : setting.model.nq] for x in
                     (log.observations, log.next_observations))  # fmt: skip
    for a, b in episode_bounds(log):
        path, whole = np.concatenate([states[a : a + 1], after[a:b]]), (b - a) // rows
        yield path[: whole * rows + 1 : rows], log.actions[a : a + whole * rows].reshape(whole, rows, -1).mean(1)


def _forces(model: mujoco.MjModel, path: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Force of the motors at the joints under each command, with the model's limits ``(N, nv)``."""
    data, found = mujoco.MjData(model), np.empty((len(commands), model.nv))
    for row, (position, command) in enumerate(zip(path, commands, strict=False)):
        data.qpos[:], data.ctrl[:] = position, command
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdActuation(model, data)
        found[row] = data.qfrc_actuator
    return found
