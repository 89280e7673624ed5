"""The laws of an effect."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import mujoco
import numpy as np
import torch

from dropo_torch.data.observation import parse_observation
from dropo_torch.effects.base import VOCABULARY, Effect, Kind, Method, Quantity, Setting, find_effect
from dropo_torch.effects.filters import observed_rates
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet, place_effects, plain_setting
from dropo_torch.effects.simulator import effect_simulator
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.support.checkpoint import dumps, loads
from dropo_torch.support.extras import MissingExtra
from dropo_torch.testing.laws import Broken, NotApplicable, Report, require, require_same, try_laws

#: Two links in a chain, a free ball on a floor and a cart on a rail: places for every kind of effect.
RIG = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping=".1" limited="true" range="-60 60"/>
      <geom name="upper" type="capsule" size=".03" fromto="0 0 0 .1 0 -.4" mass="1.2"/>
      <body name="lower" pos=".1 0 -.4">
        <joint name="elbow" type="hinge" axis="0 1 0" stiffness=".3" springref="20"/>
        <geom name="lower" type="capsule" size=".03" fromto="0 0 0 .05 0 -.3" mass=".7"/>
      </body>
    </body>
    <body name="ball" pos="1 0 .099">
      <freejoint name="root"/><geom name="ball" type="sphere" size=".1" mass="1"/>
    </body>
    <body name="cart" pos="-2 0 1">
      <joint name="rail" type="slide" axis="1 0 0"/><geom name="cart" type="box" size=".1 .1 .1" mass="2"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="lift" joint="shoulder" gear="3"/><position name="bend" joint="elbow" kp="5" kv=".02"/>
    <motor name="push" joint="rail" gear="2"/>
  </actuator>
</mujoco>"""

_WINDOWS, _STEPS = 3, 12
#: Physics steps of a filtered signal.
_SIGNAL = 48
#: Largest difference of states, and of filtered signals, that counts as none.
_SAME_STATE, _SAME_SIGNAL = 1e-9, 1e-11
#: Share of a signal's size to which a filter may remember what lies beyond its memory.
_FORGOTTEN = 1e-3


def check_effect(
    effect: Effect,
    model: mujoco.MjModel | None = None,
    *,
    frame_skip: int = 4,
    numbers: Mapping[str, float] | None = None,
    idle: Collection[str | None] = (),
) -> Report:
    """Check that an effect keeps the laws that gap searches, fits and trainings rely on.

    See :class:`~dropo_torch.effects.Effect`. All places that the effect has in the model are tried.

    Args:
        effect: what is checked.
        model: where it is tried; by default two links, a free ball on a floor and a cart on a rail, with actuators.
        frame_skip: physics steps of a logged transition.
        numbers: values of its quantities at which it acts; by default those from which a search begins, and 0.3
            of their scale beside the neutral value where that is neutral.
        idle: places at which it does nothing in this model, such as a geom that touches nothing.

    Raises:
        ConformanceError: the first law that does not hold.
    """
    model = model or rig()
    setting = plain_setting(model, parse_observation(model, None), frame_skip)
    return try_laws(type(effect).__name__, EffectCase(effect, setting, dict(numbers or {}), frozenset(idle)), LAWS)


def rig() -> mujoco.MjModel:
    """Return the model on which effects are tried, its bodies ready for any mass and center."""
    spec = mujoco.MjSpec.from_string(RIG)
    for body in spec.bodies[1:]:
        body.simple = 0
    return spec.compile()


