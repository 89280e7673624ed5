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


def named(gap: Gap, setting: Setting) -> dict[Placed, dict[str, tuple[float, float]]]:
    """Return the named effects with their values and the intervals of these; what has no name is left out.

    A family stands there effect by effect.
    """
    found = {}
    for e in gap.effects:
        if e.effect == "unnamed":
            continue
        effect, numbers = find_effect(e.effect), e.parameters
        members = {t: (s,) for t, s in numbers.items()} if e.target == FAMILY else {e.target: tuple(numbers.values())}
        for target, strengths in members.items():
            names = [q.name for q in effect.quantities(setting, target)]
            ranges = {n: (s.low, s.high) for n, s in zip(names, strengths, strict=True)}
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
    if not gap.effects or problem.model_path is None:
        return []
    setting = make_setting(problem, problem.trajectories)
    found = named(gap, setting)
    if not found:
        return []
    notes = []
    values = problem.space.vector({n: after for n, (_, _, after) in gap.declared.items()})
    before = () if problem.effects is None else problem.effects.at(values)
    model = folder / "model.xml"
    try:
        rest = write_model(problem.model_path, [*before, *found], model, problem.space, values)
        if rest:
            names = ", ".join(f"{p.effect.name} of {p.target}" if p.target else p.effect.name for p in rest)
            notes.append(f"MJCF cannot express {names}: model.xml lacks it, config.yaml has it.")
    except InputError as error:
        notes.append(f"No model.xml was written: {error}.")
    config = problem.config
    if config.noise is None:
        columns = Features.of(problem.observation).column_noise(np.array(gap.noise))
        config = config.model_copy(update={"noise": [float(f"{v:.3g}") for v in columns]})
    ranges = {placed.key: intervals for placed, intervals in found.items()}
    write_config(config, problem.space, setting, list(found), ranges, model, folder / "config.yaml")
    return notes
