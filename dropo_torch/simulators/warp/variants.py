"""Open-loop simulation of models that differ from each other in anything, one model at a time."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.warp.engine import Batch, Engine
from dropo_torch.simulators.warp.fields import Fields
from dropo_torch.simulators.warp.layout import FIELDS
from dropo_torch.simulators.warp.pairs import candidate_pairs

#: Engines that are kept.
KEPT = 64


class Variants:
    """Simulates variants of a model with Warp; an engine is made for every structure that comes along.

    Args:
        space: parameters, whose fields may vary within one engine.
        num_threads: threads of a CPU, 0 for all processors.
        device: Warp's name of the device.
    """

    def __init__(self, space: ParameterSpace, *, num_threads: int = 0, device: str = "cpu") -> None:
        self._space, self._device, self._threads = space, device, num_threads
        self._engines: dict[bytes, Engine | None] = {}

    def rollout(self, model: mujoco.MjModel, starts: np.ndarray, controls: np.ndarray) -> np.ndarray | None:
        """Return the states after every physics step ``(W, S, nq + nv)``, NaN throughout where one diverged.

        Args:
            model: the variant, with its derived constants.
            starts: initial states ``(W, nq + nv)``.
            controls: controls of every physics step ``(W, S, nu)``.

        Returns:
            ``None`` for a model outside the subset that Warp simulates.
        """
        structure = _structure(model)
        if structure not in self._engines:
            if len(self._engines) >= KEPT:
                self._engines.pop(next(iter(self._engines)))
            self._engines[structure] = self._engine(model)
        engine = self._engines[structure]
        if engine is None:
            return None
        theta = Fields(model, self._space, candidate_pairs(model)).constant()
        values, states, inputs = (torch.from_numpy(np.ascontiguousarray(x)) for x in (theta, starts, controls))
        flat, _ = engine.simulate(Batch(values, states, inputs, skip=1), keep=False)
        out = flat.numpy().reshape(len(starts), controls.shape[1], starts.shape[1])
        out[~(np.abs(out) < DIVERGED).all((1, 2))] = np.nan
        return out

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
