"""The page of a study: its tables, one below the other, each with its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from dropo_torch.report.page import Versions, write_page


def write_study_report(
    path: str | Path,
    *,
    title: str,
    lead: str,
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]],
    figures: Mapping[str, str],
    versions: Versions = None,
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
    content = {"lead": lead, "tables": tables, "figures": {heading: Markup(svg) for heading, svg in figures.items()}}
    write_page(path, "study.html", title, content, config=None, versions=versions)
