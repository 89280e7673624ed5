"""The log as the gap sees it: features, windows with a start of their own, and the sizes of what it holds."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from dropo_torch.data.features import masked_columns
from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Setting, Signals
from dropo_torch.effects.twin import Windows
from dropo_torch.problem import Problem

#: Configurations of the log at which the typical forces are computed.
SAMPLES = 400


def episode_bounds(log: Trajectories) -> list[tuple[int, int]]:
    """Return first and last-plus-one row of every episode."""
    ends = np.flatnonzero(log.terminals) + 1
    return list(zip(np.append(0, ends[:-1]).tolist(), ends.tolist(), strict=True))


def cut_windows(log: Trajectories, observation: Observation, length: int, *, stride: int | None = None) -> Windows:
    """Cut a log into windows of ``length`` logged steps, one every ``stride``.

    By default no two windows share a measurement. They never cross an episode's end; an episode shorter than a window
    gives none.
    """
    bounds = episode_bounds(log)
    longest = max(b - a for a, b in bounds)
    commands = np.zeros((len(bounds), longest + 1, log.actions.shape[1]))
    observed, following = observation.observed(log.observations), observation.observed(log.next_observations)
    measured, rates, episodes, steps = [], [], [], []
    for e, (a, b) in enumerate(bounds):
        commands[e, : b - a] = log.actions[a:b]
        commands[e, b - a :] = log.actions[b - 1]
        path = np.concatenate([observed[a : a + 1], following[a:b]])
        slope = np.gradient(path, axis=0) if len(path) > 1 else np.zeros_like(path)
        for start in range(0, b - a - length + 1, stride or length + 1):
            measured.append(path[start : start + length + 1])
            rates.append(slope[start])
            episodes.append(e)
            steps.append(start)
    shape = (0, length + 1, observed.shape[1])
    return Windows(
        np.stack(measured) if measured else np.zeros(shape),
        (np.stack(rates) if rates else np.zeros((0, observed.shape[1]))) / (log.dt or 1.0),
        np.array(episodes, dtype=int),
        np.array(steps, dtype=int),
        commands,
    )


def make_setting(problem: Problem, log: Trajectories) -> Setting:
    """Return where effects are looked for: the model, its columns, and the sizes of the log."""
    model = copy.copy(problem.space.model)
    assert model is not None
    frame_skip = problem.simulator.frame_skip
    states = problem.observation.states(log.observations)
    rows = np.unique(np.linspace(0, len(states) - 1, SAMPLES).astype(int))
    data = mujoco.MjData(model)
    nv = model.nv
    inertia, force, speed, touches = np.zeros(nv), np.zeros(nv), np.zeros(model.nbody), np.zeros(model.ngeom, bool)
    dense = np.zeros((nv, nv))
    after = problem.observation.states(log.next_observations)
    step = frame_skip * float(model.opt.timestep)
    for row in rows:
        data.qpos[:], data.qvel[:] = states[row, : model.nq], states[row, model.nq :]
        data.ctrl[:] = log.actions[row]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, dense)
        inertia += np.diag(dense)
        acceleration = (after[row, model.nq :] - states[row, model.nq :]) / step
        total = np.abs(dense @ acceleration) + np.abs(data.qfrc_bias) + np.abs(data.qfrc_actuator)
        force += total
        for b in range(model.nbody):
            speed[b] += float(np.sum(_velocity(model, data, b) ** 2))
        for contact in data.contact[: data.ncon]:
            touches[contact.geom[contact.geom >= 0]] = True
    observed = problem.observation.observed(log.observations)
    seen = np.isin(np.arange(model.nq), problem.observation.columns)
    position = np.where(
        seen[:, None], np.percentile(states[:, : model.nq], [1, 99], axis=0).T, np.nan
    )  # fmt: skip
    velocity = np.sqrt(np.mean(states[:, model.nq :] ** 2, axis=0))
    signals = Signals(
        timestep=step,
        position=position,
        speed=velocity,
        force=np.maximum(force / len(rows), 1e-12),
        inertia=inertia / len(rows),
        command=np.abs(log.actions).max(0) if log.actions.shape[1] else np.zeros(0),
        column=observed.std(0),
        linear_speed=np.sqrt(speed / len(rows)),
        contacts=touches,
    )
    masked = masked_columns(problem.observation, problem.config.mask)
    return Setting(model, problem.observation, signals, frame_skip, masked)


def _velocity(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    out = np.empty(6)
    mujoco.mj_objectVelocity(model, data, int(mujoco.mjtObj.mjOBJ_BODY), body, out, 0)
    return out[3:]


def start_values(problem: Problem) -> np.ndarray:
    """Declared parameters to begin with: the model's own where they lie in their box, else its middle."""
    space = problem.space
    middle = 0.5 * (space.low + space.high)
    nominal = space.nominal
    inside = np.isfinite(nominal) & (nominal >= space.low) & (nominal <= space.high)
    return np.where(inside, nominal, middle)
