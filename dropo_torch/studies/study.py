"""Studies: what an interrupted one does not compute again, cells that are computed side by side, and what they say."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically
from dropo_torch.support.given import reading
from dropo_torch.support.parallel import Task, Workers, check_workers, in_parallel
from dropo_torch.support.report import Report

SCHEMA = "dropo-torch/study/1"

Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)
Result = TypeVar("Result")


class Cell(Protocol):
    """One computation of a study, usually a fit; a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""


def run_cells(
    out: Path,
    plan: Any,
    cells: Sequence[Cell],
    run: Callable[..., dict[str, Any]],
    *,
    resume: bool = False,
    workers: Workers = 1,
    report: Report = lambda stage, share: None,
) -> list[dict[str, Any]]:
    """Run every cell whose file is not there yet, and return all results, each with its ``cell``, in the cells' order.

    Args:
        out: the folder, which gets ``plan.json`` and ``cells/``.
        plan: a dataclass of how large the study is; a folder with another one is refused.
        cells: what is to be run.
        run: called as ``run(cell, threads=...)``, gives plain data; of a module's top level, as it is pickled.
        resume: go on with the study that the folder holds.
        workers: processes that run cells side by side, or ``"ray"``. The results do not depend on it.
        report: called with what is being done and the share that is.

    Raises:
        InputError: a folder with another study, or with one that is not to be resumed; a cluster that is not there.
    """
    check_workers(workers)
    _claim(out, plan, resume=resume)
    files = {cell.name: out / "cells" / f"{cell.name}.json" for cell in cells}
    waiting = [cell for cell in cells if not files[cell.name].exists()]
    done = len(cells) - len(waiting)
    report(f"{done} of {len(cells)} fits are done", done / len(cells))
    for number, (cell, found) in enumerate(in_parallel(run, waiting, workers), done + 1):
        write_atomically(files[cell.name], json.dumps(found, indent=1).encode() + b"\n")
        report(f"{number} of {len(cells)}: {cell.name}", number / len(cells))
    return [{**json.loads(files[cell.name].read_text()), "cell": asdict(cell)} for cell in cells]


class Store(Generic[Result]):
    """Results by key: dataclasses of plain data, or mappings.

    Args:
        path: the file, written whole after each result; ``None`` to keep nothing.
        fingerprint: identifies config, log and options.
        what: the study, for messages.
        kind: makes a result of what the file holds, from keyword arguments.

    Raises:
        InputError: a file of something else, or of a study with another fingerprint.
    """

    def __init__(self, path: Path | None, fingerprint: str, what: str, kind: Callable[..., Result]) -> None:
        self._path, self._fingerprint = path, fingerprint
        self._results: dict[str, Result] = {}
        if path is None or not path.is_file():
            return
        with reading(f"resume: {path}", f"the record of a {what}", "start again without --resume"):
            content = json.loads(path.read_text())
            owner = content["fingerprint"]
            self._results = {key: kind(**result) for key, result in content["results"].items()}
        if owner != fingerprint:
            raise InputError(
                f"resume: {path} belongs to another config or log, or to other options; start again without --resume"
            )

    def results(
        self,
        tasks: Mapping[str, Task],
        work: Callable[..., Result],
        workers: Workers = 1,
        on_result: Callable[[Result], None] = lambda result: None,
    ) -> list[Result]:
        """Return the results of tasks by key, in their order, each computed and kept where there is none yet.

        Args:
            tasks: independent of each other.
            work: called as ``work(task, threads=...)``; see :func:`~dropo_torch.support.parallel.in_parallel`.
            workers: processes that do them side by side, or ``"ray"``.
            on_result: called with each that is computed.
        """
        waiting = [item for item in tasks.items() if item[0] not in self._results]
        for (key, _), result in in_parallel(functools.partial(_by_key, work=work), waiting, workers):
            self._results[key] = result
            if self._path is not None:
                content = {"fingerprint": self._fingerprint, "results": self._results}
                write_atomically(self._path, json.dumps(content, default=asdict).encode())
            on_result(result)
        return [self._results[key] for key in tasks]


def _by_key(item: tuple[str, Task], *, work: Callable[..., Result], threads: int) -> Result:
    return work(item[1], threads=threads)


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return items by their key, both in the order in which they come."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


@dataclass(frozen=True)
class Finding:
    """A claim that the study tests, whether it holds, and what was measured about it."""

    finding: str
    holds: bool
    measured: str

    def sentence(self) -> str:
        """Return the finding in a line."""
        return f"{'holds' if self.holds else 'DOES NOT HOLD'}: {self.finding} ({self.measured})"


@dataclass(frozen=True)
class Section:
    """A table as people read it, and the file of the figure that shows the same, where there is one."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    figure: str = ""


def findings_section(findings: Iterable[Finding]) -> Section:
    """Return the table of findings."""
    rows = [[f.finding, "yes" if f.holds else "no", f.measured] for f in findings]
    return Section("Findings", ["finding", "holds", "measured"], rows)


def markdown(title: str, introduction: str, sections: Iterable[Section]) -> str:
    """Return a study's page as Markdown."""
    parts = [f"# {title}\n", introduction + "\n"]
    for section in sections:
        lines = [section.head, ["---"] * len(section.head), *section.rows]
        parts.append(f"## {section.title}\n")
        if section.figure:
            parts.append(f"![{section.title}]({section.figure})\n")
        parts.append("\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n")
    return "\n".join(parts)


def _claim(out: Path, plan: Any, *, resume: bool) -> None:
    """Mark the folder as this study's; refuse one that holds another's results."""
    mark = out / "plan.json"
    wanted = json.loads(json.dumps({"schema": SCHEMA, "plan": asdict(plan)}))
    if mark.exists():
        if not resume:
            raise InputError(f"--out: {out} holds a study; add --resume to go on with it, or name another folder")
        if json.loads(mark.read_text()) != wanted:
            raise InputError(
                f"resume: {out} holds a study of another size; name another folder, or give --reduced as at its start"
            )
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out: {out} is not an empty folder; name another one")
    write_atomically(mark, json.dumps(wanted, indent=2).encode() + b"\n")
