"""Any simulator with effects in it: commands as they act, forces, and measurements as the sensors give them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import mujoco
import numpy as np
import torch

from dropo_torch.data.trajectory import MOST_BEFORE, Trajectories
from dropo_torch.effects.base import Placed, applied
from dropo_torch.effects.engine import Past, Variant, VariantEngine, parts, past_rows, remembered_from, whole_ratio
from dropo_torch.effects.filters import (
    Filter,
    extended,
    filtered,
    filters_of,
    is_exact,
    observed_rates,
    placed_filters,
    rate_columns,
    sensed,
    settled_after,
    unsensed,
)
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import Numbers, Simulator
from dropo_torch.simulators.hidden import filter_memory

#: Shares of the search box of which one after the other is asked whether most of the log knows its commands.
SHARES = (1.0, 0.5, 0.25, 0.0)
#: Logged steps of history for a filter that remembers all of its past.
LONGEST_HISTORY = 200

#: Simulates true states under commands of every physics step: of parameter vectors ``(K, d)``, states at the start
#: ``(K, T, n)``, commands as they act ``(K, T, S, nu)``, whether the result is fine, and what was before, if known.
#: Returns the states after every physics step ``(K, T, S, n)`` or, not fine, after every logged one
#: ``(K, T, S / skip, n)``, NaN where diverged.
Engine = Callable[[np.ndarray, np.ndarray, np.ndarray, bool, Past | None], np.ndarray]


def inner_engine(effects: EffectSet, space: ParameterSpace, num_threads: int) -> Engine:
    """Return MuJoCo, with every kind of effect."""
    inner = VariantEngine(effects.setting, space, num_threads=num_threads)

    def engine(
        values: np.ndarray, starts: np.ndarray, signals: np.ndarray, fine: bool, past: Past | None
    ) -> np.ndarray:
        variants = [Variant(tuple(v.tolist()), effects.at(v)) for v in values]
        return inner.paths(variants, inner.models(variants), starts, signals, fine=fine, past=past)

    return engine


def outer_engine(effects: EffectSet, inner: Simulator) -> Engine:
    """Return another simulator, which takes one physics step a control; effects stay outside of it."""

    @torch.no_grad()
    def engine(
        values: np.ndarray, starts: np.ndarray, signals: np.ndarray, fine: bool, past: Past | None
    ) -> np.ndarray:
        del past  # no force is outside, and so none that remembers
        first, kind = effects.kinds(values)  # parameter vectors whose effects are the same go together
        every = 1 if fine else effects.setting.frame_skip
        out = np.empty((len(values), starts.shape[1], (signals.shape[2] - inner.history) // every, starts.shape[2]))
        for number, row in enumerate(first):
            given = (starts[row], np.ascontiguousarray(signals[row]), values[kind == number])
            found = inner.rollout(*map(torch.from_numpy, given)).numpy().swapaxes(0, 1)
            out[kind == number] = found[:, :, every - 1 :: every]
        return out

    return engine


class EffectSimulator(Simulator):
    """A simulator with effects: ``controls`` carry ``history`` logged steps before the window, ``states`` ``past``.

    States go in and come out as the sensors show them: the true start is found from the measured one, and a
    measurement that comes late is taken from the simulated path, or, from before its start, from the start's velocity.

    Args:
        engine: simulates true states under commands as they act.
        effects: the effects, understood in a setting.
        parameters: what varies, numbers of effects among it.
        history: logged steps of controls before each window.
        past: logged steps before a window whose states effects remember; at most as many as of controls.
        lead: physics steps before a window whose commands the engine gets, too, for filters in the model.
        timestep: seconds of a logged transition.
        name: the backend's name.
        chunk_size: simulations held at once.
    """

    name: ClassVar[str] = "effects"
    differentiable: ClassVar[bool] = False

    def __init__(
        self, engine: Engine, effects: EffectSet, *, parameters: ParameterSpace, history: int, past: int,
        lead: int, timestep: float, name: str, chunk_size: int,
    ) -> None:  # fmt: skip
        setting = effects.setting
        self.name = name  # type: ignore[misc]  # the backend's own
        self.remedy = (
            f"effects such as {effects.entries[0].effect.name} are simulated without gradients; "
            "use optimizer: fisher or cma"
        )
        self.parameters, self.history, self.past, self._lead = parameters, history, past, lead
        self.frame_skip, self.timestep = setting.frame_skip, timestep
        self.num_states = setting.model.nq + setting.model.nv
        self.num_controls = setting.model.nu
        self._engine, self._step = engine, timestep / setting.frame_skip
        self._chunk_size = max(1, chunk_size // setting.frame_skip)
        self._commands, self._sensors, self._setting = effects.having("command"), effects.having("sense"), setting
        self._rates, self._observed_rates = rate_columns(setting.model), observed_rates(setting)
        late = self._sensors.look_back(parameters)
        self._late = min(math.ceil(late / timestep - 1e-9), LONGEST_HISTORY) if late < math.inf else LONGEST_HISTORY

    def simulate(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after ``lag`` transitions; see :meth:`Simulator.simulate`."""
        return self._run(states, controls, values, last=True)[:, :, 0]

    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each transition; see :meth:`Simulator.rollout`."""
        return self._run(states, controls, values, last=False)

    def check_arguments(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> None:
        """Raise an :class:`InputError` for arguments whose shapes do not fit."""
        if self.past and states.ndim == 3:
            if states.shape[1] != self.past + 1:
                raise InputError(
                    f"states: {states.shape[1]} rows given for each; these effects remember {self.past} before its own"
                )
            states = states[:, -1]
        super().check_arguments(states, controls, values)
        if controls.shape[1] <= self.history:
            raise InputError(
                f"controls: {controls.shape[1]} logged steps given; these effects need {self.history} before each "
                "window, and its own"
            )

    def _run(self, states: Numbers, controls: Numbers, values: Numbers, *, last: bool) -> torch.Tensor:
        start, control, vectors = self.arrays(states, controls, values)
        lag = control.shape[1] - self.history
        start, before = (start[:, -1], start) if start.ndim == 3 else (start, None)
        out, size = np.empty((len(start), len(vectors), 1 if last else lag, self.num_states)), self._chunk_size
        if before is not None:
            size = min(size, max(1, MOST_BEFORE // before[0].size))
        for k in parts(len(vectors), size):
            for t in parts(len(start), max(1, size // len(vectors[k]))):
                found = self._chunk(start[t], None if before is None else before[t], control[t], vectors[k])
                out[t, k] = (found[:, :, -1:] if last else found).swapaxes(0, 1)
        return torch.from_numpy(out)

    def _chunk(
        self, start: np.ndarray, before: np.ndarray | None, control: np.ndarray, values: np.ndarray
    ) -> np.ndarray:
        """Return states as the sensors show them, ``(K, T, lag, num_states)``."""
        signals, skip = self._signals(control, values), self.frame_skip
        begin = self.history * skip - self._lead
        starts, past = np.repeat(start[None], len(values), 0), None
        if before is not None:
            past = Past(before, signals[:, :, (self.history - self.past) * skip : self.history * skip : skip])
        if not len(self._sensors):
            return self._engine(values, starts, signals[:, :, begin:], False, past)
        rates = self._start_rates(starts, signals[:, :, max(begin - 1, 0) :][:, :, : self._lead + 1], values)
        index, known = self._setting.observation.index, self._rates >= 0
        shown = starts[..., index].copy()
        numbers = ((e, torch.from_numpy(e.values(values).repeat(len(start), 0))) for e in self._sensors.entries)
        sensors = filters_of(((e.effect, e.target, own) for e, own in numbers), "sense", self._setting)
        flat, slope = (torch.from_numpy(x[..., index].reshape(-1, len(index))) for x in (starts, rates))
        starts[..., index] = unsensed(flat, slope, sensors).numpy().reshape(shown.shape)
        if self._late:  # with the velocities now true, and changing, the past shows what is missing
            rates[..., known] = starts[..., self._rates[known]]
            starts[..., index] += shown - self._shown(starts[:, :, None], rates, sensors)[:, :, 0]
        fine = self._engine(values, starts, signals[:, :, begin:], True, past)
        fine = np.concatenate([starts[:, :, None], fine], 2)
        out = fine[:, :, skip::skip].copy()
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

        A position's is the velocity; a velocity's is found by one physics step under the last command
        before the window, where a sensor is late; the engine's lead comes with it, ``(K, T, lead + 1, nu)``.
        """
        if not self._late:
            return np.zeros_like(starts)
        after = self._engine(values, starts, command, True, None)[:, :, 0]
        rates = np.nan_to_num((after - starts) * (self.frame_skip / (self.timestep or 1.0)))
        known = self._rates >= 0
        rates[..., known] = starts[..., self._rates[known]]
        return rates

    def _shown(self, fine: np.ndarray, rates: np.ndarray, sensors: list[Filter]) -> np.ndarray:
        """Return observed columns as the sensors show them, of states at every physics step ``(K, T, L·skip + 1, ·)``.

        Before its start, a window has moved with the start's velocity and acceleration; at rest, where that is not
        observed.
        """
        index, skip = self._setting.observation.index, self.frame_skip
        of = self._rates[index]
        curved = np.where((of >= 0) & (np.array(self._observed_rates) >= 0), rates[..., of], 0.0)
        columns, slope, curvature = (
            torch.from_numpy(x.reshape(-1, *x.shape[2:])) for x in (fine[..., index], rates[..., index], curved)
        )
        exact = is_exact(self._setting.model)
        past = extended(columns, slope, curvature[:, None], self._late * skip, self._step, exact=exact)
        instants = (fine.shape[2] - 1) // skip + 1
        path = SensedPath.of(past, instants, skip, self._step, self._observed_rates)
        return sensed(path, sensors).numpy().reshape(*fine.shape[:2], instants, len(index))


