"""Environments on MuJoCo's own batches."""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import torch

from dropo_torch.effects.placing import EffectSet
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace, unmark_frames
from dropo_torch.rl.batch_stepper import BatchStepper
from dropo_torch.rl.inside import RowFields, RowForces, RowModels, inside_model
from dropo_torch.simulators.mujoco import default_row


class MujocoStepper(BatchStepper):
    """Environments on ``mujoco.batch``: bit-identical to ``mj_step`` of one simulation each, at any thread count.

    An episode starts as ``mj_resetData`` leaves a simulation (cold solver, empty actuators and delays); from then on
    all of MuJoCo's own state is kept between steps.

    Args:
        space: what varies, over the model that is simulated.
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        effects: effects, of which those inside the simulation are applied here.
        num_threads: threads, 0 for all processors; results do not depend on it.
    """

    def __init__(
        self, space: ParameterSpace, num_envs: int, *, frame_skip: int, effects: EffectSet | None = None,
        num_threads: int = 0,
    ) -> None:  # fmt: skip
        assert space.model is not None
        inside = inside_model(space, effects)
        model = inside.model
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a divergence must show
        unmark_frames(model, space)
        self.num_envs, self.frame_skip, self.num_states = num_envs, frame_skip, model.nq + model.nv
        self._batch = mujoco.batch.Batch(model, num_envs, num_threads)
        self._row = default_row(model)
        self._states = _adjacent(self._batch, "qpos", "qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._failed = np.zeros(num_envs, dtype=bool)
        self._models: RowModels | RowFields = (
            RowModels(self._batch, space, effects)
            if inside.varies and effects is not None
            else RowFields(self._batch, space.on(model), inside.finer)
        )
        self._forces = RowForces(self._batch, effects) if effects is not None else None

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: torch.Tensor) -> None:
        """Start new episodes; see :meth:`BatchStepper.reset`."""
        ids = rows.cpu().numpy()
        self._set_parameters(ids, values.cpu().numpy())
        self._batch.state[ids] = self._row
        self._states[ids] = states.cpu().numpy()
        self._failed[ids] = False
        if self._forces is not None:
            self._forces.restart(ids)

    def step(self, controls: torch.Tensor) -> torch.Tensor:
        """Make an environment step; see :meth:`BatchStepper.step`."""
        given = controls.cpu().numpy()
        count = given.shape[1]
        out = np.empty((self.num_envs, count, self.num_states))
        with quiet_mujoco():
            for s in range(count):
                self._ctrl[:] = given[:, s]
                self._advance(self.frame_skip // count)
                out[:, s] = self._states
        if self._failed.any():
            out[self._failed] = np.nan
        return torch.from_numpy(out)

    def _advance(self, steps: int) -> None:
        """Make physics steps of the model's own length under the controls in place."""
        forces = self._forces if self._forces is not None and self._forces.any else None
        for ids, finer in self._models.groups():
            for _ in range(1 if forces is None else steps * finer):
                if forces is not None:
                    forces.apply(ids, finer)
                try:
                    self._batch.step(ids, nstep=steps * finer if forces is None else 1)
                except mujoco.batch.SimulationError as error:
                    self._failed[error.ids] = True

    def _set_parameters(self, ids: np.ndarray, values: np.ndarray) -> None:
        self._models.write(ids, values)
        if self._forces is not None:
            self._forces.write(ids, values)

    def state_dict(self) -> dict[str, Any]:
        """Return MuJoCo's integration states; see :meth:`BatchStepper.state_dict`."""
        out = {"rows": torch.from_numpy(self._batch.state.copy()), "failed": torch.from_numpy(self._failed.copy())}
        if self._forces is not None:
            out["before"] = torch.from_numpy(self._forces.before.copy())
        return out

    def load_state_dict(self, state: dict[str, Any], values: torch.Tensor) -> None:
        """Go on from a state; see :meth:`BatchStepper.load_state_dict`."""
        self._set_parameters(np.arange(self.num_envs), values.cpu().numpy())
        self._batch.state[:] = state["rows"].numpy()
        self._failed[:] = state["failed"].numpy()
        if self._forces is not None:
            self._forces.before[:] = state["before"].numpy()


def _adjacent(batch: mujoco.batch.Batch, first: str, second: str) -> np.ndarray:
    """Two neighbouring components of the state as one live array, ``(N, n)``."""
    left, right = batch.bind(first), batch.bind(second)
    start = (left.__array_interface__["data"][0] - batch.state.__array_interface__["data"][0]) // 8
    assert right.__array_interface__["data"][0] == left.__array_interface__["data"][0] + 8 * left.shape[1]
    return batch.state[:, start : start + left.shape[1] + right.shape[1]]
