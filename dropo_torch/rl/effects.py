"""Effects in a batch of environments, each with its own numbers: inside the simulations (other models, forces and
wrenches), and outside them, from step to step (what reaches the actuators, and what the sensors show)."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from typing import Any, Literal

import mujoco
import mujoco.batch
import numpy as np
import torch
from torch.nn.functional import pad

from dropo_torch.data.observation import parse_observation
from dropo_torch.effects.drive import Drive, Drives
from dropo_torch.effects.engine import Force, Forces, Memory, ModelRefused, Variant, VariantEngine
from dropo_torch.effects.filters import extended, filters_of, observed_rates, rate_columns, sensed
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet, Entry, plain_setting
from dropo_torch.effects.simulator import LONGEST_HISTORY, apply_native, finer_steps, overlap
from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive_all
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace, read_field


def no_effects(space: ParameterSpace, frame_skip: int) -> EffectSet:
    """Return an empty set of effects on a space's model."""
    assert space.model is not None
    return EffectSet((), plain_setting(space.model, parse_observation(space.model, None), frame_skip))


def inside_model(space: ParameterSpace, effects: EffectSet) -> tuple[mujoco.MjModel, int, bool]:
    """Return the model with effects that change it.

    Returns:
        A copy of the model, with the effects in it that are the same in every episode; its steps in one of the given
        model's; whether effects change the model from episode to episode.

    Raises:
        InputError: effects whose finer steps do not fill the model's.
    """
    assert space.model is not None
    applied = effects.having("apply")
    own = any(e.varies for e in applied.entries) or overlap(applied, space) is not None
    if own or len(effects.having("force_under")):
        return copy.copy(space.model), 1, True
    model = apply_native(space.model, applied) if len(applied) else copy.copy(space.model)
    return model, finer_steps(space.model, model, applied), False


class RowFields:
    """Writes parameter vectors into some simulations of a batch, and what MuJoCo derives from them.

    Args:
        batch: the batch.
        space: the parameters, over the batch's model.
        finer: steps of the batch's model in one of the given model's.

    Attributes:
        finer: the same for every simulation, ``(N,)``.
    """

    def __init__(self, batch: mujoco.batch.Batch, space: ParameterSpace, finer: int) -> None:
        self._batch, self._space = batch, space
        for field in space.fields:
            batch.expand(field)
        if space.fields:
            derive_all(batch, batch.model)  # what it derives becomes each simulation's own, too
        own = [f for f in sorted(mujoco.batch.MODEL_FIELDS) if batch.expanded(f) is not None]
        self._fields = {f: batch.expand(f) for f in own if read_field(batch.model, f).dtype.kind == "f"}
        self._shared = {f: read_field(batch.model, f).copy() for f in self._fields}
        self.finer = np.full(batch.nsim, finer)

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the values ``(k, d)``; the others are untouched."""
        if not self._fields:
            return
        fresh = {f: np.repeat(self._shared[f][None], len(ids), 0) for f in self._space.fields}
        self._space.write(fresh, values)
        for field, own in self._fields.items():  # whatever an earlier call derived starts afresh
            own[ids] = fresh.get(field, self._shared[field])
        try:
            with quiet_mujoco():
                derive_all(self._batch, self._batch.model, ids)
        except mujoco.batch.SimulationError as error:
            row = int(np.flatnonzero(ids == error.ids[0])[0])
            raise _refused(self._space, values[row], self._batch.error(int(error.ids[0]))) from None


class RowModels:
    """Gives some simulations of a batch the models of parameter vectors, effects included.

    Args:
        batch: the batch, of the model without effects.
        space: the parameters.
        effects: the effects.

    Attributes:
        models: of each simulation.
        finer: steps of each simulation's model in one of the given model's, ``(N,)``.
    """

    def __init__(self, batch: mujoco.batch.Batch, space: ParameterSpace, effects: EffectSet) -> None:
        self._batch, self._space, self._effects = batch, space, effects
        self._engine = VariantEngine(effects.setting, space, num_threads=1)
        self.models = [batch.model] * batch.nsim
        self.finer = np.ones(batch.nsim, dtype=int)

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the models of values ``(k, d)``; the others are untouched."""
        for row, vector in zip(ids, values, strict=True):
            try:
                self.models[row] = self._engine.model(Variant(tuple(vector.tolist()), self._effects.at(vector)))
            except ModelRefused as error:
                raise _refused(self._space, vector, str(error)) from None
            self.finer[row] = finer_steps(self._effects.setting.model, self.models[row], self._effects)
        self._batch.set_models(self.models)


