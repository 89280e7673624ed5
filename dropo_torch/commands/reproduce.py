"""``dropo reproduce``: the published study of a bundled simulation, redone."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from rich.console import Console

from dropo_torch.commands.options import add_folder, workers
from dropo_torch.commands.progress import StageProgress
from dropo_torch.errors import InputError
from dropo_torch.models.bundled import bundled_study
from dropo_torch.support.parallel import processors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo reproduce``."""
    parser.add_argument("study", metavar="STUDY", help="hopper, push or puck: the DROPO paper's experiments, simulated")
    add_folder(parser)
    parser.add_argument("--reduced", action="store_true", help="short logs and few seeds: minutes instead of hours")
    parser.add_argument(
        "--workers", type=workers, metavar="N|ray",
        help="fits side by side, each a process (default: one a processor); or ray, for those of a cluster",
    )  # fmt: skip


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo reproduce``; print what it found."""

    for key in overrides:
        raise InputError(f"reproduce: --{key} is not understood; it takes --out, --resume, --reduced and --workers")
    study, out = bundled_study(given.study), given.out
    side_by_side = processors() if given.workers is None else given.workers
    with StageProgress(console, f"reproduce {given.study}") as progress:
        found = study(out, reduced=given.reduced, resume=given.resume, report=progress.show, workers=side_by_side)
    lines = [*(f"  - {line}" for line in found), f"tables: {out / 'tables.md'}; report: {out / 'report.html'}"]
    for line in lines:
        console.print(line, soft_wrap=True)
