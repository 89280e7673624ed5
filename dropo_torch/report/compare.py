"""The page of a comparison: curves of likelihood and error against cost, and a table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from dropo_torch.report import figures, words
from dropo_torch.report.html import config_yaml, render
from dropo_torch.studies.compare import Comparison, Run
from dropo_torch.support.files import write_atomically

_COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#d55e00", "#e69f00", "#cc79a7")


def write_compare_report(
    path: str | Path,
    comparison: Comparison,
    *,
    config: Mapping[str, Any] | None,
    versions: Mapping[str, str] | None = None,
    title: str = "Comparison of optimizers",
) -> None:
    """Write the report of a comparison as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        comparison: the runs.
        config: the runs' config, printed as YAML.
        versions: name → version of what the result depends on.
        title: of the page.
    """
    methods = list(dict.fromkeys(run.method for run in comparison.runs))
    colours = dict(zip(methods, _COLOURS, strict=False))
    best = max(run.log_likelihood for run in comparison.runs)

    def panel(cost: str, what: str) -> Markup:
        return Markup(cost_panel(comparison.runs, colours, best, cost=cost, what=what))

    content = {
        "title": title,
        "legend": [{"name": m, "colour": colours[m]} for m in methods],
        "panels": [panel(c, w) for w in ("shortfall", "error") for c in ("simulated_transitions", "seconds")],
        "reference": comparison.reference_is,
        "rows": [_row(run, best) for run in comparison.runs],
        "config": config_yaml(config),
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("compare.html", content))


def cost_panel(runs: tuple[Run, ...], colours: Mapping[str, str], best: float, *, cost: str, what: str) -> str:
    """Draw one curve a run over a logarithmic cost.

    Args:
        runs: the runs.
        colours: method → colour.
        best: the largest log-likelihood of all.
        cost: ``"simulated_transitions"`` or ``"seconds"``.
        what: ``"shortfall"`` (nats below the best, plus one) or ``"error"`` (largest relative error of a mean).
    """
    label = {"shortfall": "nats below the best, plus 1", "error": "largest error of a mean (%)"}[what]
    figure = figures.new_figure(460, 290)
    axes = figures.new_axes(figure, (62, 42, 14, 12))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.minorticks_off()
    axes.grid(color="#edf0f3", linewidth=0.8)
    for run in runs:
        x = np.array([max(getattr(p, cost), 1e-3) for p in run.curve])
        shortfall = np.array([best - p.log_likelihood for p in run.curve])
        error = np.array([100 * p.error for p in run.curve])
        y = np.maximum(shortfall, 0) + 1 if what == "shortfall" else np.maximum(error, 1e-6)
        axes.plot(x, y, color=colours[run.method], linewidth=1.4, marker=".", markersize=5, alpha=0.85)
    axes.set_xlabel("simulated transitions" if cost == "simulated_transitions" else "seconds")
    axes.set_ylabel(label)
    return figures.to_svg(figure, f"{label} against {cost.replace('_', ' ')}")


def _row(run: Run, best: float) -> dict[str, str]:
    def count(value: int | None) -> str:
        return "–" if value is None else f"{value:,}"

    return {
        "method": run.method,
        "seed": str(run.seed),
        "log_likelihood": f"{run.log_likelihood:.1f}",
        "shortfall": f"{best - run.log_likelihood:.1f}",
        "to_percent": count(run.to_percent),
        "to_permille": count(run.to_permille),
        "transitions": count(run.simulated_transitions),
        "seconds": words.number(run.seconds),
        "reason": run.stop_reason,
    }
