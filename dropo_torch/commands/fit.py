"""``dropo fit``: a config and a folder in; the distribution, its report and the fitted model out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from rich.console import Console
from rich.table import Table

from dropo_torch.commands.check import add_force, check_first
from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config, add_log
from dropo_torch.commands.progress import fit_shown
from dropo_torch.config import Config, load_config
from dropo_torch.errors import InputError
from dropo_torch.support.extras import require
from dropo_torch.support.files import write_atomically

if TYPE_CHECKING:
    from dropo_torch.diagnostics import Diagnostics
    from dropo_torch.fit import Fit
    from dropo_torch.problem import Problem


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo fit``."""
    add_config(parser, "fit")
    add_log(parser, "the history")
    add_force(parser)


#: Exit code of a fit that is hopeless.
HOPELESS = 3


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> int:
    """Run ``dropo fit``."""
    config = load_config(given.config, overrides)
    result = run_fit(config, given.out, console=console, resume=given.resume, log=given.log, force=given.force)
    return HOPELESS if result.judgment and result.judgment.verdict == "hopeless" else 0


def run_fit(
    config: Config, out: Path, *, console: Console, resume: bool = False, log: str | None = None, force: bool = False
) -> Fit:
    """Fit, and write ``fit.json``, ``report.html``, the distribution and the model to ``out``.

    Args:
        config: the config.
        out: the folder; results of an earlier run there are moved aside, never overwritten.
        console: where progress and results are shown.
        resume: continue an interrupted run in ``out``.
        log: ``"tensorboard"`` writes the history as TensorBoard events too.
        force: go on although the log is surely wrong.
    """
    from dropo_torch.baselines import make_search
    from dropo_torch.diagnostics import diagnose
    from dropo_torch.excitation import refuse_dead_parameters
    from dropo_torch.problem import logged_data, make_problem
    from dropo_torch.shooting.posing import is_placeable, posed
    from dropo_torch.verdict import judge

    if log is not None:
        require("tensorboard", f"--log {log}")
    problem = make_problem(config)
    check_first(logged_data(problem), console, force=force)
    if is_placeable(problem):
        problem = posed(problem)
    continued = resume and (out / "checkpoint.bin").exists()
    make_search(problem)  # what it refuses, it refuses before an earlier run is moved aside
    if not (continued or problem.observation.is_sensed):  # such a fit looks at them once it has states
        refuse_dead_parameters(problem.objective)
    prepare_folder(out, problem.model_path, resume=continued)
    result = fit_shown(problem, console, checkpoint=out / "checkpoint.bin", resume=resume)
    known = None
    if (estimated := result.estimated) is not None:
        problem = replace(problem, objective=estimated.objective)
        known = estimated.standard_error, estimated.correlation
    diagnostics = diagnose(problem.objective, result.distribution, seed=config.seed, known=known)
    diagnostics = replace(diagnostics, unjoined=estimated.unjoined if estimated else ())
    lost = result.diverged / (len(problem.objective) * result.samples)
    result = replace(result, judgment=judge(result.distribution, result.method, diagnostics, lost, result.stop_reason))
    _write(problem, result, diagnostics, out)
    if log is not None:
        _write_events(result, out / "tensorboard")
    _show(problem, result, out, console)
    return result


def _write(problem: Problem, result: Fit, diagnostics: Diagnostics, out: Path) -> None:
    from dropo_torch.report import write_fit_report

    config = problem.sensed or problem.config
    result.save(out / "fit.json")
    result.distribution.save(out / "distribution.yaml")
    portable = yaml.safe_dump(config.portable(), sort_keys=False, allow_unicode=True)
    write_atomically(out / "fitted_config.yaml", portable.encode())
    title, notes = f"Fit of {config.sim or config.model or config.environment}", _write_model(problem, result, out)
    notes += [*([_left_out(problem)] if problem.left_out else []), *problem.simulator.notes]
    notes += [_sensed(result)] if result.estimated is not None else []
    about = {"title": title, "notes": notes, **provenance(config)}
    write_fit_report(out / "report.html", fit=result, diagnostics=diagnostics, space=problem.space, **about)


def _write_model(problem: Problem, result: Fit, out: Path) -> list[str]:
    """Write ``model.xml`` with the fitted values and effects; return what it lacks, in words."""
    from dropo_torch.effects.export import write_model
    from dropo_torch.models.export import export_model

    if problem.model_path is None:
        return []
    values, path, rest = result.distribution.center, out / "model.xml", []
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
    if result.judgment is not None:
        verdict = result.judgment.verdict.replace("_", " ")
        console.print(f"verdict: {verdict}: {result.judgment.reason}", soft_wrap=True, markup=False)
    console.print(
        f"log-likelihood {result.log_likelihood:.2f}, mean squared error {result.mse:.3g}, "
        f"{len(problem.objective)} windows, {result.simulated_transitions} simulated transitions, "
        f"{result.seconds:.1f} s; stopped because {result.stop_reason}",
        soft_wrap=True,
    )
    if problem.left_out:
        console.print(_left_out(problem))
    if result.diverged:
        share = 100 * result.diverged / (len(problem.objective) * result.samples)
        console.print(f"{result.diverged} simulations ({share:.2g} %) diverged under the fitted distribution")
    show_report(out, console)


def _left_out(problem: Problem) -> str:
    return (
        f"{problem.left_out} transitions are left out: commands or motion from before the log still act in them, by a "
        "delay, a lag, play or a transmission that gives."
    )


def _sensed(result: Fit) -> str:
    """What was estimated beside the parameters, in words."""
    windows = result.extras["windows"]
    noise = ", ".join(f"{name} {value:.2g}" for name, value in result.extras["noise"].items())
    return (
        f"The log does not show the states: {windows['count']} windows of {windows['steps']} logged steps have initial "
        "states of their own, which were estimated with the parameters; standard errors count that. Noise of the "
        f"columns, whose square stands for ε here: {noise}."
    )


def show_report(out: Path, console: Console) -> None:
    """Print where the report is."""
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
