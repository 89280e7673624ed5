"""The page of a study: its tables, one below the other, each with its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from dropo_torch.report.html import render
from dropo_torch.support.files import write_atomically


def write_study_report(
    path: str | Path,
    *,
    title: str,
    lead: str,
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]],
    figures: Mapping[str, str],
    versions: Mapping[str, str] | None = None,
) -> None:
    """Write the report of a study as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        title: of the page.
        lead: what the study is.
        tables: each a heading, the columns' names and the rows.
        figures: heading of the table that a figure stands above → SVG.
        versions: name → version of what the results depend on.
    """
    content = {
        "title": title,
        "lead": lead,
        "tables": list(tables),
        "figures": {heading: Markup(svg) for heading, svg in figures.items()},
        "config": "",
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("study.html", content))
