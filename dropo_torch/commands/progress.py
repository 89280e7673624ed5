"""What a person sees while a run goes on."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from dropo_torch.fit import HistoryEntry
from dropo_torch.optimizers import Progress as OptimizerProgress

#: Seconds between lines where the output is no terminal.
INTERVAL = 10.0


class _Live:
    """A bar that shows while it is entered."""

    _bar: Progress

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


class FitProgress(_Live):
    """A progress line of a fit: stage, evaluations, best log-likelihood, time spent and left.

    On a terminal it is redrawn in place; elsewhere a line is printed every ten seconds.
    """

    def __init__(self, console: Console, label: str) -> None:
        self._console = console
        self._label = label
        self._last = time.monotonic()
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(label, total=1.0, status="simulating")

    def update(self, entry: HistoryEntry, progress: OptimizerProgress) -> None:
        """Show the state after a batch."""
        best = "" if math.isnan(entry.log_likelihood) else f", best log-likelihood {entry.log_likelihood:.1f}"
        left = entry.seconds * (1 - progress.fraction) / max(progress.fraction, 0.05)
        status = f"{progress.stage}: {entry.evaluations} evaluations{best}, about {_duration(left)} left"
        self._bar.update(self._task, completed=progress.fraction, status=status)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last > INTERVAL:
            self._last = now
            self._console.print(f"{self._label}: {status}", soft_wrap=True)


class StageProgress(_Live):
    """A progress line of a run in stages; elsewhere than on a terminal a line for every stage."""

    def __init__(self, console: Console, label: str) -> None:
        self._console, self._label, self._stage = console, label, ""
        self._bar = Progress(
            SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=20), TimeElapsedColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task(label, total=1.0)

    def update(self, stage: str, share: float) -> None:
        """Show a stage and how much of it is done."""
        self._bar.update(self._task, completed=share, description=f"{self._label}: {stage}")
        if not self._console.is_terminal and stage != self._stage:
            self._console.print(f"{self._label}: {stage}", soft_wrap=True)
        self._stage = stage


class TrainProgress(_Live):
    """A progress line of a training: steps, return of late, steps a second, time left."""

    def __init__(self, console: Console, steps: int) -> None:
        self._console, self._steps, self._last = console, steps, time.monotonic()
        self._bar = Progress(
            SpinnerColumn(), TextColumn("train"), BarColumn(bar_width=20), TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("train", total=1.0, status="simulating")
        self._from: tuple[int, float] | None = None

    def update(self, steps: int, mean_return: float) -> None:
        """Show how many steps are done, and the return of the episodes that ended last."""
        now = time.monotonic()
        first_steps, first_time = self._from = self._from or (steps, now)
        rate = (steps - first_steps) / max(now - first_time, 1e-9)
        left = f", about {_duration((self._steps - steps) / rate)} left" if rate > 0 else ""
        late = "" if math.isnan(mean_return) else f", return {mean_return:.4g}"
        status = f"{steps:,} of {self._steps:,} steps{late}{left}"
        self._bar.update(self._task, completed=steps / self._steps, status=status)
        if not self._console.is_terminal and now - self._last > INTERVAL:
            self._last = now
            self._console.print(f"train: {status}", soft_wrap=True, highlight=False)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
