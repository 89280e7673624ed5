"""The log as the gap sees it: features, windows with initial states of their own, and the sizes of what it holds."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from dropo_torch.data.features import Features, masked_columns
from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Setting, Signals
from dropo_torch.gap.twin import Windows
from dropo_torch.problem import Problem
from dropo_torch.support.rows import evenly

#: Configurations of the log at which the typical forces are computed.
SAMPLES = 400


def episode_bounds(log: Trajectories) -> list[tuple[int, int]]:
    """Return first and last-plus-one row of every episode."""
    ends = np.flatnonzero(log.terminals) + 1
    return list(zip(np.append(0, ends[:-1]).tolist(), ends.tolist(), strict=True))


def cut_windows(
    log: Trajectories, observation: Observation, length: int, *, stride: int | None = None,
    since: np.ndarray | None = None,
) -> Windows:  # fmt: skip
    """Cut a log into windows of ``length`` logged steps, one every ``stride``.

    By default no two windows share a measurement. They never cross an episode's end; an episode shorter than a window
    gives none.

    Args:
        log: the log.
        observation: its columns.
        length: logged steps of a window.
        stride: logged steps from one to the next.
        since: logged step of each episode at which its first window starts, ``(E,)``.
    """
    bounds, commands = episode_bounds(log), log.commands
    begin = np.zeros(len(bounds), dtype=int) if since is None else since
    observed, following = observation.observed(log.observations), observation.observed(log.next_observations)
    found, paths = [], np.empty((len(bounds), commands.shape[1], observed.shape[1]))
    for e, (a, b) in enumerate(bounds):
        path = np.concatenate([observed[a : a + 1], following[a:b]])
        paths[e, : b - a] = observed[a:b]
        paths[e, b - a :] = following[b - 1]
        slope = np.gradient(path, axis=0)
        starts = range(int(begin[e]), b - a - length + 1, stride or length + 1)
        found += [(path[s : s + length + 1], slope[s], e, s) for s in starts]
    measured, rates, episodes, steps = zip(*found, strict=True) if found else ((), (), (), ())
    firsts = np.array([a for a, _ in bounds])
    rows = firsts[np.array(episodes, dtype=int)] + np.array(steps, dtype=int)
    return Windows(
        np.reshape(measured, (-1, length + 1, observation.size)),
        np.reshape(rates, (-1, observation.size)) / (log.dt or 1.0),
        np.array(episodes, dtype=int), np.array(steps, dtype=int), commands,
        None if log.unseen is None else log.unseen[rows], gains=_gains(log, observation, rows, length), observed=paths,
    )  # fmt: skip


def _gains(log: Trajectories, observation: Observation, rows: np.ndarray, length: int) -> np.ndarray | None:
    """Noise of each column in windows that begin at some rows, relative to that of a sample, ``(W, L + 1, n)``."""
    if log.gains is None:
        return None
    gains = log.gains[:, :, list(observation.log_columns)]
    return np.concatenate([gains[rows, :1], gains[rows[:, None] + np.arange(length), 1]], axis=1)


def longest_episode(log: Trajectories) -> int:
    """Return the logged steps of the longest episode."""
    return max(b - a for a, b in episode_bounds(log))


def feature_sizes(setting: Setting, columns: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each feature ``(m,)`` over observed columns ``(..., n)``."""
    columns = columns.reshape(-1, columns.shape[-1])
    return Features.of(setting.observation).difference(columns, columns[:1]).std(0)


def since_known(windows: Windows, since: np.ndarray) -> Windows:
    """Return the windows that start no earlier than some logged step of their episode, ``(E,)``."""
    return windows.select(windows.steps >= since[windows.episodes])


def spread(windows: Windows, most: int) -> Windows:
    """Return at most so many windows, evenly spread."""
    if len(windows) <= most:
        return windows
    return windows.select(evenly(len(windows), most))


