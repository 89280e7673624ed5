"""What a person sees while a run goes on."""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

if TYPE_CHECKING:
    from dropo_torch.fit import Fit, HistoryEntry
    from dropo_torch.gap.time_left import TimeLeft
    from dropo_torch.optimizers import Progress as OptimizerProgress
    from dropo_torch.problem import Problem
    from dropo_torch.support.parallel import Workers

#: Seconds between lines where the output is no terminal.
INTERVAL = 10.0


class _Live(Progress):
    """A bar with a status while it is entered: redrawn in place on a terminal, a line every ten seconds elsewhere."""

    def __init__(self, console: Console, label: str, *columns: ProgressColumn) -> None:
        super().__init__(
            SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(bar_width=20),
            TextColumn("{task.fields[status]}", markup=False), *columns, TimeElapsedColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._label, self._last = label, time.monotonic()
        self._bar = self.add_task(label, total=1.0, status="simulating")

    def _show(self, status: str, share: float, interval: float = INTERVAL) -> None:
        self.update(self._bar, completed=share, status=status)
        now = time.monotonic()
        if not self.console.is_terminal and now - self._last > interval:
            self._last = now
            self.console.print(f"{self._label}: {status}", soft_wrap=True)


class FitProgress(_Live):
    """A fit's stage, evaluations, best log-likelihood, time spent and left."""

    def show(self, entry: HistoryEntry, progress: OptimizerProgress) -> None:
        """Show the state after a batch."""
        best = "" if math.isnan(entry.log_likelihood) else f", best log-likelihood {entry.log_likelihood:.1f}"
        left = entry.seconds * (1 - progress.fraction) / max(progress.fraction, 0.05)
        done = f"{progress.stage}: {entry.evaluations} evaluations{best}"
        self._show(f"{done}, about {_duration(left)} left", progress.fraction)


class _LeftColumn(ProgressColumn):
    """The time left, as it is when it is drawn."""

    def __init__(self, words: Callable[[], str]) -> None:
        super().__init__()
        self._words = words

    def render(self, task: Task) -> Text:
        return Text(self._words())


class StageProgress(_Live):
    """The stage of a run, and the time left if stages have a plan; elsewhere than on a terminal a line a stage."""

    def __init__(self, console: Console, label: str, remaining: TimeLeft | None = None) -> None:
        super().__init__(console, label, _LeftColumn(self._left))
        self._stage, self._remaining = "", remaining

    def show(self, stage: str, share: float) -> None:
        """Show a stage, and how much is done: of it, or of the whole run if stages have a plan."""
        if self._remaining is not None:
            now = time.monotonic()
            self._remaining = self._remaining.told(stage, share, now)
            share = self._remaining.share(now)
        words = stage if self.console.is_terminal else ", ".join(filter(None, (stage, self._left())))
        self._show(words, share, interval=math.inf if stage == self._stage else -math.inf)
        self._stage = stage

    def _left(self) -> str:
        left = math.nan if self._remaining is None else self._remaining.left(time.monotonic())
        return "" if math.isnan(left) else f"about {_duration(left)} left"


class TrainProgress(_Live):
    """A training's steps, return of late, and time left."""

    def __init__(self, console: Console, steps: int) -> None:
        super().__init__(console, "train")
        self._steps = steps
        self._first: tuple[int, float] | None = None

    def show(self, steps: int, mean_return: float) -> None:
        """Show how many steps are done, and the return of the episodes that ended last."""
        now = time.monotonic()
        first_steps, first_time = self._first = self._first or (steps, now)
        rate = (steps - first_steps) / max(now - first_time, 1e-9)
        left = f", about {_duration((self._steps - steps) / rate)} left" if rate > 0 else ""
        late = "" if math.isnan(mean_return) else f", return {mean_return:.4g}"
        self._show(f"{steps:,} of {self._steps:,} steps{late}{left}", steps / self._steps)


@contextlib.contextmanager
def fits_side_by_side(console: Console, label: str, total: int, workers: Workers) -> Iterator[Callable[[], None]]:
    """Show how many fits of a study are done, by what is called after each; those in turn show their own progress."""
    if workers == 1:
        yield lambda: None
        return
    done = itertools.count(1)
    with StageProgress(console, label) as progress:
        progress.show("fitting side by side", 0.0)

        def count() -> None:
            number = next(done)
            progress.show(f"fits done: {number}", number / total)

        yield count


def fit_shown(
    problem: Problem, console: Console | None, label: str = "fit", *, checkpoint: Path | None = None,
    resume: bool = False,
) -> Fit:  # fmt: skip
    """Fit as the config says, and show how far it is, if there is somewhere to."""
    from dropo_torch.baselines import fit_problem

    if console is None:
        return fit_problem(problem, checkpoint=checkpoint, resume=resume)
    with FitProgress(console, label) as progress:
        return fit_problem(problem, checkpoint=checkpoint, resume=resume, on_progress=progress.show)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