def _refused(space: ParameterSpace, values: np.ndarray, reason: str) -> InputError:
    named = ", ".join(f"{n} {v:g}" for n, v in space.named(values).items())
    return InputError(f"distribution: MuJoCo refuses {named}: {reason}; narrow the distribution or give limits")


class RowForces:
    """Forces that depend on the state, and constant wrenches, of effects with numbers of each simulation's own.

    Args:
        batch: the batch.
        effects: the effects.
        models: of each simulation, where they have their own; needed by forces that depend on the actuators'.

    Attributes:
        any: whether there are forces that depend on the state.
        before: velocities one physics step ago, ``(N, nv)``.
        memory: what the forces remember, ``(N, k)``.
    """

    def __init__(
        self, batch: mujoco.batch.Batch, effects: EffectSet, models: Sequence[mujoco.MjModel] | None = None
    ) -> None:
        self._models, self._drives = models, None
        if models is not None and len(effects.having("force_under")):
            self._drives, self._ctrl = Drives.of(models), batch.bind("ctrl")
        self._setting, self._forces = effects.setting, Forces(effects.setting)
        self._entries, self._wrenches = (effects.having(method).entries for method in ("force", "wrench"))
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._force, self._wrench = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        self._values = [np.full((batch.nsim, len(e.fixed)), e.fixed) for e in self._entries]
        self.any = bool(self._entries)
        self.before = np.zeros_like(self._qvel)
        remembered = [self._recalled(e, own) for e, own in zip(self._entries, self._values, strict=True)]
        self.memory = np.concatenate([np.zeros((batch.nsim, 0)), *remembered], 1)
        ends = np.cumsum([0, *(part.shape[1] for part in remembered)]).tolist()
        self._parts = [self.memory[:, a:b] for a, b in itertools.pairwise(ends)]

    def _recalled(self, entry: Entry, values: np.ndarray, ids: np.ndarray | slice = slice(None)) -> np.ndarray:
        """What a force remembers where episodes begin in the states in place, ``(k, n)``."""
        return entry.effect.recall(self._setting, entry.target, values, self._qpos[ids], self._qvel[ids])

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the numbers in values ``(k, d)``."""
        for entry, own in zip(self._entries, self._values, strict=True):
            own[ids] = entry.values(values)
        if self._drives is not None and self._models is not None:
            self._drives.numbers[:, ids] = Drives.of([self._models[i] for i in ids]).numbers

    def restart(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Begin episodes in simulations whose states have just been set, with values ``(k, d)``."""
        self.before[ids] = self._qvel[ids]
        for entry, own, part in zip(self._entries, self._values, self._parts, strict=True):
            part[ids] = self._recalled(entry, own[ids], ids)
        for row, vector in zip(ids, values, strict=True) if self._wrenches else ():
            self._wrench[row] = sum(
                e.effect.wrench(self._setting, e.target, e.values(vector[None])[0]) for e in self._wrenches
            )

    def apply(self, ids: np.ndarray, finer: int) -> None:
        """Set the forces that act in the next physics step of simulations ``ids``."""
        step, velocity = float(self._setting.model.opt.timestep) / finer, self._qvel[ids]
        acting = [
            Force(e.effect, e.target, own[ids] if e.varies else own[:1], slice(None), Memory(part[ids]))
            for e, own, part in zip(self._entries, self._values, self._parts, strict=True)
        ]
        drive = None
        if self._drives is not None:
            drive = Drive(self._drives, self._ctrl, step).at(ids)
        self._force[ids] = self._forces(acting, self._qpos[ids], velocity, self.before[ids], step, drive)
        for force, part in zip(acting, self._parts, strict=True):
            part[ids] = force.memory.now
        self.before[ids] = velocity


