"""Effects inside the simulations of a batch: other models, forces and wrenches, each row with its own numbers."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np

from dropo_torch.effects.base import Effect
from dropo_torch.effects.placing import EffectSet
from dropo_torch.effects.simulator import apply_native, finer_steps, overlap
from dropo_torch.effects.twin import Middle, Twin, Variant
from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field


@dataclass(frozen=True)
class Inside:
    """The model that is simulated, and how.

    Attributes:
        model: a copy of the model, with the effects in it that are the same in every episode.
        finer: its steps in one of the given model's.
        varies: whether effects change the model from episode to episode.
    """

    model: mujoco.MjModel
    finer: int
    varies: bool


def inside_model(space: ParameterSpace, effects: EffectSet | None) -> Inside:
    """Return the model with effects that change it.

    Raises:
        InputError: effects whose finer steps do not fill the model's.
    """
    assert space.model is not None
    applied = None if effects is None else effects.matching(lambda e: type(e).apply is not Effect.apply)
    if applied is None or not len(applied):
        return Inside(copy.copy(space.model), 1, False)
    if any(e.varies for e in applied.entries) or overlap(applied, space) is not None:
        return Inside(copy.copy(space.model), 1, True)
    model = apply_native(space.model, applied)
    return Inside(model, finer_steps(space.model, model, applied), False)


class RowModels:
    """Writes the models of parameter vectors, effects included, into some simulations of a batch.

    Args:
        batch: the batch, of the model without effects.
        space: the parameters.
        effects: the effects.
    """

    #: Parameter vectors at which the changed fields are looked for, beside the corners of the bounds.
    PROBES = 8

    def __init__(self, batch: mujoco.batch.Batch, space: ParameterSpace, effects: EffectSet) -> None:
        self._space, self._effects = space, effects
        self._twin = Twin(effects.setting, space, num_threads=1)
        self._base = effects.setting.model
        drawn = np.random.default_rng(0).uniform(space.low, space.high, (self.PROBES, len(space)))
        models = [self._model(v) for v in (space.low, 0.5 * (space.low + space.high), space.high, *drawn)]
        self._finer = np.ones(batch.nsim, dtype=int)
        self._fields = {f: batch.expand(f) for f in _changed(self._base, models)}

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the models of values ``(k, d)``; the others are untouched."""
        for row, vector in zip(ids, values, strict=True):
            model = self._model(vector)
            self._finer[row] = finer_steps(self._base, model, self._effects)
            for field, own in self._fields.items():
                own[row] = read_field(model, field)

    def groups(self) -> list[tuple[np.ndarray, int]]:
        """Return simulations with steps of the same length, and how many of them make one of the model's."""
        return [(np.flatnonzero(self._finer == n).astype(np.int32), int(n)) for n in np.unique(self._finer)]

    def _model(self, vector: np.ndarray) -> mujoco.MjModel:
        try:
            return self._twin.model(Variant(tuple(vector.tolist()), self._effects.at(vector)))
        except ValueError as error:
            named = ", ".join(f"{n} {v:g}" for n, v in self._space.named(vector).items())
            raise InputError(
                f"distribution: MuJoCo refuses {named}: {error}; narrow the distribution or give limits"
            ) from None


def _changed(base: mujoco.MjModel, models: list[mujoco.MjModel]) -> list[str]:
    """Fields that a batch can hold per simulation and in which models differ from a base."""
    return [
        f for f in sorted(mujoco.batch.MODEL_FIELDS)
        if any(not np.array_equal(read_field(base, f), read_field(m, f)) for m in models) and f != "opt.disableflags"
    ]  # fmt: skip


class Forces:
    """Forces that depend on the state, and constant wrenches, of effects with numbers of each simulation's own.

    Args:
        batch: the batch.
        space: the parameters.
        effects: the effects.

    Attributes:
        any: whether there are forces that depend on the state.
        before: velocities one physics step ago, ``(N, nv)``.
    """

    def __init__(self, batch: mujoco.batch.Batch, space: ParameterSpace, effects: EffectSet) -> None:
        self._setting = effects.setting
        forces = effects.matching(lambda e: e.has_force)
        self._entries = forces.entries
        self._wrenches = effects.matching(lambda e: type(e).wrench is not Effect.wrench).entries
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._force, self._wrench = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        self._middle = Middle(effects.setting.model)
        self._values = [np.full((batch.nsim, len(e.fixed)), e.fixed) for e in self._entries]
        self._pushes = np.zeros_like(self._wrench)
        self.any = bool(self._entries)
        self.before = np.zeros_like(self._qvel)

    def write(self, ids: np.ndarray, values: np.ndarray) -> None:
        """Give simulations ``ids`` the numbers in values ``(k, d)``."""
        for entry, own in zip(self._entries, self._values, strict=True):
            own[ids] = entry.values(values)
        for row, vector in zip(ids, values, strict=True) if self._wrenches else ():
            wrenches = (e.effect.wrench(self._setting, e.target, e.values(vector[None])[0]) for e in self._wrenches)
            self._pushes[row] = sum(w for w in wrenches if w is not None)

    def restart(self, ids: np.ndarray) -> None:
        """Begin episodes in simulations whose states have just been set."""
        self.before[ids] = self._qvel[ids]
        if self._wrenches:
            self._wrench[ids] = self._pushes[ids]

    def apply(self, ids: np.ndarray, finer: int) -> None:
        """Set the forces that act in the next physics step of simulations ``ids``."""
        step = float(self._setting.model.opt.timestep) / finer
        position, velocity = self._middle.ahead(self._qpos[ids], self._qvel[ids], self.before[ids], step)
        self.before[ids] = self._qvel[ids]
        total = np.zeros_like(velocity)
        for entry, own in zip(self._entries, self._values, strict=True):
            kinds, which = (own[:1], None) if not entry.varies else np.unique(own[ids], axis=0, return_inverse=True)
            for k, numbers in enumerate(kinds):
                rows = slice(None) if which is None else which == k
                with np.errstate(all="ignore"):
                    found = entry.effect.force(self._setting, entry.target, numbers, position[rows], velocity[rows])
                if found is not None:
                    total[rows] += np.nan_to_num(found)
        self._force[ids] = total
