"""Whether a log excites the parameters: those that move nothing that is compared cannot be fitted."""

from __future__ import annotations

import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.support.rows import evenly


def no_effect(objective: Objective, *, max_transitions: int = 500) -> tuple[list[str], int]:
    """Return the names of parameters that move no compared column of this log, and the logged steps simulated.

    Each is moved to 1/4 and 4/5 of its box with the others in the middle, as it is itself for comparison: an effect
    that is even about the middle shows, too. First on transitions spread over the log, which count as none, then, where
    nothing moved, on all of them.
    """
    box, space = objective.box, objective.simulator.parameters
    d = len(space)
    points = np.repeat(box.middle[None], 2 * d + 1, axis=0)
    points[np.arange(d), np.arange(d)] = box.low + 0.25 * box.width
    points[np.arange(d) + d, np.arange(d)] = box.low + 0.8 * box.width
    values = box.values(points)

    def count_moved(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        moved = features[:, : 2 * d] - features[:, 2 * d :]
        change = torch.nan_to_num(moved, nan=1.0).abs().unflatten(1, (2, d)).amax(1)
        magnitude = 1e-12 * torch.nan_to_num(features).abs().amax((0, 1))
        return (change > magnitude).sum((0, 2)).double()

    spread = evenly(len(objective), max_transitions)
    if bool((objective.map(values, count_moved, spread).total > 0).all()):
        return [], 0
    found = objective.map(values, count_moved)
    names = [name for name, count in zip(space.names, found.total, strict=True) if count == 0]
    return names, found.simulated_transitions


def refuse_dead_parameters(objective: Objective) -> int:
    """Raise an :class:`InputError` that names every parameter without effect on the log; return what that took.

    Returns:
        Logged steps that were simulated.
    """
    dead, simulated_transitions = no_effect(objective)
    if not dead:
        return simulated_transitions
    space = objective.simulator.parameters
    where = "; ".join(f"{p.name!r} ({p.where})" for p in space.parameters if p.name in dead)
    raise InputError(
        f"parameters: {where} moves no compared column of this log anywhere in its bounds; "
        "leave it out, or log a motion that excites it"
    )
