"""Figures of the page on a training: the learning curve and the evaluations' episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, GRAY, INK, ORANGE
from dropo_torch.rl.collect import Returns
from dropo_torch.rl.train import Training

_COLORS = {"distribution": GRAY, "nominal": BLUE, "target": ORANGE}


def learning_curve(training: Training) -> Any:
    """Draw the return of training episodes and of evaluations against environment steps."""
    figure, axes = drawing.new_panel(760, 300, "return against environment steps", (64, 42, 14, 26), grid="both")
    steps = np.array([e.steps for e in training.history], dtype=float)
    returns = np.array([e.mean_return for e in training.history])
    keep = np.isfinite(returns)
    if keep.any():
        axes.plot(steps[keep], returns[keep], color=BLUE, linewidth=1.4)
    at, mean, std = ([float(getattr(e, k)) for e in training.evaluations] for k in ("steps", "mean", "std"))
    axes.errorbar(at, mean, std, color=INK, linewidth=0.9, marker="o", markersize=3.5, linestyle="none")
    for best in [e for e in training.evaluations if e.kept][-1:]:
        axes.plot([best.steps], [best.mean], "o", markersize=8, color="none", markeredgecolor=ORANGE)
    axes.set(xlim=(0, float(training.steps) * 1.02), xlabel="environment steps", ylabel="return of an episode")
    drawing.few_ticks(axes, 6, 6)
    drawing.clock(axes, steps, np.array([e.seconds for e in training.history]))
    return figure


def episodes_panel(evaluations: Mapping[str, Returns]) -> Any:
    """Draw the return of every episode of each evaluation as a dot, and the mean as a stroke."""
    figure, axes = drawing.new_panel(
        760, 58 + 34 * len(evaluations), "returns of the evaluation episodes", (120, 42, 14, 8), grid="x"
    )
    for row, (name, e) in enumerate(evaluations.items()):
        axes.plot(e.returns, np.full(len(e.returns), row), "o", color=_COLORS[name], alpha=0.45, markersize=6)
        axes.plot([e.mean, e.mean], [row - 0.32, row + 0.32], color=_COLORS[name], linewidth=2.2)
    drawing.name_rows(axes, list(evaluations))
    drawing.few_ticks(axes, x=7)
    axes.set_xlabel("return of an episode")
    return figure
