"""One transition at a time, simulated: what the model says that the logged commands do."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from mujoco import rollout

from dropo_torch.data.examination.record import Record
from dropo_torch.data.examination.rules import Rules
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.support.rows import evenly

#: Microseconds of simulation that an examination may take, about, and the fewest and most rows that are simulated.
BUDGET, LEAST_ROWS, MOST_ROWS = 4e5, 250, 1200
#: Blocks of rows over which readings are compared, the fewest rows for that, and what a row counts at most.
BLOCKS, LEAST_COMPARED, WORST = 20, 100, 9.0
#: Threads of a simulation; results do not depend on them.
THREADS = min(4, os.cpu_count() or 1)


def chosen_rows(record: Record, steps: int, block: int = 40, reach: int = 0) -> np.ndarray:
    """Return rows in blocks spread over the log, so few that simulating ``steps`` physics steps of each takes no time.

    ``reach`` rows before and after each must follow one another.
    """
    assert record.model is not None
    most = int(np.clip(BUDGET / (_cost(record.model) * steps), LEAST_ROWS, MOST_ROWS))
    usable = ~record.cut
    number = record.runs
    for shift in range(1, reach + 1):
        usable[shift:] &= number[shift:] == number[:-shift]
        usable[:-shift] &= number[:-shift] == number[shift:]
        usable[:shift] = usable[-shift:] = False
    rows = np.flatnonzero(usable)
    if len(rows) <= most:
        return rows
    blocks = np.array_split(rows, max(1, len(rows) // block))
    picked = evenly(len(blocks), max(1, most // block))
    return np.concatenate([blocks[i] for i in picked])


def response_steps(record: Record) -> int:
    """Return over how many physics steps of a row the commands' effect is simulated: all, unless that takes long."""
    model = record.model
    assert model is not None
    affordable = BUDGET / (LEAST_ROWS * _cost(model) * max(model.nu, 1))
    return int(np.clip(affordable, 1, record.frame_skip))


def _cost(model: mujoco.MjModel) -> float:
    """Microseconds of a physics step, about."""
    return float((3 + 0.15 * model.nv**2) * (2 if model.npair or _touching(model) else 1))


def _touching(model: mujoco.MjModel) -> bool:
    """Whether geoms may touch."""
    return bool((model.geom_contype[:, None] & model.geom_conaffinity[None]).any())


def simulate(model: mujoco.MjModel, states: np.ndarray, controls: np.ndarray, steps: int) -> np.ndarray:
    """Return the states ``(T, nq + nv)`` after ``steps`` physics steps under ``controls (T, nu)``; NaN if diverged."""
    data = mujoco.MjData(model)
    kind = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.empty((len(states), mujoco.mj_stateSize(model, kind)))
    own = np.empty(start.shape[1])
    mujoco.mj_getState(model, data, own, kind)
    start[:] = own
    first = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_TIME))
    start[:, first : first + model.nq + model.nv] = states
    control = np.repeat(controls[:, None], steps, axis=1)
    with quiet_mujoco():
        out, _ = rollout.rollout(model, [mujoco.MjData(model) for _ in range(THREADS)], start, control, nstep=steps)
    ends = np.array(out[:, -1, first : first + model.nq + model.nv])
    with np.errstate(invalid="ignore"):
        bad = ~(np.abs(ends) < 1e8).all(axis=1) | (out[:, -1, 0] < start[:, 0] + 0.5 * steps * model.opt.timestep)
    ends[bad] = np.nan
    return ends


@dataclass(frozen=True)
class Reading:
    """One way to read a log: what its columns and its commands are.

    Attributes:
        places: the number of each observed column in the extended state, ``(n,)``.
        signs: by which observed columns are multiplied, ``(n,)``.
        commands: by which commands are multiplied, ``(nu,)``.
    """

    places: tuple[int, ...]
    signs: tuple[float, ...]
    commands: tuple[float, ...]

    @classmethod
    def of(
        cls, record: Record, places: Sequence[int] | None = None, *, columns: Sequence[int] = (),
        commands: Sequence[int] = (),
    ) -> Reading:  # fmt: skip
        """Return the log's own reading with other places, and with columns and commands negated."""
        own = record.observation.columns
        return cls(
            tuple(own if places is None else places),
            tuple(-1.0 if i in columns else 1.0 for i in range(len(own))),
            tuple(-1.0 if i in commands else 1.0 for i in range(record.log.actions.shape[1])),
        )


