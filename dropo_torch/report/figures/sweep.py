"""Figures of the page on a sweep over ε."""

from __future__ import annotations

from typing import Any

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, ORANGE


def epsilon_panel(epsilon: np.ndarray, y: np.ndarray, chosen: float, label: str, *, log: bool) -> Any:
    """Draw one curve over a logarithmic axis of ε, with one place on it marked.

    Args:
        epsilon, y: ``(n,)`` each.
        chosen: the marked ε; NaN for none.
        label: of the vertical axis.
        log: whether the vertical axis is logarithmic, too.
    """
    figure, axes = drawing.new_panel(460, 300, f"{label} against ε", (62, 42, 14, 12), grid="both")
    usable = np.isfinite(epsilon) & (epsilon > 0) & np.isfinite(y) & ((y > 0) | (not log))
    axes.plot(epsilon[usable], y[usable], color=BLUE, linewidth=1.5, marker="o", markersize=4.5)
    if np.isfinite(chosen) and chosen > 0:
        axes.axvline(chosen, color=ORANGE, linewidth=1.0, linestyle=(0, (4, 3)))
        at = usable & np.isclose(epsilon, chosen, rtol=1e-9, atol=0)
        axes.plot(epsilon[at], y[at], color=ORANGE, marker="o", markersize=9, markerfacecolor="none", markeredgewidth=2)
    if usable.any():
        drawing.log_scale(axes, "x")
        if log:
            drawing.log_scale(axes, "y")
        axes.set_xlim(epsilon[usable].min() / 1.5, epsilon[usable].max() * 1.5)
        drawing.few_ticks(axes, 12, 6)
    axes.set(xlabel="ε", ylabel=label)
    return figure
