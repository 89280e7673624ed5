"""Any simulator with effects in it: commands as they act, forces, and measurements as the sensors give them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import ClassVar, Protocol

import mujoco
import numpy as np
import torch

from dropo_torch.effects.actuator import actuator_number
from dropo_torch.effects.base import Effect, Path, Placed, Setting
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.effects.sensor import SensorEffect
from dropo_torch.effects.twin import Twin, Variant
from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.base import Simulator

#: Logged steps of history for a filter that remembers all of its past.
LONGEST_HISTORY = 200


class Engine(Protocol):
    """Simulates states under commands of every physics step."""

    def paths(
        self, values: np.ndarray, placed: list[tuple[Placed, ...]], starts: np.ndarray, signals: np.ndarray, fine: bool
    ) -> np.ndarray:
        """Return states ``(K, T, S, n)`` or, not fine, ``(K, T, S / skip, n)``, NaN where diverged.

        Args:
            values: parameter vectors, ``(K, d)``.
            placed: the effects under each.
            starts: true states, ``(K, T, n)``.
            signals: commands as they act, ``(K, T, S, nu)``.
            fine: states after every physics step instead of every logged one.
        """
        ...


class TwinEngine:
    """MuJoCo, with every kind of effect."""

    def __init__(self, setting: Setting, space: ParameterSpace, num_threads: int) -> None:
        self._twin = Twin(setting, space, num_threads=num_threads)

    def paths(
        self, values: np.ndarray, placed: list[tuple[Placed, ...]], starts: np.ndarray, signals: np.ndarray, fine: bool
    ) -> np.ndarray:
        """Simulate; see :meth:`Engine.paths`."""
        variants = [Variant(tuple(v), p) for v, p in zip(values.tolist(), placed, strict=True)]
        return self._twin.paths(variants, starts, signals, fine=fine)


class OuterEngine:
    """Another simulator, which takes one physics step a control; effects stay outside of it."""

    def __init__(self, inner: Simulator, skip: int) -> None:
        self._inner, self._skip = inner, skip

    def paths(
        self, values: np.ndarray, placed: list[tuple[Placed, ...]], starts: np.ndarray, signals: np.ndarray, fine: bool
    ) -> np.ndarray:
        """Simulate; parameter vectors whose effects are the same go together. See :meth:`Engine.paths`."""
        groups: dict[tuple, list[int]] = {}
        for k, effects in enumerate(placed):
            groups.setdefault(tuple(p.values for p in effects), []).append(k)
        every = 1 if fine else self._skip
        out = np.empty((len(values), starts.shape[1], signals.shape[2] // every, starts.shape[2]))
        for members in groups.values():
            first = members[0]
            with torch.no_grad():
                found = self._inner.rollout(
                    torch.from_numpy(starts[first]), torch.from_numpy(np.ascontiguousarray(signals[first])),
                    torch.from_numpy(values[members]),
                )  # fmt: skip
            out[members] = found.numpy().swapaxes(0, 1)[:, :, every - 1 :: every]
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
        timestep: seconds of a logged transition, or ``None``.
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
        self.effects = effects
        self._engine = engine
        self._chunk_size = max(1, chunk_size // setting.frame_skip)
        self._rates = rate_columns(setting.model)
        sensors = effects.matching(lambda e: e.acts_on_sensor)
        self._sensed = bool(len(sensors))
        late = sensors.look_back(parameters, sensors=True)
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
            placed = [self.effects.at(vector) for vector in vectors[k]]
            for t in _parts(len(start), max(1, self._chunk_size // len(placed))):
                found = self._chunk(start[t], control[t], vectors[k], placed)
                out[t, k] = (found[:, :, -1:] if last else found).swapaxes(0, 1)
        return torch.from_numpy(out)

    def _chunk(
        self, start: np.ndarray, control: np.ndarray, values: np.ndarray, placed: list[tuple[Placed, ...]]
    ) -> np.ndarray:
        """Return states as the sensors show them, ``(K, T, lag, num_states)``."""
        signals = self._signals(control, placed)
        begin = self.history * self.frame_skip
        starts = np.repeat(start[None], len(values), 0)
        if not self._sensed:
            return self._engine.paths(values, placed, starts, signals[:, :, begin:], False)
        rates = self._start_rates(starts, signals[:, :, max(begin - 1, 0)], values, placed)
        index, known = self.effects.setting.observation.index, self._rates >= 0
        for k, effects in enumerate(placed):
            shown = start[:, index]
            starts[k][:, index] = unsensed(shown, rates[k][:, index], effects, self.effects.setting)
            if self._late:  # with the velocities now true, and changing, the past shows what is missing
                rates[k][:, known] = starts[k][:, self._rates[known]]
                starts[k][:, index] += shown - self._shown(starts[k][:, None], rates[k], effects)[:, 0]
        fine = self._engine.paths(values, placed, starts, signals[:, :, begin:], True)
        fine = np.concatenate([starts[:, :, None], fine], 2)
        out = fine[:, :, self.frame_skip :: self.frame_skip].copy()
        for k, effects in enumerate(placed):
            out[k][..., index] = self._shown(fine[k], rates[k], effects)[:, 1:]
        return out

    def _signals(self, control: np.ndarray, placed: list[tuple[Placed, ...]]) -> np.ndarray:
        """Return commands as they act in every physics step, ``(K, T, (history + lag)·skip, nu)``."""
        skip = self.frame_skip
        plain = np.repeat(control, skip, axis=1)
        step = (self.timestep or 0.0) / skip
        known: dict[tuple, np.ndarray] = {}
        out = []
        for effects in placed:
            filters = [p for p in effects if p.effect.acts_on_command]
            key = tuple(p.values for p in filters)
            if key not in known:
                known[key] = filtered(plain, filters, self.effects.setting.model, step)
            out.append(known[key])
        return np.stack(out)

    def _start_rates(
        self, starts: np.ndarray, command: np.ndarray, values: np.ndarray, placed: list[tuple[Placed, ...]]
    ) -> np.ndarray:
        """Return time derivatives of the states at the starts, ``(K, T, num_states)``, just before them.

        A position's is the velocity; a velocity's is found by one physics step under the last command ``(K, T, nu)``
        before the window, where a sensor is late.
        """
        if not self._late:
            return np.zeros_like(starts)
        after = self._engine.paths(values, placed, starts, command[:, :, None], True)[:, :, 0]
        rates = np.nan_to_num((after - starts) * (self.frame_skip / (self.timestep or 1.0)))
        known = self._rates >= 0
        rates[..., known] = starts[..., self._rates[known]]
        return rates

    def _shown(self, fine: np.ndarray, rates: np.ndarray, effects: tuple[Placed, ...]) -> np.ndarray:
        """Return observed columns as the sensors show them ``(T, L + 1, n)``, of states ``(T, L·skip + 1, ...)``."""
        setting, skip = self.effects.setting, self.frame_skip
        index = setting.observation.index
        step = (self.timestep or 0.0) / skip
        before = np.arange(-self._late * skip, 0)[None, :, None] * step
        columns = fine[..., index]
        curved = np.where(self._rates[index] >= 0, rates[:, self._rates[index]], 0.0)[:, None]
        past = columns[:, :1] + before * rates[:, None, index] + 0.5 * before * (before + step) * curved
        columns = np.concatenate([past, columns], 1)
        places = {int(c): i for i, c in enumerate(index)}
        path = Path(
            columns=columns[:, ::skip], fine=columns, valid=np.ones(columns[:, ::skip].shape, dtype=bool), step=step,
            rates=np.array([places.get(int(self._rates[c]), -1) for c in index]),
        )  # fmt: skip
        for placed in effects:
            if placed.effect.acts_on_sensor:
                column = SensorEffect.column(setting, placed.target)
                path = placed.effect.sense(path, column, np.asarray(placed.values))
        return path.columns[:, self._late :]


def filtered(signal: np.ndarray, filters: list[Placed], model: mujoco.MjModel, step: float) -> np.ndarray:
    """Return commands ``(T, S, nu)`` of physics steps as they act."""
    out = signal.copy() if filters else signal
    for placed in filters:
        actuator = actuator_number(model, placed.target)
        column = int(model.actuator_ctrladr[actuator])
        out[..., column] = placed.effect.command(out[..., column], actuator, step, np.asarray(placed.values))
    return out


def unsensed(shown: np.ndarray, rates: np.ndarray, effects: tuple[Placed, ...], setting: Setting) -> np.ndarray:
    """Return observed columns ``(T, n)`` of true states, of which the sensors show ``shown``."""
    for placed in reversed(effects):
        if placed.effect.acts_on_sensor:
            column = SensorEffect.column(setting, placed.target)
            shown = placed.effect.unsense(shown, rates, column, np.asarray(placed.values))
    return shown


def rate_columns(model: mujoco.MjModel) -> np.ndarray:
    """Return for every state column the one that is its time derivative, or -1, ``(nq + nv,)``."""
    found = np.full(model.nq + model.nv, -1)
    for j in range(model.njnt):
        position, velocity = int(model.jnt_qposadr[j]), model.nq + int(model.jnt_dofadr[j])
        width = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}.get(int(model.jnt_type[j]), 1)
        found[position : position + width] = velocity + np.arange(width)
    return found


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
    seconds = effects.look_back(space, sensors=False)
    if seconds == 0:  # a late sensor asks for the command just before the window
        return min(1, longest) if effects.look_back(space, sensors=True) > 0 else 0
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
    native, outer = effects.matching(is_native), effects.matching(is_outer)
    if needs_mujoco(effects, space):
        check_backend(backend, effects, space)
        simulator: Engine = TwinEngine(setting, space, num_threads)
        make(setting.model, setting.frame_skip, space)  # for what it refuses
        wrapped, kept = simulator, effects
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
        wrapped, kept = OuterEngine(make(model, finer, inner_space), setting.frame_skip), outer
    history = history_steps(kept, space, timestep, longest)
    return EffectSimulator(
        wrapped, kept, parameters=space, history=history, timestep=timestep, name=backend, chunk_size=chunk_size
    ), history  # fmt: skip


def is_outer(effect: Effect) -> bool:
    """Whether an effect stays outside of the simulator: it filters commands or measurements and does nothing else."""
    return (effect.acts_on_command or effect.acts_on_sensor) and not (
        _is_force(effect) or type(effect).apply is not Effect.apply
    )


def is_native(effect: Effect) -> bool:
    """Whether an effect is numbers of the model and nothing else."""
    return effect.native and not (effect.acts_on_command or effect.acts_on_sensor or _is_force(effect))


def _is_force(effect: Effect) -> bool:
    return effect.has_force or type(effect).wrench is not Effect.wrench


def needs_mujoco(effects: EffectSet, space: ParameterSpace) -> bool:
    """Whether effects are forces in the simulation or change its model from one parameter vector to another."""
    native = effects.matching(is_native)
    inside = len(native) + len(effects.matching(is_outer)) < len(effects)
    return inside or any(e.varies for e in native.entries) or overlap(native, space) is not None


def check_backend(backend: str, effects: EffectSet, space: ParameterSpace) -> None:
    """Raise an :class:`InputError` for an effect that a backend cannot have; it says what could."""
    if backend == "mujoco":
        return
    for entry in effects.entries:
        if not is_native(entry.effect) and not is_outer(entry.effect):
            raise InputError(
                f"effects: backend {backend} cannot have {entry.place}, a force in the simulation; backend: mujoco can"
            )
    native = effects.matching(is_native)
    for entry in native.entries:
        if entry.varies:
            raise InputError(
                f"effects: {entry.place} has a number that varies, which backend {backend} cannot; "
                "vary a field of the model instead, or use backend: mujoco"
            )
    shared = overlap(native, space)
    if shared is not None:
        raise InputError(
            f"effects: {shared[0].place} writes the same number of the model as parameter {shared[1]!r}, "
            f"which backend {backend} cannot; leave one of them out, or use backend: mujoco"
        )


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
    native = effects.matching(is_native)
    for vector in (space.low, 0.5 * (space.low + space.high)):
        changed = copy.copy(setting.model)
        for placed in native.at(vector):
            placed.effect.apply(changed, placed.target, np.asarray(placed.values))
        finer_steps(setting.model, changed, native)


def _parts(total: int, size: int) -> Iterator[slice]:
    return (slice(a, min(a + size, total)) for a in range(0, total, size))


__all__ = ["EffectSimulator", "effect_simulator", "filtered", "history_steps"]
