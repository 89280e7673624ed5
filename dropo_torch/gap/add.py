"""Putting named effects into the model, and into the config that fits their numbers."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import yaml

from dropo_torch.config import Config
from dropo_torch.data.features import Features
from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed, Quantity, Setting, applied
from dropo_torch.effects.engine import whole_ratio
from dropo_torch.effects.export import write_model
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.effects.simulator import overlap
from dropo_torch.errors import InputError
from dropo_torch.gap.log import make_setting
from dropo_torch.gap.result import FAMILY, Gap
from dropo_torch.gap.verify import below
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.parameters import ParameterSpace, Target, object_names, read_field
from dropo_torch.problem import Problem
from dropo_torch.support.files import write_atomically

#: Intervals of an effect's numbers, by its key and the number's name.
Intervals = Mapping[tuple[str, str | None], Mapping[str, tuple[float, float]]]
#: Of an effect's numbers, by their names: their search boxes, and what a config says of each as a parameter.
_Boxes = dict[str, tuple[float, float]]
_Specifications = dict[str, dict[str, Any]]

#: Half widths of a number's interval that its search box reaches, and the box's least half width, relative.
REACH, LEAST = 4.0, 0.2
#: Seconds before and after a push that are left out with it.
BESIDE = 0.1


def named(gap: Gap, setting: Setting) -> dict[Placed, dict[str, tuple[float, float]]]:
    """Return the named effects with their values and the intervals of these; what has no name is left out.

    A family stands there effect by effect.
    """
    found = {}
    for e in gap.effects:
        if e.effect == "unnamed":
            continue
        effect, numbers = find_effect(e.variant or e.effect), e.parameters
        members = {t: (s,) for t, s in numbers.items()} if e.target == FAMILY else {e.target: tuple(numbers.values())}
        for target, strengths in members.items():
            quantities = effect.quantities(setting, target)
            ranges = {q.name: (s.low, s.high) for q, s in zip(quantities, strengths, strict=True) if not q.discrete}
            found[Placed(effect, target, tuple(s.value for s in strengths))] = ranges
    return found


def add(problem: Problem, gap: Gap, folder: Path) -> list[str]:
    """Write ``model.xml`` with the effects that MJCF can express, and ``config.yaml`` that uses all of them.

    The declared parameters stand in ``model.xml`` with the values that were fitted beside the effects. Where the config
    had no noise, the one that is written has the estimate.

    Args:
        problem: the problem that was searched.
        gap: what was found.
        folder: where to write.

    Returns:
        Remarks for a person: what the model file lacks, or why there is none.
    """
    setting = make_setting(problem, problem.trajectories)
    found = named(gap, setting)
    if not found:
        return []
    if problem.model_path is None:
        return ["No model.xml and no config.yaml were written: the environment's model is no file; name one by model."]
    notes = []
    values = problem.space.vector({n: after for n, (_, _, after) in gap.declared.items()})
    before = () if problem.effects is None else problem.effects.at(values)
    model: Path | None = folder / "model.xml"
    rest: list[Placed] = []
    try:
        rest = write_model(problem.model_path, [*before, *found], folder / "model.xml", problem.space, values)
        if rest:
            names = ", ".join(_place(p) for p in rest)
            has = "" if problem.sensed else ", config.yaml has it"
            notes.append(f"MJCF cannot express {names}: model.xml lacks it{has}.")
        finer = whole_ratio(setting.model.opt.timestep, applied(setting.model, [*before, *found]).opt.timestep)
        if finer != 1 and finer is not None:
            notes.append(f"{setting.frame_skip * finer} steps of model.xml make one logged transition.")
    except InputError as error:
        model = None
        notes.append(f"No model.xml was written: {error}.")
    if again := [p for p in found if p.key in {b.key for b in before}]:
        return [*notes, f"No config.yaml was written: the config has {_place(again[0])} already; let its numbers vary."]
    ranges = {placed.key: intervals for placed, intervals in found.items()}
    if problem.sensed is not None and (model is None or rest):
        return [*notes, "No config.yaml was written: effects that MJCF cannot express do not go with a log of sensors."]
    config = problem.sensed or _with_noise(problem, np.array(gap.noise))
    if gap.disturbances and config.leave_out:
        notes.append("config.yaml leaves out what it did, and not the pushes: add their spans to leave_out.")
    elif gap.disturbances:
        config = config.model_copy(update={"leave_out": pushed_spans(gap)})
    options = {"whole": problem.sensed is not None}
    write_config(config, problem.space, setting, list(found), ranges, model, folder / "config.yaml", **options)
    return notes


def pushed_spans(gap: Gap) -> list[tuple[int, float, float]]:
    """Return the spans that a config leaves out, for something pushed in them that is no part of the robot."""
    ends = ((d.episode, max(d.begin - BESIDE, 0.0), d.end + BESIDE) for d in gap.disturbances)
    return [(episode, float(f"{begin:.6g}"), float(f"{end:.6g}")) for episode, begin, end in ends]


def _place(placed: Placed) -> str:
    return f"{placed.effect.name} of {placed.target}" if placed.target else placed.effect.name


def _with_noise(problem: Problem, noise: np.ndarray) -> Config:
    """The config with the noise of features ``(m,)``, and with ε below it, where it said nothing of them."""
    config = problem.config
    columns = Features.of(problem.observation).column_noise(noise)
    changes: dict[str, Any] = {}
    if config.noise is None:
        changes["noise"] = [float(f"{v:.3g}") for v in columns]
    if "epsilon" not in config.model_fields_set:
        changes["epsilon"] = float(f"{below(problem.objective.features.feature_noise(columns)):.2g}")
    return config.model_copy(update=changes)


def write_config(
    config: Config, space: ParameterSpace, setting: Setting, placed: Sequence[Placed], intervals: Intervals,
    model_path: Path | None, path: Path, *, whole: bool = False,
) -> None:  # fmt: skip
    """Write the config of a fit of the effects' numbers, together with the parameters that the config had.

    Numbers with an interval become parameters around their value; others stay fixed. Where fields of the model express
    every native effect's numbers, one each, the config names ``model_path``, the model with these effects, and its
    fields. Otherwise it names the model as it was, and its native effects stand in ``effects`` like all others; so it
    does where one of them changes the step, of which the log's, the filters' and a task's are whole numbers.

    Args:
        config: the config by which the effects were found.
        space: its parameters, over the model without effects.
        setting: where the effects were found.
        placed: the effects with values.
        intervals: where a number lies, as ``(low, high)``, by the effect's key and the number's name.
        model_path: the model that :func:`~dropo_torch.effects.export.write_model` wrote, or ``None``.
        path: where to write.
        whole: name ``model_path``, which has all effects, in any case; only numbers that are its fields then vary.
    """
    document = _document(config, path.parent)
    if config.backend == "gymnasium" and any(not p.effect.outer for p in placed):
        document = {k: v for k, v in document.items() if k != "environment"}  # it has its model for itself
        document |= {"backend": "mujoco", "frame_skip": setting.frame_skip}
    boxes = {p.key: _boxes(p, setting, intervals.get(p.key, {})) for p in placed}
    native = {p.key: p for p in placed if p.effect.native}
    fields: dict[tuple[str, str | None], _Specifications] = {}
    if whole:
        fields = {key: _fields(p, setting, boxes[key]) or {} for key, p in native.items()}
    elif model_path is not None and _may_be_fields(config, document, space, setting, list(native.values())):
        found = {key: _fields(p, setting, boxes[key]) for key, p in native.items()}
        fields = {key: own for key, own in found.items() if own is not None and None not in found.values()}
    if model_path is not None and fields:
        document["model"] = os.path.relpath(model_path.resolve(), path.parent.resolve())
    for p in placed:
        _put(document, p, setting, boxes[p.key], fields.get(p.key))
    if config.backend == "warp" and any(not p.effect.outer and p.key not in fields for p in placed):
        document["backend"] = "mujoco"
    if document.get("effects") and config.optimizer == "adam":
        document["optimizer"] = "fisher"
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    write_atomically(path, text.encode())


def _may_be_fields(
    config: Config, document: Mapping[str, Any], space: ParameterSpace, setting: Setting, native: Sequence[Placed]
) -> bool:
    """Whether a config may name the model with native effects in it, whose numbers are then fields."""
    # Fields are written after the model is read: what both a parameter and an effect write must stay an effect.
    entries = tuple(Entry(p.effect, p.target, p.values, (-1,) * len(p.values)) for p in native)
    return not (
        config.backend == "gymnasium"
        or config.effects
        or applied(setting.model, native).opt.timestep != setting.model.opt.timestep
        or overlap(EffectSet(entries, setting), space)
        or any(spec.get("relative") for spec in document["parameters"].values())
    )


def _put(
    document: dict[str, Any], placed: Placed, setting: Setting, boxes: _Boxes, fields: _Specifications | None
) -> None:
    """Put an effect's numbers into a config: as ``fields`` of its model, or beside an entry of ``effects``."""
    if fields is None:
        entry, fields = _effect(placed, setting, boxes)
        document["effects"] = [*document.get("effects", []), entry]
    for number, specification in fields.items():
        document["parameters"][_free_name(document["parameters"], placed, number)] = specification


