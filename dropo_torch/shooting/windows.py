"""Windows of a log whose states are unknown, and their simulation from states that are tried."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.data.observation import Observation, parse_observation
from dropo_torch.data.trajectory import horizon_of, make_transitions, measured_path
from dropo_torch.distribution import SearchBox
from dropo_torch.problem import Problem
from dropo_torch.simulators.base import Simulator
from dropo_torch.support.threads import single_thread

_JOINT = mujoco.mjtJoint
#: Logged steps of a window, about, where ``lag`` says nothing.
LENGTH = 10


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of H logged steps, and what simulates them.

    A state of a window has *moves*: s numbers by which it is changed, those of its plain columns and rotation vectors
    for its orientations, in units of :attr:`sizes`.

    Attributes:
        simulator: its states are extended by ``sensordata``.
        observation: what the log's columns are.
        features: what of them is compared, m features.
        box: of the parameters.
        controls: those of the windows, after those of ``history`` steps before, ``(W, history + H, nu)``.
        measured: observed columns after each step, ``(W, H, n)``.
        starts: the log's states at the starts, with the model's defaults for what it does not show, ``(W, nq + nv)``.
        follows: whether a window begins where the one before ends, ``(W,)`` bool.
        rows: row of the log at which each starts, ``(W,)``.
        episodes: episode of each, ``(W,)``.
        chunk_size: simulations at a time.
    """

    simulator: Simulator
    observation: Observation
    features: Features
    box: SearchBox
    controls: np.ndarray
    measured: np.ndarray
    starts: np.ndarray
    follows: np.ndarray
    rows: np.ndarray
    episodes: np.ndarray
    chunk_size: int

    @classmethod
    def of(cls, problem: Problem) -> Windows:
        """Cut a problem's log into windows that follow on each other."""
        log, objective, lag = problem.trajectories, problem.objective, problem.config.lag
        assert problem.space.model is not None
        steps = horizon_of(log, lag if lag > 1 else LENGTH, problem.since)
        history = problem.simulator.history
        cut = make_transitions(log, problem.observation, lag=steps, history=history, since=problem.since)
        follows = (np.diff(cut.rows) == steps) & (np.diff(cut.episodes) == 0)
        width = problem.simulator.num_states - problem.space.model.nsensordata
        return cls(
            problem.simulator, problem.observation, objective.features, objective.box, cut.controls,
            measured_path(log, problem.observation, cut), cut.states[:, :width],
            np.append(False, follows), cut.rows, cut.episodes, problem.config.chunk_size,
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of windows W."""
        return len(self.measured)

    @property
    def model(self) -> mujoco.MjModel:
        """The model."""
        return self.simulator.parameters.model

    @property
    def length(self) -> int:
        """Logged steps H of a window."""
        return int(self.measured.shape[1])

    @cached_property
    def chart(self) -> Features:
        """The moves of a state."""
        return Features.of(parse_observation(self.model, None))

    @cached_property
    def sizes(self) -> np.ndarray:
        """What counts as a large change of each move, ``(s,)``: a rad, a body or half a range; that within a window."""
        model, time = self.model, self.length * (self.simulator.timestep or 1.0)
        position, speed = np.ones(model.nq), np.ones(model.nv)
        for kind, first, dof, limited, ends in zip(
            model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, model.jnt_limited, model.jnt_range, strict=True
        ):
            count = {int(_JOINT.mjJNT_FREE): 3, int(_JOINT.mjJNT_BALL): 0}.get(int(kind), 1)
            size = 1.0 if kind == _JOINT.mjJNT_HINGE else float(model.stat.meansize)
            size = min(size, 0.5 * float(np.ptp(ends))) if limited and kind != _JOINT.mjJNT_BALL else size
            position[first : first + count] = speed[dof : dof + count] = size
        plain = np.concatenate([position, speed / time])[list(self.chart.plain)]
        return np.concatenate([plain, np.ones(3 * len(self.chart.quaternions))])

    def moved(self, states: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Return states ``(..., nq + nv)`` changed by moves ``(..., s)``."""
        return self.chart.move(states, np.broadcast_to(moves * self.sizes, (*states.shape[:-1], len(self.sizes))))

    def between(self, end: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return the moves ``(..., s)`` that lead from states ``start`` to ``end``, ``(..., nq + nv)`` each."""
        return self.chart.difference(end, start) / self.sizes

    def paths(self, rows: np.ndarray, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Simulate windows, ``(R,)``, from states ``(R, M, nq + nv)`` under parameters ``(K, d)``, in units.

        Returns:
            Extended states after each step, ``(R, M, K, H, num_states)``; NaN where one diverges.
        """
        num_m = states.shape[1]
        full = np.zeros((states[..., 0].size, self.simulator.num_states))
        full[:, : states.shape[-1]] = states.reshape(-1, states.shape[-1])
        with single_thread():
            path = self.simulator.rollout(full, np.repeat(self.controls[rows], num_m, axis=0), values).numpy()
        return path.reshape(len(rows), num_m, *path.shape[1:])

    def residuals(self, rows: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """Return measured minus simulated features of paths ``(R, ..., H, num_states)``, ``(R, ..., H, m)``."""
        columns = paths[..., self.observation.index]
        between = (1,) * (paths.ndim - 3)
        measured = self.measured[rows].reshape(len(rows), *between, *self.measured.shape[1:])
        with np.errstate(invalid="ignore"):
            return self.features.difference(np.broadcast_to(measured, columns.shape), columns)

    def blocks(self, simulations: int) -> Iterator[np.ndarray]:
        """Return the windows, ``(R,)`` at a time, of each of which so many simulations are held at once."""
        step = max(1, self.chunk_size // simulations)
        return (np.arange(a, min(a + step, len(self))) for a in range(0, len(self), step))
