"""``dropo fit``: a config and a folder in; the distribution, its report and the fitted model out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from rich.console import Console
from rich.table import Table

from dropo_torch.commands.folder import prepare_folder, versions
from dropo_torch.commands.options import add_config, add_log
from dropo_torch.commands.progress import fit_shown
from dropo_torch.config import Config, load_config
from dropo_torch.errors import InputError
from dropo_torch.support.extras import require
from dropo_torch.support.files import write_atomically

if TYPE_CHECKING:
    from dropo_torch.fit import Fit
    from dropo_torch.problem import Problem


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo fit``."""
    add_config(parser)
    add_log(parser, "the history")


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo fit``."""

    run_fit(load_config(given.config, overrides), given.out, console=console, resume=given.resume, log=given.log)


def run_fit(config: Config, out: Path, *, console: Console, resume: bool = False, log: str | None = None) -> Fit:
    """Fit, and write ``fit.json``, ``report.html``, the distribution and the model to ``out``.

    Args:
        config: the config.
        out: the folder; results of an earlier run there are moved aside, never overwritten.
        console: where progress and results are shown.
        resume: continue an interrupted run in ``out``.
        log: ``"tensorboard"`` writes the history as TensorBoard events too.
    """
    from dropo_torch.baselines import make_search
    from dropo_torch.excitation import refuse_dead_parameters
    from dropo_torch.problem import make_problem

    if log is not None:
        require("tensorboard", f"--log {log}")
    problem = make_problem(config)
    continued = resume and (out / "checkpoint.bin").exists()
    make_search(problem)  # what it refuses, it refuses before an earlier run is moved aside
    if not continued:
        refuse_dead_parameters(problem.objective)
    prepare_folder(out, problem.model_path, resume=continued)
    result = fit_shown(problem, console, checkpoint=out / "checkpoint.bin", resume=resume)
    if result.diverged == len(problem.objective) * result.samples:
        raise InputError(
            "parameters: every simulation of this log diverges, wherever in the bounds; "
            "check the log's units, the order of its columns (observation), frame_skip and the bounds"
        )
    _write(problem, result, out)
    if log is not None:
        _write_events(result, out / "tensorboard")
    _show(problem, result, out, console)
    return result


def _write(problem: Problem, result: Fit, out: Path) -> None:
    from dropo_torch.diagnostics import diagnose
    from dropo_torch.report import write_fit_report

    config = problem.config
    result.save(out / "fit.json")
    result.distribution.save(out / "distribution.yaml")
    portable = yaml.safe_dump(config.portable(), sort_keys=False, allow_unicode=True)
    write_atomically(out / "fitted_config.yaml", portable.encode())
    write_fit_report(
        out / "report.html",
        fit=result,
        diagnostics=diagnose(problem.objective, result.distribution, seed=config.seed),
        config=config.document(),
        title=f"Fit of {config.sim or config.model or config.environment}",
        notes=_write_model(problem, result, out / "model.xml"),
        versions=versions(),
        space=problem.space,
    )


def _write_model(problem: Problem, result: Fit, path: Path) -> list[str]:
    """Write the model with the fitted values and effects; return what it lacks, in words."""
    from dropo_torch.effects.export import write_model
    from dropo_torch.models.export import export_model

    if problem.model_path is None:
        return []
    values, rest = result.distribution.center, []
    try:
        if problem.effects is None:
            export_model(problem.model_path, problem.space, values, path)
        else:
            rest = write_model(problem.model_path, problem.effects.at(values), path, problem.space, values)
    except InputError as error:
        return [f"No model.xml was written: {error}."]
    names = ", ".join(p.effect.name + (f" at {p.target}" if p.target else "") for p in rest)
    return [f"model.xml lacks what MJCF cannot express: {names}. The fitted config has it."] if rest else []


def _write_events(result: Fit, folder: Path) -> None:
    """Write the history as TensorBoard scalars, over simulated transitions."""
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(folder)) as writer:
        for entry in result.history:
            step = entry.simulated_transitions
            writer.add_scalar("log_likelihood", entry.log_likelihood, step)
            for i, name in enumerate(result.distribution.names):
                writer.add_scalar(f"mean/{name}", entry.mean[i], step)
                writer.add_scalar(f"std/{name}", entry.std[i], step)


def _show(problem: Problem, result: Fit, out: Path, console: Console) -> None:
    table = Table("parameter", "mean", "std", "unit", "search box")
    for name, entry in result.distribution.summary().items():
        box = f"[{entry['low']:g}, {entry['high']:g}]"
        table.add_row(name, f"{entry['mean']:.5g}", f"{entry['std']:.2g}", entry["unit"], box)
    console.print(table)
    console.print(
        f"log-likelihood {result.log_likelihood:.2f}, mean squared error {result.mse:.3g}, "
        f"{len(problem.objective)} windows, {result.simulated_transitions} simulated transitions, "
        f"{result.seconds:.1f} s; stopped because {result.stop_reason}",
        soft_wrap=True,
    )
    if result.diverged:
        share = 100 * result.diverged / (len(problem.objective) * result.samples)
        console.print(f"{result.diverged} simulations ({share:.2g} %) diverged under the fitted distribution")
    show_report(out, console)


def show_report(out: Path, console: Console) -> None:
    """Print where the report is."""
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