@dataclass(frozen=True)
class EffectCase:
    """An effect and where it is checked; see :func:`check_effect`."""

    effect: Effect
    setting: Setting
    numbers: dict[str, float]
    idle: frozenset[str | None]

    @cached_property
    def places(self) -> list[str | None]:
        """Where the effect can sit."""
        return self.effect.targets(self.setting)

    def quantities(self, target: str | None) -> tuple[Quantity, ...]:
        """The effect's numbers."""
        return self.effect.quantities(self.setting, target)

    def neutral(self, target: str | None) -> np.ndarray:
        """The values at which it is absent, ``(p,)``."""
        return np.array([q.neutral for q in self.quantities(target)])

    def acting(self, target: str | None) -> np.ndarray:
        """Values at which it acts, ``(p,)``."""
        found = np.array(self.effect.starts(self.setting, target)[-1], dtype=np.float64)
        for i, q in enumerate(self.quantities(target)):
            if found[i] == q.neutral:
                found[i] = np.clip(q.neutral + 0.3 * q.scale, q.low, q.high)
            found[i] = self.numbers.get(q.name, found[i])
        return found

    def rows(self, target: str | None) -> torch.Tensor:
        """Values of each row, from near neutral to beyond acting, ``(R, p)``."""
        neutral, acting = self.neutral(target), self.acting(target)
        low, high = (np.array([getattr(q, end) for q in self.quantities(target)]) for end in ("low", "high"))
        shares = np.array([0.5, 1.0, 1.3])[:, None]
        return torch.from_numpy(np.clip(neutral + shares * (acting - neutral), low, high))

    @property
    def step(self) -> float:
        """Seconds of a physics step."""
        return float(self.setting.model.opt.timestep)

    @cached_property
    def signal(self) -> torch.Tensor:
        """Commands of each row, held for some physics steps as a log's are, ``(R, S)``."""
        held = np.random.default_rng(3).uniform(-1, 1, (3, _SIGNAL // 4))
        return torch.from_numpy(np.repeat(held, 4, 1))

    @cached_property
    def fine(self) -> torch.Tensor:
        """Columns at every physics step, ``(R, F, n)``."""
        phase = np.random.default_rng(4).uniform(0, 6, (3, 1, self.setting.observation.size))
        time = self.step * np.arange(40 * self.setting.frame_skip + 1)[:, None]
        return torch.from_numpy(np.sin(phase + (2 + phase) * time))

    def path(self, fine: torch.Tensor, instants: int = 4) -> SensedPath:
        """Paths that the sensors see."""
        return SensedPath.of(fine, instants, self.setting.frame_skip, self.step, observed_rates(self.setting))

    @cached_property
    def states(self) -> torch.Tensor:
        """Initial states of some windows; free and ball joints are where the model has them, ``(W, nq + nv)``."""
        model, rng = self.setting.model, np.random.default_rng(0)
        states = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (_WINDOWS, 1))
        simple = model.jnt_qposadr[model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
        states[:, simple] += rng.uniform(-0.9, 0.9, (_WINDOWS, len(simple)))
        states[:, model.nq :] += rng.normal(0, 1.0, (_WINDOWS, model.nv))
        return torch.from_numpy(states)

    @cached_property
    def controls(self) -> torch.Tensor:
        """Their controls, ``(W, T, nu)``."""
        low, high = self.setting.model.actuator_ctrlrange.T
        limited = self.setting.model.actuator_ctrllimited.astype(bool)
        ends = np.where(limited, low, -1.0), np.where(limited, high, 1.0)
        return torch.from_numpy(np.random.default_rng(1).uniform(*ends, (_WINDOWS, _STEPS, len(low))))

    @cached_property
    def plain(self) -> torch.Tensor:
        """States without the effect, ``(W, T, nq + nv)``."""
        model = self.setting.model
        simulator = MujocoSimulator(
            model, parameters=ParameterSpace.empty(model), frame_skip=self.setting.frame_skip, num_threads=1
        )
        return simulator.rollout(self.states, self._after_its_past(simulator.history), _NO_VALUES)[:, 0]

    def _after_its_past(self, history: int) -> torch.Tensor:
        """The controls after as many that were held before, ``(W, H + T, nu)``."""
        return torch.cat([self.controls[:, :1].expand(-1, history, -1), self.controls], 1)

    def placed(self, target: str | None, values: np.ndarray) -> EffectSet:
        """The effect at a place, as a config would have it."""
        names = [q.name for q in self.quantities(target)]
        document: dict[str, Any] = {"effect": self.effect.name, **dict(zip(names, values.tolist(), strict=True))}
        if target is not None:
            document["target"] = target
        space = ParameterSpace.empty(self.setting.model)
        return place_effects([document], space, self.setting, lambda name: self.effect)

    def fitted(self, target: str | None, values: np.ndarray, states: torch.Tensor) -> torch.Tensor:
        """States ``(W, T, nq + nv)`` of the simulator that a fit has."""

        def make(model: mujoco.MjModel, skip: int, space: ParameterSpace) -> MujocoSimulator:
            return MujocoSimulator(model, parameters=space, frame_skip=skip, num_threads=1)

        simulator = effect_simulator(
            "mujoco", self.placed(target, values), ParameterSpace.empty(self.setting.model), make,
            timestep=self.step * self.setting.frame_skip, longest=1000, num_threads=1,
        )  # fmt: skip
        return simulator.rollout(states, self._after_its_past(simulator.history), _NO_VALUES)[:, 0]

    def trained(self, target: str | None, values: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """What the environments of a training show at first ``(W, nq + nv)``, and then ``(W, T, nq + nv)``."""
        try:
            from dropo_torch.rl.effects import Commands, Sensors
            from dropo_torch.rl.stepper import MujocoStepper
        except MissingExtra as error:
            raise NotApplicable(str(error)) from None
        effects, space, rows = self.placed(target, values), ParameterSpace.empty(self.setting.model), torch.arange(3)
        none = np.zeros((_WINDOWS, 0))
        stepper = MujocoStepper(space, _WINDOWS, frame_skip=self.setting.frame_skip, effects=effects, num_threads=1)
        commands = Commands(effects, _WINDOWS, device=torch.device("cpu"))
        sensors = Sensors(effects, _WINDOWS, space=space, device=torch.device("cpu"))
        stepper.reset(rows, self.states, torch.from_numpy(none))
        commands.reset(rows, none)
        sensors.reset(rows, self.states, none)
        first, shown = sensors.show(self.states), []
        for control in self.controls.split(1, 1):
            fine = stepper.step(commands(control))
            sensors.record(fine)
            shown.append(sensors.show(fine[:, -1]))
        return first, torch.stack(shown, 1)


_NO_VALUES = torch.zeros(1, 0, dtype=torch.float64)


def _require_close(found: torch.Tensor, expected: torch.Tensor, within: float, what: str, like: str) -> None:
    require(found.shape == expected.shape, f"{what} of shape {tuple(found.shape)}", f"{tuple(expected.shape)}")
    error = float((found - expected).abs().nan_to_num(nan=math.inf).max()) if found.numel() else 0.0
    require(error <= within, f"{what} off by {error:.3g}", f"{like}, within {within:g}")


def _needs(case: EffectCase, method: Method) -> None:
    if not case.effect.has(method):
        raise NotApplicable(f"the effect has no {method}")


def _filtered(case: EffectCase, signal: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Commands that act, of a filter settled at the first."""
    effect, step = case.effect, case.step
    return effect.command(signal, values, step, effect.settled(signal[:, :1], values, step))[0]


def _column(case: EffectCase, target: str | None) -> int:
    return case.setting.column(target)


def _it_says_what_it_is(case: EffectCase) -> None:
    effect = case.effect
    name = getattr(effect, "name", None)
    require(isinstance(name, str) and name.isidentifier(), f"name {name!r}", "a word such as joint_damping")
    kind = getattr(effect, "kind", None)
    require(kind in get_args(Kind), f"kind {kind!r}", f"one of {', '.join(get_args(Kind))}")
    sentence = getattr(effect, "sentence", None)
    says_where = isinstance(sentence, str) and (kind == "world" or "{target}" in sentence)
    require(says_where, f"sentence {sentence!r}", "words in which {target} stands for the target")
    methods = get_args(Method)
    require(any(effect.has(m) for m in methods), "no method that acts", f"one of {', '.join(methods)}")


def _it_has_places(case: EffectCase) -> None:
    require(case.places, "no place in this model", "one; or another model")
    require(len(set(case.places)) == len(case.places), f"places {case.places}", "each once")
    if case.effect.kind == "world":
        require(case.places == [None], f"places {case.places} of the world", "[None]")
        return
    prefix = {"joint": "jnt", "sensor": ""}.get(case.effect.kind, case.effect.kind)
    known = case.setting.names(prefix) if prefix else list(case.setting.observation.labels)
    strangers = [p for p in case.places if p not in known]
    require(not strangers, f"places {strangers}", f"some of {', '.join(known)}")


def _its_numbers_are_consistent(case: EffectCase) -> None:
    for target in case.places:
        quantities = case.quantities(target)
        names = [q.name for q in quantities]
        require(quantities and len(set(names)) == len(names), f"numbers {names} at {target}", "one or more, each once")
        for q in quantities:
            where = f"{q.name} at {target}"
            require(q.unit, f"no unit of {where}", "one; '-' for none")
            inside = q.low <= q.neutral <= q.high and q.low < q.high and math.isfinite(q.neutral)
            require(inside, f"{where} with bounds [{q.low}, {q.high}], neutral {q.neutral}", "low <= neutral <= high")
            require(0 < q.scale < math.inf, f"{where} with scale {q.scale}", "a positive size that matters")


def _searches_begin_within_the_bounds(case: EffectCase) -> None:
    for target in case.places:
        quantities = case.quantities(target)
        low, high = (np.array([getattr(q, end) for q in quantities]) for end in ("low", "high"))
        begun = case.effect.starts(case.setting, target)
        require(begun, f"no values from which a search begins at {target}", "one or more")
        for values in begun:
            require(np.shape(values) == low.shape, f"initial values {values} at {target}", f"{len(low)} numbers")
            inside = ((low <= values) & (values <= high)).all()
            require(inside, f"initial values {values} at {target}", f"ones between {low} and {high}")
    moved = case.effect.screened()
    count = len(case.quantities(case.places[0]))
    require(moved is None or set(moved) <= set(range(count)), f"screened {moved}", f"some of the {count} numbers")


def _it_is_kept_by_its_name(case: EffectCase) -> None:
    if VOCABULARY.get(case.effect.name) is not case.effect:
        raise NotApplicable("the effect is not registered")
    kept = b"".join(dumps("gap", (), case.effect, named={Effect: find_effect}))
    for found in (loads(kept, named={Effect: find_effect})[2], copy.deepcopy(case.effect)):
        require(found is case.effect, f"{found!r} after it was kept or copied", "the registered effect itself")


def _the_same_numbers_do_the_same_and_nothing_given_is_changed(case: EffectCase) -> None:
    own = copy.deepcopy(vars(case.effect))
    given = _image(case.setting.model)
    for target in case.places:
        for name, act in _acts(case, target).items():
            first, second = act(), act()
            for one, other in zip(first, second, strict=True):
                require_same(other, one, f"{name} at {target}, a second time,", "the first time")
    require(np.array_equal(_image(case.setting.model), given), "a change of the setting's model", "none: it is shared")
    require(vars(case.effect) == own, f"state of its own, {vars(case.effect)}", "none: effects are shared")


def _acts(case: EffectCase, target: str | None) -> dict[str, Callable[[], list[torch.Tensor]]]:
    """What the effect does at a place, by method; each call checks that its arguments stay as they are."""
    effect, setting, values, rows = case.effect, case.setting, case.acting(target), case.rows(target)
    nq = setting.model.nq

    def kept(call: Callable[..., Any], *arguments: Any) -> list[torch.Tensor]:
        given = [torch.as_tensor(a) for a in arguments if isinstance(a, np.ndarray | torch.Tensor)]
        before = [a.clone() for a in given]
        found = call(*arguments)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(given, before, strict=True)):
            raise Broken(f"other arguments after {call.__name__} at {target}", "the arguments as they were given")
        return [torch.as_tensor(part).clone() for part in (found if isinstance(found, tuple) else (found,))]

    def applied(numbers: np.ndarray) -> np.ndarray:
        model = copy.copy(setting.model)
        effect.apply(model, target, numbers)
        return _image(model)

    acts: dict[str, Callable[[], list[torch.Tensor]]] = {}
    if effect.has("apply"):
        acts["apply"] = lambda: kept(applied, values)
    if effect.has("force"):
        q, v = (x.contiguous().numpy() for x in (case.states[:, :nq], case.states[:, nq:]))
        acts["force"] = lambda: kept(effect.force, setting, target, rows.numpy(), q, v)
        memory = effect.recall(setting, target, rows.numpy(), q, v)
        acts["force_after"] = lambda: kept(effect.force_after, setting, target, rows.numpy(), -q, v, memory)
    if effect.has("wrench"):
        acts["wrench"] = lambda: kept(effect.wrench, setting, target, values)
    if effect.has("command"):
        state = effect.settled(case.signal[:, :1], rows, case.step)
        acts["command"] = lambda: kept(effect.command, case.signal, rows, case.step, state)
    if effect.has("sense"):
        column, path = _column(case, target), case.path(case.fine)
        rates = torch.zeros_like(path.shown[:, -1])
        acts["sense"] = lambda: kept(lambda fine, shown, r: effect.sense(path, column, r), path.fine, path.shown, rows)
        acts["unsense"] = lambda: kept(effect.unsense, path.shown[:, -1], rates, column, rows)
    return acts


def _image(model: mujoco.MjModel) -> np.ndarray:
    """All of a model's numbers, as bytes."""
    found = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, found)
    return found


def _rows_do_not_depend_on_each_other(case: EffectCase) -> None:
    effect, setting = case.effect, case.setting
    if not (effect.has("force") or effect.is_filter):
        raise NotApplicable("the effect has no rows")
    for target in case.places:
        rows = case.rows(target)
        for name, whole, alone in _row_by_row(case, target, rows):
            for i in range(len(rows)):
                one = alone(slice(i, i + 1), rows[i : i + 1])
                _require_close(one[0], whole(rows)[i], _SAME_SIGNAL, f"{name} of row {i} alone at {target}", "the same")
            shared = alone(slice(None), rows[:1])
            expected = whole(rows[:1].expand(len(rows), -1))
            _require_close(shared, expected, _SAME_SIGNAL, f"{name} of values (1, p) at {target}", "that of (R, p)")
    if effect.has("force"):
        target = case.places[0]
        q, v = case.states[:, : setting.model.nq].numpy(), case.states[:, setting.model.nq :].numpy()
        found = effect.force(setting, target, case.rows(target).numpy(), q, v)
        require(found.shape == v.shape, f"forces of shape {found.shape}", f"(R, nv), {v.shape}")


def _row_by_row(case: EffectCase, target: str | None, rows: torch.Tensor) -> list[tuple[str, Any, Any]]:
    """For each method with rows: all of them at once, and some of them."""
    effect, setting, nq = case.effect, case.setting, case.setting.model.nq
    found: list[tuple[str, Any, Any]] = []
    if effect.has("force"):
        q, v = case.states[:, :nq].numpy(), case.states[:, nq:].numpy()

        def force(part: slice, values: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(effect.force(setting, target, values.numpy(), q[part], v[part]))

        def later(part: slice, values: torch.Tensor) -> torch.Tensor:
            own = setting, target, values.numpy()
            return torch.cat([torch.from_numpy(x) for x in effect.force_after(
                *own, 0.9 * q[part], -v[part], effect.recall(*own, q[part], v[part]))], 1)  # fmt: skip

        found.append(("force", lambda values: force(slice(None), values), force))
        found.append(("force_after", lambda values: later(slice(None), values), later))
    if effect.has("command"):

        def command(part: slice, values: torch.Tensor) -> torch.Tensor:
            return _filtered(case, case.signal[part], values)

        found.append(("command", lambda values: command(slice(None), values), command))
    if effect.has("sense"):

        def sense(part: slice, values: torch.Tensor) -> torch.Tensor:
            return effect.sense(case.path(case.fine[part]), _column(case, target), values)

        found.append(("sense", lambda values: sense(slice(None), values), sense))
    return found


def _a_force_without_a_past_is_that_of_its_state(case: EffectCase) -> None:
    _needs(case, "force")
    effect, nq = case.effect, case.setting.model.nq
    q, v = case.states[:, :nq].numpy(), case.states[:, nq:].numpy()
    for target in case.places:
        own = case.setting, target, case.rows(target).numpy()
        found, expected = effect.force_after(*own, q, v, effect.recall(*own, q, v))[0], effect.force(*own, q, v)
        where = f"force_after of what is recalled at {target}"
        _require_close(torch.from_numpy(found), torch.from_numpy(expected), _SAME_SIGNAL, where, "the force")


def _commands_in_pieces_are_those_in_one(case: EffectCase) -> None:
    _needs(case, "command")
    effect, signal, step = case.effect, case.signal, case.step
    for target in case.places:
        rows = case.rows(target)
        state, parts = effect.settled(signal[:, :1], rows, step), []
        for piece in signal.split([7, 1, 16, _SIGNAL - 24], 1):
            part, state = effect.command(piece, rows, step, state)
            parts.append(part)
        whole = _filtered(case, signal, rows)
        _require_close(torch.cat(parts, 1), whole, _SAME_SIGNAL, f"commands in pieces at {target}", "those in one")


def _a_settled_filter_is_steady(case: EffectCase) -> None:
    _needs(case, "command")
    for target in case.places:
        constant = case.signal[:, :1].expand(-1, _SIGNAL)
        found = _filtered(case, constant, case.rows(target))
        steady = found[:, :1].expand(-1, _SIGNAL)
        _require_close(found, steady, _SAME_SIGNAL, f"a constant command at {target}", "a constant after `settled`")


def _what_lies_beyond_its_memory_does_not_matter(case: EffectCase) -> None:
    if not case.effect.is_filter:
        raise NotApplicable("the effect is no filter")
    tried = False
    for target in case.places:
        values = case.acting(target)
        seconds, rows = case.effect.memory(values), torch.from_numpy(values)[None]
        require(seconds >= 0, f"a memory of {seconds} s at {target}", "0 or more")
        steps = math.inf if math.isinf(seconds) else math.ceil(seconds / case.step - 1e-9) + 1
        if case.effect.has("command") and steps < 1000:
            tried = True
            same = case.signal.repeat(1, 1 + int(steps) // _SIGNAL)
            found = [_filtered(case, torch.cat([first, same], 1), rows) for first in (case.signal, -case.signal)]
            after = _SIGNAL + int(steps)
            _require_close(
                found[0][:, after:], found[1][:, after:], _FORGOTTEN, f"commands at {target}, later than its memory of "
                f"{seconds:g} s,", "those after another past",
            )  # fmt: skip
        if case.effect.has("sense") and steps < case.fine.shape[1] - 1:
            tried = True
            other = case.fine.clone()
            other[:, : -int(steps) - 1] = 7.0
            column = _column(case, target)
            shown = [case.effect.sense(case.path(f, 1), column, rows) for f in (case.fine, other)]
            _require_close(shown[1], shown[0], _FORGOTTEN, f"a measurement at {target}", "that after another past")
    if not tried:
        raise NotApplicable("the effect remembers all of its past")


def _measurements_in_pieces_are_those_in_one(case: EffectCase) -> None:
    _needs(case, "sense")
    for target in case.places:
        column, rows = _column(case, target), case.rows(target)
        whole = case.effect.sense(case.path(case.fine), column, rows)
        require(whole.shape == (3, 4), f"measurements of shape {tuple(whole.shape)}", "(R, T), (3, 4)")
        last = case.effect.sense(case.path(case.fine, 1), column, rows)
        _require_close(last[:, 0], whole[:, -1], _SAME_SIGNAL, f"a single measurement at {target}", "the last of many")


def _true_states_are_found_from_shown_ones(case: EffectCase) -> None:
    _needs(case, "sense")
    at_once = [t for t in case.places if case.effect.memory(case.acting(t)) == 0]
    if not at_once:
        raise NotApplicable("measurements come late: the true state is a forecast")
    for target in at_once:
        column, rows, path = _column(case, target), case.rows(target), case.path(case.fine, 1)
        shown = path.shown[:, 0].clone()
        shown[:, column] = case.effect.sense(path, column, rows)[:, 0]
        found = case.effect.unsense(shown, torch.zeros_like(shown), column, rows)
        true = path.shown[:, 0, column]
        _require_close(found, true, _SAME_SIGNAL, f"unsense of what sense shows at {target}", "the true column")


def _neutral_numbers_change_nothing(case: EffectCase) -> None:
    for target in case.places:
        found = case.fitted(target, case.neutral(target), case.states)
        _require_close(found, case.plain, _SAME_STATE, f"states with neutral numbers at {target}", "those without it")


def _numbers_that_matter_change_the_simulation(case: EffectCase) -> None:
    for target in case.places:
        values = case.acting(target)
        found = case.fitted(target, values, case.states).nan_to_num(nan=1e3)
        change = float((found - case.plain).abs().max())
        wanted = "one; or give numbers at which it acts, or the idle places"
        require(change > 1e-6 or target in case.idle, f"no change at {target} with {values}", wanted)


def _fit_and_training_agree(case: EffectCase) -> None:
    if case.effect.has("sense") and all(case.effect.memory(case.acting(t)) > 0 for t in case.places):
        raise NotApplicable("measurements come late: a fit forecasts what a training knows of the first")
    if case.setting.model.na:
        raise NotApplicable("a training begins with activations at rest, a fit with those of the log's past")
    for target in case.places:
        values = case.acting(target)
        first, found = case.trained(target, values)
        expected = case.fitted(target, values, first)
        _require_close(found, expected, _SAME_STATE, f"states of a training at {target}", "those of a fit")


LAWS: Sequence[Callable[[EffectCase], None]] = (
    _it_says_what_it_is,
    _it_has_places,
    _its_numbers_are_consistent,
    _searches_begin_within_the_bounds,
    _it_is_kept_by_its_name,
    _the_same_numbers_do_the_same_and_nothing_given_is_changed,
    _rows_do_not_depend_on_each_other,
    _a_force_without_a_past_is_that_of_its_state,
    _commands_in_pieces_are_those_in_one,
    _a_settled_filter_is_steady,
    _what_lies_beyond_its_memory_does_not_matter,
    _measurements_in_pieces_are_those_in_one,
    _true_states_are_found_from_shown_ones,
    _neutral_numbers_change_nothing,
    _numbers_that_matter_change_the_simulation,
    _fit_and_training_agree,
)
