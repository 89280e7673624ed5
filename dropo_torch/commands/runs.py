"""What each command does: a config and a folder in, files in that folder out."""

from __future__ import annotations

import functools
import platform
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from dropo_torch.baselines import fit_problem, make_search
from dropo_torch.certify import Certificate, certify
from dropo_torch.commands.progress import FitProgress, StageProgress
from dropo_torch.config import Config, make_config
from dropo_torch.diagnostics import diagnose
from dropo_torch.effects.export import write_model
from dropo_torch.errors import InputError
from dropo_torch.excitation import refuse_dead_parameters
from dropo_torch.fit import Fit
from dropo_torch.gap import Gap, add, find_gap, prepare
from dropo_torch.models.bundled import bundled_sim, bundled_study
from dropo_torch.models.export import export_model
from dropo_torch.objective import Objective
from dropo_torch.problem import Problem, make_problem
from dropo_torch.report.gap_words import answer
from dropo_torch.studies.compare import Comparison, Run, compare
from dropo_torch.studies.sweep import (
    Sweep,
    SweepPoint,
    default_epsilons,
    epsilon_keys,
    noise_keys,
    rising,
    robust_log_likelihood,
    sweep_epsilon,
)
from dropo_torch.support.files import write_atomically, write_json

#: What runs write to their folder; an earlier run's are moved aside together.
_RESULTS = (
    "fit.json", "sweep.json", "compare.json", "certificate.json", "gap.json", "train.json", "checkpoint.pkl",
    "gap-progress.pkl", "sweep-progress.json", "compare-progress.json", "train-progress.pt", "policy.pt",
    "gap-progress-shorter.pkl", "gap-progress-contact.pkl", "distribution.yaml", "fitted_config.yaml", "config.yaml",
    "model.xml", "report.html", "tensorboard",
)  # fmt: skip
#: The first of them: a folder with none of these holds no run.
_MARKS = _RESULTS[:11]
_PACKAGES = ("dropo_torch", "torch", "mujoco", "warp-lang", "numpy", "scipy", "cma", "gymnasium")


def run_fit(config: Config, out: Path, *, console: Console, resume: bool = False, log: str | None = None) -> Fit:
    """Fit, and write ``fit.json``, ``report.html``, the distribution and the model to ``out``.

    Args:
        config: the config.
        out: the folder; results of an earlier run there are moved aside, never overwritten.
        console: where progress and results are shown.
        resume: continue an interrupted run in ``out``.
        log: ``"tensorboard"`` writes the history as TensorBoard events too.
    """
    check_log_option(log)
    problem = make_problem(config)
    continued = resume and (out / "checkpoint.pkl").exists()
    make_search(problem)  # what it refuses, it refuses before an earlier run is moved aside
    if not continued:
        refuse_dead_parameters(problem.objective)
    prepare_folder(out, problem.model_path, resume=continued)
    result = _fit(problem, out / "checkpoint.pkl", resume=resume, console=console)
    _refuse_lost(problem, result)
    _write_fit(problem, result, out)
    if log == "tensorboard":
        _write_tensorboard(result, out / "tensorboard")
    _show(problem, result, out, console)
    return result


def run_demo(out: Path, *, console: Console, overrides: Mapping[str, Any] | None = None, resume: bool = False) -> Fit:
    """Fit the bundled Hopper's masses to its log and compare them with the masses it was recorded with."""
    config = make_config({"sim": "hopper"}, overrides)
    sim = bundled_sim(str(config.sim))
    console.print(
        "The demo fits four link masses of a simulated Hopper to 200 logged transitions "
        "(sims/hopper/log.npz),\nrecorded with masses that the model does not have."
    )
    result = run_fit(config, out, console=console, resume=resume)
    table = Table("parameter", "recorded with", "found", "error", title="Against the truth", title_justify="left")
    for name, entry in result.distribution.summary().items():
        truth = sim.truth.get(name)
        if truth is None:
            continue
        error = 100 * (entry["mean"] / truth - 1)
        table.add_row(name, f"{truth:.4g} {entry['unit']}", f"{entry['mean']:.4g}", f"{error:+.3f} %")
    console.print(table)
    return result


