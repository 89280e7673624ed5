"""How often the force that a joint lacks ripples along its path: a periodogram over the position."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy import ndimage

from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.engine import Variant
from dropo_torch.gap.log import cut_windows
from dropo_torch.gap.twin import Twin

#: Physics steps that are simulated, about, at most.
STEPS = 50_000
#: Waves that are told, at most, and how often chance makes one of noise, about.
WAVES, CHANCE = 3, 0.01
#: Frequencies by the finest that the range resolves; of these, those whose median power is the noise of one.
FINER, BESIDE = 8, 24
#: Phase in radians from one row to the next at the typical speed, at most; and over a bin of positions.
TURN, BIN = np.pi / 2, np.pi / 4
#: Bins of positions, at most.
BINS = 2**17
#: Largest residual by the median one: impacts say nothing.
LARGEST = 5.0


def ripples(twin: Twin, log: Trajectories, variant: Variant) -> dict[int, tuple[float, ...]]:
    """Return the angular frequencies over the position, by coordinate, at which hinges and slides lack a force.

    The force is seen in what one logged step adds to a joint's velocity beside what the simulation adds.

    Args:
        twin: simulates the log.
        log: what was measured.
        variant: the hypothesis that lacks something.
    """
    every = -(-len(log.observations) * twin.setting.frame_skip // STEPS)
    windows = cut_windows(log, twin.setting.observation, 1, stride=every)
    (simulated,), _ = twin.predict([variant], windows)
    missing, path = (windows.measured - simulated)[:, 1], windows.measured.mean(1)
    model, signals, found = twin.setting.model, twin.setting.signals, dict[int, tuple[float, ...]]()
    index = twin.setting.observation.index.tolist()
    for joint in np.flatnonzero(np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))):
        coordinate, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        speed = model.nq + dof
        if coordinate in index and speed in index and signals.speed[dof] > 0:
            highest = TURN / (signals.speed[dof] * signals.timestep)
            found[coordinate] = waves(path[:, index.index(coordinate)], missing[:, index.index(speed)], highest)
    return found


def waves(position: np.ndarray, force: np.ndarray, highest: float) -> tuple[float, ...]:
    """Return the angular frequencies at which a force stands out over the position, the strongest first.

    Args:
        position: of each row, ``(N,)``.
        force: what is missing there, in any unit, ``(N,)``.
        highest: angular frequency, in radians by the unit of the position.
    """
    known = np.isfinite(force) & np.isfinite(position)
    position, force = position[known], force[known]
    length = float(np.ptp(position)) if known.any() else 0.0
    if not 2 * np.pi < highest * length:
        return ()
    power = _power(position, force, max(int(highest * length / BIN), 1))
    step = 2 * np.pi / (FINER * length)
    power = power[: int(highest / step) + 2]
    noise = ndimage.median_filter(power, FINER * BESIDE, mode="reflect") / np.log(2)
    excess = power / np.maximum(noise, 1e-300)
    inner = np.arange(FINER, len(power) - 1)
    stands_out = excess[inner] > np.log(len(power) / CHANCE)
    peaks = inner[stands_out & (excess == ndimage.maximum_filter(excess, 2 * FINER + 1))[inner]]
    best = peaks[np.argsort(-excess[peaks])][:WAVES]
    return tuple((step * (best + _vertex(*(np.log(power[best + i]) for i in (-1, 0, 1))))).tolist())


def _power(position: np.ndarray, force: np.ndarray, bins: int) -> np.ndarray:
    """Periodogram of a force over the position, of unit frequency 2π by :data:`FINER` times the range."""
    bins = min(bins, BINS)
    at = ((position - position.min()) * (bins / np.ptp(position))).astype(int).clip(max=bins - 1)
    offset = force - np.median(force)
    limit = LARGEST * float(np.median(np.abs(offset)))
    offset = offset.clip(-limit, limit)
    return np.abs(np.fft.rfft(np.bincount(at, offset - offset.mean(), bins), FINER * bins)) ** 2


def _vertex(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where a parabola through three values has its top, in steps from the middle one."""
    return 0.5 * (before - after) / (before - 2 * here + after)