def _boxes(placed: Placed, setting: Setting, intervals: Mapping[str, tuple[float, float]]) -> _Boxes:
    """The bounds of the numbers that have an interval."""
    quantities = zip(placed.effect.quantities(setting, placed.target), placed.values, strict=True)
    return {q.name: search_box(v, intervals[q.name], q) for q, v in quantities if q.name in intervals}


def search_box(value: float, interval: tuple[float, float], quantity: Quantity) -> tuple[float, float]:
    """Return the bounds of a number that was found in an interval: several half widths to either side."""
    half = 0.5 * abs(interval[1] - interval[0])
    reach = max(REACH * half, LEAST * abs(value), 1e-3 * quantity.scale)
    low, high = (float(f"{end:.4g}") for end in (value - reach, value + reach))
    low, high = max(low, quantity.low), min(high, quantity.high)
    return (low, high) if low < high else (value - reach, value + reach)


def _document(config: Config, folder: Path) -> dict[str, Any]:
    """The config as plain data without a bundled simulation, whose parts it names instead."""
    document = config.portable()
    if config.sim is not None and config.backend != "gymnasium":
        sim = bundled_sim(config.sim)
        own = {
            "model": str(sim.model), "data": str(sim.log), "frame_skip": sim.frame_skip,
            "observation": list(sim.observation), "parameters": {n: dict(s) for n, s in sim.parameters.items()},
            **({"task": config.sim} if sim.task is not None else {}),
        }  # fmt: skip
        document = {**own, **{k: v for k, v in document.items() if k != "sim"}}
    document.setdefault("parameters", {})
    return document


