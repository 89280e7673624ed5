"""``dropo compare``: fits by several optimizers and backends, side by side."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Console

from dropo_torch.commands.fit import show_report
from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config, count
from dropo_torch.commands.progress import fit_shown, fits_side_by_side
from dropo_torch.commands.sweep import only_dropo
from dropo_torch.config import Config, load_config
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.support.files import write_json
from dropo_torch.support.parallel import check_workers

if TYPE_CHECKING:
    from dropo_torch.fit import Fit
    from dropo_torch.objective import Objective
    from dropo_torch.studies.compare import Run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo compare``."""
    add_config(parser, "fit")
    parser.add_argument("--methods", metavar="fisher-warp,...", help="optimizer-backend pairs, all by default")
    parser.add_argument("--seeds", type=count, metavar="N", default=3, help="seeds of each (default 3)")


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo compare``, which writes ``compare.json`` and ``report.html``."""
    from dropo_torch.problem import make_problem, refuse_sensed
    from dropo_torch.report import write_compare_report
    from dropo_torch.studies.compare import METHODS, compare

    config, out = load_config(given.config, overrides), given.out
    only_dropo(config, "compare runs the optimizers of DROPO")
    check_workers(config.workers)
    problem = make_problem(config)
    refuse_sensed(problem, "compare")
    store = out / "compare-progress.json"
    prepare_folder(out, problem.model_path, resume=given.resume and store.exists())
    truth = bundled_sim(config.sim).truth if config.sim and config.data is None else {}
    methods = METHODS if given.methods is None else [m.strip() for m in given.methods.split(",")]
    seeds = range(config.seed, config.seed + given.seeds)
    reference = {n: truth[n] for n in problem.space.names} if truth else None
    with fits_side_by_side(console, "compare", len(methods) * len(seeds), config.workers) as count:

        def show(run: Run) -> None:
            count()
            console.print(
                f"{run.method}, seed {run.seed}: log-likelihood {run.log_likelihood:.1f}, "
                f"{run.simulated_transitions} simulated transitions, {run.seconds:.1f} s",
            )

        comparison = compare(
            functools.partial(fit_by, config=config, console=console if config.workers == 1 else None),
            methods=methods, seeds=seeds, reference=reference, store=store, fingerprint=problem.fingerprint,
            workers=config.workers, on_run=show,
        )  # fmt: skip
    write_json(out / "compare.json", comparison.document())
    write_compare_report(out / "report.html", comparison, **provenance(config))
    show_report(out, console)


def fit_by(
    optimizer: str, backend: str, seed: int, *, config: Config, console: Console | None, threads: int
) -> tuple[Fit, Objective]:
    """Fit by an optimizer on a backend, showing how far it is if there is a console; return the objective, too."""
    from dropo_torch.problem import make_problem

    keys = {"optimizer": optimizer, "backend": backend, "seed": seed, "threads": config.threads or threads}
    part = make_problem(config.model_copy(update=keys))
    return fit_shown(part, console, f"{optimizer} on {backend}, seed {seed}"), part.objective
