"""What may vary: named parameters of a model, and vectors of their values.

A parameter names a field of ``MjModel``, the object that carries it and, where the field has several
components, which one. Any real-valued field that ``mujoco.batch`` gives per simulation can vary. Two
more fields stand for several at once: ``actuator_kp`` and ``actuator_kv``, the gains of position and
velocity servos (in ``gainprm`` and ``biasprm`` together).
"""

from __future__ import annotations

import copy
import fnmatch
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import mujoco
import mujoco.batch
import numpy as np

from dropo_torch.errors import InputError, choices
from dropo_torch.models.constants import derive
from dropo_torch.models.load import CENTERS, load_model
from dropo_torch.support.given import check_keys

#: Fields whose values must be positive, whatever the search bounds.
POSITIVE_FIELDS = frozenset({"body_mass", "body_inertia", "opt.timestep", "opt.impratio", "geom_size", "pair_friction"})
#: Fields whose values must not be negative.
NONNEGATIVE_FIELDS = frozenset(
    {
        "dof_damping", "dof_frictionloss", "dof_armature", "jnt_stiffness", "geom_friction", "opt.density",
        "opt.viscosity", "actuator_damping", "actuator_armature", "actuator_kp", "actuator_kv", "actuator_delay",
        "tendon_stiffness", "tendon_damping", "tendon_frictionloss", "tendon_armature", "body_gravcomp",
    }
)  # fmt: skip
#: Servo gains: where a gain stands, as (field, component, factor).
_SERVO = {
    "actuator_kp": (("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)),
    "actuator_kv": (("actuator_biasprm", 2, -1.0),),
}
#: Fields of directions and of rotations: what is written there is normalized.
UNIT_FIELDS = frozenset({"body_quat", "geom_quat", "site_quat", "jnt_axis"})
_FIRST_COMPONENT = frozenset({"geom_friction", "pair_friction", "actuator_gear", "actuator_gainprm"})
#: First word of a field → the kind of object that carries it.
_OBJECTS = {kind: kind for kind in ("body", "geom", "actuator", "site", "tendon", "pair", "flex")}
_OBJECTS |= dict.fromkeys(("jnt", "dof", "qpos0", "qpos"), "joint") | {"eq": "equality"}
_KEYS = ("field", "name", "index", "bounds", "limits", "unit", "scale", "relative", "scale_inertia", "effect")
#: Keys of a parameter that is a number of an effect.
_EFFECT_KEYS = ("effect", "name", "index", "bounds", "limits", "unit", "scale")


@dataclass(frozen=True)
class Target:
    """One number of a model that a parameter writes: ``field.flat[index] = factor * value``."""

    field: str
    index: int
    factor: float = 1.0

    def read(self, model: mujoco.MjModel) -> float:
        """Return the number that a model has there."""
        return float(read_field(model, self.field).reshape(-1)[self.index])


@dataclass(frozen=True)
class Parameter:
    """One parameter of a simulator.

    Attributes:
        name: what the parameter is called, in reports and files.
        low, high: the search box of its mean, in ``unit``.
        field: the field of ``MjModel``; empty for a simulator that is no MuJoCo model.
        objects: names of the objects that carry it; several are tied to one value.
        index: component of the field, where it has several.
        unit: unit of the value, for people.
        limits: values outside are never simulated: samples are redrawn inside them.
        scale: ``"log"`` searches and distributes the logarithm of the value.
        targets: the numbers of the model that it writes.
        effect: the effect of which it is a number, where it is no field.
        quantity: which of the effect's numbers; empty for the only one.
    """

    name: str
    low: float = -np.inf
    high: float = np.inf
    field: str = ""
    objects: tuple[str, ...] = ()
    index: int | None = None
    unit: str = ""
    limits: tuple[float, float] = (-np.inf, np.inf)
    scale: Literal["linear", "log"] = "linear"
    targets: tuple[Target, ...] = ()
    effect: str = ""
    quantity: str = ""

    @property
    def where(self) -> str:
        """The parameter's place in the model, such as ``body_mass of thigh``."""
        if self.effect:
            what = f"{self.quantity} of {self.effect}" if self.quantity else self.effect
            return what + "".join(f" at {name}" for name in self.objects)
        component = "" if self.index is None else f"[{self.index}]"
        of = f" of {', '.join(self.objects)}" if self.objects else ""
        return f"{self.field or 'parameter'}{component}{of}"

    def nominal(self, model: mujoco.MjModel | None) -> float:
        """Return a model's own value; NaN for a parameter outside the model."""
        found = None if model is None else next(iter(self.targets), None)
        return found.read(model) / found.factor if found and found.factor else math.nan


class ParameterSpace:
    """The parameters that may vary, in order, and the vectors of their values ``(..., d)``.

    Args:
        model: the model or its path; ``None`` for a simulator that is no MuJoCo model.
        parameters: name → ``field``, ``name`` (one, a list or a pattern such as ``"*_joint"``),
            ``bounds`` and, where needed, ``index``, ``unit``, ``limits``, ``scale: log``,
            ``relative: true`` (the value multiplies the model's own) and ``scale_inertia: true`` (a
            mass takes its inertia along).

    Raises:
        InputError: an unknown key, field or object (the nearest is offered), bounds that cannot be.
    """

    def __init__(self, model: mujoco.MjModel | str | Path | None, parameters: Mapping[str, Mapping[str, Any]]) -> None:
        self.model = None if model is None else load_model(model)
        if not parameters:
            raise InputError("parameters: none given; name at least one, such as 'mass: {field: body_mass, ...}'")
        self.parameters = tuple(_parse(self.model, str(name), spec) for name, spec in parameters.items())
        _refuse_overlap(self)
        if self.model is not None:
            _refuse_derived(self)

    @classmethod
    def empty(cls, model: mujoco.MjModel) -> ParameterSpace:
        """Return a space over a model in which nothing varies."""
        space = cls.__new__(cls)
        space.model, space.parameters = model, ()
        return space

    def __len__(self) -> int:
        """Return the number of parameters d."""
        return len(self.parameters)

    def __repr__(self) -> str:
        return f"ParameterSpace({', '.join(self.names)})"

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, d of them."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def low(self) -> np.ndarray:
        """Lower search bounds, ``(d,)``."""
        return np.array([p.low for p in self.parameters])

    @cached_property
    def high(self) -> np.ndarray:
        """Upper search bounds, ``(d,)``."""
        return np.array([p.high for p in self.parameters])

    @property
    def limits(self) -> np.ndarray:
        """Physical limits, ``(d, 2)``."""
        return np.array([p.limits for p in self.parameters]).reshape(-1, 2)

    @cached_property
    def is_log(self) -> np.ndarray:
        """Whether each parameter is searched by its logarithm, ``(d,)`` bool."""
        return np.array([p.scale == "log" for p in self.parameters])

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """The model fields that the parameters write."""
        return tuple(dict.fromkeys(t.field for _, t in self.targets))

    @property
    def targets(self) -> list[tuple[int, Target]]:
        """Every number that is written, with the column of its parameter."""
        return [(column, t) for column, p in enumerate(self.parameters) for t in p.targets]

    @property
    def nominal(self) -> np.ndarray:
        """The model's own values, ``(d,)``; NaN for a parameter outside the model."""
        return np.array([p.nominal(self.model) for p in self.parameters])

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """Return named values as a vector ``(d,)``.

        Raises:
            InputError: a missing or unknown name.
        """
        for name in values:
            if name not in self.names:
                raise InputError(f"parameters: unknown name {name!r}" + choices(name, self.names))
        for name in self.names:
            if name not in values:
                raise InputError(f"parameters: no value given for {name!r}")
        return np.array([float(values[n]) for n in self.names])

    def with_limits(self, low: np.ndarray) -> ParameterSpace:
        """Return the same space with the lower physical limits ``(d,)`` raised to those given."""
        other, raised = copy.copy(self), np.maximum(self.limits[:, 0], low).tolist()
        pairs = zip(self.parameters, raised, strict=True)
        other.parameters = tuple(replace(p, limits=(least, p.limits[1])) for p, least in pairs)
        return other

    def on(self, model: mujoco.MjModel) -> ParameterSpace:
        """Return the same parameters, with the same targets and factors, of another model of the same robot."""
        other = copy.copy(self)
        other.model = model
        return other

    def named(self, values: np.ndarray) -> dict[str, float]:
        """Return a vector ``(d,)`` as name → value."""
        return dict(zip(self.names, (float(v) for v in values), strict=True))

    def write(self, fields: Mapping[str, np.ndarray], values: np.ndarray) -> None:
        """Write parameter vectors ``(K, d)`` into per-simulation model fields ``(K, ...)``, in place."""
        for column, target in self.targets:
            fields[target.field].reshape(len(values), -1)[:, target.index] = target.factor * values[:, column]
        for field in UNIT_FIELDS.intersection(self.fields):
            _normalize(field, fields[field])

    def write_into(self, model: mujoco.MjModel, vector: Sequence[float] | np.ndarray) -> None:
        """Write values ``(d,)`` into a model, but not yet what is derived from them."""
        for column, target in self.targets:
            write_field(model, target.field, target.index, target.factor * vector[column])
        for field in UNIT_FIELDS.intersection(self.fields):
            _normalize(field, getattr(model, field))

    def apply(self, values: np.ndarray | Mapping[str, float]) -> mujoco.MjModel:
        """Return a copy of the model with the given values and everything derived from them.

        Raises:
            InputError: no model, other names, or the center of mass of a body that is compiled as simple.
        """
        if self.model is None:
            raise InputError("parameters: these belong to no MuJoCo model")
        vector = self.vector(values) if isinstance(values, Mapping) else np.asarray(values, dtype=np.float64)
        model = copy.copy(self.model)
        self.write_into(model, vector)
        try:
            derive(model)
        except mujoco.FatalError:
            _check_centers(self.model, self)
            raise
        return model


def _normalize(field: str, array: np.ndarray) -> None:
    """Give the directions or quaternions of a field length 1, in place; those of length 0 stay."""
    rows = array.reshape(-1, 4 if field.endswith("quat") else 3)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows /= np.where(length > 0, length, 1.0)


#: Fields that move a frame; ``body_sameframe`` marks one as coinciding, so that MuJoCo need not compute it.
_FRAMES = ("body_ipos", "body_iquat", "geom_pos", "geom_quat", "site_pos", "site_quat")


def unmark_frames(model: mujoco.MjModel, space: ParameterSpace) -> None:
    """Tell MuJoCo that the frames which the parameters move coincide with no other, in place.

    ``mj_setConst`` does so for a single model; the simulations of a batch share these marks.

    Raises:
        InputError: the center of mass of a body that is compiled as simple.
    """
    _check_centers(model, space)
    none = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
    for _, target in space.targets:
        if target.field not in _FRAMES:
            continue
        row = target.index // read_field(model, target.field).shape[-1]
        getattr(model, target.field.split("_")[0] + "_sameframe")[row] = none
        if target.field not in CENTERS:
            continue
        model.geom_sameframe[model.geom_bodyid == row] = none  # some coincide with the body's inertial frame
        model.site_sameframe[model.site_bodyid == row] = none


def _check_centers(model: mujoco.MjModel, space: ParameterSpace) -> None:
    """Raise an :class:`InputError` for the center of mass of a body that is compiled as simple."""
    for column, target in space.targets:
        if target.field not in CENTERS:
            continue
        row = target.index // read_field(model, target.field).shape[-1]
        if model.body_simple[row]:
            raise InputError(
                f"parameters: {space.names[column]!r}: body {row} ({model.body(row).name}) is compiled as simple, its "
                'center of mass in its frame; give the path of the model, or compile it with simple="false"'
            )


def read_field(model: mujoco.MjModel, field: str) -> np.ndarray:
    """Return a model field, or an option written ``opt.timestep``, as an array."""
    owner, attribute = (model.opt, field[4:]) if field.startswith("opt.") else (model, field)
    return np.asarray(getattr(owner, attribute))


def write_field(model: mujoco.MjModel, field: str, index: int, value: float) -> None:
    """Write one number of a model field, counted over the flattened field."""
    array = read_field(model, field)
    if array.ndim == 0:
        setattr(model.opt, field[4:], value)
    else:
        array.reshape(-1)[index] = value


def object_names(model: mujoco.MjModel, prefix: str) -> list[str]:
    """Names of a model's objects of one kind, in order; unnamed ones are called ``body3``, ``geom0``.

    An actuator without a name is called by its joint's, where it is the first that would be.
    """
    accessor = _OBJECTS[prefix]
    number = model.njnt if accessor == "joint" else getattr(model, f"n{prefix}")
    names = []
    for i in range(number):
        name = getattr(model, accessor)(i).name
        if not name and accessor == "actuator" and model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            name = model.joint(model.actuator_trnid[i, 0]).name
            name = "" if name in names else name
        names.append(name or f"{accessor}{i}")
    return names


def object_number(model: mujoco.MjModel, prefix: str, name: str | None) -> int:
    """Return the number of an object of a kind by its own name, or else by that of :func:`object_names`."""
    number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{_OBJECTS[prefix].upper()}"), str(name))
    return number if number >= 0 else object_names(model, prefix).index(str(name))


def _parse(model: mujoco.MjModel | None, name: str, spec: Mapping[str, Any]) -> Parameter:
    """One entry of ``parameters``."""
    where = f"parameters.{name}"
    if not isinstance(spec, Mapping):
        raise InputError(f"{where}: expected keys such as field, name and bounds, got {spec!r}")
    check_keys(spec, _KEYS, where)
    for key in ("relative", "scale_inertia"):
        if not isinstance(spec.get(key, False), bool):
            raise InputError(f"{where}: {key} is {spec[key]!r}; expected true or false")
    scale = spec.get("scale", "linear")
    if scale not in ("linear", "log"):
        raise InputError(f"{where}: scale is {scale!r}; expected linear or log")
    found = _at_effect(where, name, spec) if "effect" in spec else _at_field(model, where, name, spec)
    low, high = _interval(where, "bounds", spec.get("bounds"))
    limits = _limits(where, found.field, spec, low, high)
    if scale == "log" and low <= 0:
        raise InputError(f"{where}: scale log needs positive bounds, got [{low:g}, {high:g}]")
    return replace(found, low=low, high=high, unit=str(spec.get("unit", "") or ""), limits=limits, scale=scale)


def _at_effect(where: str, name: str, spec: Mapping[str, Any]) -> Parameter:
    """A number of an effect, without bounds; whether there is such an effect is checked where they are known."""
    for key in spec:
        if key not in _EFFECT_KEYS:
            raise InputError(
                f"{where}: {key} belongs to a field; a parameter of an effect has {', '.join(_EFFECT_KEYS)}"
            )
    for key in ("effect", "index"):
        if not isinstance(spec.get(key, ""), str | None):
            raise InputError(f"{where}: {key} is {spec[key]!r}; expected a name")
    given = spec.get("name") or ()
    objects = (given,) if isinstance(given, str) else given
    if not isinstance(objects, list | tuple) or not all(isinstance(o, str) for o in objects):
        raise InputError(f"{where}: name is {given!r}; expected a name, or a list of them")
    objects = tuple(dict.fromkeys(objects))
    return Parameter(name, objects=objects, effect=str(spec["effect"]), quantity=spec.get("index") or "")


def _at_field(model: mujoco.MjModel | None, where: str, name: str, spec: Mapping[str, Any]) -> Parameter:
    """The numbers of the model that a field, its objects and component stand for, without bounds."""
    field, index = _field_and_index(where, spec)
    if model is None:
        for key in ("field", "relative", "scale_inertia"):
            if spec.get(key):
                raise InputError(f"{where}: {key} {spec[key]!r} needs a MuJoCo model; this simulator has none")
        return Parameter(name)
    if not field:
        raise InputError(f"{where}: no field given; expected one of MjModel's, such as field: body_mass")
    targets, objects, index = _targets(model, where, field, index, spec)
    if spec.get("relative"):
        if none := [t.field for t in targets if t.read(model) == 0]:
            raise InputError(f"{where}: relative, but the model's {none[0]} is 0 there; give absolute bounds")
        targets = tuple(replace(t, factor=t.read(model)) for t in targets)  # they multiply the model's own
    if spec.get("scale_inertia"):
        targets = _with_inertia(model, where, field, targets, bool(spec.get("relative")))
    return Parameter(name, field=field, objects=objects, index=index, targets=targets)


def _field_and_index(where: str, spec: Mapping[str, Any]) -> tuple[str, int | None]:
    """The field, and the component of ``geom_friction[0]`` or of ``index``."""
    field = str(spec.get("field", "") or "")
    index = spec.get("index")
    inline = re.fullmatch(r"(.+)\[(\d+)\]", field)
    if inline:
        field, index = inline[1], int(inline[2]) if index is None else index
    if index is not None and (isinstance(index, bool) or not isinstance(index, int) or index < 0):
        raise InputError(f"{where}: index is {index!r}; expected a component counted from 0")
    return field, index


def _targets(
    model: mujoco.MjModel, where: str, field: str, index: int | None, spec: Mapping[str, Any]
) -> tuple[tuple[Target, ...], tuple[str, ...], int | None]:
    """The numbers of the model that a field, its objects and component stand for."""
    if field in _SERVO:
        return _servo_targets(model, where, field, spec)
    known = mujoco.batch.MODEL_FIELDS
    if field not in known:
        real = [f for f in known if read_field(model, f).dtype.kind == "f"]
        raise InputError(f"{where}: unknown field {field!r}" + choices(field, sorted([*real, *_SERVO])))
    array = read_field(model, field)
    if array.dtype.kind != "f":
        raise InputError(f"{where}: field {field!r} holds whole numbers or flags; only real-valued fields can vary")
    if field.startswith("opt."):
        if spec.get("name"):
            raise InputError(f"{where}: {field} belongs to the whole model; leave out name")
        component = _component(where, field, index, array.size)
        return (Target(field, component),), (), (component if array.size > 1 else None)
    prefix = field.split("_", 1)[0]
    if prefix not in _OBJECTS:
        raise InputError(f"{where}: field {field!r} belongs to no named object; it cannot vary")
    objects = _select_objects(where, spec, object_names(model, prefix), _OBJECTS[prefix])
    size = int(np.prod(array.shape[1:], dtype=int))
    every: list[Target] = []
    for number in objects.values():
        rows = _rows(model, prefix, number)
        is_chosen = index is not None or prefix in ("qpos0", "qpos")
        if len(rows) > 1 and size == 1 and is_chosen:  # one degree of freedom of a free or ball joint
            rows, component = [rows[_component(where, f"{field} of this joint", index, len(rows))]], 0
        else:
            component = _component(where, field, index, size)
        every += [Target(field, row * size + component) for row in rows]
    return tuple(every), tuple(objects), (index if index is not None or size == 1 else 0)


def _servo_targets(
    model: mujoco.MjModel, where: str, field: str, spec: Mapping[str, Any]
) -> tuple[tuple[Target, ...], tuple[str, ...], None]:
    objects = _select_objects(where, spec, object_names(model, "actuator"), "actuator")
    targets = []
    for name, number in objects.items():
        if model.actuator_biastype[number] != mujoco.mjtBias.mjBIAS_AFFINE:
            raise InputError(
                f"{where}: actuator {name!r} is no position or velocity servo; use actuator_gear or actuator_gainprm"
            )
        is_velocity = model.actuator_biasprm[number, 1] == 0 and model.actuator_biasprm[number, 2] != 0
        if field == "actuator_kp" and is_velocity:
            raise InputError(f"{where}: actuator {name!r} is a velocity servo; its gain is actuator_kv")
        parts = _SERVO[field] + ((("actuator_gainprm", 0, 1.0),) if field == "actuator_kv" and is_velocity else ())
        if model.actuator_gaintype[number] == mujoco.mjtGain.mjGAIN_PID:  # its gains stand in biasprm alone
            parts = tuple(p for p in parts if p[0] == "actuator_biasprm")
        targets += [Target(p, number * read_field(model, p).shape[1] + index, factor) for p, index, factor in parts]
    return tuple(targets), tuple(objects), None


def _select_objects(where: str, spec: Mapping[str, Any], names: Sequence[str], kind: str) -> dict[str, int]:
    """The objects of ``name``: one, a list, or patterns with ``*``; name → number."""
    wanted = spec.get("name")
    if wanted is None or wanted == []:
        raise InputError(f"{where}: no name given; expected a {kind}" + choices("", names).replace("; ", " ", 1))
    if not isinstance(wanted, (str, list, tuple)):
        raise InputError(f"{where}: name is {wanted!r}; expected a {kind}'s name, or a list of them")
    found: dict[str, int] = {}
    for entry in map(str, [wanted] if isinstance(wanted, str) else wanted):
        matches = fnmatch.filter(names, entry) if "*" in entry else [n for n in names if n == entry]
        if not matches:
            raise InputError(f"{where}: the model has no {kind} {entry!r}" + choices(entry, names))
        found.update({n: names.index(n) for n in matches})
    return found


def _rows(model: mujoco.MjModel, prefix: str, number: int) -> list[int]:
    """Rows of a field for one object: a joint's may be several degrees of freedom."""
    if prefix == "dof":
        return np.flatnonzero(model.dof_jntid == number).tolist()
    if prefix in ("qpos0", "qpos"):
        return list(range(model.jnt_qposadr[number], [*model.jnt_qposadr, model.nq][number + 1]))
    return [number]


def _component(where: str, field: str, index: int | None, size: int) -> int:
    if index is None:
        if size == 1 or field in _FIRST_COMPONENT:
            return 0
        raise InputError(f"{where}: {field} has {size} components; add index: 0 to {size - 1}")
    if index >= size:
        raise InputError(f"{where}: index {index} is outside {field}, which has {size} component{'s' * (size > 1)}")
    return index


def _with_inertia(
    model: mujoco.MjModel, where: str, field: str, targets: tuple[Target, ...], relative: bool
) -> tuple[Target, ...]:
    """Add the principal moments of inertia, in proportion to the mass."""
    if field != "body_mass":
        raise InputError(f"{where}: scale_inertia is for field body_mass, not {field!r}")
    extra = []
    for body in (target.index for target in targets):
        mass = 1.0 if relative else float(model.body_mass[body])
        if mass <= 0:
            raise InputError(f"{where}: scale_inertia needs a body whose mass in the model is positive")
        extra += [Target("body_inertia", 3 * body + i, float(model.body_inertia[body, i]) / mass) for i in range(3)]
    return targets + tuple(extra)


def _interval(where: str, key: str, pair: Any) -> tuple[float, float]:
    is_pair = isinstance(pair, (list, tuple, np.ndarray)) and len(pair) == 2
    if not is_pair or any(isinstance(x, (bool, str)) or not np.isscalar(x) for x in pair):
        raise InputError(f"{where}: {key} is {pair!r}; expected [low, high]")
    low, high = (float(np.float64(str(x))) if isinstance(x, int) else float(x) for x in pair)
    if np.isnan(low) or np.isnan(high) or (key == "bounds" and not np.isfinite([low, high]).all()):
        raise InputError(f"{where}: {key} is [{low:g}, {high:g}]; expected finite numbers")
    if low >= high:
        raise InputError(f"{where}: {key} is [{low:g}, {high:g}]; the first must be below the second")
    return low, high


def _limits(where: str, field: str, spec: Mapping[str, Any], low: float, high: float) -> tuple[float, float]:
    """Physical limits: what the field allows, narrowed by the entry's own ``limits``."""
    positive = field in POSITIVE_FIELDS
    floor = 0.0 if positive or field in NONNEGATIVE_FIELDS else -np.inf
    what = "value" if spec.get("relative") else field.replace("opt.", "").split("_")[-1]
    if positive and low <= 0:
        raise InputError(f"{where}: bounds [{low:g}, {high:g}] allow a {what} that is not positive; start above 0")
    if low < floor:
        raise InputError(f"{where}: bounds [{low:g}, {high:g}] allow a negative {what}; start at 0 or above")
    if spec.get("limits") is not None:
        smallest, largest = _interval(where, "limits", spec["limits"])
        if smallest > low or largest < high:
            raise InputError(f"{where}: limits [{smallest:g}, {largest:g}] do not contain bounds [{low:g}, {high:g}]")
        if smallest < floor or (positive and smallest <= 0):
            raise InputError(f"{where}: limits [{smallest:g}, {largest:g}] allow a {what} that cannot be")
        return smallest, largest
    if positive or spec.get("scale") == "log":
        return 0.1 * low, np.inf
    return floor, np.inf


def _refuse_derived(space: ParameterSpace) -> None:
    """MuJoCo computes some fields from others whenever its constants are set: those cannot vary."""
    values = 0.5 * (space.low + space.high)
    try:
        model = space.apply(values)
    except mujoco.FatalError as error:
        raise InputError(f"parameters: MuJoCo refuses the middle of the bounds: {error}") from None
    for column, t in space.targets:
        if t.field not in UNIT_FIELDS and not np.isclose(t.read(model), t.factor * values[column], rtol=1e-6):
            where = f"parameters.{space.names[column]}"
            raise InputError(f"{where}: MuJoCo derives {t.field} from other fields; vary those instead")


def _refuse_overlap(space: ParameterSpace) -> None:
    """Two parameters must not write the same number."""
    owner: dict[tuple[str, int], int] = {}
    for column, t in space.targets:
        other = owner.setdefault((t.field, t.index), column)
        if other != column:
            here, there = space.names[column], space.names[other]
            raise InputError(f"parameters.{here}: writes the same {t.field} as {there!r}; keep one of them")
