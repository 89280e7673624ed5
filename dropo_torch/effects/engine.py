"""The model with effects in it, simulated under many variants at once: other models, forces, wrenches."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import mujoco
import mujoco.batch
import numpy as np

from dropo_torch.effects.base import Effect, Method, Placed, Setting, apply_all
from dropo_torch.effects.drive import Drive, Drives
from dropo_torch.models.constants import derive
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.hidden import filter_memory, filters_of, refuse_prescribed
from dropo_torch.simulators.mujoco import default_row

Models = Sequence[mujoco.MjModel | None]
#: Seconds, and rows at most, before a simulation from which what an effect remembers is replayed.
PAST, MOST_PAST = 3.0, 1000
#: Simulations below which handing work to threads costs more than it saves.
ALONE = 200


@dataclass(frozen=True)
class Variant:
    """One hypothesis about the robot: values of the declared parameters ``(d,)``, and effects."""

    declared: tuple[float, ...]
    placed: tuple[Placed, ...] = ()

    def has(self, *methods: Method) -> bool:
        """Whether any of its effects acts by one of some methods."""
        return any(p.effect.has(m) for p in self.placed for m in methods)

    def eased(self, setting: Setting) -> Variant:
        """The same as differences are taken of it; see :meth:`Effect.eased`."""
        return Variant(self.declared, tuple(p.eased(setting) for p in self.placed))


@dataclass
class Memory:
    """What a force remembers in its rows, ``(R, k)``; ``None`` before the first physics step of a simulation."""

    now: np.ndarray | None = None


@dataclass(frozen=True)
class Force:
    """An effect that is a force, and the rows on which it acts, with their numbers ``(R, p)`` or ``(1, p)``.

    It lasts for one simulation, whose past is in ``memory``.
    """

    effect: Effect
    target: str | None
    values: np.ndarray
    rows: slice | np.ndarray
    memory: Memory = field(default_factory=Memory)


def forces_of(variants: Sequence[Variant], each: int) -> list[Force]:
    """Return the forces of variants, each in ``each`` rows; those of one effect at one target together."""
    acting: dict[tuple, list[tuple[int, Placed]]] = {}
    for k, variant in enumerate(variants):
        own = [p for p in variant.placed if p.effect.has("force")]
        for i, p in enumerate(own):  # one that is there twice acts twice
            twice = sum(p.key == other.key for other in own[:i])
            acting.setdefault((*p.key, twice), []).append((k, p))
    found = []
    for group in acting.values():
        members, first = np.array([k for k, _ in group]), group[0][1]
        values = np.repeat(np.array([p.values for _, p in group]), each, axis=0)
        rows: slice | np.ndarray = (members[:, None] * each + np.arange(each)).ravel()
        if len(members) == np.ptp(members) + 1:
            rows = slice(members[0] * each, (members[-1] + 1) * each)
        found.append(Force(first.effect, first.target, values, rows))
    return found


@dataclass(frozen=True)
class Past:
    """What the log shows of the rows before simulations, P of them.

    Attributes:
        states: before each of these rows and where simulations begin, ``(W, P + 1, nq + nv)``; NaN where there is none.
        commands: as they act in these rows, ``(K, W, P, nu)``.
    """

    states: np.ndarray
    commands: np.ndarray


def past_rows(memory: float, timestep: float) -> int:
    """Return the rows, of ``timestep`` seconds, from which what an effect remembers for ``memory`` is replayed."""
    return min(math.ceil(min(memory, PAST) / timestep - 1e-9), MOST_PAST)


def remembered_from(lengths: np.ndarray, rows: int) -> np.ndarray:
    """Return the row of episodes, of so many ``(E,)``, from which on the log shows the past that effects remember.

    That is the number of rows that they need, but no more than half an episode.
    """
    return np.minimum(rows, lengths // 2)


def drives_of(forces: Iterable[Force], models: Models, each: int = 1) -> Drives | None:
    """Return the laws of the actuators of models, each in ``each`` rows; ``None`` where no force depends on them."""
    if not any(f.effect.has(method) for f in forces for method in ("force_under", "replay")):
        return None
    return Drives.of([m for m in models if m is not None], each)


class Forces:
    """The forces of effects that depend on the state, at states half a physics step ahead.

    A force that is held over the step is then right to second order. Free and ball joints stay where they are.
    """

    def __init__(self, setting: Setting) -> None:
        model = setting.model
        simple = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)))
        self._setting = setting
        self._position, self._velocity = model.jnt_qposadr[simple], model.jnt_dofadr[simple]
        if simple.all():  # views of all columns need no copy
            self._position = self._velocity = slice(None)

    def __call__(
        self, acting: Iterable[Force], position: np.ndarray, velocity: np.ndarray, before: np.ndarray, step: float,
        drive: Drive | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return generalized forces ``(R, nv)``.

        Args:
            acting: the effects.
            position, velocity: the states, ``(R, nq)`` and ``(R, nv)``.
            before: velocities a physics step ago, ``(R, nv)``; those of the states at an episode's start.
            step: seconds of a physics step.
            drive: the actuators, where an effect depends on them.
        """
        ahead = position.copy()
        ahead[:, self._position] += 0.5 * step * velocity[:, self._velocity]
        then, out = velocity + 0.5 * (velocity - before), np.zeros_like(velocity)
        with np.errstate(all="ignore"):
            for f in acting:
                own = self._setting, f.target, f.values
                if f.memory.now is None:
                    f.memory.now = f.effect.recall(*own, position[f.rows], velocity[f.rows])
                now = *own, ahead[f.rows], then[f.rows], f.memory.now
                if drive is not None and f.effect.has("force_under"):
                    found, f.memory.now = f.effect.force_under(*now, drive.at(f.rows))
                else:
                    found, f.memory.now = f.effect.force_after(*now)
                out[f.rows] += found if np.isfinite(found).all() else np.nan_to_num(found)
        return out


