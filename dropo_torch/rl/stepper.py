"""Many environments that go on from step to step, each with its own parameters and hidden state."""

from __future__ import annotations

import abc
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import torch

from dropo_torch.effects.placing import EffectSet
from dropo_torch.errors import InputError, choices
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace, read_field, unmark_frames
from dropo_torch.rl.inside import Forces, RowModels, inside_model
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.mujoco import default_row
from dropo_torch.support.extras import extra

BACKENDS = ("mujoco", "warp")


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
            states: start states, ``(k, nq + nv)`` float64.
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
        self._groups = [(np.arange(num_envs, dtype=np.int32), inside.finer)]
        self._writer: RowFields | RowModels | None = None
        if inside.varies:
            assert effects is not None
            self._writer = RowModels(self._batch, space, effects)
        elif space.fields:
            self._writer = RowFields(self._batch, space.on(model))
        self._forces = Forces(self._batch, space, effects) if effects is not None else None

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
        forced = self._forces is not None and self._forces.any
        for ids, finer in self._groups:
            for _ in range(steps * finer if forced else 1):
                if forced:
                    assert self._forces is not None
                    self._forces.apply(ids, finer)
                try:
                    self._batch.step(ids, nstep=1 if forced else steps * finer)
                except mujoco.batch.SimulationError as error:
                    self._failed[error.ids] = True

    def _set_parameters(self, ids: np.ndarray, values: np.ndarray) -> None:
        if isinstance(self._writer, RowFields):
            self._writer.write(ids, values)
        elif self._writer is not None:
            self._writer.write(ids, values)
            self._groups = self._writer.groups()
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


class RowFields:
    """Writes parameter vectors into some simulations of a batch, and what MuJoCo derives from them.

    Args:
        batch: the batch.
        space: the parameters, over the batch's model.
    """

    def __init__(self, batch: mujoco.batch.Batch, space: ParameterSpace) -> None:
        self._batch, self._space = batch, space
        self._fields = {f: batch.expand(f) for f in derived_fields(batch.model, space)}
        self._shared = {f: read_field(batch.model, f).copy() for f in self._fields}

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the values ``(k, d)``; the others are untouched."""
        fresh = {f: np.repeat(self._shared[f][None], len(ids), 0) for f in self._space.fields}
        self._space.write(fresh, values)
        for field, own in self._fields.items():  # whatever an earlier call derived starts afresh
            own[ids] = fresh.get(field, self._shared[field])
        try:
            with quiet_mujoco():
                self._batch.set_const(ids.astype(np.int32))
        except mujoco.batch.SimulationError as error:
            row = int(np.flatnonzero(ids == error.ids[0])[0])
            raise _refused(self._space, values[row], self._batch.error(int(error.ids[0]))) from None


def _refused(space: ParameterSpace, values: np.ndarray, reason: str) -> InputError:
    named = ", ".join(f"{n} {v:g}" for n, v in space.named(values).items())
    return InputError(f"distribution: MuJoCo refuses {named}: {reason}; narrow the distribution or give limits")


def derived_fields(model: mujoco.MjModel, space: ParameterSpace) -> list[str]:
    """Return the real-valued model fields that the parameters write, and those that ``mj_setConst`` then does."""
    probe = mujoco.batch.Batch(model, 1, 1)
    for field in space.fields:
        probe.expand(field)
    probe.set_const()
    return [
        f
        for f in sorted(mujoco.batch.MODEL_FIELDS)
        if probe.expanded(f) is not None and read_field(model, f).dtype.kind == "f"
    ]


def _adjacent(batch: mujoco.batch.Batch, first: str, second: str) -> np.ndarray:
    """Two neighbouring components of the state as one live array, ``(N, n)``."""
    left, right = batch.bind(first), batch.bind(second)
    start = (left.__array_interface__["data"][0] - batch.state.__array_interface__["data"][0]) // 8
    assert right.__array_interface__["data"][0] == left.__array_interface__["data"][0] + 8 * left.shape[1]
    return batch.state[:, start : start + left.shape[1] + right.shape[1]]


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
    raise InputError(f"backend: unknown {backend!r} for environments" + choices(backend, BACKENDS))


__all__ = ["BACKENDS", "DIVERGED", "BatchStepper", "MujocoStepper", "make_stepper"]
