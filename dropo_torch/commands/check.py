"""``dropo check``: what is wrong with a log, before anything is fitted to it; and the same before a fit."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from dropo_torch.commands.folder import prepare_folder, versions
from dropo_torch.commands.options import add_config
from dropo_torch.config import Config, load_config
from dropo_torch.errors import InputError
from dropo_torch.support.files import write_json

if TYPE_CHECKING:
    from dropo_torch.data.examination import Finding
    from dropo_torch.logged import LoggedData

SCHEMA = "dropo-torch/check/1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo check``."""
    add_config(parser, out_required=False)


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add ``--force``, which goes on where the log is surely wrong."""
    parser.add_argument("--force", action="store_true", help="go on although `dropo check` finds the log wrong")


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo check``, which writes ``check.json`` and ``report.html`` where a folder is given.

    Raises:
        InputError: something is surely wrong with the log, or the parameters are none of the model's; the files are
            written all the same.
    """
    from dropo_torch.data.examination.finding import verdict
    from dropo_torch.logged import read_log
    from dropo_torch.parameters import ParameterSpace

    config = load_config(given.config, overrides)
    logged = read_log(config, uneven=True)
    began = time.perf_counter()
    findings = logged.examined()
    seconds = time.perf_counter() - began
    if given.out is not None:
        _write(given.out, config, logged, findings, seconds)
    if findings:
        console.print(_table(findings))
    log = logged.trajectories
    console.print(
        f"{verdict(findings)} {len(log)} transitions, {log.num_episodes} episodes, {seconds:.2f} s", soft_wrap=True,
        markup=False,
    )  # fmt: skip
    if given.out is not None:
        console.print(f"report: {given.out / 'report.html'}", soft_wrap=True, markup=False)
    refuse(findings)
    if config.parameters and logged.model is not None:
        ParameterSpace(logged.model, config.parameters)  # raises where one is none of the model's


def check_first(logged: LoggedData, console: Console, *, force: bool) -> None:
    """Examine a log before a run: doubts are told, and what is surely wrong stops it.

    Raises:
        InputError: something is surely wrong, and the run is not forced.
    """
    findings = logged.examined()
    for finding in findings:
        if force or not finding.sure:
            console.print(f"log: {finding.confidence}: {told(finding)}", soft_wrap=True, markup=False)
    if not force:
        refuse(findings, hint="; --force goes on")


def refuse(findings: Sequence[Finding], hint: str = "") -> None:
    """Raise an :class:`InputError` that names what is surely wrong, if anything is."""
    sure = [finding for finding in findings if finding.sure]
    if sure:
        more = f" (and {', '.join(f.name for f in sure[1:])})" if sure[1:] else ""
        raise InputError(f"data: {told(sure[0])}{more}{hint}")


def told(finding: Finding) -> str:
    """Return a finding in one line, with what cures it."""
    cure = f"cured by {finding.cure_line}" if finding.cure_line else finding.advice
    return f"{finding.name}: {finding.what}" + (f"; {cure}" if cure else "")


def _table(findings: Sequence[Finding]) -> Table:
    table = Table("", "finding", "what", "cure")
    for finding in findings:
        style = "bold" if finding.sure else ""
        cure = finding.cure_line or finding.advice
        table.add_row(*(Text(text, style) for text in (finding.confidence, finding.name, finding.what)), Text(cure))
    return table


def _write(out: Path, config: Config, logged: LoggedData, findings: Sequence[Finding], seconds: float) -> None:
    from dropo_torch.report.check import write_check_report

    prepare_folder(out, logged.model_path, resume=False)
    log = logged.trajectories
    write_json(out / "check.json", {
        "schema": SCHEMA,
        "right": not any(finding.sure for finding in findings),
        "findings": [finding.document() for finding in findings],
        "transitions": len(log),
        "episodes": log.num_episodes,
        "seconds": seconds,
        "config": config.portable(),
    })  # fmt: skip
    write_check_report(
        out / "report.html", findings, transitions=len(log), episodes=log.num_episodes, seconds=seconds,
        config=config.document(), versions=versions(), title=f"Examination of {Path(log.source).name}",
    )  # fmt: skip
