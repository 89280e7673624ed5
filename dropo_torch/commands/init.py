"""``dropo init``: a config from a model and a log, and a page that explains it."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.folder import made_for_use, versions
from dropo_torch.commands.options import seconds
from dropo_torch.commands.progress import StageProgress
from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically

if TYPE_CHECKING:
    from dropo_torch.proposal import Choice, Clock, Matching, Proposal
    from dropo_torch.proposal.columns import Columns
    from dropo_torch.proposal.places import Place


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo init``."""
    parser.add_argument("model", type=Path, metavar="MODEL", help="MJCF or URDF")
    parser.add_argument(
        "data", type=Path, nargs="+", metavar="LOG",
        help="a log of any format: docs/data.md; several files, or a pattern, each with an episode or more",
    )  # fmt: skip
    parser.add_argument(
        "--out", dest="path", type=Path, default=Path("robot.yaml"), metavar="CONFIG",
        help="the config to write (robot.yaml); the page lies beside it",
    )  # fmt: skip
    parser.add_argument("--dt", type=seconds, metavar="SECONDS", help="between rows, for a log without time stamps")
    parser.add_argument("--interactive", action="store_true", help="show each step, and let it be corrected")
    parser.add_argument("--overwrite", action="store_true", help="replace a config that is there")
    parser.set_defaults(out=None)


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo init``, which writes the config and its page.

    Raises:
        InputError: a config that already exists, options that are keys of a config, or what the log lacks.
    """
    if overrides:
        raise InputError(f"--{next(iter(overrides))}: init proposes all keys; change them in the file that it writes")
    path, page = given.path, given.path.with_suffix(".html")
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"--out: {path} is no YAML file; expected a name such as robot.yaml")
    if path.exists() and not given.overwrite:
        raise InputError(f"--out: {path} already exists; choose another name or pass --overwrite")
    from dropo_torch.proposal import propose_config
    from dropo_torch.report import write_init_report

    began = time.perf_counter()
    review = Questions(console) if given.interactive else None
    with made_for_use(path.parent), StageProgress(console, "init") as progress:
        path.parent.mkdir(parents=True, exist_ok=True)  # one that cannot be made is told at once
        if review is not None:
            progress.stop()
        proposal = propose_config(
            given.model, given.data, out=path, dt=given.dt, review=review, report=progress.show
        )  # fmt: skip
        write_atomically(path, proposal.text.encode())
    took = time.perf_counter() - began
    write_init_report(page, proposal, seconds=took, title=f"A config for {given.model.name}", versions=versions())
    _show(proposal, path, page, took, console)


def _show(proposal: Proposal, path: Path, page: Path, took: float, console: Console) -> None:
    from dropo_torch.commands.check import told

    console.print(columns_table(proposal.matching))
    console.print(parameters_table(proposal.choice))
    for line in (proposal.rate, proposal.window, *proposal.draft.turned, *proposal.draft.notes):
        console.print(line, soft_wrap=True)
    console.print(f"Of {len(proposal.choice.told)} physical parameters, {proposal.choice.summary}.", soft_wrap=True)
    for finding in proposal.findings:
        console.print(f"log: {finding.confidence}: {told(finding)}", soft_wrap=True)
    console.print(f"{took:.1f} s; config: {path}, explained in {page}", soft_wrap=True)
    for what, command in (("what the model lacks", "gap"), ("a distribution", "fit")):
        out = shlex.quote(f"{path.with_suffix('')}-{command}")
        console.print(f"{what}: dropo {command} {shlex.quote(str(path))} --out {out}", soft_wrap=True)


def columns_table(matching: Matching) -> Table:
    """Return which column is what, as a table."""
    from dropo_torch.proposal.text import described

    table = Table("column", "of the model", "unit", "sure?", "found by")
    for column in table.columns[:2]:
        column.overflow = "fold"
    for match in matching.matches:
        table.add_row(*described(match))
    return table


def parameters_table(choice: Choice) -> Table:
    """Return what is fitted, as a table."""
    from dropo_torch.proposal.text import error_text

    table = Table("parameter", "model's own", "expected error", "bounds", "also stands for")
    for column in table.columns:
        column.overflow = "fold"
    for t in choice.chosen:
        c = t.candidate
        low, high = c.spec["bounds"]
        others = ", ".join(name for name, _ in t.with_)
        table.add_row(c.name, f"{c.nominal:.4g} {c.unit}".rstrip(), error_text(t), f"[{low:g}, {high:g}]", others)
    return table


class Questions:
    """Shows each step on the terminal, and asks what to correct; an empty answer keeps it."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def columns(self, columns: Columns, matching: Matching, places: Sequence[Place]) -> Matching:
        """Ask for the column, and the factor of its unit, of any number of the model."""
        from dropo_torch.proposal.matches import Match

        while True:
            self._console.print(columns_table(matching))
            missing = ", ".join(p.label for p in matching.missing)
            self._console.print(f"without a column: {missing or 'nothing'}", soft_wrap=True)
            label = self._ask("number of the model to correct (empty: go on)")
            if not label:
                return matching
            place = next((p for p in places if p.label == label), None)
            if place is None:
                self._console.print(f"the model has no {label}; it has {', '.join(p.label for p in places)}")
                continue
            entry = self._ask(f"column of {label} (- for none)")
            rest = tuple(m for m in matching.matches if m.place.label != label and m.column.entry != entry)
            column = columns.named(entry)
            if column is not None and column.values.size:
                scale = self._number("factor of its unit to the model's", 1.0)
                rest = (*rest, Match(place, column, scale, "sure", "you"))
            elif entry != "-":
                self._console.print(
                    f"the log has no column {entry}; it has {', '.join(c.entry for c in columns.numeric)}"
                )
                continue
            found = {m.place.label: m for m in rest}
            matches = tuple(found[p.label] for p in places if p.label in found)
            used = [m.column for m in matches]
            matching = replace(
                matching, matches=matches, missing=tuple(p for p in places if p.label not in found),
                unused=tuple(c for c in columns.numeric if c.moves and all(c is not u for u in used)),
            )  # fmt: skip

    def clock(self, clock: Clock) -> Clock:
        """Ask for the seconds between rows."""
        self._console.print("; ".join(clock.why), soft_wrap=True)
        if clock.column is not None:
            unit = self._number(f"seconds of the unit of {clock.column.entry}", clock.unit)
            dt = None if clock.dt is None else clock.dt * unit / clock.unit
            return replace(clock, unit=unit, dt=dt)
        return replace(clock, dt=self._number("seconds between rows", clock.dt or 0.01))

    def parameters(self, choice: Choice) -> Sequence[str] | None:
        """Ask for parameters to add to those that were chosen, and to leave out."""
        from dropo_torch.proposal.text import error_text

        self._console.print(parameters_table(choice))
        left = [f"{t.candidate.name} ({error_text(t)})" for t in choice.told if not t.is_in]
        self._console.print(f"left out: {', '.join(left) or 'nothing'}", soft_wrap=True)
        names = [t.candidate.name for t in choice.chosen]
        changed = self._ask("names to add, or to leave out with a minus (empty: go on)").replace(",", " ").split()
        known = {t.candidate.name for t in choice.told}
        for word in changed:
            name = word.removeprefix("-")
            if name not in known:
                self._console.print(f"there is no {name}")
            elif word.startswith("-"):
                names = [n for n in names if n != name]
            elif name not in names:
                names.append(name)
        return names if changed else None

    def _ask(self, question: str) -> str:
        from rich.prompt import Prompt

        return Prompt.ask(question, console=self._console, default="", show_default=False).strip()

    def _number(self, question: str, default: float) -> float:
        from rich.prompt import FloatPrompt

        return FloatPrompt.ask(question, console=self._console, default=default)