def run_sweep(
    config: Config,
    out: Path,
    *,
    console: Console,
    epsilons: Sequence[float] | None = None,
    noisy_starts: bool = False,
    resume: bool = False,
) -> Sweep:
    """Fit at several ε, choose by the elbow, and write ``sweep.json`` and ``report.html`` to ``out``.

    Args:
        config: the config.
        out: the folder.
        console: where progress and results are shown.
        epsilons: the values to try; where the config has an ε for every column, the geometric mean of the columns'.
        noisy_starts: take ε for the variance of every measurement, of the starts of transitions, too.
        resume: continue an interrupted run in ``out``.
    """
    from dropo_torch.report import write_sweep_report

    _only_dropo(config, "sweep-epsilon chooses the ε of DROPO")
    if noisy_starts and config.noise is not None:
        raise InputError(f"noise: {config.noise} given, which --noisy-starts is to find; leave one of them out")
    if noisy_starts and isinstance(config.epsilon, list):
        raise InputError(f"epsilon: {config.epsilon} given, but --noisy-starts tries one for all columns; leave it out")
    problem = make_problem(config)
    store = out / "sweep-progress.json"
    values = default_epsilons(problem.objective.measured.numpy()) if epsilons is None else rising(epsilons)
    continued = resume and store.exists()
    if not continued:
        refuse_dead_parameters(problem.objective)  # before an earlier run is moved aside
    prepare_folder(out, problem.model_path, resume=continued)

    def keys_of(epsilon: float) -> dict[str, Any]:
        return noise_keys(problem.objective, epsilon) if noisy_starts else epsilon_keys(config.epsilon, epsilon)

    def point_at(epsilon: float) -> SweepPoint:
        part = make_problem(config.model_copy(update=keys_of(epsilon)))
        fit = _fit(part, None, resume=False, console=console, label=f"ε = {epsilon:g}")
        return SweepPoint.of(epsilon, fit, robust_log_likelihood(part.objective, fit) if noisy_starts else None)

    sweep = sweep_epsilon(point_at, values, noisy_starts=noisy_starts, fingerprint=problem.fingerprint, store=store)
    chosen = keys_of(sweep.chosen) | ({"scaling": True} if config.scaling else {})  # which ε is in units of
    _show_sweep(sweep, chosen, problem.space.names, console)
    write_json(out / "sweep.json", {**sweep.document(), "use": chosen})
    write_sweep_report(out / "report.html", sweep, use=chosen, config=config.document(), versions=versions())
    console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False, markup=False)
    return sweep


def _show_sweep(sweep: Sweep, chosen: Mapping[str, Any], names: Sequence[str], console: Console) -> None:
    heads = ("variance of the noise", "robust log-likelihood") if sweep.noisy_starts else ("ε", "log-likelihood")
    table = Table(heads[0], "mean squared error", heads[1], *names)
    for p in sweep.points:
        marked = "[bold]" if p.epsilon == sweep.chosen else ""
        cells = [f"{p.mean[n]:.4g} ± {p.std[n]:.2g}" for n in names]
        value = p.log_likelihood if p.robust_log_likelihood is None else p.robust_log_likelihood
        table.add_row(f"{marked}{p.epsilon:g}", f"{p.mse:.4g}", f"{value:.1f}", *cells)
    console.print(table)
    keys = yaml.safe_dump(dict(chosen), default_flow_style=True, sort_keys=False, width=10_000).strip()[1:-1]
    console.print(f"chosen: [bold]{keys}[/], since {sweep.reason}", soft_wrap=True)


def _only_dropo(config: Config, what: str) -> None:
    if config.method != "dropo":
        raise InputError(f"method: {config.method} given, but {what}; leave method and method_options out")


