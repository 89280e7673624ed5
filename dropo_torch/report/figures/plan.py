"""Figures of the page on a planned motion: commands and motion over time, and standard errors before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, GRAY, ORANGE

#: Points of a curve that are drawn.
POINTS = 400
#: Colors of standard errors by what they rest on.
COLORS = {"log": GRAY, "plan": ORANGE, "both": BLUE}


def time_panel(time: np.ndarray, values: np.ndarray, limits: tuple[float, float] | None, label: str) -> Any:
    """Draw a command or a column of the state over seconds, with its limits where these are in sight.

    Args:
        time: seconds, ``(n,)``.
        values: ``(n,)``.
        limits: lowest and highest value that is allowed, or ``None``.
        label: for screen readers.
    """
    figure, axes = drawing.new_panel(300, 120, label, (46, 20, 8, 6), grid="y")
    every = max(1, len(time) // POINTS)
    axes.plot(time[::every], values[::every], color=BLUE, linewidth=1.2)
    axes.set_xlim(time[0], time[-1])
    low, high = axes.get_ylim()
    for end in limits or ():
        if low - 1.5 * (high - low) <= end <= high + 1.5 * (high - low):
            axes.axhline(end, color=ORANGE, linewidth=1.0, linestyle=(0, (4, 3)))
    drawing.few_ticks(axes, 5, 4)
    return figure


def error_bars(names: Sequence[str], errors: Mapping[str, np.ndarray]) -> Any:
    """Draw standard errors, as shares of the parameters' bounds, on a logarithmic axis.

    Args:
        names: of the d parameters.
        errors: by what they rest on, ``(d,)`` each, in the order in which they are drawn.
    """
    height = 58 + (14 * len(errors) + 12) * len(names)
    figure, axes = drawing.new_panel(760, height, "standard errors as shares of the bounds", (190, 42, 20, 8), grid="x")
    finite = np.concatenate(list(errors.values()))
    least = max(float(np.min(finite)) / 2, 1e-9)
    thick = 0.8 / max(len(errors), 1)
    for row in range(len(names)):
        for i, (kind, values) in enumerate(errors.items()):
            at = row - 0.4 + thick * (i + 0.5)
            axes.barh(at, float(values[row]) - least, left=least, height=0.86 * thick, color=COLORS[kind])
    axes.set_xlim(least, max(1.0, float(np.max(finite)) * 1.2))
    drawing.log_scale(axes, "x")
    drawing.name_rows(axes, [drawing.shorten(n) for n in names])
    drawing.few_ticks(axes, x=6)
    axes.set_xlabel("standard error, as a share of the width of the bounds")
    return figure