class RowFilters:
    """The effects on commands, or on measurements; every environment has its own numbers.

    Args:
        effects: the effects, of which those with the method count.
        method: ``"command"`` or ``"sense"``.
        num_envs: environments N.
        device: of the numbers.
    """

    def __init__(
        self, effects: EffectSet, method: Literal["command", "sense"], num_envs: int, device: torch.device
    ) -> None:
        setting = effects.setting
        self._acting = effects.having(method)
        self._skip, self._step = setting.frame_skip, float(setting.model.opt.timestep)
        zeros = torch.zeros(num_envs, 0, dtype=torch.float64, device=device)
        self._values = [zeros.new_zeros(num_envs, len(e.fixed)) for e in self._acting.entries]
        acting = zip(self._acting.entries, self._values, strict=True)
        self._filters = filters_of(((e.effect, e.target, own) for e, own in acting), method, setting)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._filters)

    def _write(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Give environments ``rows`` the numbers in parameter vectors ``(k, d)``."""
        for entry, own in zip(self._acting.entries, self._values, strict=True):
            own[rows] = torch.from_numpy(entry.values(values)).to(own.device)


class Commands(RowFilters):
    """All effects on commands. An episode begins with the filters settled at its first command.

    Args:
        effects: the effects, of which those on commands count.
        num_envs: environments N.
        device: of the commands.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, device: torch.device) -> None:
        super().__init__(effects, "command", num_envs, device)
        self._states = [f.values[:, :0] for f in self._filters]
        self._fresh = torch.ones(num_envs, 1, dtype=torch.bool, device=device)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` with parameter vectors ``(k, d)``."""
        self._write(rows, values)
        self._fresh[rows] = True

    def __call__(self, controls: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip, nu)`` as they act, of an environment step's controls ``(N, S, nu)`` in a row."""
        signals = controls.repeat_interleave(self._skip // controls.shape[1], 1)
        any_fresh = bool(self._fresh.any())
        for i, f in enumerate(self._filters):
            signal, state = signals[:, :, f.column], self._states[i]
            if any_fresh:
                settled = f.effect.settled(signal[:, :1], f.values, self._step)
                kept = pad(state, (settled.shape[1] - state.shape[1], 0))  # of states, the last entries count
                state = torch.where(self._fresh, settled, kept)
            signals[:, :, f.column], self._states[i] = f.effect.command(signal, f.values, self._step, state)
        self._fresh = torch.zeros_like(self._fresh)
        return signals

    def state_dict(self) -> dict[str, Any]:
        """Return the filters' states."""
        return {"fresh": self._fresh.clone(), "memory": [state.clone() for state in self._states]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from states; the numbers have been given by :meth:`reset`."""
        self._states = [saved.to(self._fresh.device, copy=True) for saved in state["memory"]]
        self._fresh = state["fresh"].to(self._fresh.device, copy=True)


class Sensors(RowFilters):
    """Shows the states of N environments as their sensors do.

    Before an episode's start, as far as a late sensor looks back, an environment has moved with its initial velocity.

    Args:
        effects: the effects, of which those on sensors count.
        num_envs: environments N.
        space: the parameters.
        device: of the states.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, space: ParameterSpace, device: torch.device) -> None:
        super().__init__(effects, "sense", num_envs, device)
        setting = effects.setting
        self._index = torch.from_numpy(setting.observation.index).to(device)
        late = self._acting.look_back(space)
        steps = math.ceil(late / (self._step * self._skip) - 1e-9) if late < math.inf else LONGEST_HISTORY
        window = min(steps, LONGEST_HISTORY) * self._skip + self._skip + 1
        self._rates, self._rate_of = observed_rates(setting), torch.from_numpy(rate_columns(setting.model)).to(device)
        self._past = torch.zeros(num_envs, window, len(self._index), dtype=torch.float64, device=device)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` at true states ``(k, nq + nv)``, with values ``(k, d)``."""
        self._write(rows, values)
        rates = torch.where(self._rate_of >= 0, states[:, self._rate_of], 0.0)[:, self._index]
        start = states[:, None, self._index]
        self._past[rows] = extended(start, rates, 0.0, self._past.shape[1] - 1, self._step)

    def record(self, fine: torch.Tensor) -> None:
        """Take in true states ``(N, skip, nq + nv)`` after each physics step."""
        self._past = torch.cat([self._past[:, fine.shape[1] :], fine[..., self._index]], 1)

    def show(self, states: torch.Tensor) -> torch.Tensor:
        """Return true states ``(N, nq + nv)`` with what the sensors show of them now in their places."""
        shown = states.clone()
        path = SensedPath.of(self._past, 1, self._skip, self._step, self._rates)
        shown[:, self._index] = sensed(path, self._filters)[:, 0]
        return shown

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what the sensors remember."""
        return {"past": self._past.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a memory; the numbers have been given by :meth:`reset`."""
        self._past = state["past"].to(self._past.device, copy=True)