def run_certify(config: Config, out: Path, *, console: Console) -> Certificate:
    """Certify the gradients of every parameter on this model and log, and write ``certificate.json`` to ``out``.

    Raises:
        InputError: a gradient that is dead or wrong; the certificate is written all the same.
    """
    problem = make_problem(config.model_copy(update={"backend": "warp"}))
    prepare_folder(out, problem.model_path, resume=False)
    found = certify(problem.objective, seed=config.seed)
    write_json(out / "certificate.json", found.document())
    table = Table("parameter", "derivative", "median error", "99 %", "active set moved", "verdict")
    for p in found.parameters:
        numbers = (
            f"{p.magnitude:.3g}",
            f"{p.median_error:.1e}",
            f"{p.worst_error:.1e}",
            f"{100 * p.disagreeing:.2f} %",
        )
        table.add_row(p.name, *numbers, p.verdict)
    console.print(table)
    console.print(
        f"{found.transitions} transitions; next states differ from MuJoCo's by at most {found.state_error:.1e}",
        highlight=False,
    )
    found.check()
    return found


def run_compare(
    config: Config, out: Path, *, console: Console, methods: Sequence[str], seeds: int, resume: bool = False
) -> Comparison:
    """Fit by several optimizers and backends, and write ``compare.json`` and ``report.html`` to ``out``."""
    from dropo_torch.report import write_compare_report

    _only_dropo(config, "compare runs the optimizers of DROPO")
    problem = make_problem(config)
    store = out / "compare-progress.json"
    prepare_folder(out, problem.model_path, resume=resume and store.exists())

    def fit_with(optimizer: str, backend: str, seed: int) -> tuple[Fit, Objective]:
        part = make_problem(config.model_copy(update={"optimizer": optimizer, "backend": backend, "seed": seed}))
        label = f"{optimizer} on {backend}, seed {seed}"
        return _fit(part, None, resume=False, console=console, label=label), part.objective

    def show(run: Run) -> None:
        console.print(
            f"{run.method}, seed {run.seed}: log-likelihood {run.log_likelihood:.1f}, "
            f"{run.simulated_transitions} simulated transitions, {run.seconds:.1f} s",
            highlight=False,
        )

    truth = dict(bundled_sim(config.sim).truth) if config.sim and config.data is None else {}
    comparison = compare(
        fit_with,
        methods=methods,
        seeds=range(config.seed, config.seed + seeds),
        reference={n: truth[n] for n in problem.space.names} if truth else None,
        store=store,
        fingerprint=problem.fingerprint,
        on_run=show,
    )
    write_json(out / "compare.json", comparison.document())
    write_compare_report(out / "report.html", comparison, config=config.document(), versions=versions())
    console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False, markup=False)
    return comparison


def run_reproduce(
    name: str, out: Path, *, console: Console, reduced: bool = False, resume: bool = False, workers: int = 1
) -> Sequence[str]:
    """Redo the published study of a bundled simulation in ``out`` by so many processes; print what it found."""
    study = bundled_study(name)
    with StageProgress(console, f"reproduce {name}") as progress:
        found = study(out, reduced=reduced, resume=resume, report=progress.update, workers=workers)
    for line in found:
        console.print(f"  - {line}", highlight=False, markup=False, soft_wrap=True)
    console.print(
        f"tables: {out / 'tables.md'}; report: {out / 'report.html'}", highlight=False, markup=False, soft_wrap=True
    )
    return found


