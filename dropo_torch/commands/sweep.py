"""``dropo sweep-epsilon``: fits at several ε, one of them chosen."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import yaml
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dropo_torch.commands.fit import show_report
from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config
from dropo_torch.commands.progress import fit_shown, fits_side_by_side
from dropo_torch.config import Config, load_config
from dropo_torch.errors import InputError
from dropo_torch.support.files import write_json
from dropo_torch.support.parallel import check_workers

if TYPE_CHECKING:
    from dropo_torch.studies.sweep import Sweep, SweepPoint


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo sweep-epsilon``."""
    add_config(parser, "fit")
    parser.add_argument("--epsilons", type=_numbers, metavar="1e-6,1e-5,...", help="the values to try")
    parser.add_argument(
        "--noisy-starts", action="store_true",
        help="take ε for the variance of every measurement, of the initial states of transitions, too",
    )  # fmt: skip


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo sweep-epsilon``, which writes ``sweep.json`` and ``report.html``.

    Where the config has an ε for every column, the values to try are the geometric mean of the columns'.
    """
    from dropo_torch.excitation import refuse_dead_parameters
    from dropo_torch.problem import make_problem, refuse_sensed
    from dropo_torch.report import write_sweep_report
    from dropo_torch.studies import sweep as study

    config, out, noisy_starts = load_config(given.config, overrides), given.out, given.noisy_starts
    only_dropo(config, "sweep-epsilon chooses the ε of DROPO")
    if noisy_starts and config.noise is not None:
        raise InputError(f"noise: {config.noise} given, which --noisy-starts is to find; leave one of them out")
    if noisy_starts and isinstance(config.epsilon, list):
        raise InputError(f"epsilon: {config.epsilon} given, but --noisy-starts tries one for all columns; leave it out")
    check_workers(config.workers)
    problem = make_problem(config)
    refuse_sensed(problem, "sweep-epsilon")
    store = out / "sweep-progress.json"
    values = study.rising(given.epsilons or study.default_epsilons(problem.objective.measured.numpy()))
    continued = given.resume and store.exists()
    if not continued:
        refuse_dead_parameters(problem.objective)  # before an earlier run is moved aside
    prepare_folder(out, problem.model_path, resume=continued)

    def keys_of(epsilon: float) -> dict[str, Any]:
        if noisy_starts:
            return study.noise_keys(problem.objective, epsilon)
        return study.epsilon_keys(config.epsilon, epsilon)

    with fits_side_by_side(console, "sweep-epsilon", len(values), config.workers) as count:
        sweep = study.sweep_epsilon(
            functools.partial(
                point_at, keys={epsilon: keys_of(epsilon) for epsilon in values}, config=config,
                noisy_starts=noisy_starts, console=console if config.workers == 1 else None,
            ),
            values, noisy_starts=noisy_starts, fingerprint=problem.fingerprint, store=store, workers=config.workers,
            on_point=lambda point: count(),
        )  # fmt: skip
    chosen = keys_of(sweep.chosen) | ({"scaling": True} if config.scaling else {})  # which ε is in units of
    _show(sweep, chosen, problem.space.names, console)
    write_json(out / "sweep.json", {**sweep.document(), "use": chosen})
    write_sweep_report(out / "report.html", sweep, use=chosen, **provenance(config))
    show_report(out, console)


def point_at(
    epsilon: float, *, keys: Mapping[float, Mapping[str, Any]], config: Config, noisy_starts: bool,
    console: Console | None, threads: int,
) -> SweepPoint:  # fmt: skip
    """Fit at an ε, by the keys of the config that stand for it, showing how far it is if there is a console."""
    from dropo_torch.problem import make_problem
    from dropo_torch.studies.sweep import SweepPoint

    part = make_problem(config.model_copy(update={"threads": config.threads or threads, **keys[epsilon]}))
    return SweepPoint.of(epsilon, fit_shown(part, console, f"ε = {epsilon:g}"), noisy_starts=noisy_starts)


def only_dropo(config: Config, what: str) -> None:
    """Raise an :class:`InputError` for a config with another method."""
    if config.method != "dropo":
        raise InputError(f"method: {config.method} given, but {what}; leave method and method_options out")


def _show(sweep: Sweep, chosen: Mapping[str, Any], names: Sequence[str], console: Console) -> None:
    heads = ("variance of the noise", "robust log-likelihood") if sweep.noisy_starts else ("ε", "log-likelihood")
    table = Table(heads[0], "mean squared error", heads[1], *names)
    for p in sweep.points:
        cells = [f"{p.mean[n]:.4g} ± {p.std[n]:.2g}" for n in names]
        value = p.log_likelihood if p.robust_log_likelihood is None else p.robust_log_likelihood
        first = Text(f"{p.epsilon:g}", "bold" if p.epsilon == sweep.chosen else "")
        table.add_row(first, f"{p.mse:.4g}", f"{value:.1f}", *cells)
    console.print(table)
    keys = yaml.safe_dump(dict(chosen), default_flow_style=True, sort_keys=False, width=10_000).strip()[1:-1]
    console.print(Text.assemble("chosen: ", (keys, "bold"), f", since {sweep.reason}"), soft_wrap=True)


def _numbers(text: str) -> list[float]:
    try:
        return [float(x) for x in text.strip("[]").split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected numbers such as 1e-6,1e-5,1e-4") from None
