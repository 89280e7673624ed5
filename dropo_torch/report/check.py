"""The page of an examination: what is wrong with a log, how surely, and the config lines that cure it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from dropo_torch.data.examination import Finding
from dropo_torch.data.examination.finding import MOST_ROWS, verdict
from dropo_torch.report.page import Frame, write_page


def write_check_report(
    path: str | Path,
    findings: Sequence[Finding],
    *,
    transitions: int,
    episodes: int,
    seconds: float,
    **frame: Unpack[Frame],
) -> None:
    """Write the report of an examination.

    Args:
        path: the HTML file; written whole or not at all.
        findings: what was found, the sure ones first.
        transitions: transitions of the log.
        episodes: its episodes.
        seconds: what the examination took.
        frame: the page's title, config and versions.
    """
    facts = [("Transitions", f"{transitions:,}"), ("Episodes", f"{episodes:,}"), ("Seconds", f"{seconds:.2f}")]
    content = {"verdict": verdict(findings), "found": findings, "facts": facts, "most_rows": MOST_ROWS}
    write_page(path, "check.html", content, {"title": "Examination of the log", **frame})
