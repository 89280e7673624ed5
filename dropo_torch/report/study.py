"""The page of a study: its tables, one below the other, each with its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Unpack

from dropo_torch.report.page import Frame, write_page


def write_study_report(
    path: str | Path,
    *,
    lead: str,
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]],
    figures: Mapping[str, str],
    **frame: Unpack[Frame],
) -> None:
    """Write the report of a study as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        lead: what the study is.
        tables: each a heading, the columns' names and the rows.
        figures: heading of the table that a figure stands above → SVG.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    write_page(path, "study.html", {"lead": lead, "tables": tables, "figures": figures}, frame)
