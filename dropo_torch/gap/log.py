"""The log as the gap sees it: features, windows with initial states of their own, and the sizes of what it holds."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Setting, Signals
from dropo_torch.effects.twin import Windows
from dropo_torch.objective import masked_columns
from dropo_torch.problem import Problem

#: Configurations of the log at which the typical forces are computed.
SAMPLES = 400


@dataclass(frozen=True)
class Chart:
    """Coordinates in which observed columns are compared: a quaternion becomes a rotation vector.

    Attributes:
        plain: observed columns that are compared as they are.
        quaternions: columns of each observed quaternion.
        labels: names of the features, ``(m,)``.
        units: their units.
        masked: observed columns that are not compared.
    """

    plain: tuple[int, ...]
    quaternions: tuple[tuple[int, int, int, int], ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    masked: frozenset[int] = frozenset()

    @classmethod
    def of(cls, observation: Observation, masked: frozenset[int] = frozenset()) -> Chart:
        """Return the chart of an observation; masked columns are features that are never known."""
        taken = {c for q in observation.quaternions for c in q}
        plain = tuple(c for c in range(observation.size) if c not in taken)
        stems = [observation.labels[q[0]].split("[")[0] for q in observation.quaternions]
        turned = [f"{stem}.rotation[{axis}]" for stem in stems for axis in "xyz"]
        return cls(
            plain, observation.quaternions, tuple(observation.labels[c] for c in plain) + tuple(turned),
            tuple(observation.units[c] for c in plain) + ("rad",) * len(turned), masked,
        )  # fmt: skip

    @property
    def size(self) -> int:
        """Number of features m."""
        return len(self.plain) + 3 * len(self.quaternions)

    def feature_noise(self, columns: np.ndarray) -> np.ndarray:
        """Return deviations of the features ``(m,)`` from those of columns ``(n,)``; a quaternion's ν turns by 2ν."""
        turned = [np.repeat(2 * columns[list(q)].mean(), 3) for q in self.quaternions]
        return np.concatenate([columns[list(self.plain)], *turned])

    def column_noise(self, features: np.ndarray) -> np.ndarray:
        """Return deviations of the columns ``(n,)`` that give those of the features ``(m,)``; one to a quaternion."""
        columns = np.empty(len(self.plain) + 4 * len(self.quaternions))
        columns[list(self.plain)] = features[: len(self.plain)]
        for q, turned in zip(self.quaternions, features[len(self.plain) :].reshape(-1, 3), strict=True):
            columns[list(q)] = 0.5 * np.sqrt(np.mean(turned**2))
        return columns

    def difference(self, measured: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """Return measured minus simulated, ``(..., m)``, of columns ``(..., n)``."""
        parts = [(measured - simulated)[..., list(self.plain)]]
        parts += [_rotation(simulated[..., list(q)], measured[..., list(q)]) for q in self.quaternions]
        return np.concatenate(parts, -1)

    def move(self, columns: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Return columns ``(..., n)`` moved by features ``(..., m)``."""
        out = np.broadcast_to(columns, (*delta.shape[:-1], columns.shape[-1])).copy()
        out[..., list(self.plain)] += delta[..., : len(self.plain)]
        for i, q in enumerate(self.quaternions):
            turn = delta[..., len(self.plain) + 3 * i : len(self.plain) + 3 * i + 3]
            out[..., list(q)] = _turned(out[..., list(q)], turn)
        return out

    def known(self, valid: np.ndarray) -> np.ndarray:
        """Return which features ``(..., m)`` are known, of columns ``(..., n)``."""
        valid = valid & ~np.isin(np.arange(valid.shape[-1]), list(self.masked))
        parts = [valid[..., list(self.plain)]]
        parts += [np.repeat(valid[..., list(q)].all(-1, keepdims=True), 3, -1) for q in self.quaternions]
        return np.concatenate(parts, -1)


def _rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation vector, in the body's frame, from one quaternion to another."""
    w0, x0, y0, z0 = np.moveaxis(start, -1, 0)
    w1, x1, y1, z1 = np.moveaxis(end, -1, 0)
    w = w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1
    v = np.stack(
        [
            w0 * x1 - x0 * w1 - y0 * z1 + z0 * y1,
            w0 * y1 - y0 * w1 - z0 * x1 + x0 * z1,
            w0 * z1 - z0 * w1 - x0 * y1 + y0 * x1,
        ],
        -1,
    )
    v, w = np.where(w[..., None] < 0, -v, v), np.abs(w)
    sine = np.linalg.norm(v, axis=-1)
    angle = 2 * np.arctan2(sine, w)
    return v * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)[..., None]


def _turned(quaternion: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Quaternion turned by a rotation vector in the body's frame."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    share = np.where(angle > 1e-12, np.sin(angle / 2) / np.maximum(angle, 1e-300), 0.5)
    w1, (x1, y1, z1) = np.cos(angle / 2)[..., 0], np.moveaxis(turn * share, -1, 0)
    w0, x0, y0, z0 = np.moveaxis(quaternion, -1, 0)
    return np.stack(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 + y0 * w1 + z0 * x1 - x0 * z1,
            w0 * z1 + z0 * w1 + x0 * y1 - y0 * x1,
        ],
        -1,
    )


def episode_bounds(log: Trajectories) -> list[tuple[int, int]]:
    """Return first and last-plus-one row of every episode."""
    ends = np.flatnonzero(log.terminals) + 1
    return list(zip(np.append(0, ends[:-1]).tolist(), ends.tolist(), strict=True))


def cut_windows(log: Trajectories, observation: Observation, length: int, *, stride: int | None = None) -> Windows:
    """Cut a log into windows of ``length`` logged steps, one every ``stride``.

    By default no two windows share a measurement. They never cross an episode's end; an episode shorter than a window
    gives none.
    """
    bounds, ahead = episode_bounds(log), np.arange(longest_episode(log) + 1)
    commands = np.stack([log.actions[np.minimum(a + ahead, b - 1)] for a, b in bounds])
    observed, following = observation.observed(log.observations), observation.observed(log.next_observations)
    found = []
    for e, (a, b) in enumerate(bounds):
        path = np.concatenate([observed[a : a + 1], following[a:b]])
        slope = np.gradient(path, axis=0)
        starts = range(0, b - a - length + 1, stride or length + 1)
        found += [(path[s : s + length + 1], slope[s], e, s) for s in starts]
    measured, rates, episodes, steps = zip(*found, strict=True) if found else ((), (), (), ())
    return Windows(
        np.reshape(measured, (-1, length + 1, observation.size)),
        np.reshape(rates, (-1, observation.size)) / (log.dt or 1.0),
        np.array(episodes, dtype=int), np.array(steps, dtype=int), commands,
    )  # fmt: skip


def longest_episode(log: Trajectories) -> int:
    """Return the logged steps of the longest episode."""
    return max(b - a for a, b in episode_bounds(log))


def feature_sizes(setting: Setting, columns: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each feature ``(m,)`` over observed columns ``(..., n)``."""
    columns = columns.reshape(-1, columns.shape[-1])
    return Chart.of(setting.observation).difference(columns, columns[:1]).std(0)


def spread(windows: Windows, most: int) -> Windows:
    """Return at most so many windows, evenly spread."""
    if len(windows) <= most:
        return windows
    return windows.select(np.unique(np.linspace(0, len(windows) - 1, most).astype(int)))


def blocks_of(episodes: np.ndarray, least: int) -> np.ndarray:
    """Return blocks of windows ``(W,)`` that count as independent: episodes if there are enough, else tenths."""
    return episodes if len(np.unique(episodes)) >= least else np.arange(len(episodes)) * 10 // max(len(episodes), 1)


def make_setting(problem: Problem, log: Trajectories) -> Setting:
    """Return where effects are looked for: the model, its columns, and the sizes of the log."""
    model, observation = copy.copy(problem.space.model), problem.observation
    assert model is not None
    frame_skip, nq, nv = problem.simulator.frame_skip, model.nq, model.nv
    step = frame_skip * float(model.opt.timestep)
    states, after = observation.states(log.observations), observation.states(log.next_observations)
    rows = np.unique(np.linspace(0, len(states) - 1, SAMPLES).astype(int))
    inertia, force, speed, touches = np.zeros(nv), np.zeros(nv), np.zeros(model.nbody), np.zeros(model.ngeom, bool)
    data, dense, velocity = mujoco.MjData(model), np.zeros((nv, nv)), np.empty(6)
    for row in rows:
        data.qpos[:], data.qvel[:] = states[row, :nq], states[row, nq:]
        data.ctrl[:] = log.actions[row]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, dense)
        inertia += np.diag(dense)
        acceleration = (after[row, nq:] - states[row, nq:]) / step
        force += np.abs(dense @ acceleration) + np.abs(data.qfrc_bias) + np.abs(data.qfrc_actuator)
        for b in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, int(mujoco.mjtObj.mjOBJ_BODY), b, velocity, 0)
            speed[b] += float(np.sum(velocity[3:] ** 2))
        for contact in data.contact[: data.ncon]:
            touches[contact.geom[contact.geom >= 0]] = True
    seen = np.isin(np.arange(nq), observation.columns)
    signals = Signals(
        timestep=step,
        position=np.where(seen[:, None], np.percentile(states[:, :nq], [1, 99], axis=0).T, np.nan),
        speed=np.sqrt(np.mean(states[:, nq:] ** 2, axis=0)),
        force=np.maximum(force / len(rows), 1e-12),
        inertia=inertia / len(rows),
        command=np.abs(log.actions).max(0),
        column=observation.observed(log.observations).std(0),
        linear_speed=np.sqrt(speed / len(rows)),
        contacts=touches,
    )
    masked = frozenset(masked_columns(observation, problem.config.mask))
    return Setting(model, observation, signals, frame_skip, masked)


def start_values(problem: Problem) -> np.ndarray:
    """Declared parameters to begin with: the model's own where they lie in their box, else its middle."""
    space, nominal = problem.space, problem.space.nominal
    inside = (nominal >= space.low) & (nominal <= space.high)  # not where it is NaN
    return np.where(inside, nominal, 0.5 * (space.low + space.high))
