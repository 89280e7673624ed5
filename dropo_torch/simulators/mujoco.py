"""The black-box backend: MuJoCo itself, many simulations as one ``mujoco.batch``."""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive_all
from dropo_torch.models.load import load_model, quiet_mujoco, show_divergence
from dropo_torch.parameters import ParameterSpace, read_field, unmark_frames
from dropo_torch.simulators.base import DIVERGED, Numbers, Simulator
from dropo_torch.simulators.hidden import POSE, filters_of, prescribed_bodies


class MujocoSimulator(Simulator):
    """Transitions on ``mujoco.batch``: bit-identical to ``mj_step``, at any thread count.

    Rows of the batch are pairs (transition, parameter vector), in chunks of at most ``chunk_size``, so
    that memory does not grow with T·K. The constants that MuJoCo derives from masses and geometry
    (``mj_setConst``) are computed once a parameter vector. Each transition starts from a cold solver
    (``qacc_warmstart`` zero), whatever ran before.

    Args:
        model: the model or its path.
        parameters: what varies; a space over this model.
        frame_skip: physics steps of one logged transition.
        num_threads: threads, 0 for all processors.
        chunk_size: rows that are simulated at once.
        history: logged steps before each transition whose controls come with it, ``(T, history + lag, ·)``: first-order
            filters of actuators are replayed over them. Without history, filters start settled at the first control.
        sensors: whether states are extended by ``sensordata``, ``[qpos, qvel, sensordata]``: its values in the state
            after a transition, under the control that led there. Those of initial states are not read.

    Controls of a model with mocap bodies that act on something are its ``nu`` controls and then the pose of each such
    body, position and quaternion ``(w, x, y, z)``, held throughout the transition.

    Raises:
        InputError: a model whose actuators have a hidden state that no log holds.
    """

    name = "mujoco"

    def __init__(
        self,
        model: mujoco.MjModel | str | Path,
        *,
        parameters: ParameterSpace,
        frame_skip: int = 1,
        num_threads: int = 0,
        chunk_size: int = 10_000,
        history: int = 0,
        sensors: bool = False,
    ) -> None:
        model = load_model(model)
        if frame_skip < 1 or chunk_size < 1:
            raise InputError(f"frame_skip {frame_skip}, chunk_size {chunk_size}: both must be 1 or more")
        self.model = show_divergence(copy.copy(model))
        unmark_frames(self.model, parameters)
        self.parameters = parameters
        self.frame_skip = int(frame_skip)
        self._sensors = sensors
        self.num_states = model.nq + model.nv + sensors * model.nsensordata
        self._mocap = model.body_mocapid[prescribed_bodies(model)]
        self.num_controls = model.nu + POSE * len(self._mocap)
        self.history = int(history)
        self.timestep = float(model.opt.timestep) * self.frame_skip
        self._num_threads = num_threads
        self._chunk_size = int(chunk_size)
        self._filters = filters_of(model)
        self._row = default_row(self.model)
        self._batch: mujoco.batch.Batch | None = None
        self._tiled: tuple[np.ndarray, int] | None = None  # the values that the batch's fields hold, and their repeats
        self._constants: mujoco.batch.Batch | None = None

    def simulate(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after ``lag`` transitions; see :meth:`Simulator.simulate`."""
        return self._run(states, controls, values, slice(-1, None))[:, :, 0]

    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each transition; see :meth:`Simulator.rollout`."""
        return self._run(states, controls, values, slice(None))

    def _run(self, states: Numbers, controls: Numbers, values: Numbers, kept: slice) -> torch.Tensor:
        start, control, vectors = self.arrays(states, controls, values)
        num_t, num_k, lag = len(start), len(vectors), control.shape[1] - self.history
        out = np.empty((num_t, num_k, len(range(lag)[kept]), self.num_states))
        for k in range(0, num_k, self._chunk_size):
            part = vectors[k : k + self._chunk_size]
            rows = max(1, min(num_t, self._chunk_size // len(part)))
            failed = self._set_parameters(part, rows)
            for t in range(0, num_t, rows):
                block = slice(t, t + rows)
                out[block, k : k + len(part)] = self._step(start[block], control[block], len(part))[:, :, kept]
            out[:, k : k + len(part)][:, failed] = np.nan
        return torch.from_numpy(out)

    def _set_parameters(self, vectors: np.ndarray, repeats: int) -> np.ndarray:
        """Give the batch's rows their parameters, ``repeats`` times over; return which vectors MuJoCo refuses."""
        failed = np.zeros(len(vectors), dtype=bool)
        num_rows = repeats * len(vectors)
        if self._batch is None or self._batch.nsim < num_rows:
            self._batch = mujoco.batch.Batch(self.model, num_rows, self._num_threads)
            self._tiled = None
        if self._tiled is not None and self._tiled[1] >= repeats and np.array_equal(self._tiled[0], vectors):
            return failed
        if self._constants is None or self._constants.nsim != len(vectors):
            self._constants = mujoco.batch.Batch(self.model, len(vectors), self._num_threads)
        constants = self._constants
        for field in _own_values(constants):  # whatever an earlier call derived starts afresh
            constants.expand(field)[:] = read_field(self.model, field)
        self.parameters.write({f: constants.expand(f) for f in self.parameters.fields}, vectors)
        try:
            with quiet_mujoco():
                derive_all(constants, self.model)
        except mujoco.batch.SimulationError as error:
            failed[error.ids] = True
        self._tiled = None if failed.any() else (vectors.copy(), repeats)
        for field, own in _own_values(constants).items():
            shared = read_field(self.model, field)
            if self._batch.expanded(field) is not None or (own != shared).any():
                rows = self._batch.expand(field)[:num_rows]
                rows.reshape(repeats, len(vectors), *shared.shape)[:] = own.reshape(len(vectors), *shared.shape)
        return failed

    def _step(self, start: np.ndarray, control: np.ndarray, num_k: int) -> np.ndarray:
        """Simulate ``len(start)`` transitions under each of the ``num_k`` parameter vectors that the batch holds."""
        batch = self._batch
        assert batch is not None
        model, num_rows, lag = self.model, len(start) * num_k, control.shape[1] - self.history

        def field(name: str) -> np.ndarray:
            return batch.bind(name)[:num_rows]

        ids = np.arange(num_rows, dtype=np.int32)
        batch.state[:num_rows] = self._row
        qpos, qvel, ctrl = field("qpos"), field("qvel"), field("ctrl")
        shown, stage = [qpos, qvel], mujoco.mjtStage.mjSTAGE_NONE
        if self._sensors:
            shown, stage = [*shown, field("sensordata")], mujoco.mjtStage.mjSTAGE_ACC
        qpos[:] = np.repeat(start[:, : model.nq], num_k, axis=0)
        qvel[:] = np.repeat(start[:, model.nq : model.nq + model.nv], num_k, axis=0)
        if len(self._filters):
            field("act")[:, self._filters.activations] = self._activations(control, num_k)
        control = control[:, self.history :]
        out = np.empty((num_rows, lag, self.num_states))
        failed = np.zeros(num_rows, dtype=bool)
        for step in range(lag):
            now = np.repeat(control[:, step], num_k, axis=0)
            ctrl[:] = now[:, : model.nu]
            if len(self._mocap):
                poses = now[:, model.nu :].reshape(num_rows, -1, POSE)
                field("mocap_pos").reshape(num_rows, -1, 3)[:, self._mocap] = poses[..., :3]
                field("mocap_quat").reshape(num_rows, -1, 4)[:, self._mocap] = poses[..., 3:]
            try:
                with quiet_mujoco():
                    batch.step(ids, nstep=self.frame_skip, stage=stage)
            except mujoco.batch.SimulationError as error:
                failed[error.ids] = True
            np.concatenate(shown, axis=1, out=out[:, step])
        failed |= ~(np.abs(out) < DIVERGED).all(axis=(1, 2))
        out[failed] = np.nan
        return out.reshape(len(start), num_k, *out.shape[1:])

    def _activations(self, control: np.ndarray, num_k: int) -> np.ndarray:
        """Return the filters' activations before the controls of the transitions, ``(rows, F)``."""
        filters = self._filters
        if not self.history:
            return np.repeat(filters.settled(self.model, control[:, 0]), num_k, axis=0)
        assert self._batch is not None
        own = self._batch.expanded("actuator_dynprm")
        constants = self.model.actuator_dynprm[filters.actuators, 0]
        if own is not None:
            constants = own[: len(control) * num_k].reshape(-1, *self.model.actuator_dynprm.shape)[
                :, filters.actuators, 0
            ]
        repeated = np.repeat(control[:, : self.history], num_k if own is not None else 1, axis=0)
        found = filters.replayed(self.model, repeated, self.frame_skip, constants)
        return found if own is not None else np.repeat(found, num_k, axis=0)


def _own_values(batch: mujoco.batch.Batch) -> dict[str, np.ndarray]:
    """Real-valued model fields that hold a value per simulation in this batch, ``(nsim, ...)``."""
    found = {field: batch.expanded(field) for field in sorted(mujoco.batch.MODEL_FIELDS)}
    return {field: own for field, own in found.items() if own is not None and own.dtype.kind == "f"}


def default_row(model: mujoco.MjModel) -> np.ndarray:
    """The integration state of a simulation that has just been reset, ``(nstate,)``."""
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    row = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, mujoco.MjData(model), row, spec)
    return row
