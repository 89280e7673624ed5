"""Effects as a config names them: where they sit, and which of their numbers are parameters."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from dropo_torch.data.observation import Observation
from dropo_torch.effects.base import Effect, Method, Placed, Quantity, Setting, Signals
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import Parameter, ParameterSpace

Find = Callable[[str], Effect]


@dataclass(frozen=True)
class Entry:
    """An effect at a target: its fixed numbers, and the columns of parameter vectors that hold the others.

    Attributes:
        effect: the effect.
        target: where it sits, ``None`` for the world.
        fixed: its numbers, ``(p,)``; NaN where a parameter holds one.
        columns: the parameter of each number, or -1, ``(p,)``.
    """

    effect: Effect
    target: str | None
    fixed: tuple[float, ...]
    columns: tuple[int, ...]

    @property
    def varies(self) -> bool:
        """Whether a parameter holds one of its numbers."""
        return any(c >= 0 for c in self.columns)

    @property
    def place(self) -> str:
        """What it is called in messages, such as ``actuator_delay at elbow``."""
        return self.effect.name + (f" at {self.target}" if self.target else "")

    def values(self, vectors: np.ndarray) -> np.ndarray:
        """Return its numbers ``(K, p)`` under parameter vectors ``(K, d)``."""
        out = np.tile(np.asarray(self.fixed, dtype=np.float64), (len(vectors), 1))
        for number, column in enumerate(self.columns):
            if column >= 0:
                out[:, number] = vectors[:, column]
        return out

    def at(self, vector: np.ndarray) -> Placed:
        """Return the effect under a parameter vector ``(d,)``."""
        numbers = tuple(f if c < 0 else float(vector[c]) for f, c in zip(self.fixed, self.columns, strict=True))
        return Placed(self.effect, self.target, numbers)


@dataclass(frozen=True)
class EffectSet:
    """The effects of a config, and the setting in which they are understood."""

    entries: tuple[Entry, ...]
    setting: Setting

    def __len__(self) -> int:
        """Return the number of effects."""
        return len(self.entries)

    def at(self, vector: np.ndarray) -> tuple[Placed, ...]:
        """Return the effects under a parameter vector ``(d,)``."""
        return tuple(entry.at(vector) for entry in self.entries)

    def matching(self, wanted: Callable[[Effect], bool]) -> EffectSet:
        """Return the effects of a kind."""
        return EffectSet(tuple(e for e in self.entries if wanted(e.effect)), self.setting)

    @property
    def native(self) -> EffectSet:
        """The effects that are numbers of the model."""
        return self.matching(lambda effect: effect.native)

    @property
    def outer(self) -> EffectSet:
        """The effects that stay outside of a simulator."""
        return self.matching(lambda effect: effect.outer)

    def having(self, method: Method) -> EffectSet:
        """Return the effects that act by a method."""
        return self.matching(lambda effect: effect.has(method))

    def kinds(self, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which parameter vectors ``(K, d)`` give the effects the same numbers.

        Returns:
            A row of each kind, ``(N,)``, and the kind of each row, ``(K,)``.
        """
        numbers = [np.zeros((len(vectors), 1)), *(e.values(vectors) for e in self.entries)]
        _, first, kind = np.unique(np.concatenate(numbers, 1), axis=0, return_index=True, return_inverse=True)
        return first, kind.reshape(-1)

    def look_back(self, space: ParameterSpace) -> float:
        """Return the most seconds that the effects look back, wherever the parameters may go."""
        top = np.minimum(space.high + (space.high - space.low), space.limits[:, 1])
        numbers = [(e.effect, v) for e in self.entries for v in e.values(np.stack([space.low, space.high, top]))]
        return max((effect.memory(values) for effect, values in numbers), default=0.0)