def _fields(placed: Placed, setting: Setting, boxes: _Boxes) -> _Specifications | None:
    """An effect's numbers as parameters that are fields of the model; ``None`` unless each is one number of it."""
    found = {}
    for i, q in enumerate(placed.effect.quantities(setting, placed.target)):
        if q.name in boxes:
            own, (low, high) = placed.values[i], boxes[q.name]
            values = [(*placed.values[:i], v, *placed.values[i + 1 :]) for v in (own, own + 1e-3 * q.scale, low, high)]
            here, there, *ends = (applied(setting.model, [placed.at(v)]) for v in values)
            changed = _differing(here, there)
            specification = _specification(setting.model, *changed[0]) if len(changed) == 1 else None
            if specification is None:
                return None
            bounds = sorted(float(f"{Target(*changed[0]).read(end):.6g}") for end in ends)
            found[q.name] = {**specification, "bounds": bounds, "unit": q.unit}
    return found


def _effect(placed: Placed, setting: Setting, boxes: _Boxes) -> tuple[dict[str, Any], _Specifications]:
    """An effect as an entry of ``effects``, and its numbers that are parameters."""
    name, quantities = placed.effect.name, placed.effect.quantities(setting, placed.target)
    numbers = {q.name: float(f"{v:.6g}") for q, v in zip(quantities, placed.values, strict=True)}
    target, place = ({} if placed.target is None else {key: placed.target} for key in ("target", "name"))
    parameters = {
        q.name: {"effect": name, **place, "index": q.name, "bounds": list(boxes[q.name]), "unit": q.unit}
        for q in quantities
        if q.name in boxes
    }
    return {"effect": name, **target, **numbers}, parameters


def _differing(one: mujoco.MjModel, other: mujoco.MjModel) -> list[tuple[str, int]]:
    """The real numbers in which two models differ."""
    found = []
    for field in sorted(mujoco.batch.MODEL_FIELDS):
        a, b = (read_field(m, field).reshape(-1) for m in (one, other))
        found += [(field, int(i)) for i in np.flatnonzero(a != b)]
    return found


def _specification(model: mujoco.MjModel, field: str, flat: int) -> dict[str, Any] | None:
    """How a config names a number of the model, or ``None``."""
    shape = read_field(model, field).shape
    if field.startswith("opt."):
        return {"field": field, **({"index": flat} if math.prod(shape) > 1 else {})}
    size = math.prod(shape[1:])
    row, component = divmod(flat, size)
    prefix = field.split("_", 1)[0]
    if prefix in ("dof", "qpos"):
        at = model.jnt_dofadr if prefix == "dof" else model.jnt_qposadr
        match = np.flatnonzero((at == row) & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)))
        if not match.size:
            return None
        row = int(match[0])
    elif prefix not in ("jnt", "body", "geom", "actuator"):
        return None
    name = object_names(model, prefix)[row]
    return {"field": field, "name": name, **({"index": component} if size > 1 else {})}


def _free_name(taken: Mapping[str, Any], placed: Placed, number: str) -> str:
    """A name for a parameter, such as ``elbow_friction``."""
    place = placed.target if placed.target is not None else placed.effect.name
    base = re.sub("[ ./]", "_", f"{place}_{number}")
    options = itertools.chain((base, f"{base}_{placed.effect.name}"), (f"{base}_{i}" for i in itertools.count(2)))
    return next(name for name in options if name not in taken)
