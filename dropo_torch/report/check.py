"""The page of an examination: what is wrong with a log, how surely, and the config lines that cure it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dropo_torch.data.examination import Finding
from dropo_torch.data.examination.finding import MOST_ROWS, verdict
from dropo_torch.report.page import Config, Versions, write_page


def write_check_report(
    path: str | Path,
    findings: Sequence[Finding],
    *,
    transitions: int,
    episodes: int,
    seconds: float,
    config: Config,
    versions: Versions = None,
    title: str = "Examination of the log",
) -> None:
    """Write the report of an examination.

    Args:
        path: the HTML file; written whole or not at all.
        findings: what was found, the sure ones first.
        transitions: transitions of the log.
        episodes: its episodes.
        seconds: what the examination took.
        config: the run's config, printed as YAML.
        versions: name → version of what the result depends on.
        title: of the page.
    """
    facts = [("Transitions", f"{transitions:,}"), ("Episodes", f"{episodes:,}"), ("Seconds", f"{seconds:.2f}")]
    content = {"verdict": verdict(findings), "found": findings, "facts": facts, "most_rows": MOST_ROWS}
    write_page(path, "check.html", title, content, config=config, versions=versions)
