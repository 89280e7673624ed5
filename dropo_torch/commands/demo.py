"""``dropo demo``: the bundled Hopper's masses, fitted to its log and compared with those it was recorded with."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.fit import run_fit
from dropo_torch.commands.options import add_folder
from dropo_torch.config import make_config
from dropo_torch.models.bundled import bundled_sim


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo demo``."""
    add_folder(parser, default=Path("out/demo"))


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo demo``."""

    config = make_config({"sim": "hopper"}, overrides)
    truth = bundled_sim(str(config.sim)).truth
    console.print(
        "The demo fits four link masses of a simulated Hopper to 200 logged transitions "
        "(sims/hopper/log.npz),\nrecorded with masses that the model does not have."
    )
    result = run_fit(config, given.out, console=console, resume=given.resume)
    table = Table("parameter", "recorded with", "found", "error", title="Against the truth", title_justify="left")
    for name, entry in result.distribution.summary().items():
        if name in truth:
            error = 100 * (entry["mean"] / truth[name] - 1)
            table.add_row(name, f"{truth[name]:.4g} {entry['unit']}", f"{entry['mean']:.4g}", f"{error:+.3f} %")
    console.print(table)
