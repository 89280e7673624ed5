"""``dropo plan``: the motion to record next, and what it is to tell."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config, count, seconds
from dropo_torch.commands.progress import StageProgress
from dropo_torch.config import load_config
from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically, write_json

if TYPE_CHECKING:
    from dropo_torch.planning import Plan

#: Seconds of a motion, unless told otherwise, and the file of its video.
SECONDS, VIDEO = 20.0, "motion.mp4"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo plan``."""
    add_config(parser, "plan")
    parser.add_argument(
        "--seconds", type=seconds, default=SECONDS, metavar="S", help=f"how long the motion is ({SECONDS:g})"
    )
    parser.add_argument(
        "--at", type=Path, metavar="FIT", help="fit.json at whose means it is planned (the model's own values)"
    )
    parser.add_argument(
        "--gap", type=Path, metavar="DIR", help="folder of a dropo gap: the motion is to tell its tied effects apart"
    )
    parser.add_argument("--no-video", action="store_true", help="write no video of the expected motion")
    parser.add_argument("--evaluations", type=count, metavar="N", help="motions to try; the config's plan.evaluations")


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo plan``: ``plan.json``, ``commands.csv``, ``expected.csv``, ``report.html``, and a video if it can.

    Raises:
        InputError: a fit that is not there, or what :func:`~dropo_torch.planning.make_plan` refuses.
    """
    if given.evaluations is not None:
        overrides = {**overrides, "plan.evaluations": given.evaluations}
    config, out = load_config(given.config, overrides), given.out
    if given.at is not None and not given.at.is_file():
        raise InputError(f"--at: no file {given.at}; expected the fit.json of a dropo fit")
    for source in filter(None, (given.at and given.at.parent, given.gap)):
        if source.resolve() == out.resolve():
            raise InputError(
                f"--out: {out} holds what the plan starts from, which would be moved aside; name another folder"
            )
    from dropo_torch.planning import make_plan, prepare
    from dropo_torch.report import write_plan_report

    store = out / "plan-progress.bin"
    with StageProgress(console, "plan") as progress:
        progress.show("preparing", 0.0)
        ground = prepare(config, given.seconds, at=given.at, gap=given.gap)
        continued = given.resume and store.exists()
        prepare_folder(out, ground.problem.model_path, resume=continued)
        plan = make_plan(ground, checkpoint=store, resume=continued, report=progress.show)
    write_json(out / "plan.json", plan.document() | {"config": config.portable()})
    write_atomically(out / "commands.csv", table(["time", *plan.actuators], plan.times[:-1], plan.commands))
    write_atomically(out / "expected.csv", table(["time", *plan.columns[0]], plan.times, plan.states))
    note = "" if given.no_video else _video(plan, out / VIDEO, console)
    shown = VIDEO if (out / VIDEO).is_file() else ""
    write_plan_report(out / "report.html", plan, video=shown, **provenance(config))
    _show(plan, out, console)
    if note:
        console.print(note, soft_wrap=True)


def _video(plan: Plan, path: Path, console: Console) -> str:
    """Write a video of the expected motion; return why there is none, or nothing."""
    from dropo_torch.planning.shown import view_of
    from dropo_torch.view import write_video

    with StageProgress(console, "plan") as progress:
        return write_video(path, view_of(plan), lambda done, of: progress.show("drawing the video", done / of))


def table(names: list[str], times: Any, rows: Any) -> bytes:
    """Return a table as CSV, a row each time."""
    lines = [",".join(names)]
    for time, row in zip(times, rows, strict=True):
        lines.append(",".join([f"{time:.9g}", *(f"{x:.9g}" for x in row)]))
    return ("\n".join(lines) + "\n").encode()


def _show(plan: Plan, out: Path, console: Console) -> None:
    kinds = {"plan": "by the motion"}
    if plan.ground.has_log:
        kinds = {"log": "by the log", **kinds, "both": "by both"}
    shown = Table("parameter", "at", "unit", *kinds.values())
    for name, entry in plan.document()["parameters"].items():
        errors = [f"± {entry['standard_error'][kind]:.2g}" for kind in kinds]
        shown.add_row(name, f"{entry['value']:.4g}", entry["unit"], *errors)
    console.print(shown)
    for line in plan.remarks:
        console.print(line, soft_wrap=True)
    console.print(
        f"{plan.found.evaluations} motions tried, {plan.seconds:.1f} s; commands: {out / 'commands.csv'}; "
        f"report: {out / 'report.html'}",
        soft_wrap=True,
    )
