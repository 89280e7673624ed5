"""Figures of the page on a comparison of optimizers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.studies.compare import Run

Cost = Literal["simulated_transitions", "seconds"]
Shown = Literal["shortfall", "error"]
_LABELS = {"shortfall": "nats below the best, plus 1", "error": "largest error of a mean (%)"}


def cost_panel(runs: Sequence[Run], colors: Mapping[str, str], best: float, *, cost: Cost, shown: Shown) -> Any:
    """Draw one curve a run over a logarithmic cost.

    Args:
        runs: the runs.
        colors: method → color.
        best: the largest log-likelihood of all.
        cost: what the horizontal axis shows.
        shown: nats below the best, plus one, or the largest relative error of a mean.
    """
    name = cost.replace("_", " ")
    figure, axes = drawing.new_panel(460, 290, f"{_LABELS[shown]} against {name}", (62, 42, 14, 12), grid="both")
    drawing.log_scale(axes, "x")
    drawing.log_scale(axes, "y")
    for run in runs:
        x = [max(getattr(p, cost), 1e-3) for p in run.curve]
        below = np.maximum([best - p.log_likelihood for p in run.curve], 0) + 1
        y = below if shown == "shortfall" else np.maximum([100 * p.error for p in run.curve], 1e-6)
        axes.plot(x, y, color=colors[run.method], linewidth=1.4, marker=".", markersize=5, alpha=0.85)
    axes.set(xlabel=name, ylabel=_LABELS[shown])
    return figure
