"""``dropo certify``: the gradients of the warp backend, against MuJoCo's own differences."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.folder import prepare_folder
from dropo_torch.commands.options import add_config
from dropo_torch.config import load_config
from dropo_torch.support.files import write_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo certify``."""
    add_config(parser, resumes=False)


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo certify``, which writes ``certificate.json`` for every parameter on this model and log.

    Raises:
        InputError: a gradient that is dead or wrong; the certificate is written all the same.
    """
    from dropo_torch.certify import certify
    from dropo_torch.problem import make_problem

    config = load_config(given.config, overrides)
    problem = make_problem(config.model_copy(update={"backend": "warp"}))
    prepare_folder(given.out, problem.model_path, resume=False)
    found = certify(problem.objective, seed=config.seed)
    write_json(given.out / "certificate.json", found.document())
    table = Table("parameter", "derivative", "median error", "99 %", "active set moved", "verdict")
    for p in found.parameters:
        errors = f"{p.median_error:.1e}", f"{p.worst_error:.1e}", f"{100 * p.disagreeing:.2f} %"
        table.add_row(p.name, f"{p.magnitude:.3g}", *errors, p.verdict)
    console.print(table)
    console.print(
        f"{found.transitions} transitions; next states differ from MuJoCo's by at most {found.state_error:.1e}"
    )
    found.check()
