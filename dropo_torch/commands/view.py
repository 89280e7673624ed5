"""``dropo view``: measured and simulated motion side by side, as a page to scrub through and as a video."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from dropo_torch.commands.folder import claimed, prepare_folder, provenance
from dropo_torch.commands.options import add_out, seconds
from dropo_torch.commands.progress import StageProgress
from dropo_torch.errors import InputError
from dropo_torch.view.settings import HORIZON, SECONDS

if TYPE_CHECKING:
    from dropo_torch.view import Run, View

#: What the command writes.
PAGE, VIDEO = "view.html", "view.mp4"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo view``."""
    parser.add_argument(
        "run_folder", type=Path, metavar="RUN",
        help="folder of a finished dropo fit, gap or check; or a config, whose model is then taken as it is",
    )  # fmt: skip
    add_out(parser, "folder of the page and the video (RUN itself)")
    parser.add_argument("--episode", type=_index, default=0, metavar="N", help="which of the log's, counted from 0 (0)")
    parser.add_argument(
        "--start", type=_start, default=0.0, metavar="S", help="seconds since the episode's start to begin at (0)"
    )
    parser.add_argument(
        "--seconds", type=seconds, default=SECONDS, metavar="T", help=f"seconds to show ({SECONDS:g})"
    )  # fmt: skip
    parser.add_argument(
        "--horizon", type=seconds, default=HORIZON, metavar="H",
        help=f"seconds after which the simulation starts from the logged state again ({HORIZON:g})",
    )  # fmt: skip
    parser.epilog = "every key of the config is an option too, such as --data other.csv"


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo view``, which writes ``view.html`` and, where OpenGL can draw, ``view.mp4``."""
    from dropo_torch.view import make_view, read_run

    found = read_run(given.run_folder, overrides)
    out = found.folder if given.out is None else given.out
    if out is None:
        raise InputError(f"--out: {given.run_folder} is a config; name a folder for the page and the video: --out DIR")
    with claimed(out) if given.out is None else contextlib.nullcontext():
        times = {"start": given.start, "seconds": given.seconds, "horizon": given.horizon}
        view = make_view(found, episode=given.episode, **times)
        prepare_folder(out, None, resume=True)
        _write(found, view, out, console)


def _write(found: Run, view: View, out: Path, console: Console) -> None:
    from dropo_torch.report import write_view_page
    from dropo_torch.view import write_video

    with StageProgress(console, "view") as progress:
        note = write_video(out / VIDEO, view, lambda done, of: progress.show("drawing the video", done / of))
    if note:
        (out / VIDEO).unlink(missing_ok=True)  # of an earlier view
    links = [(VIDEO, "the same as a video")] if not note else []
    if found.folder == out and (out / "report.html").is_file():
        links.append(("report.html", "the report of this run"))
    about = provenance(found.candidates[-1].problem.config)
    write_view_page(out / PAGE, view, links=links, **about)
    for take in view.takes:
        console.print(f"{take.name}: off by {take.overall:.3g} times the noise (rms, open loop)", soft_wrap=True)
    if note:
        console.print(note, soft_wrap=True)
    else:
        console.print(f"video: {out / VIDEO}", soft_wrap=True)
    console.print(f"page: {out / PAGE}", soft_wrap=True)


def _index(text: str) -> int:
    """Return a whole number, 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} given; expected a whole number, 0 or more")
    return int(text)


def _start(text: str) -> float:
    """Return a time in seconds, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected seconds, 0 or more")
    return value