def blocks_of(episodes: np.ndarray, least: int) -> np.ndarray:
    """Return blocks of windows ``(W,)`` that count as independent: episodes if there are enough, else tenths."""
    return episodes if len(np.unique(episodes)) >= least else np.arange(len(episodes)) * 10 // max(len(episodes), 1)


def parts_of(episodes: np.ndarray, least: int) -> np.ndarray:
    """Return blocks of windows ``(W,)``: episodes, or where these are few, runs of windows of one.

    Windows share no measurement and have initial states of their own.

    Args:
        episodes: episode of each window, in the log's order, ``(W,)``.
        least: blocks that are wanted; of fewer windows each is one.
    """
    names, begins, own = np.unique(episodes, return_index=True, return_inverse=True)
    if len(names) >= least:
        return own
    size = max(1, len(episodes) // least)
    run = (np.arange(len(episodes)) - begins[own]) // size
    return own * len(episodes) + run


def make_setting(problem: Problem, log: Trajectories) -> Setting:
    """Return where effects are looked for: the model, its columns, and the sizes of the log."""
    model, observation = copy.copy(problem.space.model), problem.observation
    assert model is not None
    nq, nv, physics, step = model.nq, model.nv, float(model.opt.timestep), problem.simulator.timestep
    step = problem.simulator.frame_skip * physics if step is None else step
    frame_skip = round(step / physics)  # steps of the given model, whatever the simulator makes of them
    states, after = (
        observation.states(log.observations, log.unseen),
        observation.states(log.next_observations, log.unseen),
    )
    rows = evenly(len(states), SAMPLES)
    inertia, force, touches = np.zeros(nv), np.zeros(nv), np.zeros(model.ngeom, bool)
    squares = np.zeros((model.nbody, 2))  # of angular and linear velocity
    data, dense, velocity = mujoco.MjData(model), np.zeros((nv, nv)), np.empty(6)
    for row in rows:
        data.qpos[:], data.qvel[:] = states[row, :nq], states[row, nq:]
        data.ctrl[:] = log.actions[row, : model.nu]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, dense)
        inertia += np.diag(dense)
        acceleration = (after[row, nq:] - states[row, nq:]) / step
        force += np.abs(dense @ acceleration) + np.abs(data.qfrc_bias) + np.abs(data.qfrc_actuator)
        for b in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, int(mujoco.mjtObj.mjOBJ_BODY), b, velocity, 0)
            squares[b] += (velocity**2).reshape(2, 3).sum(1)
        for contact in data.contact[: data.ncon]:
            touches[contact.geom[contact.geom >= 0]] = True
    known = [*observation.columns, *(observation.unseen if log.unseen is not None else ())]
    seen, speeds = np.isin(np.arange(nq), known), np.sqrt(squares / len(rows))
    signals = Signals(
        timestep=step,
        position=np.where(seen[:, None], np.percentile(states[:, :nq], [1, 99], axis=0).T, np.nan),
        speed=np.sqrt(np.mean(states[:, nq:] ** 2, axis=0)),
        force=np.maximum(force / len(rows), 1e-12),
        inertia=inertia / len(rows),
        command=np.abs(log.actions[:, : model.nu]).max(0),
        column=observation.observed(log.observations).std(0),
        linear_speed=speeds[:, 1],
        angular_speed=speeds[:, 0],
        contacts=touches,
    )
    masked = masked_columns(observation, problem.config.mask)
    derived = tuple((observation.labels.index(label), error) for label, error in problem.derived.items())
    differentiated = problem.sensed is None and problem.config.derives_velocities
    slopes = tuple(i for i, column in enumerate(observation.log_columns) if column in log.slopes)
    return Setting(model, observation, signals, frame_skip, masked, derived, differentiated, slopes, log.lead)


def start_values(problem: Problem) -> np.ndarray:
    """Declared parameters to begin with: the model's own where they lie in their box, else its middle."""
    space, nominal = problem.space, problem.space.nominal
    inside = (nominal >= space.low) & (nominal <= space.high)  # not where it is NaN
    return np.where(inside, nominal, 0.5 * (space.low + space.high))
