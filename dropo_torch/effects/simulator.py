"""Any simulator with effects in it: commands as they act, forces, and measurements as the sensors give them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import ClassVar

import mujoco
import numpy as np
import torch

from dropo_torch.effects.base import Setting
from dropo_torch.effects.engine import Variant, VariantEngine
from dropo_torch.effects.filters import (
    Filter,
    extended,
    filtered,
    filters_of,
    observed_rates,
    placed_filters,
    rate_columns,
    sensed,
    unsensed,
)
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.base import Simulator

#: Logged steps of history for a filter that remembers all of its past.
LONGEST_HISTORY = 200


#: Simulates true states under commands of every physics step: of parameter vectors ``(K, d)``, states at the start
#: ``(K, T, n)``, commands as they act ``(K, T, S, nu)`` and whether the result is fine. Returns the states after every
#: physics step ``(K, T, S, n)`` or, not fine, after every logged one ``(K, T, S / skip, n)``, NaN where diverged.
Engine = Callable[[np.ndarray, np.ndarray, np.ndarray, bool], np.ndarray]


class InnerEngine:
    """MuJoCo, with every kind of effect."""

    def __init__(self, effects: EffectSet, space: ParameterSpace, num_threads: int) -> None:
        self._engine, self._effects = VariantEngine(effects.setting, space, num_threads=num_threads), effects

    def __call__(self, values: np.ndarray, starts: np.ndarray, signals: np.ndarray, fine: bool) -> np.ndarray:
        """Simulate; see :data:`Engine`."""
        variants = [Variant(tuple(v.tolist()), self._effects.at(v)) for v in values]
        return self._engine.paths(variants, self._engine.models(variants), starts, signals, fine=fine)


class OuterEngine:
    """Another simulator, which takes one physics step a control; effects stay outside of it."""

    def __init__(self, effects: EffectSet, inner: Simulator) -> None:
        self._inner, self._effects, self._skip = inner, effects, effects.setting.frame_skip

    def __call__(self, values: np.ndarray, starts: np.ndarray, signals: np.ndarray, fine: bool) -> np.ndarray:
        """Simulate; parameter vectors whose effects are the same go together. See :data:`Engine`."""
        first, kind = self._effects.kinds(values)
        every = 1 if fine else self._skip
        out = np.empty((len(values), starts.shape[1], signals.shape[2] // every, starts.shape[2]))
        for number, row in enumerate(first):
            with torch.no_grad():
                found = self._inner.rollout(
                    torch.from_numpy(starts[row]), torch.from_numpy(np.ascontiguousarray(signals[row])),
                    torch.from_numpy(values[kind == number]),
                )  # fmt: skip
            out[kind == number] = found.numpy().swapaxes(0, 1)[:, :, every - 1 :: every]
        return out


class EffectSimulator(Simulator):
    """A simulator with effects: ``controls`` carry ``history`` logged steps before the window.

    States go in and come out as the sensors show them: the true start is found from the measured one, and a
    measurement that comes late is taken from the simulated path, or, from before its start, from the start's velocity.

    Args:
        engine: simulates true states under commands as they act.
        effects: the effects, understood in a setting.
        parameters: what varies, numbers of effects among it.
        history: logged steps of controls before each window.
        timestep: seconds of a logged transition.
        name: the backend's name.
        chunk_size: simulations held at once.
    """

    name: ClassVar[str] = "effects"
    differentiable: ClassVar[bool] = False

    def __init__(
        self, engine: Engine, effects: EffectSet, *, parameters: ParameterSpace, history: int, timestep: float,
        name: str, chunk_size: int,
    ) -> None:  # fmt: skip
        setting = effects.setting
        self.name = name  # type: ignore[misc]  # the backend's own
        self.remedy = (
            f"effects such as {effects.entries[0].effect.name} are simulated without gradients; "
            "use optimizer: fisher or cma"
        )
        self.parameters, self.history = parameters, history
        self.frame_skip, self.timestep = setting.frame_skip, timestep
        self.num_states = setting.model.nq + setting.model.nv
        self.num_controls = setting.model.nu
        self._engine, self._step = engine, timestep / setting.frame_skip
        self._chunk_size = max(1, chunk_size // setting.frame_skip)
        self._commands, self._sensors, self._setting = effects.having("command"), effects.having("sense"), setting
        self._rates, self._observed_rates = rate_columns(setting.model), observed_rates(setting)
        late = self._sensors.look_back(parameters)
        self._late = min(math.ceil(late / timestep - 1e-9), LONGEST_HISTORY) if late < math.inf else LONGEST_HISTORY

    def simulate(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Return the states after ``lag`` transitions; see :meth:`Simulator.simulate`."""
        return self._run(states, controls, values, last=True)[:, :, 0]

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Return the states after each transition; see :meth:`Simulator.rollout`."""
        return self._run(states, controls, values, last=False)

    def check_arguments(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> None:
        """Raise an :class:`InputError` for arguments whose shapes do not fit."""
        super().check_arguments(states, controls, values)
        if controls.shape[1] <= self.history:
            raise InputError(
                f"controls: {controls.shape[1]} logged steps given; these effects need {self.history} before each "
                "window, and its own"
            )

    def _run(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor, *, last: bool) -> torch.Tensor:
        self.check_arguments(states, controls, values)
        start, control, vectors = (x.detach().cpu().double().numpy() for x in (states, controls, values))
        lag = control.shape[1] - self.history
        out = np.empty((len(start), len(vectors), 1 if last else lag, self.num_states))
        for k in _parts(len(vectors), self._chunk_size):
            for t in _parts(len(start), max(1, self._chunk_size // len(vectors[k]))):
                found = self._chunk(start[t], control[t], vectors[k])
                out[t, k] = (found[:, :, -1:] if last else found).swapaxes(0, 1)
        return torch.from_numpy(out)

    def _chunk(self, start: np.ndarray, control: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return states as the sensors show them, ``(K, T, lag, num_states)``."""
        signals = self._signals(control, values)
        begin = self.history * self.frame_skip
        starts = np.repeat(start[None], len(values), 0)
        if not len(self._sensors):
            return self._engine(values, starts, signals[:, :, begin:], False)
        rates = self._start_rates(starts, signals[:, :, max(begin - 1, 0)], values)
        index, known = self._setting.observation.index, self._rates >= 0
        shown = starts[..., index].copy()
        numbers = ((e, torch.from_numpy(e.values(values).repeat(len(start), 0))) for e in self._sensors.entries)
        sensors = filters_of(((e.effect, e.target, own) for e, own in numbers), "sense", self._setting)
        flat, slope = (torch.from_numpy(x[..., index].reshape(-1, len(index))) for x in (starts, rates))
        starts[..., index] = unsensed(flat, slope, sensors).numpy().reshape(shown.shape)
        if self._late:  # with the velocities now true, and changing, the past shows what is missing
            rates[..., known] = starts[..., self._rates[known]]
            starts[..., index] += shown - self._shown(starts[:, :, None], rates, sensors)[:, :, 0]
        fine = self._engine(values, starts, signals[:, :, begin:], True)
        fine = np.concatenate([starts[:, :, None], fine], 2)
        out = fine[:, :, self.frame_skip :: self.frame_skip].copy()
        out[..., index] = self._shown(fine, rates, sensors)[:, :, 1:]
        return out

    def _signals(self, control: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return commands as they act in every physics step, ``(K, T, (history + lag)·skip, nu)``."""
        plain = np.repeat(control, self.frame_skip, axis=1)
        first, kind = self._commands.kinds(values)
        filters = [placed_filters(self._commands.at(values[k]), "command", self._setting) for k in first]
        return np.stack([filtered(plain, f, self._step) for f in filters])[kind]

    def _start_rates(self, starts: np.ndarray, command: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return time derivatives of the states at the starts, ``(K, T, num_states)``, just before them.

        A position's is the velocity; a velocity's is found by one physics step under the last command ``(K, T, nu)``
        before the window, where a sensor is late.
        """
        if not self._late:
            return np.zeros_like(starts)
        after = self._engine(values, starts, command[:, :, None], True)[:, :, 0]
        rates = np.nan_to_num((after - starts) * (self.frame_skip / (self.timestep or 1.0)))
        known = self._rates >= 0
        rates[..., known] = starts[..., self._rates[known]]
        return rates

    def _shown(self, fine: np.ndarray, rates: np.ndarray, sensors: list[Filter]) -> np.ndarray:
        """Return observed columns as the sensors show them, of states at every physics step ``(K, T, L·skip + 1, ·)``.

        Before its start, a window has moved with the start's velocity and acceleration.
        """
        index, skip = self._setting.observation.index, self.frame_skip
        of = self._rates[index]
        curved = np.where(of >= 0, rates[..., of], 0.0)
        columns, slope, curvature = (
            torch.from_numpy(x.reshape(-1, *x.shape[2:])) for x in (fine[..., index], rates[..., index], curved)
        )
        past = extended(columns, slope, curvature, self._late * skip, self._step)
        instants = (fine.shape[2] - 1) // skip + 1
        path = SensedPath.of(past, instants, skip, self._step, self._observed_rates)
        return sensed(path, sensors).numpy().reshape(*fine.shape[:2], instants, len(index))


def apply_native(model: mujoco.MjModel, effects: EffectSet) -> mujoco.MjModel:
    """Return a copy of a model with the fixed native effects in it, and its derived constants."""
    out = copy.copy(model)
    for entry in effects.entries:
        entry.effect.apply(out, entry.target, np.asarray(entry.fixed))
    try:
        mujoco.mj_setConst(out, mujoco.MjData(out))
    except mujoco.FatalError as error:
        places = ", ".join(e.place for e in effects.entries)
        raise InputError(
            f"effects: MuJoCo refuses the model with {places}: {error}; a free body whose mass or centre changes must "
            "not be compiled as simple: name the model by its path, so that it is compiled for it"
        ) from None
    return out


def overlap(effects: EffectSet, space: ParameterSpace) -> tuple[Entry, str] | None:
    """Return a native effect and a parameter that write the same number of the model, or ``None``."""
    model = effects.setting.model
    for entry in effects.entries:
        changed = copy.copy(model)
        entry.effect.apply(changed, entry.target, np.asarray(entry.fixed))
        for parameter in space.parameters:
            for target in parameter.targets:
                ours, theirs = (read_field(m, target.field).reshape(-1)[target.index] for m in (changed, model))
                if ours != theirs:
                    return entry, parameter.name
    return None


def history_steps(effects: EffectSet, space: ParameterSpace, timestep: float, longest: int) -> int:
    """Return how many logged steps of controls the effects need before a window, of an episode of ``longest``."""
    seconds = effects.having("command").look_back(space)
    if seconds == 0:  # a late sensor asks for the command just before the window
        return min(1, longest) if effects.having("sense").look_back(space) > 0 else 0
    steps = LONGEST_HISTORY if seconds == math.inf else math.ceil(seconds / timestep - 1e-9) + 1
    return min(steps, longest)


def effect_simulator(
    backend: str,
    effects: EffectSet,
    space: ParameterSpace,
    make: Callable[[mujoco.MjModel, int, ParameterSpace], Simulator],
    *,
    timestep: float,
    longest: int,
    num_threads: int = 0,
    chunk_size: int = 10_000,
    owns_model: bool = True,
) -> tuple[Simulator, int]:
    """Return a simulator with effects in it, and how many logged steps of controls each window needs before it.

    Effects that are fixed and native become part of the model, and the backend's own simulator comes back where
    there are no others.

    Args:
        backend: its name.
        effects: the effects; at least one.
        space: what varies, numbers of effects among it.
        make: returns the backend's simulator of a model, physics steps per control and parameters.
        timestep: seconds of a logged transition.
        longest: logged steps of the longest episode.
        num_threads, chunk_size: as for :func:`~dropo_torch.simulators.make_simulator`.
        owns_model: whether the model that ``make`` gets is the one that it simulates.

    Raises:
        InputError: effects that the backend cannot have.
    """
    setting = effects.setting
    native, outer = effects.native, effects.outer
    check_backend(backend, effects, space)
    if obstacle(backend, effects, space) is not None:
        make(setting.model, setting.frame_skip, space)  # for what it refuses
        engine: Engine = InnerEngine(effects, space, num_threads)
        kept = effects
        _check_timestep(setting, effects, space)
    else:
        if len(native) and not owns_model:
            raise InputError(
                f"effects: {native.entries[0].place} changes the model, which an adapter has for itself; "
                "let the adapter do it"
            )
        model = apply_native(setting.model, native)
        finer = finer_steps(setting.model, model, native)
        if backend == "gymnasium" and finer > 1:
            raise InputError(
                f"effects: {native.entries[0].place} changes the step, which an environment has for itself"
            )
        inner_space = space.on(model)
        if not len(outer):
            return make(model, setting.frame_skip * finer, inner_space), 0
        engine, kept = OuterEngine(outer, make(model, finer, inner_space)), outer
    history = history_steps(kept, space, timestep, longest)
    return EffectSimulator(
        engine, kept, parameters=space, history=history, timestep=timestep, name=backend, chunk_size=chunk_size
    ), history  # fmt: skip


def obstacle(backend: str, effects: EffectSet, space: ParameterSpace) -> str | None:
    """Return why a backend other than MuJoCo cannot have the effects: forces, or a model that varies; or ``None``."""
    for entry in effects.entries:
        if not (entry.effect.native or entry.effect.outer):
            return f"backend {backend} cannot have {entry.place}, a force in the simulation; backend: mujoco can"
    for entry in effects.native.entries:
        if entry.varies:
            return (
                f"{entry.place} has a number that varies, which backend {backend} cannot; "
                "vary a field of the model instead, or use backend: mujoco"
            )
    shared = overlap(effects.native, space)
    return None if shared is None else (
        f"{shared[0].place} writes the same number of the model as parameter {shared[1]!r}, "
        f"which backend {backend} cannot; leave one of them out, or use backend: mujoco"
    )  # fmt: skip


def check_backend(backend: str, effects: EffectSet, space: ParameterSpace) -> None:
    """Raise an :class:`InputError` for an effect that a backend cannot have; it says what could."""
    reason = obstacle(backend, effects, space)
    if backend != "mujoco" and reason is not None:
        raise InputError(f"effects: {reason}")


def finer_steps(model: mujoco.MjModel, changed: mujoco.MjModel, native: EffectSet) -> int:
    """Return how many steps of the changed model make one of the model.

    Raises:
        InputError: no whole number.
    """
    ratio = model.opt.timestep / changed.opt.timestep
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        entry = next((e for e in native.entries if e.effect.name == "integration"), native.entries[0])
        raise InputError(
            f"effects: {entry.place} makes steps of {changed.opt.timestep:g} s, of which no whole number is the "
            f"model's {model.opt.timestep:g} s"
        )
    return round(ratio)


def _check_timestep(setting: Setting, effects: EffectSet, space: ParameterSpace) -> None:
    """Raise unless the finer steps of the effects fill the model's."""
    native = effects.native
    for vector in (space.low, 0.5 * (space.low + space.high)):
        changed = copy.copy(setting.model)
        for placed in native.at(vector):
            placed.effect.apply(changed, placed.target, np.asarray(placed.values))
        finer_steps(setting.model, changed, native)


def _parts(total: int, size: int) -> Iterator[slice]:
    return (slice(a, min(a + size, total)) for a in range(0, total, size))


__all__ = ["EffectSimulator", "effect_simulator", "history_steps"]
