"""The page of a comparison: curves of likelihood and error against cost, and a table."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from dropo_torch.report.figures.compare import cost_panel
from dropo_torch.report.page import Frame, write_page
from dropo_torch.studies.compare import Comparison

_COLORS = ("#0072b2", "#56b4e9", "#009e73", "#d55e00", "#e69f00", "#cc79a7")


def write_compare_report(path: str | Path, comparison: Comparison, **frame: Unpack[Frame]) -> None:
    """Write the report of a comparison as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        comparison: the runs.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    runs = comparison.runs
    colors = dict(zip(dict.fromkeys(run.method for run in runs), _COLORS, strict=False))
    best = max(run.log_likelihood for run in runs)
    content = {
        "title": "Comparison of optimizers",
        "colors": colors,
        "panels": [
            cost_panel(runs, colors, best, cost=cost, shown=shown)
            for shown in ("shortfall", "error")
            for cost in ("simulated_transitions", "seconds")
        ],
        "comparison": comparison,
        "best": best,
    }
    write_page(path, "compare.html", content, frame)