def apply_native(model: mujoco.MjModel, effects: EffectSet) -> mujoco.MjModel:
    """Return a copy of a model with the fixed native effects in it, and its derived constants."""
    out = applied(model, effects.at(np.empty(0)))
    try:
        derive(out)
    except mujoco.FatalError as error:
        places = ", ".join(e.place for e in effects.entries)
        raise InputError(
            f"effects: MuJoCo refuses the model with {places}: {error}; a free body whose mass or center changes must "
            "not be compiled as simple: name the model by its path, so that it is compiled for it"
        ) from None
    return out


def native_model(backend: str, effects: EffectSet) -> tuple[mujoco.MjModel, int]:
    """Return the model with the fixed native effects in it, and how many of its steps make one of the model's.

    Raises:
        InputError: steps that the backend cannot have.
    """
    native = effects.native
    model = apply_native(effects.setting.model, native)
    finer = finer_steps(effects.setting.model, model, native)
    if backend == "gymnasium" and finer > 1:
        raise InputError(f"effects: {native.entries[0].place} changes the step, which an environment has for itself")
    return model, finer


def check_steps(effects: EffectSet, space: ParameterSpace) -> None:
    """Refuse native effects whose steps do not fill the model's, at the search box's lower bounds or its center.

    Raises:
        InputError: no whole number of steps.
    """
    model = effects.setting.model
    for vector in (space.low, 0.5 * (space.low + space.high)):
        finer_steps(model, applied(model, effects.native.at(vector)), effects.native)


