"""The config that fits the numbers of effects that were found."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import yaml

from dropo_torch.config import Config
from dropo_torch.effects.base import Placed, Quantity, Setting
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.effects.simulator import overlap
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.parameters import ParameterSpace, object_names, read_field
from dropo_torch.support.files import write_atomically

#: Intervals of an effect's numbers, by its key and the number's name.
Intervals = Mapping[tuple[str, str | None], Mapping[str, tuple[float, float]]]

#: Half widths of a number's interval that its search box reaches, and the box's least half width, relative.
REACH, LEAST = 4.0, 0.2


def write_config(
    config: Config, space: ParameterSpace, setting: Setting, placed: Sequence[Placed], intervals: Intervals,
    model_path: Path, path: Path,
) -> None:  # fmt: skip
    """Write the config of a fit of the effects' numbers, together with the parameters that the config had.

    Numbers with an interval become parameters around their value; others stay fixed. Where fields of the model express
    every native effect's numbers, one each, the config names ``model_path``, the model with these effects, and its
    fields. Otherwise it names the model as it was, and its native effects stand in ``effects`` like all others.

    Args:
        config: the config by which the effects were found.
        space: its parameters, over the model without effects.
        setting: where the effects were found.
        placed: the effects with values.
        intervals: where a number lies, as ``(low, high)``, by the effect's key and the number's name.
        model_path: the model that :func:`~dropo_torch.effects.export.write_model` wrote.
        path: where to write.
    """
    document = _document(config, path.parent)
    native = [p for p in placed if p.effect.native]
    # Fields are written after the model is read: what both a parameter and an effect write must stay an effect.
    entries = tuple(Entry(p.effect, p.target, p.values, (-1,) * len(p.values)) for p in native)
    plain = (
        config.backend != "gymnasium"
        and not config.effects
        and overlap(EffectSet(entries, setting), space) is None
        and not any(spec.get("relative") for spec in document.get("parameters", {}).values())
    )
    fields = {p.key: _fields(p, setting, intervals.get(p.key, {})) for p in native} if plain else {}
    plain = plain and all(f is not None for f in fields.values())
    if native and plain:
        document["model"] = os.path.relpath(model_path.resolve(), path.parent.resolve())
    for p in placed:
        quantities = p.effect.quantities(setting, p.target)
        boxes = {
            q.name: search_box(v, intervals[p.key][q.name], q)
            for q, v in zip(quantities, p.values, strict=True)
            if q.name in intervals.get(p.key, {})
        }
        if plain and p.effect.native:
            _add_fields(document, p, quantities, boxes, fields[p.key] or {}, setting)
        else:
            fixed = config.backend == "gymnasium" and p.effect.native
            _add_effect(document, p, quantities, {} if fixed else boxes)
    inside = [p for p in placed if not p.effect.outer and not (plain and p.effect.native)]
    if inside and config.backend == "warp":
        document["backend"] = "mujoco"
    if document.get("effects") and config.optimizer == "adam":
        document["optimizer"] = "fisher"
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    write_atomically(path, text.encode())


def search_box(value: float, interval: tuple[float, float], quantity: Quantity) -> tuple[float, float]:
    """Return the bounds of a number that was found in an interval: several half widths to either side."""
    half = 0.5 * abs(interval[1] - interval[0])
    reach = max(REACH * half, LEAST * abs(value), 1e-3 * quantity.scale)
    low, high = max(value - reach, quantity.low), min(value + reach, quantity.high)
    return (float(f"{low:.4g}"), float(f"{high:.4g}")) if low < high else (value - reach, value + reach)


def _document(config: Config, folder: Path) -> dict[str, Any]:
    """The config as plain data without a bundled simulation, whose parts it names instead."""
    document = config.portable()
    if config.sim is not None and config.backend != "gymnasium":
        sim = bundled_sim(config.sim)
        own = {
            "model": str(sim.model), "data": str(sim.log), "frame_skip": sim.frame_skip,
            "observation": list(sim.observation), "parameters": {n: dict(s) for n, s in sim.parameters.items()},
        }  # fmt: skip
        document = {**own, **{k: v for k, v in document.items() if k != "sim"}}
    document.setdefault("parameters", {})
    return document


def _fields(
    placed: Placed, setting: Setting, wanted: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[str, int]] | None:
    """The number of the model that each wanted number of an effect is, ``(field, flat index)``; ``None`` if not one."""
    found = {}
    for i, q in enumerate(placed.effect.quantities(setting, placed.target)):
        if q.name not in wanted:
            continue
        here, there = np.array(placed.values), np.array(placed.values)
        there[i] += 1e-3 * q.scale
        changed = _differing(_applied(setting, placed, here), _applied(setting, placed, there))
        if len(changed) != 1 or _specification(setting.model, *changed[0]) is None:
            return None
        found[q.name] = changed[0]
    return found


def _applied(setting: Setting, placed: Placed, values: np.ndarray) -> mujoco.MjModel:
    model = copy.copy(setting.model)
    placed.effect.apply(model, placed.target, values)
    return model


def _differing(one: mujoco.MjModel, other: mujoco.MjModel) -> list[tuple[str, int]]:
    """The real numbers in which two models differ."""
    found = []
    for field in sorted(mujoco.batch.MODEL_FIELDS):
        a, b = (np.atleast_1d(read_field(m, field)).reshape(-1) for m in (one, other))
        found += [(field, int(i)) for i in np.flatnonzero(a != b)]
    return found


def _specification(model: mujoco.MjModel, field: str, flat: int) -> dict[str, Any] | None:
    """How a config names a number of the model, or ``None``."""
    array = read_field(model, field)
    if field.startswith("opt."):
        return {"field": field, **({"index": flat} if array.size > 1 else {})}
    size = int(np.prod(array.shape[1:], dtype=int))
    row, component = divmod(flat, size)
    prefix = field.split("_", 1)[0]
    if prefix in ("dof", "qpos"):
        at = model.jnt_dofadr if prefix == "dof" else model.jnt_qposadr
        match = np.flatnonzero(at == row)
        if not match.size or int(model.jnt_type[match[0]]) < int(mujoco.mjtJoint.mjJNT_SLIDE):
            return None
        row = int(match[0])
    elif prefix not in ("jnt", "body", "geom", "actuator"):
        return None
    name = object_names(model, prefix)[row]
    return {"field": field, "name": name, **({"index": component} if size > 1 else {})}


def _add_fields(
    document: dict[str, Any], placed: Placed, quantities: Sequence[Quantity], boxes: dict[str, tuple[float, float]],
    fields: dict[str, tuple[str, int]], setting: Setting,
) -> None:  # fmt: skip
    """Add an effect's numbers as parameters of the written model's fields."""
    for i, q in enumerate(quantities):
        if q.name not in boxes:
            continue
        field, flat = fields[q.name]
        ends = []
        for bound in boxes[q.name]:
            values = np.array(placed.values)
            values[i] = bound
            ends.append(float(np.atleast_1d(read_field(_applied(setting, placed, values), field)).reshape(-1)[flat]))
        specification = _specification(setting.model, field, flat)
        assert specification is not None
        name = _free_name(document["parameters"], placed, q)
        bounds = sorted(float(f"{e:.6g}") for e in ends)
        document["parameters"][name] = {**specification, "bounds": bounds, "unit": q.unit}


def _add_effect(
    document: dict[str, Any], placed: Placed, quantities: Sequence[Quantity], boxes: dict[str, tuple[float, float]]
) -> None:
    """Add an effect to ``effects``, and its numbers to the parameters."""
    entry: dict[str, Any] = {"effect": placed.effect.name}
    if placed.target is not None:
        entry["target"] = placed.target
    for q, value in zip(quantities, placed.values, strict=True):
        entry[q.name] = float(f"{value:.6g}")
        if q.name in boxes:
            parameter: dict[str, Any] = {"effect": placed.effect.name}
            if placed.target is not None:
                parameter["name"] = placed.target
            parameter |= {"index": q.name, "bounds": list(boxes[q.name]), "unit": q.unit}
            document["parameters"][_free_name(document["parameters"], placed, q)] = parameter
    document["effects"] = [*document.get("effects", []), entry]


def _free_name(taken: Mapping[str, Any], placed: Placed, quantity: Quantity) -> str:
    """A name for a parameter, such as ``elbow_friction``."""
    place = placed.target if placed.target is not None else placed.effect.name
    base = f"{place}_{quantity.name}".replace(" ", "_").replace(".", "_").replace("/", "_")
    options = [base, f"{base}_{placed.effect.name}", *(f"{base}_{i}" for i in range(2, 1000))]
    return next(name for name in options if name not in taken)