def run_gap(config: Config, out: Path, *, console: Console, source: Path | None = None, resume: bool = False) -> Gap:
    """Find what the model lacks, and write ``gap.json``, ``report.html``, ``model.xml`` and ``config.yaml`` to ``out``.

    Args:
        config: the config.
        out: the folder; results of an earlier run there are moved aside, never overwritten.
        console: where progress and results are shown.
        source: the config's file, which must not be the one that is written.
        resume: continue an interrupted run in ``out``.
    """
    from dropo_torch.report import write_gap_report

    problem = make_problem(config, general=True)
    written = out / "config.yaml"
    if source is not None and source.resolve() == written.resolve():
        raise InputError(f"--out: {source} is the config of this run, which would replace it; name another folder")
    if written.exists() and not (out / "gap.json").exists():
        raise InputError(f"--out: {written} is no result of an earlier run; name another folder, or move it")
    store = out / "gap-progress.pkl"
    with StageProgress(console, "gap") as progress:
        progress.update("preparing", 0.0)
        scene = prepare(problem)  # before an earlier run is moved aside
        prepare_folder(out, problem.model_path, resume=resume and store.exists())
        gap = find_gap(problem, checkpoint=store, resume=resume, report=progress.update, scene=scene)
    notes = add(problem, gap, out)
    gap = replace(gap, notes=(*gap.notes, *notes))
    write_json(out / "gap.json", gap.document())
    name = config.sim or config.model or "model"
    write_gap_report(
        out / "report.html", gap, config=config.document(), versions=versions(), title=f"What {name} lacks",
        model_note=" ".join(notes), has_config=written.exists(),
    )  # fmt: skip
    _show_gap(gap, out, console)
    return gap


def _show_gap(gap: Gap, out: Path, console: Console) -> None:
    headline, items = answer(gap)
    console.print(headline, highlight=False, markup=False)
    for item in items:
        console.print(f"  - {item}", highlight=False, markup=False)
    table = Table("held-out data", "before", "after", "noise alone")
    rows = (
        ("one-step mean squared error", "mse", "{:.3g}"),
        ("log-likelihood", "log_likelihood", "{:.1f}"),
        (f"open-loop error over {gap.rollout_seconds:g} s", "rollout_rmse", "{:.3g}"),
    )
    for words, key, form in rows:
        table.add_row(words, *(form.format(getattr(s, key)) for s in (gap.before, gap.after, gap.noise_floor)))
    console.print(table)
    if gap.next_experiment:
        console.print(gap.next_experiment, highlight=False, markup=False)
    for note in gap.notes:
        console.print(note, highlight=False, markup=False)
    console.print(
        f"{gap.simulated_transitions} simulated transitions, {gap.seconds:.1f} s; report: {out / 'report.html'}",
        soft_wrap=True, highlight=False, markup=False,
    )  # fmt: skip
    if (out / "config.yaml").exists():
        console.print(f"to fit the strengths: dropo fit {out / 'config.yaml'} --out DIR", soft_wrap=True, markup=False)