def better_reading(record: Record, readings: Sequence[Reading], rules: Rules) -> int | None:
    """Return which of some readings the model predicts clearly better over a row than all others, or ``None``."""
    if not can_predict(record):
        return None
    misfits = [_misfit(record, reading) for reading in readings]
    known = [(float(m.sum()), i) for i, m in enumerate(misfits) if m is not None]
    if len(known) < len(readings):
        return None
    (least, best), (other, second) = sorted(known)[:2]
    first, following = misfits[best], misfits[second]
    assert first is not None
    assert following is not None
    floor = max(float(first.mean()), 1e-12)  # blocks count alike, however much moves in them
    change = np.log((following + floor) / (first + floor))
    error = float(change.std(ddof=1)) / np.sqrt(len(change))
    clear = float(change.mean()) > rules.sure_significance * error and least < rules.reading * other
    return best if clear else None


def can_predict(record: Record) -> bool:
    """Whether the model can be simulated from a log's rows, and velocities of it are seen."""
    model = record.model
    return (
        model is not None
        and not record.observation.is_sensed
        and record.log.actions.shape[1] == model.nu
        and not model.na
        and any(place >= model.nq for place in record.observation.columns)
    )


def _misfit(record: Record, reading: Reading) -> np.ndarray | None:
    """What a reading leaves of the changes of velocity in each block of rows, of their size, cut at outliers."""
    model = record.model
    assert model is not None
    rows, observation = chosen_rows(record, record.frame_skip), record.observation
    speeds = [i for i, place in enumerate(reading.places) if place >= model.nq]
    if len(rows) < LEAST_COMPARED or not speeds:
        return None
    full = np.ones(observation.log_width)
    full[list(observation.log_columns)] = reading.signs
    try:
        states = replace(observation, columns=reading.places).states(record.log.observations[rows] * full)
    except ValueError:  # a zero quaternion
        return None
    ends = simulate(model, states, record.log.actions[rows] * np.array(reading.commands), record.frame_skip)
    signs = np.array(reading.signs)[speeds]
    before, after = record.before[rows][:, speeds] * signs, record.after[rows][:, speeds] * signs
    change, told = after - before, ends[:, [reading.places[i] for i in speeds]] - before
    scale = np.maximum(change.std(axis=0), 1e-12)
    off = np.minimum(np.nan_to_num(((change - told) / scale) ** 2, nan=WORST, posinf=WORST), WORST).mean(axis=1)
    return np.array([block.sum() for block in np.array_split(off, BLOCKS)])


def skills(
    record: Record, factors: Mapping[int, float], commands: Mapping[int, float] | None = None
) -> tuple[float, float]:
    """Return which share of the changes of velocity the model explains: as logged, and with columns scaled.

    Args:
        record: the log.
        factors: of observed columns.
        commands: factors of commands.

    Each is the median over degrees of freedom of 1 minus the unexplained over the whole, both cut at outliers. Without
    a model whose velocities are observed, both are 0.
    """
    model = record.model
    columns = np.asarray(record.observation.columns)
    if model is None or not can_predict(record):
        return 0.0, 0.0
    rows = chosen_rows(record, 2 * record.frame_skip)
    scale = np.ones(len(columns))
    scale[list(factors)] = list(factors.values())
    told = np.ones(record.log.actions.shape[1])
    told[list(commands or {})] = list((commands or {}).values())
    found = []
    for factor, gain in ((np.ones(len(columns)), np.ones(len(told))), (scale, told)):
        full = np.ones(record.observation.log_width)
        full[list(record.observation.log_columns)] = factor
        try:
            states = record.observation.states(record.log.observations[rows] * full)
        except ValueError:  # a zero quaternion
            return 0.0, 0.0
        ends = simulate(model, states, record.log.actions[rows] * gain, record.frame_skip)[:, columns]
        measured, start = record.after[rows] * factor, record.before[rows] * factor
        shares = [
            _explained(measured[:, i] - start[:, i], ends[:, i] - start[:, i])
            for i in range(len(columns))
            if columns[i] >= model.nq and np.ptp(start[:, i]) > 0
        ]
        found.append(float(np.median(shares)) if shares else 0.0)
    return found[0], found[1]


def _explained(measured: np.ndarray, predicted: np.ndarray) -> float:
    """Share of a signal that a prediction explains, without the tenth of the rows that it explains worst."""
    good = np.isfinite(predicted)
    if good.mean() < 0.9:
        return 0.0
    measured, off = measured[good], (measured - predicted)[good] ** 2
    kept = off <= np.quantile(off, 0.9)
    whole = float((measured[kept] ** 2).sum())
    return 1 - min(1.0, float(off[kept].sum()) / whole) if whole > 0 else 0.0
