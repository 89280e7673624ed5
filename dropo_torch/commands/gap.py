"""``dropo gap``: what the model lacks, named, and the model and config with it."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.check import add_force, check_first
from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config, seconds
from dropo_torch.commands.progress import StageProgress
from dropo_torch.config import load_config
from dropo_torch.errors import InputError
from dropo_torch.support.files import write_json

if TYPE_CHECKING:
    from dropo_torch.gap import Gap


#: Seconds of a search, unless told otherwise.
LIMIT = 600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo gap``."""
    add_config(parser)
    add_force(parser)
    parser.add_argument(
        "--time-limit", type=seconds, default=LIMIT, metavar="SECONDS",
        help=f"after which no more effects are looked for, and the best answer so far is given ({LIMIT:g})",
    )  # fmt: skip


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo gap``, which writes ``gap.json``, report, picture, and the model and config with what it found."""
    from dropo_torch.gap import add, as_given, find_gap, find_gap_as_given, prepare
    from dropo_torch.gap.run import SEARCHED
    from dropo_torch.gap.time_left import TimeLeft
    from dropo_torch.problem import logged_data, make_problem
    from dropo_torch.report import write_gap_picture, write_gap_report
    from dropo_torch.shooting.posing import posed

    config, out = load_config(given.config, overrides), given.out
    written = out / "config.yaml"
    if given.config.resolve() == written.resolve():
        raise InputError(
            f"--out: {given.config} is the config of this run, which would replace it; name another folder"
        )
    if written.exists() and not (out / "gap.json").exists():
        raise InputError(f"--out: {written} is no result of an earlier run; name another folder, or move it")
    problem = make_problem(config, general=True)
    check_first(logged_data(problem), console, force=given.force)
    store = out / "gap-progress.bin"
    with StageProgress(console, "gap", TimeLeft(SEARCHED * given.time_limit)) as progress:
        progress.show("preparing", 0.0)
        problem = posed(problem)
        first = config.as_given and bool(problem.space.names)
        scene = prepare(as_given(problem) if first else problem)  # before an earlier run is moved aside
        stores = (store, store.with_stem(f"{store.stem}-given"))
        prepare_folder(out, problem.model_path, resume=given.resume and any(path.exists() for path in stores))
        options = {"checkpoint": store, "resume": given.resume, "time_limit": given.time_limit, "scene": scene}
        if first:
            problem, gap = find_gap_as_given(problem, report=progress.show, **options)
        else:
            gap = find_gap(problem, report=progress.show, **options)
    notes = add(problem, gap, out)
    gap = replace(gap, notes=(*gap.notes, *notes))
    write_json(out / "gap.json", gap.document() | {"config": config.portable()})
    about = {"title": f"What {config.sim or config.model or 'model'} lacks", **provenance(config)}
    write_gap_picture(out / "picture.png", gap)
    write_gap_report(out / "report.html", gap, model_note=" ".join(notes), has_config=written.exists(), **about)
    _show(gap, out, console)


def _show(gap: Gap, out: Path, console: Console) -> None:
    from dropo_torch.report.gap_words import ambiguous, answer, tabled

    headline, items = answer(gap)
    for line in (headline, *(f"  - {item}" for item in items)):
        console.print(line)
    if rows_of_numbers := tabled(gap):
        numbers = Table("what is missing", "number or place", "value (90 % interval)")
        for row in rows_of_numbers:
            numbers.add_row(*row)
        console.print(numbers)
    for effect in () if gap.forces else gap.effects:
        if effect.indistinguishable_from:
            console.print(ambiguous(effect))
    table = Table("held-out data", "before", "after", "noise alone")
    rows = (
        ("one-step mean squared error", "mse", "{:.3g}"),
        ("log-likelihood", "log_likelihood", "{:.1f}"),
        (f"open-loop error over {gap.rollout_seconds:.3g} s", "rollout_rmse", "{:.3g}"),
    )
    for words, key, form in rows:
        table.add_row(words, *(form.format(getattr(s, key)) for s in (gap.before, gap.after, gap.noise_floor)))
    console.print(table)
    if gap.forces:
        forces = Table("unexplained force on held-out data", "unit", "before", "after")
        for f in gap.forces:
            forces.add_row(f.joint, f.unit, f"{f.before:.3g}", f"{f.after:.3g}")
        console.print(forces)
    if gap.declared:
        values = Table("parameter of the config", "model as given", "fitted alone", "fitted with the effects")
        for name, fitted in gap.declared.items():
            values.add_row(name, *(f"{value:.4g}" for value in fitted))
        console.print(values)
    for line in filter(None, (gap.next_experiment, *gap.notes)):
        console.print(line)
    console.print(
        f"{gap.simulated_transitions} simulated transitions, {gap.seconds:.1f} s; report: {out / 'report.html'}",
        soft_wrap=True,
    )  # fmt: skip
    if (out / "config.yaml").exists():
        console.print(
            f"to fit the strengths: dropo fit {shlex.quote(str(out / 'config.yaml'))} --out DIR", soft_wrap=True
        )
