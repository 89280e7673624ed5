"""Simulation of models that differ from each other in anything, together where they share a structure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.warp.engine import Batch, Engine
from dropo_torch.simulators.warp.layout import FIELDS, FRAMES, INERTIAL
from dropo_torch.simulators.warp.support import remarks
from dropo_torch.simulators.warp.varied import inertial_frames

#: Engines that are kept.
KEPT = 64


@dataclass(frozen=True)
class Worlds:
    """Models that are simulated together, each in a number of rows.

    Attributes:
        engines: for each structure among the models its engine, the rows of its models, and their θ ``(r, P)``.
    """

    engines: tuple[tuple[Engine, np.ndarray | slice, torch.Tensor], ...]

    def rollout(
        self, starts: np.ndarray, controls: np.ndarray, skip: int, *, applied: bool = False, wrenched: bool = False
    ) -> np.ndarray:
        """Return the states after every logged step ``(R, S, nq + nv)``, NaN throughout where one diverged.

        Args:
            starts: initial states ``(R, nq + nv)``.
            controls: controls of every logged step ``(R, S, nu)``, and what else acts in it, behind them.
            skip: physics steps of a logged step.
            applied: whether generalized forces stand at the end, and
            wrenched: whether wrenches on the bodies do after the controls, see :class:`Batch`.
        """
        out = np.empty((*controls.shape[:2], starts.shape[1]))
        for engine, rows, theta in self.engines:
            states, inputs = (torch.from_numpy(np.ascontiguousarray(x[rows])) for x in (starts, controls))
            batch = Batch(theta, states, inputs, skip, paired=True, applied=applied, wrenched=wrenched)
            flat, _ = engine.simulate(batch, keep=False)
            out[rows] = flat.numpy().reshape(len(theta), *out.shape[1:])
        with np.errstate(invalid="ignore"):
            out[~(np.abs(out) < DIVERGED).all((1, 2))] = np.nan
        return out

    def stepper(
        self, starts: np.ndarray, width: int, skip: int, *, applied: bool = False, wrenched: bool = False
    ) -> Stepper:
        """Return what simulates one logged step after the other from ``starts``; see there."""
        return Stepper(self, starts, width, skip, applied=applied, wrenched=wrenched)


class Stepper:
    """Simulates models one logged step at a time, under inputs that depend on the states.

    Args:
        worlds: the models.
        states: the initial states ``(R, nq + nv)``.
        width: inputs of a step, see :meth:`Worlds.rollout`.
        skip: physics steps of a logged step.
        applied, wrenched: what stands in the inputs, see :class:`Batch`.

    Attributes:
        states: the states now, ``(R, nq + nv)``.
    """

    def __init__(
        self, worlds: Worlds, states: np.ndarray, width: int, skip: int, *, applied: bool = False,
        wrenched: bool = False,
    ) -> None:  # fmt: skip
        self.states, self._parts = states, []
        for engine, rows, theta in worlds.engines:
            before, after = (torch.empty(len(theta), states.shape[1], dtype=torch.float64) for _ in range(2))
            inputs = torch.empty(len(theta), 1, width, dtype=torch.float64)
            batch = Batch(theta, before, inputs, skip, paired=True, applied=applied, wrenched=wrenched)
            arrays = before.numpy(), inputs.numpy()[:, 0], after.numpy()
            self._parts.append((rows, *arrays, engine.repeated(batch, after)))

    def step(self, inputs: np.ndarray) -> None:
        """Simulate one logged step under inputs ``(R, width)``; one that diverges is NaN from then on."""
        found = np.empty_like(self.states)
        for rows, before, given, after, run in self._parts:
            before[:], given[:] = self.states[rows], inputs[rows]
            run()
            found[rows] = after
        with np.errstate(invalid="ignore"):
            near = np.abs(found) < DIVERGED
            if not near.all():
                found[~near.all(1)] = np.nan
        self.states = found


class Variants:
    """Makes worlds of variants of a model on Warp; an engine is made for every structure that comes along.

    Args:
        space: parameters, whose fields may vary within one engine.
        num_threads: threads of a CPU, 0 for all processors.
    """

    def __init__(self, space: ParameterSpace, *, num_threads: int = 0) -> None:
        self._space, self._threads = space, num_threads
        self._engines: dict[bytes, Engine | None] = {}
        self._tabled: tuple[str, ...] = ()
        self._free = _in_theta(space)

    def worlds(self, models: Sequence[mujoco.MjModel], each: int) -> Worlds | None:
        """Return worlds of variants, with their derived constants, each in ``each`` rows.

        Returns:
            ``None`` where one of them is outside the subset that Warp simulates.
        """
        members: dict[bytes, list[int]] = {}
        self._tabled = self._tabled or tabled_fields(models[0])
        for k, model in enumerate(models):
            members.setdefault(_structure(model, self._tabled, self._free), []).append(k)
        found = []
        for structure, own in members.items():
            engine = self._of(structure, models[own[0]])
            if engine is None:
                return None
            alone = len(own) == len(models)
            rows = slice(None) if alone else (np.array(own)[:, None] * each + np.arange(each)).ravel()
            theta = engine.fields.of([models[k] for k in own]).repeat_interleave(each, 0)
            found.append((engine, rows, theta))
        return Worlds(tuple(found))

    def _of(self, structure: bytes, model: mujoco.MjModel) -> Engine | None:
        """The engine of a structure, as a model has it; ``None`` outside the subset."""
        engine = self._engines.pop(structure) if structure in self._engines else self._engine(model)
        if len(self._engines) >= KEPT:  # the one not used for longest
            self._engines.pop(next(iter(self._engines)))
        self._engines[structure] = engine
        return engine

    def _engine(self, model: mujoco.MjModel) -> Engine | None:
        if remarks(model) or model.na:  # it stands in for MuJoCo with these very options, and without activations
            return None
        try:
            return Engine(model, self._space, skip=1, chunk_size=4096, num_threads=self._threads, device="cpu")
        except InputError:
            return None


def tabled_fields(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the fields of a model of which an engine's tables, or whether there may be one, may follow.

    All that hold anything, but for those in θ, those that follow from the others, and those that move nothing.
    """
    arrays = [name for name in dir(model) if not name.startswith(("_", *_IDLE)) and name not in _DERIVED]
    arrays = [name for name in arrays if isinstance(found := getattr(model, name), np.ndarray) and found.size]
    options = [f"opt.{name}" for name in dir(model.opt) if not name.startswith("_")]
    in_theta = {*FIELDS, INERTIAL} - {*FRAMES}
    return tuple(field for field in (*options, *arrays) if field not in in_theta)


