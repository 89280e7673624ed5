"""The pages of studies of fits whose truth is known, and their picture of distributions found and true."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.report import figures
from dropo_torch.report.figures import to_svg
from dropo_torch.report.study import write_study_report
from dropo_torch.studies.recovery import Result, drawn_std
from dropo_torch.studies.study import SCHEMA, Finding, Section, findings_section, markdown
from dropo_torch.support.files import write_atomically, write_json


def write_recovery_study(
    out: Path, *, title: str, lead: str, plan: Mapping[str, Any], findings: Sequence[Finding],
    tables: Mapping[str, Any], sections: Sequence[Section], drawn: Mapping[str, Any], versions: Mapping[str, str],
) -> list[str]:  # fmt: skip
    """Write ``study.json``, ``tables.md``, ``report.html`` and figures; return the findings as sentences.

    Args:
        out: the folder.
        title: of the page.
        lead: what the study is.
        plan: how large it was.
        findings: what it tests.
        tables: rows by table.
        sections: the tables as people read them.
        drawn: figures by the names of their files.
        versions: of the software.
    """
    document = {"schema": SCHEMA, "plan": plan, "findings": [asdict(f) for f in findings], "tables": tables}
    write_json(out / "study.json", document)
    page = [findings_section(findings), *sections]
    for name, figure in drawn.items():
        figure.savefig(out / name, dpi=110, facecolor="white", metadata={"Software": None})
    write_atomically(out / "tables.md", markdown(title, lead, page).encode())
    write_study_report(
        out / "report.html",
        title=title,
        lead=lead,
        tables=[(section.title, section.head, section.rows) for section in page],
        figures={s.title: to_svg(drawn[s.figure], s.figure) for s in page if s.figure},
        versions=versions,
    )
    return [finding.sentence() for finding in findings]


def draw_recovery(
    chosen: Sequence[Result], label: Callable[[Result], str], colors: Mapping[str, str], units: Mapping[str, str]
) -> Any:
    """Draw the fitted normals of what varied over the realized ones; points as upright lines.

    Args:
        chosen: one result a method, of one log.
        label: what a result's method is called.
        colors: of the methods.
        units: of the parameters, where they have one.
    """
    names = list(chosen[0]["fit"]["parameters"])
    figure = figures.new_figure(230 * len(names), 230)
    for i, name in enumerate(names):
        axes = panel(figure, i, len(names))
        truth = chosen[0]["truth"][name]
        curves = {"realized": (truth["mean"], truth["std"])} | {
            label(r): (r["fit"]["parameters"][name]["mean"], drawn_std(r, name)) for r in chosen
        }
        reach = 3.5 * max(std for _, std in curves.values())
        for method, (mean, std) in curves.items():
            x, density = _bell(mean, std, 1e-2 * reach)
            style = {"color": "#1f2933", "linestyle": "--", "zorder": 3} if method == "realized" else {}
            axes.plot(x, density, **{"color": colors.get(method), "linewidth": 1.4, "label": method, **style})
        centers = [mean for mean, _ in curves.values()]
        axes.set_xlim(min(centers) - reach, max(centers) + reach)
        axes.set_yticks([])
        axes.set_xlabel(f"{name} ({units[name]})" if units.get(name) else name)
    lines, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="upper center", ncol=6, frameon=False, fontsize=9)
    return figure


def panel(figure: Any, index: int, count: int) -> Any:
    """Return the axes of one of several panels side by side."""
    total = float(figure.get_size_inches()[0]) * 72
    width = total / count
    left = index * width + 52
    return figures.new_axes(figure, (left, 40, total - left - width + 66, 44))


def _bell(mean: float, std: float, narrow: float) -> tuple[np.ndarray, np.ndarray]:
    """A normal density of height 1, ``(n,)`` each; an upright line where it is narrow."""
    if std < narrow:
        return np.full(2, mean), np.array([0.0, 1.0])
    z = np.linspace(-4, 4, 201)
    return mean + std * z, np.exp(-0.5 * z**2)