def plain_setting(
    model: mujoco.MjModel, observation: Observation, frame_skip: int, size: float = 1.0, *, differentiated: bool = False
) -> Setting:
    """Return a setting that knows no log: everything moves, touches and has one size."""
    ones = np.full(max(model.nv, model.nu, model.nbody, observation.size), size)
    signals = Signals(
        timestep=frame_skip * float(model.opt.timestep), position=np.tile([-size, size], (model.nq, 1)),
        speed=ones[: model.nv], force=ones[: model.nv], inertia=ones[: model.nv], command=ones[: model.nu],
        column=ones[: observation.size], linear_speed=ones[: model.nbody],
        angular_speed=ones[: model.nbody], contacts=np.ones(model.ngeom, dtype=bool),
    )  # fmt: skip
    return Setting(model, observation, signals, frame_skip, differentiated=differentiated)


def place_effects(given: Sequence[Mapping[str, Any]], space: ParameterSpace, setting: Setting, find: Find) -> EffectSet:
    """Read a config's ``effects`` and the parameters that are numbers of effects.

    Every number of an effect stands in its entry or is a parameter. An effect whose numbers all are parameters needs
    no entry. Where both give a number, the parameter does.

    Args:
        given: the config's ``effects``.
        space: the parameters, those of effects among them.
        setting: the model as given, and the log's columns.
        find: returns an effect by its name.

    Raises:
        InputError: an unknown effect, target or number (the nearest is offered), a number that is missing.
    """
    known: dict[tuple[Effect, str | None], dict[str, tuple[float, int]]] = {}
    for i, document in enumerate(given):
        where = f"effects[{i}]"
        effect, target = key = _located(where, document, "target", setting, find)
        if key in known:
            raise InputError(f"{where}: {effect.name} stands there twice for {target or 'the world'}; keep one")
        numbers = _numbers(where, document, effect.quantities(setting, target))
        known[key] = {name: (value, -1) for name, value in numbers.items()}
    for column, parameter in enumerate(space.parameters):
        if parameter.effect:
            where = f"parameters.{parameter.name}"
            for effect, target in _places(where, parameter, setting, find):
                quantities = effect.quantities(setting, target)
                quantity = _quantity(where, parameter, quantities)
                if next(q for q in quantities if q.name == quantity).discrete:
                    raise InputError(
                        f"{where}: {quantity} of {effect.name} is a choice, which cannot vary; "
                        f"give it in effects: {{effect: {effect.name}, {quantity}: a number}}"
                    )
                if known.setdefault((effect, target), {}).get(quantity, (0.0, -1))[1] >= 0:
                    raise InputError(f"{where}: {quantity} of {effect.name} is already a parameter; keep one of them")
                known[effect, target][quantity] = math.nan, column
    entries = [_entry(effect, target, effect.quantities(setting, target), of) for (effect, target), of in known.items()]
    return EffectSet(tuple(entries), setting)


def lowest(effects: EffectSet, space: ParameterSpace) -> np.ndarray:
    """Return what each parameter cannot fall below ``(d,)``, by the effects' physics; minus infinity for fields.

    Raises:
        InputError: bounds that reach below, or a fixed number that is.
    """
    s = effects.setting
    settings = [plain_setting(s.model, s.observation, s.frame_skip, size) for size in (1.0, 3.0)]
    least = np.full(len(space), -np.inf)
    for entry in effects.entries:
        pairs = zip(*(entry.effect.quantities(x, entry.target) for x in settings), strict=True)
        for (one, other), value, column in zip(pairs, entry.fixed, entry.columns, strict=True):
            if column < 0:
                if one.low == other.low and value < one.low - 1e-9 * abs(one.low):
                    raise InputError(
                        f"effects: {one.name} of {entry.place} is {value:g} {one.unit}; expected {one.low:g} or more"
                    )
                continue
            parameter = space.parameters[column]
            if one.low == other.low:  # a bound that no log shifts is one of physics
                least[column] = one.low
            elif min(one.low, other.low) > 0:
                least[column] = 0.1 * max(parameter.low, 0.0)
            if parameter.low < least[column] or (min(one.low, other.low) > 0 and parameter.low <= 0):
                raise InputError(
                    f"parameters.{parameter.name}: bounds [{parameter.low:g}, {parameter.high:g}] allow a "
                    f"{one.name} of {entry.effect.name} below {max(least[column], 0.0 if one.low > 0 else one.low):g}"
                )
    return least