def _in_theta(space: ParameterSpace) -> dict[str, list[int]]:
    """Numbers of frames that parameters write, by field: they stand in θ; and bounds of geoms whose size does."""
    found: dict[str, list[int]] = {}
    for _, target in space.targets:
        if target.field in FRAMES:
            found.setdefault(target.field, []).append(target.index)
    return found | {"geom_rbound": [index // 3 for index in found.get("geom_size", ())]}


def _structure(model: mujoco.MjModel, tabled: Sequence[str], free: Mapping[str, list[int]] | None = None) -> bytes:
    """What an engine's tables, and whether there may be one, follow from; of numbers in θ only which are zero.

    Args:
        model: the model.
        tabled: its :func:`tabled_fields`.
        free: numbers of these that stand in θ for all that.
    """
    arrays = [np.sign(read_field(model, field)) for field in _SIGNS]
    arrays += [np.any(read_field(model, field)) for field in _ANY]
    arrays += inertial_frames(model)
    for field in tabled:
        array = read_field(model, field)
        if free and field in free:
            array = array.copy()
            array.reshape(-1)[free[field]] = 0
        arrays.append(array)
    return hashlib.blake2b(b"|".join([array.tobytes() for array in arrays])).digest()


#: Fields of θ of which each number's sign matters, and such of which it does whether any is not zero.
_SIGNS = (
    "dof_frictionloss", "body_gravcomp", "actuator_gainprm", "actuator_biasprm", "tendon_stiffness",
    "tendon_stiffnesspoly", "tendon_damping", "tendon_dampingpoly", "tendon_armature", "tendon_frictionloss",
    "actuator_damping", "actuator_dampingpoly", "actuator_armature",
)  # fmt: skip
_ANY = ("dof_damping", "dof_dampingpoly", "jnt_stiffness", "jnt_stiffnesspoly", "opt.density", "opt.viscosity")
#: What fields begin with that show things, name them, or measure.
_IDLE = (
    "bvh_", "cam_", "key_", "light_", "mat_", "mesh_pathadr", "mesh_tex", "name", "numeric_", "oct_", "sensor_",
    "skin_", "tex_", "text_", "tuple_",
)  # fmt: skip
#: Fields that follow from others, as constants derived from θ, and looks of what also moves.
_DERIVED = frozenset((
    "actuator_acc0", "actuator_length0", "body_invweight0", "body_margin", "body_subtreemass", "dof_M0",
    "dof_invweight0", "dof_length", "efm0_L", "flexedge_invweight0", "flexedge_length0", "geom_aabb",
    "geom_castshadow", "geom_group", "geom_matid", "geom_rgba", "jnt_group", "site_group", "site_matid", "site_rgba",
    "tendon_group", "tendon_invweight0", "tendon_length0", "tendon_matid", "tendon_rgba",
))  # fmt: skip