class ModelRefused(ValueError):
    """MuJoCo refuses a model with these values."""


class VariantEngine:
    """Simulates a model under variants of it, from full states and under commands as they act.

    Args:
        setting: the model as given.
        space: the declared parameters.
        num_threads: threads, 0 for all processors; results do not depend on it.
        warp: simulate with the Warp backend wherever it can; MuJoCo does the rest, with the same physics.

    Attributes:
        lead: physics steps before a window whose commands come with it, over which actuators' filters are replayed.
    """

    def __init__(self, setting: Setting, space: ParameterSpace, *, num_threads: int = 0, warp: bool = False) -> None:
        self._setting, self._space, self._num_threads = setting, space, num_threads
        self._warp = None
        if warp:  # imported only where it is asked for
            from dropo_torch.simulators.warp.variants import Variants

            self._warp = Variants(space, num_threads=num_threads)
        self._base = copy.copy(setting.model)
        self._base.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        refuse_prescribed(self._base, "effects")
        self._filters = filters_of(self._base)
        self.lead = filter_memory(space.on(self._base))
        self._data = mujoco.MjData(self._base)
        self._row = default_row(self._base)
        self._forces = Forces(setting)
        self._batches: dict[int, mujoco.batch.Batch] = {}

    def model(self, variant: Variant) -> mujoco.MjModel:
        """Return the model of a variant, with its derived constants.

        Raises:
            ModelRefused: values that MuJoCo refuses.
        """
        model = copy.copy(self._base)
        self._space.write_into(model, variant.declared)
        step = model.opt.timestep
        apply_all(model, variant.placed)
        if model.opt.timestep != step and whole_ratio(self._base.opt.timestep, model.opt.timestep) is None:
            raise ModelRefused(f"no whole number of its steps of {model.opt.timestep:g} s is the model's")
        if (model.body_mass < 0).any() or (model.body_inertia < 0).any() or (model.dof_armature < 0).any():
            raise ModelRefused("a mass or an inertia is negative")
        try:
            with quiet_mujoco():
                derive(model, self._data)
        except mujoco.FatalError as error:
            raise ModelRefused(str(error)) from None
        return model

    def models(self, variants: Sequence[Variant]) -> Models:
        """Return the models of variants, ``None`` where MuJoCo refuses the values."""
        found: list[mujoco.MjModel | None] = [None] * len(variants)
        for k, variant in enumerate(variants):
            with contextlib.suppress(ModelRefused):
                found[k] = self.model(variant)
        return found

    def paths(
        self, variants: Sequence[Variant], models: Models, starts: np.ndarray,
        signals: np.ndarray, *, fine: bool = False, pushes: np.ndarray | None = None, past: Past | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Simulate.

        Args:
            variants: the hypotheses, K of them.
            models: their models, of :meth:`models`.
            starts: true states, ``(K, W, nq + nv)``.
            signals: commands of every physics step, those of ``lead`` steps before the window first,
                ``(K, W, lead + S, nu)``.
            fine: return the states after every physics step instead of every logged one.
            pushes: further generalized forces in every logged step, ``(K, S / skip, nv)``; none by default.
            past: what was before, for forces that remember it; by default they begin with what they recall.

        Returns:
            States ``(K, W, S, nq + nv)`` or ``(K, W, S / skip, nq + nv)``, NaN where a simulation diverged or has no
            model.
        """
        every = 1 if fine else self._setting.frame_skip
        groups: dict[tuple, list[int]] = {}
        for k, (variant, model) in enumerate(zip(variants, models, strict=True)):
            if model is not None:
                groups.setdefault(self._kind(variant, model), []).append(k)
        out = np.full((*starts.shape[:2], (signals.shape[2] - self.lead) // every, starts.shape[2]), np.nan)
        for (finer, *_), members in groups.items():
            rows = members if len(members) < len(variants) else slice(None)  # all of them need no copy
            own, their = [models[k] for k in members], [variants[k] for k in members]
            before = None if past is None else Past(past.states, past.commands[rows])
            given = starts[rows], signals[rows], None if pushes is None else pushes[rows], finer, every, before
            found = self._by_warp(own, their, *given)
            out[rows] = found if found is not None else self._by_mujoco(own, their, *given)
        return out

    def _kind(self, variant: Variant, model: mujoco.MjModel) -> tuple:
        """What variants that are simulated together share; the base's steps in a step of theirs comes first."""
        finer = max(round(self._base.opt.timestep / model.opt.timestep), 1)
        natives = () if self._warp is None else tuple(p.key for p in variant.placed if p.effect.native)
        return finer, variant.has("force"), self._warp is not None and variant.has("wrench"), natives

    def _by_warp(
        self, models: Models, variants: Sequence[Variant], starts: np.ndarray, signals: np.ndarray,
        pushes: np.ndarray | None, finer: int, every: int, past: Past | None,
    ) -> np.ndarray | None:  # fmt: skip
        """Do what :meth:`_by_mujoco` does with Warp, or return ``None`` where it cannot."""
        if self._warp is None or len(self._filters):
            return None
        (num_k, num_w, total), nq = signals.shape[:3], self._base.nq
        worlds = self._warp.worlds([m for m in models if m is not None], num_w)
        if worlds is None:
            return None
        states, control = starts.reshape(num_k * num_w, -1), signals.reshape(num_k * num_w, total, -1)
        forces, applied, wrenched = forces_of(variants, num_w), pushes is not None, variants[0].has("wrench")
        outer = self._wrenches(variants).reshape(num_k, -1).repeat(num_w, 0) if wrenched else np.zeros((len(states), 0))
        nothing, skip = np.zeros((len(states), total // self._setting.frame_skip, 0)), self._setting.frame_skip
        pushed = nothing if pushes is None else np.repeat(pushes, num_w, axis=0)
        if not forces:
            held = 1 if _varies(control, every) else every
            at = np.arange(0, total, held)
            constant = np.broadcast_to(outer[:, None], (len(states), len(at), outer.shape[1]))
            inputs = np.concatenate([control[:, at], constant, pushed[:, at // skip]], 2)
            path = worlds.rollout(states, inputs, held * finer, applied=applied, wrenched=wrenched)
            return path[:, every // held - 1 :: every // held].reshape(num_k, num_w, -1, states.shape[1])
        out, before = np.empty((len(states), total // every, states.shape[1])), states[:, nq:]
        width, drives = control.shape[2] + outer.shape[1] + self._base.nv, drives_of(forces, models, num_w)
        self._replay(forces, drives, past)
        stepper = worlds.stepper(states, width, 1, applied=True, wrenched=wrenched)
        for step in range(total):
            for _ in range(finer):
                states = stepper.states
                now = states[:, :nq], states[:, nq:]
                drive = None if drives is None else Drive(drives, control[:, step], self._base.opt.timestep / finer)
                found = self._forces(forces, *now, before, self._base.opt.timestep / finer, drive)
                if applied:
                    found = found + pushed[:, step // skip]
                before = states[:, nq:]
                stepper.step(np.concatenate([control[:, step], outer, found], 1))
            if (step + 1) % every == 0:
                out[:, (step + 1) // every - 1] = stepper.states
        out[~np.isfinite(stepper.states).all(1)] = np.nan
        return out.reshape(num_k, num_w, *out.shape[1:])

    def _by_mujoco(
        self, models: Models, variants: Sequence[Variant], starts: np.ndarray, signals: np.ndarray,
        pushes: np.ndarray | None, finer: int, every: int, past: Past | None,
    ) -> np.ndarray:  # fmt: skip
        """Return states after each logged (or physics) step, ``(K, W, S / every, nq + nv)``.

        Args:
            models, variants: K that go together.
            starts: states, ``(K, W, nq + nv)``.
            signals: commands of every physics step of the base model, ``(K, W, lead + S, nu)``.
            pushes: further generalized forces, as for :meth:`paths`.
            finer: steps of the models that make one of the base's.
            every: steps of the base from one wanted state to the next.
            past: see :meth:`paths`.
        """
        num_k, num_w, total = *signals.shape[:2], signals.shape[2] - self.lead
        rows, nq = num_k * num_w, self._base.nq
        batch, control = self._batch(rows), signals.reshape(rows, self.lead + total, -1)
        self._begin(batch, models, variants, starts, control[:, : self.lead])
        control, forces = control[:, self.lead :], forces_of(variants, num_w)
        drives = drives_of(forces, models, num_w)
        self._replay(forces, drives, past)
        qpos, qvel, ctrl, applied = (batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qfrc_applied"))
        held = 1 if forces or _varies(control, every) else every  # steps of the base between changes
        calls, steps = (finer, 1) if forces else (1, finer * held)
        out, failed, before = np.empty((rows, total // every, starts.shape[2])), np.zeros(rows, bool), qvel.copy()
        for step in range(0, total, held):
            ctrl[:] = control[:, step]
            for _ in range(calls):
                if forces:
                    drive = None if drives is None else Drive(drives, control[:, step], self._base.opt.timestep / finer)
                    found = self._forces(forces, qpos, qvel, before, self._base.opt.timestep / finer, drive)
                    applied[:], before = found, qvel.copy()
                if pushes is not None:
                    held_pushes = np.repeat(pushes[:, step // self._setting.frame_skip], num_w, axis=0)
                    applied[:] = applied + held_pushes if forces else held_pushes
                try:
                    with quiet_mujoco():
                        batch.step(nstep=steps)
                except mujoco.batch.SimulationError as error:
                    failed[error.ids] = True
            if (step + held) % every == 0:
                at = (step + held) // every - 1
                out[:, at, :nq], out[:, at, nq:] = qpos, qvel
        with np.errstate(invalid="ignore"):
            failed |= ~(np.abs(out) < DIVERGED).all(axis=(1, 2))
        out[failed] = np.nan
        batch.set_models(None)
        return out.reshape(num_k, num_w, *out.shape[1:])

    def _replay(self, forces: Sequence[Force], drives: Drives | None, past: Past | None) -> None:
        """Let forces remember the past, each in its rows, and as far back as its own numbers do, whatever is known."""
        if past is None or drives is None:
            return
        (num_k, num_w, count, _), nq, row = past.commands.shape, self._base.nq, self._setting.signals.timestep
        states = np.broadcast_to(past.states, (num_k, *past.states.shape)).reshape(num_k * num_w, count + 1, -1)
        commands = past.commands.reshape(num_k * num_w, count, -1)
        drive = Drive(drives, commands, row)
        for f in forces:
            if f.effect.has("replay"):
                rows = [past_rows(f.effect.memory(values), row) for values in f.values[::num_w]]
                forgotten = np.arange(count + 1) < count - np.repeat(rows, num_w)[:, None]
                seen = np.where(forgotten[..., None], np.nan, states[f.rows])
                own = self._setting, f.target, f.values, seen[..., :nq], seen[..., nq:]
                f.memory.now = f.effect.replay(*own, drive.at(f.rows))

    def _begin(
        self, batch: mujoco.batch.Batch, models: Models, variants: Sequence[Variant], starts: np.ndarray,
        past: np.ndarray,
    ) -> None:  # fmt: skip
        """Give simulations their models and wrenches, and states in which filters remember the commands of the past.

        Args:
            batch: ``K · W`` simulations.
            models, variants: K of them.
            starts: states, ``(K, W, nq + nv)``.
            past: commands of ``lead`` physics steps, ``(K · W, lead, nu)``.
        """
        num_w, nq, states = starts.shape[1], self._base.nq, starts.reshape(-1, starts.shape[2])
        batch.set_models([m for m in models for _ in range(num_w)])
        batch.state[:] = self._row
        batch.bind("qpos")[:], batch.bind("qvel")[:] = states[:, :nq], states[:, nq:]
        if len(self._filters):
            constants = np.array([m.actuator_dynprm[self._filters.actuators, 0] for m in models if m is not None])
            acting = self._filters.replayed(self._base, past, 1, constants.repeat(num_w, 0))
            batch.bind("act")[:, self._filters.activations] = acting
        if any(v.has("wrench") for v in variants):
            batch.bind("xfrc_applied")[:] += self._wrenches(variants).repeat(num_w, 0)

    def _wrenches(self, variants: Sequence[Variant]) -> np.ndarray:
        """Return the wrenches on all bodies, as ``xfrc_applied`` has them ``(K, nbody, 6)``."""
        out = np.zeros((len(variants), self._base.nbody, 6))
        for own, variant in zip(out, variants, strict=True):
            for p in variant.placed:
                if p.effect.has("wrench"):
                    own += p.effect.wrench(self._setting, p.target, np.array(p.values))
        return out

    def _batch(self, rows: int) -> mujoco.batch.Batch:
        if rows not in self._batches:
            if len(self._batches) > 8:
                self._batches.clear()
            threads = 1 if rows < ALONE else self._num_threads
            self._batches[rows] = mujoco.batch.Batch(self._base, rows, threads)
        return self._batches[rows]


def whole_ratio(longer: float, shorter: float) -> int | None:
    """Return how many of the shorter steps make the longer one; ``None`` if that is no whole number."""
    ratio = longer / shorter if shorter > 0 else 0.0
    return round(ratio) if round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-6 * ratio else None


def parts(total: int, size: int) -> list[slice]:
    """Return slices of at most ``size`` that make up ``total``."""
    return [slice(a, min(a + size, total)) for a in range(0, total, size)]


def _varies(control: np.ndarray, every: int) -> bool:
    """Whether commands change within a logged step."""
    rows, steps, width = control.shape
    if every == 1 or width == 0:
        return False
    blocks = control.reshape(rows, steps // every, every, width)
    return bool((blocks != blocks[:, :, :1]).any())