def overlap(effects: EffectSet, space: ParameterSpace) -> tuple[Entry, str] | None:
    """Return a native effect and a parameter that write the same number of the model, or ``None``."""
    model = effects.setting.model
    for entry in effects.entries:
        changed = applied(model, [Placed(entry.effect, entry.target, entry.fixed)])
        for parameter in space.parameters:
            if any(target.read(changed) != target.read(model) for target in parameter.targets):
                return entry, parameter.name
    return None


def history_steps(effects: EffectSet, space: ParameterSpace, timestep: float, longest: int, lead: int = 0) -> int:
    """Return how many logged steps of controls the effects need before a window, of an episode of ``longest``.

    With filters in the model, those of their ``lead`` (physics steps) come before.
    """
    seconds = effects.having("command").look_back(space)
    own = math.ceil((lead + 1) / effects.setting.frame_skip) if lead else 0
    if own:
        return own + (LONGEST_HISTORY if seconds == math.inf else math.ceil(seconds / timestep - 1e-9) + 1)
    if seconds == 0:  # a late sensor asks for the command just before the window
        return min(1, longest) if effects.having("sense").look_back(space) > 0 else 0
    steps = LONGEST_HISTORY if seconds == math.inf else math.ceil(seconds / timestep - 1e-9) + 1
    return min(steps, longest)


