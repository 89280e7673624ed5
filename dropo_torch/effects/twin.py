"""The model with effects in it: whole windows of a log simulated under many variants at once."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import mujoco.batch
import numpy as np

from dropo_torch.effects.actuator import actuator_number
from dropo_torch.effects.base import Effect, Path, Placed, Setting
from dropo_torch.effects.sensor import SensorEffect
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace, write_field
from dropo_torch.simulators.base import DIVERGED
from dropo_torch.simulators.mujoco import control_range, default_row, filter_activations


@dataclass(frozen=True)
class Variant:
    """One hypothesis about the robot: values of the declared parameters ``(d,)``, and effects."""

    declared: tuple[float, ...]
    placed: tuple[Placed, ...] = ()


@dataclass(frozen=True)
class Windows:
    """Stretches of a log, each simulated from its own start.

    Attributes:
        measured: observed columns at L + 1 instants, the start included, ``(W, L + 1, n)``.
        rates: time derivatives of the columns at the starts, as the log shows them, ``(W, n)``.
        episodes: episode of each window, ``(W,)``.
        steps: logged step of each window's start within its episode, ``(W,)``.
        commands: commands of every episode at every logged step, the last one repeated, ``(E, N, nu)``.
    """

    measured: np.ndarray
    rates: np.ndarray
    episodes: np.ndarray
    steps: np.ndarray
    commands: np.ndarray

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.measured)

    @property
    def length(self) -> int:
        """Logged steps L of a window."""
        return self.measured.shape[1] - 1

    def select(self, rows: np.ndarray | slice) -> Windows:
        """Return the given windows."""
        return replace(
            self, measured=self.measured[rows], rates=self.rates[rows], episodes=self.episodes[rows],
            steps=self.steps[rows],
        )  # fmt: skip


#: Simulations below which handing work to threads costs more than it saves.
ALONE = 200


class Twin:
    """Simulates windows under variants of the model.

    Args:
        setting: the model as given, and the log's columns.
        space: the declared parameters.
        num_threads: threads, 0 for all processors; results do not depend on it.
        chunk_size: simulations at a time.
        warp: simulate with the Warp backend wherever it can; MuJoCo does the rest, with the same physics.
        standing: effects that every variant has, of the declared parameters' values ``(d,)``; those of the config.
    """

    def __init__(
        self, setting: Setting, space: ParameterSpace, *, num_threads: int = 0, chunk_size: int = 6000,
        warp: bool = False, standing: Callable[[np.ndarray], tuple[Placed, ...]] | None = None,
    ) -> None:  # fmt: skip
        self.setting, self.space, self._standing = setting, space, standing
        self._warp = _warp_variants(space, num_threads) if warp else None
        self._base = copy.copy(setting.model)
        self._base.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._filters = filter_activations(self._base)
        self._data = mujoco.MjData(self._base)
        self._row = default_row(self._base)
        self._default = np.array(setting.observation.default_state)
        self._num_threads, self._chunk = num_threads, chunk_size
        self._batches: dict[int, mujoco.batch.Batch] = {}
        self.rates = _rate_columns(setting)
        self._commands: np.ndarray | None = None
        self._filtered: dict[tuple, np.ndarray] = {}
        self.simulated_transitions = 0

    def also(self, placed: Placed) -> Twin:
        """Return the same with one more effect in every variant."""
        before, twin = self._standing, copy.copy(self)
        twin._standing = lambda declared: (*(before(declared) if before is not None else ()), placed)
        return twin

    def model(self, variant: Variant) -> mujoco.MjModel:
        """Return the model of a variant, with its derived constants.

        Raises:
            ValueError: values that MuJoCo refuses.
        """
        model = copy.copy(self._base)
        for column, parameter in enumerate(self.space.parameters):
            for target in parameter.targets:
                write_field(model, target.field, target.index, target.factor * variant.declared[column])
        for placed in variant.placed:
            placed.effect.apply(model, placed.target, np.asarray(placed.values))
        if (model.body_mass < 0).any() or (model.body_inertia < 0).any() or (model.dof_armature < 0).any():
            raise ValueError("a mass or an inertia is negative")
        try:
            with quiet_mujoco():
                mujoco.mj_setConst(model, self._data)
        except mujoco.FatalError as error:
            raise ValueError(str(error)) from None
        return model

    def predict(
        self,
        variants: Sequence[Variant],
        windows: Windows,
        starts: np.ndarray | None = None,
        pushes: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate every window under every variant.

        Args:
            variants: the hypotheses, K of them.
            windows: the stretches of the log.
            starts: observed columns at the starts as the sensors would show them, ``(W, n)`` for all variants or
                ``(K, W, n)``; the measured ones by default.
            pushes: generalised forces in every logged step, ``(K, L, nv)``, the same in all windows; none by default.

        Returns:
            What the sensors would show, ``(K, W, L + 1, n)``, NaN where a simulation diverged, and which entries
            the simulation can know, of the same shape.
        """
        num_k, num_w, length = len(variants), len(windows), windows.length
        if self._standing is not None:
            variants = [replace(v, placed=(*self._standing(np.asarray(v.declared)), *v.placed)) for v in variants]
        shown = windows.measured[:, 0] if starts is None else starts
        shown = np.broadcast_to(shown, (num_k, num_w, shown.shape[-1]))
        out = np.full((num_k, num_w, length + 1, shown.shape[-1]), np.nan)
        valid = np.ones(out.shape, dtype=bool)
        groups: dict[tuple, list[int]] = {}
        models: list[mujoco.MjModel | None] = []
        for k, variant in enumerate(variants):
            try:
                model = self.model(variant)
            except ValueError:
                models.append(None)
                continue
            models.append(model)
            finer = round(self._base.opt.timestep / model.opt.timestep)
            forced = any(p.effect.has_force for p in variant.placed)
            fine = any(p.effect.acts_on_sensor for p in variant.placed)
            pushed = any(type(p.effect).wrench is not Effect.wrench for p in variant.placed)
            natives = tuple(p.key for p in variant.placed if p.effect.native) if self._warp is not None else ()
            groups.setdefault((max(finer, 1), forced, fine, pushed, natives), []).append(k)
        for (finer, forced, fine, _pushed, _natives), members in groups.items():
            per_call = max(1, self._chunk // max(1, num_w))
            for a in range(0, len(members), per_call):
                part = members[a : a + per_call]
                for b in range(0, num_w, self._chunk):
                    rows = slice(b, min(b + self._chunk, num_w))
                    self._group(variants, models, part, windows.select(rows), shown[:, rows], finer, forced, fine,
                                out[:, rows], valid[:, rows], pushes)  # fmt: skip
        self.simulated_transitions += num_k * num_w * length
        return out, valid

    def paths(
        self, variants: Sequence[Variant], starts: np.ndarray, signals: np.ndarray, *, fine: bool = False
    ) -> np.ndarray:
        """Simulate from full states, under commands as they act.

        Args:
            variants: the hypotheses, K of them.
            starts: true states, ``(K, W, nq + nv)``.
            signals: commands of every physics step, ``(K, W, S, nu)``.
            fine: return the states after every physics step instead of every logged one.

        Returns:
            States ``(K, W, S, nq + nv)`` or ``(K, W, S / skip, nq + nv)``, NaN where a simulation diverged.
        """
        count = signals.shape[2] if fine else signals.shape[2] // self.setting.frame_skip
        out = np.full((*starts.shape[:2], count, starts.shape[2]), np.nan)
        groups: dict[tuple[int, bool], list[int]] = {}
        models: dict[int, mujoco.MjModel] = {}
        for k, variant in enumerate(variants):
            try:
                models[k] = self.model(variant)
            except ValueError:
                continue
            finer = max(round(self._base.opt.timestep / models[k].opt.timestep), 1)
            groups.setdefault((finer, any(p.effect.has_force for p in variant.placed)), []).append(k)
        for (finer, forced), members in groups.items():
            out[members] = self._simulate(
                [models[k] for k in members], [variants[k] for k in members], starts[members], signals[members],
                finer, forced, fine, None,
            )  # fmt: skip
        return out

    def _group(
        self, variants: Sequence[Variant], models: list, part: list[int], windows: Windows, shown: np.ndarray,
        finer: int, forced: bool, fine: bool, out: np.ndarray, valid: np.ndarray, pushes: np.ndarray | None,
    ) -> None:  # fmt: skip
        """Simulate variants of one kind and write what their sensors show."""
        observation = self.setting.observation
        starts = np.stack([self._states(variants[k], shown[k], windows.rates) for k in part])
        signals = np.stack([self._signals(variants[k], windows) for k in part])
        path = self._simulate(
            [models[k] for k in part], [variants[k] for k in part], starts, signals, finer, forced, fine,
            None if pushes is None else pushes[part],
        )  # fmt: skip
        index = observation.index
        skip = self.setting.frame_skip
        for position, k in enumerate(part):
            every = skip if fine else 1
            columns = np.concatenate([starts[position][:, None, index], path[position][..., index]], 1)
            begin = Path(
                columns=columns[:, ::every], fine=columns, valid=np.ones(columns[:, ::every].shape, dtype=bool),
                step=self._base.opt.timestep, rates=self.rates,
            )  # fmt: skip
            for placed in variants[k].placed:
                if placed.effect.acts_on_sensor:
                    column = SensorEffect.column(self.setting, placed.target)
                    begin = placed.effect.sense(begin, column, np.asarray(placed.values))
            out[k], valid[k] = begin.columns, begin.valid

    def _states(self, variant: Variant, shown: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return states ``(W, nq + nv)`` of which the sensors show ``shown``."""
        for placed in reversed(variant.placed):
            if placed.effect.acts_on_sensor:
                column = SensorEffect.column(self.setting, placed.target)
                shown = placed.effect.unsense(shown, rates, column, np.asarray(placed.values))
        states = np.tile(self._default, (len(shown), 1))
        states[:, self.setting.observation.index] = shown
        for q in self.setting.observation.quaternions:
            at = self.setting.observation.index[list(q)]
            states[:, at] /= np.linalg.norm(states[:, at], axis=1, keepdims=True)
        return states

    def _signals(self, variant: Variant, windows: Windows) -> np.ndarray:
        """Return commands as they act in every physics step of every window ``(W, L·skip, nu)``."""
        skip, length = self.setting.frame_skip, windows.length
        filters = [p for p in variant.placed if p.effect.acts_on_command]
        if self._commands is not windows.commands:
            self._commands, self._filtered = windows.commands, {}
        key = tuple((p.key, p.values) for p in filters)
        if key not in self._filtered:
            signal = np.repeat(windows.commands, skip, axis=1)
            for placed in filters:
                i = actuator_number(self._base, placed.target)
                column = int(self._base.actuator_ctrladr[i])
                signal[..., column] = placed.effect.command(
                    signal[..., column], i, self._base.opt.timestep, np.asarray(placed.values)
                )
            if len(self._filtered) > 64:
                self._filtered.clear()
            self._filtered[key] = signal
        at = windows.steps[:, None] * skip + np.arange(length * skip)
        return self._filtered[key][windows.episodes[:, None], at]

    def _simulate(
        self, models: list[mujoco.MjModel], variants: list[Variant], starts: np.ndarray, signals: np.ndarray,
        finer: int, forced: bool, fine: bool, pushes: np.ndarray | None,
    ) -> np.ndarray:  # fmt: skip
        """Return states after each logged (or physics) step ``(K, W, L or L·skip, nq + nv)``."""
        num_k, num_w = starts.shape[:2]
        if self._warp is not None and not forced and pushes is None and not self._filters:
            found = self._by_warp(models, variants, starts, signals, finer, fine)
            if found is not None:
                return found
        rows, nq = num_k * num_w, self._base.nq
        batch = self._batch(rows)
        batch.set_models([m for m in models for _ in range(num_w)])
        batch.state[:] = self._row
        qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        flat = starts.reshape(rows, -1)
        qpos[:], qvel[:] = flat[:, :nq], flat[:, nq:]
        control = signals.reshape(rows, *signals.shape[2:])
        if self._filters:
            activation, source = (list(x) for x in zip(*self._filters, strict=True))
            batch.bind("act")[:, activation] = np.clip(control[:, 0], *control_range(self._base))[:, source]
        self._push(batch, variants, num_w)
        total, every = control.shape[1], 1 if fine else self.setting.frame_skip
        out = np.empty((rows, total // every, flat.shape[1]))
        failed = np.zeros(rows, dtype=bool)
        force = batch.bind("qfrc_applied") if forced or pushes is not None else None
        middle, before = (Middle(self._base), qvel.copy()) if forced else (None, qvel)
        single = forced or _varies(control, every)
        for step in range(0, total, 1 if single else every):
            ctrl[:] = control[:, step]
            for _ in range(finer if forced else 1):
                if force is not None:
                    force[:] = 0.0
                    if middle is not None:
                        ahead = middle.ahead(qpos, qvel, before, self._base.opt.timestep / finer)
                        before = qvel.copy()
                        force[:] = self._forces(variants, *ahead, num_w)
                    if pushes is not None:
                        force[:] += np.repeat(pushes[:, step // self.setting.frame_skip], num_w, axis=0)
                try:
                    with quiet_mujoco():
                        batch.step(nstep=(1 if forced else finer) * (1 if single else every))
                except mujoco.batch.SimulationError as error:
                    failed[error.ids] = True
            done = step + (1 if single else every)
            if done % every == 0:
                out[:, done // every - 1, :nq], out[:, done // every - 1, nq:] = qpos, qvel
        with np.errstate(invalid="ignore"):
            failed |= ~(np.abs(out) < DIVERGED).all(axis=(1, 2))
        out[failed] = np.nan
        batch.set_models(None)
        return out.reshape(num_k, num_w, *out.shape[1:])

    def _by_warp(
        self, models: list[mujoco.MjModel], variants: list[Variant], starts: np.ndarray, signals: np.ndarray,
        finer: int, fine: bool,
    ) -> np.ndarray | None:  # fmt: skip
        """Do what :meth:`_simulate` does with Warp, or return ``None`` where it cannot."""
        assert self._warp is not None
        every = finer * (1 if fine else self.setting.frame_skip)
        out = []
        for k, model in enumerate(models):
            placed = variants[k].placed
            if any(p.effect.wrench(self.setting, p.target, np.asarray(p.values)) is not None for p in placed):
                return None
            path = self._warp.rollout(model, starts[k], np.repeat(signals[k], finer, axis=1))
            if path is None:
                return None
            out.append(path[:, every - 1 :: every])
        return np.stack(out)

    def _push(self, batch: mujoco.batch.Batch, variants: list[Variant], num_w: int) -> None:
        """Set the constant wrenches."""
        for k, variant in enumerate(variants):
            for placed in variant.placed:
                wrench = placed.effect.wrench(self.setting, placed.target, np.asarray(placed.values))
                if wrench is not None:
                    batch.bind("xfrc_applied")[k * num_w : (k + 1) * num_w] += wrench

    def _forces(self, variants: list[Variant], qpos: np.ndarray, qvel: np.ndarray, num_w: int) -> np.ndarray:
        """Return the state-dependent forces of every row."""
        out = np.zeros(qvel.shape)
        for k, variant in enumerate(variants):
            rows = slice(k * num_w, (k + 1) * num_w)
            for placed in variant.placed:
                if not placed.effect.has_force:
                    continue
                with np.errstate(all="ignore"):
                    found = placed.effect.force(
                        self.setting, placed.target, np.asarray(placed.values), qpos[rows], qvel[rows]
                    )
                if found is not None:
                    out[rows] += np.nan_to_num(found)
        return out

    def _batch(self, rows: int) -> mujoco.batch.Batch:
        if rows not in self._batches:
            if len(self._batches) > 8:
                self._batches.clear()
            threads = 1 if rows < ALONE else self._num_threads
            self._batches[rows] = mujoco.batch.Batch(self._base, rows, threads)
        return self._batches[rows]


class Middle:
    """States half a physics step ahead: a force that is held over the step is then right to second order."""

    def __init__(self, model: mujoco.MjModel) -> None:
        simple = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)))
        self._position, self._velocity = model.jnt_qposadr[simple], model.jnt_dofadr[simple]

    def ahead(
        self, position: np.ndarray, velocity: np.ndarray, before: np.ndarray, step: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions ``(R, nq)`` and velocities ``(R, nv)`` ahead; free and ball joints stay where they are.

        Args:
            position, velocity: the states.
            before: velocities a physics step ago, ``(R, nv)``; those of the states at an episode's start.
            step: seconds of a physics step.
        """
        q = position.copy()
        q[:, self._position] += 0.5 * step * velocity[:, self._velocity]
        return q, velocity + 0.5 * (velocity - before)


def _warp_variants(space: ParameterSpace, num_threads: int) -> Any:
    """The Warp backend, imported only where it is asked for."""
    from dropo_torch.simulators.warp.variants import Variants

    return Variants(space, num_threads=num_threads)


def _varies(control: np.ndarray, every: int) -> bool:
    """Whether commands change within a logged step."""
    if every == 1:
        return False
    blocks = control.reshape(control.shape[0], -1, every, control.shape[2])
    return bool((blocks != blocks[:, :, :1]).any())


def _rate_columns(setting: Setting) -> np.ndarray:
    """For every observed column the observed column of its velocity, or -1."""
    model, columns = setting.model, list(setting.observation.columns)
    rates = np.full(len(columns), -1)
    for j in range(model.njnt):
        if model.jnt_type[j] not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            continue
        position, velocity = int(model.jnt_qposadr[j]), model.nq + int(model.jnt_dofadr[j])
        if position in columns and velocity in columns:
            rates[columns.index(position)] = columns.index(velocity)
    return rates
