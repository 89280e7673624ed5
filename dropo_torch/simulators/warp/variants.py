"""Simulation of models that differ from each other in anything, together where they share a structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.warp.engine import Batch, Engine
from dropo_torch.simulators.warp.layout import FIELDS

#: Engines that are kept.
KEPT = 64


@dataclass(frozen=True)
class Worlds:
    """Models that are simulated together, each in a number of rows.

    Attributes:
        engines: for each structure among the models its engine, the rows of its models, and their θ ``(r, P)``.
    """

    engines: tuple[tuple[Engine, np.ndarray, torch.Tensor], ...]

    def rollout(self, starts: np.ndarray, controls: np.ndarray, skip: int, *, applied: bool = False) -> np.ndarray:
        """Return the states after every logged step ``(R, S, nq + nv)``, NaN throughout where one diverged.

        Args:
            starts: initial states ``(R, nq + nv)``.
            controls: controls of every logged step ``(R, S, nu)``, or with generalised forces ``(R, S, nu + nv)``.
            skip: physics steps of a logged step.
            applied: whether there are such forces.
        """
        out = np.empty((*controls.shape[:2], starts.shape[1]))
        for engine, rows, theta in self.engines:
            states, inputs = (torch.from_numpy(np.ascontiguousarray(x[rows])) for x in (starts, controls))
            flat, _ = engine.simulate(Batch(theta, states, inputs, skip, paired=True, applied=applied), keep=False)
            out[rows] = flat.numpy().reshape(len(rows), *out.shape[1:])
        with np.errstate(invalid="ignore"):
            out[~(np.abs(out) < DIVERGED).all((1, 2))] = np.nan
        return out


class Variants:
    """Makes worlds of variants of a model on Warp; an engine is made for every structure that comes along.

    Args:
        space: parameters, whose fields may vary within one engine.
        num_threads: threads of a CPU, 0 for all processors.
        device: Warp's name of the device.
    """

    def __init__(self, space: ParameterSpace, *, num_threads: int = 0, device: str = "cpu") -> None:
        self._space, self._device, self._threads = space, device, num_threads
        self._engines: dict[bytes, Engine | None] = {}

    def worlds(self, models: Sequence[mujoco.MjModel], each: int) -> Worlds | None:
        """Return worlds of variants, with their derived constants, each in ``each`` rows.

        Returns:
            ``None`` where one of them is outside the subset that Warp simulates.
        """
        members: dict[bytes, list[int]] = {}
        for k, model in enumerate(models):
            members.setdefault(_structure(model), []).append(k)
        found = []
        for structure, own in members.items():
            engine = self._of(structure, models[own[0]])
            if engine is None:
                return None
            rows = (np.array(own)[:, None] * each + np.arange(each)).ravel()
            theta = engine.fields.of([models[k] for k in own]).repeat_interleave(each, 0)
            found.append((engine, rows, theta))
        return Worlds(tuple(found))

    def _of(self, structure: bytes, model: mujoco.MjModel) -> Engine | None:
        """The engine of a structure, as a model has it; ``None`` outside the subset."""
        if structure not in self._engines:
            if len(self._engines) >= KEPT:
                self._engines.pop(next(iter(self._engines)))
            self._engines[structure] = self._engine(model)
        return self._engines[structure]

    def _engine(self, model: mujoco.MjModel) -> Engine | None:
        try:
            return Engine(model, self._space, skip=1, chunk_size=4096, num_threads=self._threads, device=self._device)
        except InputError:
            return None


def _structure(model: mujoco.MjModel) -> bytes:
    """Everything but the numbers in θ, of which only stands whether each is zero; what it is in, an engine serves."""
    numbers = [np.asarray(read_field(model, field)) != 0 for field in sorted(set(FIELDS))]
    tabled = [np.asarray(read_field(model, field)) for field in _TABLED if field not in FIELDS]
    return b"|".join(array.tobytes() for array in (*numbers, *tabled))


#: Fields that an effect may change and that stand in an engine's tables.
_TABLED = (
    "opt.timestep", "opt.integrator", "opt.disableflags", "opt.cone", "opt.impratio", "opt.o_margin", "body_iquat",
    "body_pos", "body_quat", "body_sameframe", "geom_pos", "geom_quat", "geom_size", "geom_sameframe", "geom_priority",
    "geom_condim", "geom_fluid", "geom_gap", "geom_solmix", "geom_contype", "geom_conaffinity", "jnt_axis", "jnt_pos",
    "jnt_limited", "jnt_actfrclimited", "actuator_biastype", "actuator_gaintype", "actuator_forcelimited",
    "actuator_ctrllimited", "actuator_gear", "actuator_dyntype", "qpos0", "actuator_damping",
)  # fmt: skip
