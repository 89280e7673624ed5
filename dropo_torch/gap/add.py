"""Putting named effects into the model and the config."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed, Setting
from dropo_torch.effects.export import write_model
from dropo_torch.errors import InputError
from dropo_torch.gap.config import write_config
from dropo_torch.gap.log import make_setting
from dropo_torch.gap.result import FAMILY, Gap
from dropo_torch.problem import Problem


def named(gap: Gap) -> list[Placed]:
    """Return the named effects with their values, a family's one by one; what has no name is left out."""
    found = []
    for e in gap.effects:
        values = [s.value for s in e.parameters.values()]
        if e.target == FAMILY:
            found += [Placed(find_effect(e.effect), t, (v,)) for t, v in zip(e.parameters, values, strict=True)]
        elif e.effect != "unnamed":
            found.append(Placed(find_effect(e.effect), e.target, tuple(values)))
    return found


def intervals(gap: Gap, setting: Setting) -> dict[tuple[str, str | None], dict[str, tuple[float, float]]]:
    """Return the intervals of the numbers of :func:`named`, by effect and target."""
    found: dict[tuple[str, str | None], dict[str, tuple[float, float]]] = {}
    for e in gap.effects:
        for name, s in e.parameters.items():
            if e.target == FAMILY:
                (quantity,) = find_effect(e.effect).quantities(setting, name)
                found[e.effect, name] = {quantity.name: (s.low, s.high)}
            else:
                found.setdefault((e.effect, e.target), {})[name] = (s.low, s.high)
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
    placed = named(gap)
    if not placed or problem.model_path is None:
        return []
    notes = []
    values = problem.space.vector({n: after for n, (_, _, after) in gap.declared.items()})
    before = () if problem.effects is None else problem.effects.at(values)
    model = folder / "model.xml"
    try:
        rest = write_model(problem.model_path, [*before, *placed], model, problem.space, values)
        if rest:
            names = ", ".join(f"{p.effect.name} of {p.target}" if p.target else p.effect.name for p in rest)
            notes.append(f"MJCF cannot express {names}: model.xml lacks it, config.yaml has it.")
    except InputError as error:
        notes.append(f"No model.xml was written: {error}.")
    setting = make_setting(problem, problem.trajectories)
    config = problem.config
    if config.noise is None:
        columns = Features.of(problem.observation).column_noise(np.array(gap.noise))
        config = config.model_copy(update={"noise": [float(f"{v:.3g}") for v in columns]})
    write_config(config, problem.space, setting, placed, intervals(gap, setting), model, folder / "config.yaml")
    return notes
