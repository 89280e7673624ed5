"""Many environments that go on from step to step, each with its own parameters and hidden state; MuJoCo's batches."""

from __future__ import annotations

import abc
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import torch

from dropo_torch.effects.placing import EffectSet
from dropo_torch.errors import InputError, choices
from dropo_torch.models.load import quiet_mujoco, show_divergence
from dropo_torch.parameters import ParameterSpace, unmark_frames
from dropo_torch.rl.effects import RowFields, RowForces, RowModels, inside_model, no_effects
from dropo_torch.simulators.mujoco import default_row
from dropo_torch.support.extras import extra


class BatchStepper(abc.ABC):
    """Steps N environments of one model, each under its own parameters.

    Attributes:
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        num_states: width of a state, ``nq + nv``.
    """

    num_envs: int
    frame_skip: int
    num_states: int

    @abc.abstractmethod
    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: torch.Tensor) -> None:
        """Start new episodes in some environments; the others stay as they are.

        Args:
            rows: their numbers, ``(k,)`` int64.
            states: initial states, ``(k, nq + nv)`` float64.
            values: parameter values, ``(k, d)`` float64.

        Raises:
            InputError: values that MuJoCo refuses.
        """

    @abc.abstractmethod
    def step(self, controls: torch.Tensor) -> torch.Tensor:
        """Make an environment step.

        Args:
            controls: S commands, each held for ``frame_skip / S`` physics steps, ``(N, S, nu)`` float64.

        Returns:
            The states after each command ``(N, S, nq + nv)``, float64; not finite, or beyond
            :data:`~dropo_torch.simulators.base.DIVERGED`, where one diverged.
        """

    @abc.abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return all that the next steps depend on, but for the parameters."""

    @abc.abstractmethod
    def load_state_dict(self, state: dict[str, Any], values: torch.Tensor) -> None:
        """Go on from a state of :meth:`state_dict`, with the parameters ``(N, d)`` of all environments."""


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
        effects = effects or no_effects(space, frame_skip)
        model, finer, varies = inside_model(space, effects)
        show_divergence(model)
        unmark_frames(model, space)
        self.num_envs, self.frame_skip, self.num_states = num_envs, frame_skip, model.nq + model.nv
        self._batch = mujoco.batch.Batch(model, num_envs, num_threads)
        self._row = default_row(model)
        self._qpos, self._qvel, self._ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._failed = np.zeros(num_envs, dtype=bool)
        self._models: RowModels | RowFields = (
            RowModels(self._batch, space, effects) if varies else RowFields(self._batch, space.on(model), finer)
        )
        own = self._models.models if isinstance(self._models, RowModels) else None
        self._forces = RowForces(self._batch, effects, own)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: torch.Tensor) -> None:
        """Start new episodes; see :meth:`BatchStepper.reset`."""
        ids = rows.cpu().numpy()
        numbers = values.cpu().numpy()
        self._models.write(ids, numbers)
        self._forces.write(ids, numbers)
        self._batch.state[ids] = self._row
        self._qpos[ids], self._qvel[ids] = np.split(states.cpu().numpy(), [self._qpos.shape[1]], axis=1)
        self._failed[ids] = False
        self._forces.restart(ids, numbers)

    def step(self, controls: torch.Tensor) -> torch.Tensor:
        """Make an environment step; see :meth:`BatchStepper.step`."""
        given = controls.cpu().numpy()
        count = given.shape[1]
        out = np.empty((self.num_envs, count, self.num_states))
        with quiet_mujoco():
            for s in range(count):
                self._ctrl[:] = given[:, s]
                self._advance(self.frame_skip // count)
                np.concatenate([self._qpos, self._qvel], axis=1, out=out[:, s])
        out[self._failed] = np.nan
        return torch.from_numpy(out)

    def _advance(self, steps: int) -> None:
        """Make physics steps of the model's own length under the controls in place."""
        for finer in np.unique(self._models.finer).tolist():
            ids = np.flatnonzero(self._models.finer == finer).astype(np.int32)
            calls, length = (steps * finer, 1) if self._forces.any else (1, steps * finer)
            for _ in range(calls):
                if self._forces.any:
                    self._forces.apply(ids, finer)
                try:
                    self._batch.step(ids, nstep=length)
                except mujoco.batch.SimulationError as error:
                    self._failed[error.ids] = True

    def state_dict(self) -> dict[str, Any]:
        """Return MuJoCo's integration states; see :meth:`BatchStepper.state_dict`."""
        return {name: torch.from_numpy(own.copy()) for name, own in self._kept().items()}

    def load_state_dict(self, state: dict[str, Any], values: torch.Tensor) -> None:
        """Go on from a state; see :meth:`BatchStepper.load_state_dict`."""
        for part in (self._models, self._forces):
            part.write(np.arange(self.num_envs), values.cpu().numpy())
        for name, own in self._kept().items():
            own[:] = state[name].numpy()

    def _kept(self) -> dict[str, np.ndarray]:
        """What the next steps depend on, as live arrays of a row for each environment."""
        kept = {"rows": self._batch.state, "failed": self._failed, "before": self._forces.before}
        return {**kept, "memory": self._forces.memory} if self._forces.memory.size else kept


def make_stepper(
    backend: str, space: ParameterSpace, num_envs: int, *, frame_skip: int, effects: EffectSet | None = None,
    num_threads: int = 0, device: str = "cpu",
) -> BatchStepper:  # fmt: skip
    """Return the stepper of a backend.

    Args:
        backend: ``"mujoco"`` or ``"warp"``.
        space: what varies, over the model that is simulated.
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        effects: effects; the stepper has those inside the simulation.
        num_threads: threads of a CPU, 0 for all processors.
        device: of the ``"warp"`` backend.

    Raises:
        InputError: an unknown backend, a model or an effect that it does not support.
    """
    if backend == "mujoco":
        return MujocoStepper(space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads)
    if backend == "warp":
        with extra("warp", "backend: warp"):
            from dropo_torch.rl.warp_stepper import WarpStepper
        return WarpStepper(
            space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads, device=device
        )
    raise InputError(f"backend: unknown {backend!r} for environments" + choices(backend, ("mujoco", "warp")))