def _places(where: str, parameter: Parameter, setting: Setting, find: Find) -> list[tuple[Effect, str | None]]:
    """The effect of a parameter at each of its targets: one, a list of them, or patterns with ``*``."""
    effect, found = _find(where, parameter.effect, find), list[str | None]()
    for name in parameter.objects or (None,):
        pattern = name is not None and "*" in name
        matches = [t for t in effect.targets(setting) if t and fnmatch.fnmatchcase(t, str(name))] if pattern else []
        found += matches or [name]  # what matches nothing is refused by name
    return [_located(where, {"effect": effect.name, "name": t}, "name", setting, find) for t in dict.fromkeys(found)]


def _located(
    where: str, document: Mapping[str, Any], key: str, setting: Setting, find: Find
) -> tuple[Effect, str | None]:
    """The effect and the target of an entry."""
    effect, target = _find(where, document.get("effect"), find), document.get(key)
    possible = effect.targets(setting)
    if target not in possible:
        names = [str(t) for t in possible if t is not None]
        if possible == [None]:
            raise InputError(f"{where}: {effect.name} belongs to the whole world; leave {key} out")
        if target is None and names:
            raise InputError(f"{where}: no {key} given; expected the {effect.kind}'s name" + choices("", names))
        has = f"cannot be at {target!r}" if target is not None else "fits nowhere in this model"
        raise InputError(f"{where}: {effect.name} {has}" + choices(target, names))
    return effect, target


def _find(where: str, name: str | None, find: Find) -> Effect:
    """The effect of an entry, by its name."""
    if name is None:
        raise InputError(f"{where}: no effect named; expected effect: NAME, such as effect: joint_friction")
    try:
        return find(str(name))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _numbers(where: str, document: Mapping[str, Any], quantities: Sequence[Quantity]) -> dict[str, float]:
    """The numbers of an entry, by name."""
    known = [q.name for q in quantities]
    found = {}
    for key, value in document.items():
        if key in ("effect", "target"):
            continue
        if key not in known:
            raise InputError(f"{where}: unknown key {key!r}" + choices(key, known))
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            unit = next(q.unit for q in quantities if q.name == key)
            raise InputError(f"{where}: {key} is {value!r}; expected a number in {unit}")
        found[key] = float(value)
    return found


def _quantity(where: str, parameter: Parameter, quantities: Sequence[Quantity]) -> str:
    """Which number of an effect a parameter is."""
    names = [q.name for q in quantities]
    if not parameter.quantity and len(names) == 1:
        return names[0]
    if parameter.quantity not in names:
        given = f"no number {parameter.quantity!r}" if parameter.quantity else "several numbers; add index: NAME"
        raise InputError(f"{where}: {parameter.effect} has {given}" + choices(parameter.quantity, names))
    return parameter.quantity


def _entry(
    effect: Effect, target: str | None, quantities: Sequence[Quantity], known: Mapping[str, tuple[float, int]]
) -> Entry:
    """The entry of an effect whose numbers are fixed, or in columns of parameter vectors."""
    found = [known.get(q.name, (math.nan, -1)) for q in quantities]
    entry = Entry(effect, target, tuple(fixed for fixed, _ in found), tuple(column for _, column in found))
    if missing := next((q for q in quantities if q.name not in known), None):
        raise InputError(
            f"effects: {entry.place} has no {missing.name}; give {missing.name}: a number in {missing.unit} "
            "in its entry of effects, or make it a parameter"
        )
    return entry