def versions() -> dict[str, str]:
    """Return the versions of what a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def _fit(problem: Problem, checkpoint: Path | None, *, resume: bool, console: Console, label: str = "fit") -> Fit:
    with FitProgress(console, label) as progress:
        return fit_problem(problem, checkpoint=checkpoint, resume=resume, on_progress=progress.update)


def prepare_folder(out: Path, model_path: Path | None, *, resume: bool) -> None:
    """Make the folder; move an earlier run's files aside unless it is to be continued. Nothing else is touched.

    Raises:
        InputError: a folder that cannot be written, or in which a result would replace one of the user's files.
    """
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"--out: {out} is a file; expected a folder")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"--out: cannot write to folder {out}: {error.strerror}") from None
    for name in _RESULTS:
        for stale in out.glob(f".{name}.*.tmp"):  # a write that kill -9 cut short
            stale.unlink()
    present = [name for name in _RESULTS if (out / name).exists()]
    if not (out / "gap.json").exists() and "config.yaml" in present:
        present.remove("config.yaml")  # one of the user's own
    source = model_path
    if source is not None and source.name in present and source.resolve() == (out / source.name).resolve():
        raise InputError(
            f"--out: {out / source.name} is the model of this run, which would replace it; name another folder"
        )
    if resume or not present:
        return
    if not any(mark in present for mark in _MARKS):
        raise InputError(f"--out: {out / present[0]} is no result of an earlier run; name another folder, or move it")
    number = next(i for i in range(1, 10_000) if not (out / f"previous-{i}").exists())
    aside = out / f"previous-{number}"
    aside.mkdir()
    for name in reversed(present):  # the marks last: what is cut short here is still known as a run
        shutil.move(str(out / name), aside / name)


def _refuse_lost(problem: Problem, result: Fit) -> None:
    """Raise an :class:`InputError` if no simulation of the final evaluation survived."""
    if result.diverged < len(problem.objective) * result.samples:
        return
    raise InputError(
        "parameters: every simulation of this log diverges, wherever in the bounds; "
        "check the log's units, the order of its columns (observation), frame_skip and the bounds"
    )


def _write_fit(problem: Problem, result: Fit, out: Path) -> None:
    from dropo_torch.report import write_fit_report

    result.save(out / "fit.json")
    result.distribution.save(out / "distribution.yaml")
    document = problem.config.document()
    portable = yaml.safe_dump(problem.config.portable(), sort_keys=False, allow_unicode=True)
    write_atomically(out / "fitted_config.yaml", portable.encode())
    notes = []
    if problem.model_path is not None:
        try:
            notes += _write_model(problem, result.distribution.center, out / "model.xml")
        except InputError as error:
            notes.append(f"No model.xml was written: {error}.")
    write_fit_report(
        out / "report.html",
        fit=result,
        diagnostics=diagnose(problem.objective, result.distribution, seed=problem.config.seed),
        config=document,
        title=f"Fit of {problem.config.sim or problem.config.model or problem.config.environment}",
        notes=notes,
        versions=versions(),
        space=problem.space,
    )


def _write_model(problem: Problem, values: np.ndarray, path: Path) -> list[str]:
    """Write the model with parameter values ``(d,)`` and effects; return what it lacks, in words."""
    assert problem.model_path is not None
    if problem.effects is None:
        export_model(problem.model_path, problem.space, values, path)
        return []
    rest = write_model(problem.model_path, problem.effects.at(values), path, problem.space, values)
    if not rest:
        return []
    names = ", ".join(p.effect.name + (f" at {p.target}" if p.target else "") for p in rest)
    return [f"model.xml lacks what MJCF cannot express: {names}. The fitted config has it."]


def _show(problem: Problem, result: Fit, out: Path, console: Console) -> None:
    table = Table("parameter", "mean", "std", "unit", "search box")
    for name, entry in result.distribution.summary().items():
        box = f"[{entry['low']:g}, {entry['high']:g}]".replace("[", "\\[")
        table.add_row(name, f"{entry['mean']:.5g}", f"{entry['std']:.2g}", entry["unit"], box)
    console.print(table)
    console.print(
        f"log-likelihood {result.log_likelihood:.2f}, mean squared error {result.mse:.3g}, "
        f"{len(problem.objective)} windows, {result.simulated_transitions} simulated transitions, "
        f"{result.seconds:.1f} s; stopped because {result.stop_reason}",
        soft_wrap=True,
        highlight=False,
    )
    if result.diverged:
        share = 100 * result.diverged / (len(problem.objective) * result.samples)
        console.print(f"{result.diverged} simulations ({share:.2g} %) diverged under the fitted distribution")
    console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False, markup=False)


def check_log_option(log: str | None) -> None:
    """Raise an :class:`InputError` for an option ``--log`` that is not known or not installed."""
    if log not in (None, "tensorboard"):
        raise InputError(f"--log: unknown {log!r}; expected tensorboard")
    if log is not None:
        _summary_writer()


@functools.cache
def _summary_writer() -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            "--log tensorboard: TensorBoard is not installed; pip install 'dropo_torch[tensorboard]'"
        ) from None
    return SummaryWriter


def _write_tensorboard(result: Fit, folder: Path) -> None:
    """Write the history as TensorBoard scalars, over simulated transitions."""
    with _summary_writer()(str(folder)) as writer:
        for entry in result.history:
            step = entry.simulated_transitions
            writer.add_scalar("log_likelihood", entry.log_likelihood, step)
            for i, name in enumerate(result.distribution.names):
                writer.add_scalar(f"mean/{name}", entry.mean[i], step)
                writer.add_scalar(f"std/{name}", entry.std[i], step)