def first_known(effects: EffectSet, space: ParameterSpace, log: Trajectories, timestep: float) -> np.ndarray:
    """Return the transition of each episode from which on the log tells all that acts, ``(E,)``.

    Those are the commands as they act, and what effects remember of the motion before. They are under all values in
    the search box; where that would leave out more than half of the log, under those of its lower half, quarter, ...

    Args:
        effects: the effects.
        space: what varies, numbers of effects among it.
        log: the log.
        timestep: seconds of a transition.
    """
    setting, commands = effects.setting, log.commands
    skip, lengths = setting.frame_skip, np.bincount(log.episodes)
    past = past_rows(effects.having("replay").look_back(space), timestep)
    before = int(effects.having("sense").look_back(space) > 0)  # a late sensor asks for the command just before

    def needed(share: float) -> np.ndarray:
        placed = effects.at(space.low + share * (space.high - space.low))
        filters = placed_filters(placed, "command", setting)
        known = np.maximum(settled_after(commands, filters, skip, timestep / skip), before)
        return np.maximum(known, remembered_from(lengths, past))

    found = np.zeros_like(lengths)
    for share in SHARES:
        found = np.minimum(np.maximum(needed(0.0), needed(share)), lengths)
        if found.sum() <= 0.5 * lengths.sum():
            break
    return found


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
) -> Simulator:
    """Return a simulator with effects in it.

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
    if check_backend(backend, effects, space):
        make(setting.model, setting.frame_skip, space)  # for what it refuses
        engine, kept, lead = inner_engine(effects, space, num_threads), effects, filter_memory(space)
        check_steps(effects, space)
    else:
        if len(effects.native) and not owns_model:
            raise InputError(
                f"effects: {effects.native.entries[0].place} changes the model, which an adapter has for itself; "
                "let the adapter do it"
            )
        model, finer = native_model(backend, effects)
        if not len(effects.outer):
            return make(model, setting.frame_skip * finer, space.on(model))
        inner = make(model, finer, space.on(model))
        engine, kept, lead = outer_engine(effects.outer, inner), effects.outer, inner.history
    past = min(past_rows(kept.having("replay").look_back(space), timestep), longest)
    history = max(history_steps(kept, space, timestep, longest, lead), past)
    return EffectSimulator(
        engine, kept, parameters=space, history=history, past=past, lead=lead, timestep=timestep,
        name=backend, chunk_size=chunk_size,
    )  # fmt: skip


def check_backend(backend: str, effects: EffectSet, space: ParameterSpace) -> bool:
    """Return whether the effects need MuJoCo's own engine with effects: for forces, or a model that varies.

    Raises:
        InputError: effects that another backend cannot have; it says what could.
    """
    forces = [e for e in effects.entries if not (e.effect.native or e.effect.outer)]
    varying = [e for e in effects.native.entries if e.varies]
    if forces:
        reason = f"backend {backend} cannot have {forces[0].place}, a force in the simulation; backend: mujoco can"
    elif varying:
        reason = (
            f"{varying[0].place} has a number that varies, which backend {backend} cannot; "
            "vary a field of the model instead, or use backend: mujoco"
        )
    elif shared := overlap(effects.native, space):
        reason = (
            f"{shared[0].place} writes the same number of the model as parameter {shared[1]!r}, "
            f"which backend {backend} cannot; leave one of them out, or use backend: mujoco"
        )
    else:
        return False
    if backend != "mujoco":
        raise InputError(f"effects: {reason}")
    return True


def finer_steps(model: mujoco.MjModel, changed: mujoco.MjModel, native: EffectSet) -> int:
    """Return how many steps of the changed model make one of the model.

    Raises:
        InputError: no whole number.
    """
    ratio = whole_ratio(model.opt.timestep, changed.opt.timestep)
    if ratio is None:
        entry = next((e for e in native.entries if e.effect.steps), native.entries[0])
        raise InputError(
            f"effects: {entry.place} makes steps of {changed.opt.timestep:g} s, of which no whole number is the "
            f"model's {model.opt.timestep:g} s"
        )
    return ratio
