"""Draw the README's picture: the demo's log before and after the fit. ``python examples/demo_figure.py``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from dropo_sims.hopper import SIM
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import dropo_torch as dropo

BLUE, ORANGE, GRAY = "#0072b2", "#d55e00", "#9aa0a6"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/demo.png"))
    given = parser.parse_args(arguments)
    problem = dropo.make_problem(dropo.make_config({"sim": "hopper"}))
    fit = dropo.fit_problem(problem)
    measured = problem.objective.measured
    before, after = problem.objective.simulated(np.stack([problem.space.nominal, fit.distribution.center])).unbind(1)
    scale = measured.std(0)
    figure = Figure(figsize=(9.6, 3.2), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    for states, color, label in ((before, ORANGE, "model as it came"), (after, BLUE, "fitted masses")):
        error = torch.sqrt(torch.mean(((states - measured) / scale) ** 2, dim=1)).clamp(min=1e-16)
        left.semilogy(np.arange(len(error)) * problem.simulator.timestep, error, color=color, lw=1.2, label=label)
    left.set(xlabel="time in the log (s)", ylabel="next-state error\n(share of the log's spread)")
    left.legend(frameon=False, loc="center right")
    names = list(problem.space.names)
    for row, name in enumerate(names):
        low, high = problem.space.low[row], problem.space.high[row]
        right.plot([low, high], [row, row], color=GRAY, lw=6, alpha=0.25, solid_capstyle="round")
        right.plot(problem.space.nominal[row], row, "|", color=ORANGE, ms=16, mew=2.5)
        right.plot(SIM.truth[name], row, "o", color="white", mec="black", ms=10)
        right.plot(fit.distribution.center[row], row, ".", color=BLUE, ms=9)
    right.set(yticks=range(len(names)), yticklabels=[n.replace("_", " ") for n in names], xlabel="kg", xlim=(0, 8.5))
    right.invert_yaxis()
    right.plot([], [], "|", color=ORANGE, ms=12, mew=2.5, label="model as it came")
    right.plot([], [], "o", color="white", mec="black", ms=9, label="recorded with")
    right.plot([], [], ".", color=BLUE, ms=9, label="found")
    right.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(given.out)
    print(given.out)


if __name__ == "__main__":
    main()
