"""Figures of the page on a proposed config."""

from __future__ import annotations

from typing import Any

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, MAX_POINTS, ORANGE


def column_panel(time: np.ndarray, values: np.ndarray, derived: np.ndarray | None, label: str) -> Any:
    """Draw the beginning of a column, and of a velocity what its position's changes make of it.

    Args:
        time: seconds, ``(n,)``.
        values: in the model's unit, ``(n,)``.
        derived: the position's changes over time, ``(n,)``, or ``None``.
        label: for screen readers.
    """
    figure, axes = drawing.new_panel(300, 120, label, (46, 20, 8, 6), grid="y")
    every = max(1, len(time) // MAX_POINTS)
    if derived is not None:
        axes.plot(time[::every], derived[::every], color=ORANGE, linewidth=2.2, alpha=0.5)
    axes.plot(time[::every], values[::every], color=BLUE, linewidth=1.1)
    if len(time) > 1:
        axes.set_xlim(time[0], time[-1])
    drawing.few_ticks(axes, 5, 4)
    return figure
