"""``dropo train``: a config and a folder in; a policy, its report and its numbers out."""

from __future__ import annotations

import argparse
import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dropo_torch.commands.check import add_force, check_first
from dropo_torch.commands.folder import prepare_folder, provenance
from dropo_torch.commands.options import add_config, add_log
from dropo_torch.commands.progress import TrainProgress
from dropo_torch.config import load_config
from dropo_torch.errors import InputError
from dropo_torch.support.extras import require
from dropo_torch.support.files import write_json

if TYPE_CHECKING:
    from dropo_torch.rl.problem import TrainingProblem
    from dropo_torch.rl.train import EvaluationPoint, TrainEntry, Training

#: The learning curves on TensorBoard have about this many points.
POINTS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``dropo train``."""
    add_config(parser, "policy")
    add_log(parser, "the learning curves")
    add_force(parser)


def run(given: argparse.Namespace, overrides: Mapping[str, Any], console: Console) -> None:
    """Run ``dropo train``, which writes ``policy.pt``, ``train.json`` and ``report.html``."""
    from dropo_torch.logged import read_log
    from dropo_torch.rl.problem import make_training
    from dropo_torch.rl.train import check_training, train

    out = given.out
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells every storage it allocates
    if given.log is not None:
        require("tensorboard", f"--log {given.log}")
    config = load_config(given.config, overrides)
    problem = make_training(config)
    if config.data is not None:  # training needs no log; one that its distribution may come from is examined
        check_first(read_log(config), console, force=given.force)
    checkpoint = out / "train-progress.bin"
    continued = given.resume and checkpoint.exists()
    path = problem.distribution_path
    if path is not None and not continued and path.resolve().parent == out.resolve():
        raise InputError(f"--out: {path} is the distribution of this run and would be moved aside; name another folder")
    check_training(problem)  # before an earlier run is moved aside
    prepare_folder(out, problem.model_path, resume=continued)
    curves = None if given.log is None else _Curves(out / "tensorboard", problem.settings.steps)
    with TrainProgress(console, problem.settings.steps) as progress:

        def show(entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
            progress.show(entry.steps, entry.mean_return)
            if curves is not None:
                curves.add(entry, evaluation)

        begin = None if curves is None else curves.begin
        result = train(problem, checkpoint=checkpoint, resume=given.resume, on_progress=show, on_start=begin)
    _write(problem, result, out)
    _show(result, out, console)


def _write(problem: TrainingProblem, result: Training, out: Path) -> None:
    from dropo_torch.report.train import write_train_report
    from dropo_torch.rl.video import chosen_frames, draw, record

    result.policy.save(out / "policy.pt")
    world = problem.target or problem.nominal or problem.training
    env = problem.env(world, 1, problem.config.seed)
    states = record(result.policy, env)
    strip, note = draw(env.space.model, states[chosen_frames(len(states), env.task.timestep)])
    notes = [note] if note else []
    if problem.nominal is None:
        notes.append("Not evaluated in a nominal model: a number of an effect has no value of its own in the model.")
    about = {"title": f"Policy for {env.task.name}", "notes": notes, **provenance(problem.config)}
    write_train_report(out / "report.html", result, strip=strip, **about)
    write_json(out / "train.json", result.document())


def _show(result: Training, out: Path, console: Console) -> None:
    from dropo_torch.report.train import WORLDS, evaluations

    table = Table("evaluated in", "mean return", "standard error", "mean length")
    for name, e in evaluations(result).items():
        length = sum(e.lengths) / len(e.lengths)
        table.add_row(WORLDS[name], f"{e.mean:.1f}", f"{e.standard_error:.1f}", f"{length:.0f}")
    console.print(table)
    busy = max(result.simulating + result.learning, 1e-9)
    console.print(
        f"{result.steps} steps, {result.episodes} episodes, {result.seconds:.1f} s, {result.steps / busy:.0f} steps a "
        f"second ({100 * result.simulating / busy:.0f} % of it simulating)"
        + (f"; {result.diverged} simulations diverged" if result.diverged else ""),
        soft_wrap=True,
    )  # fmt: skip
    for path in (out / "policy.pt", out / "report.html"):
        console.print(f"{path.stem}: {path}", soft_wrap=True)


class _Curves:
    """Learning curves as TensorBoard events; a run that goes on writes those of its beginning again."""

    def __init__(self, folder: Path, steps: int) -> None:
        self._folder, self._every, self._next = folder, max(1, steps // POINTS), 0

    def begin(self, history: Sequence[TrainEntry], evaluated: Sequence[EvaluationPoint]) -> None:
        """Start afresh with what an interrupted run had done."""
        from torch.utils.tensorboard import SummaryWriter

        shutil.rmtree(self._folder, ignore_errors=True)
        self._writer = SummaryWriter(str(self._folder))
        for entry in history:
            self.add(entry, None)
        for evaluation in evaluated:
            self._evaluation(evaluation)

    def add(self, entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
        """Write an entry, unless one has just been written, and an evaluation."""
        if evaluation is not None:
            self._evaluation(evaluation)
        if entry.steps < self._next:
            return
        self._next = entry.steps + self._every
        scalars = {"return": entry.mean_return, "length": entry.mean_length, "diverged": float(entry.diverged)}
        for name, value in {**scalars, **entry.scalars}.items():
            self._writer.add_scalar(f"train/{name}", value, entry.steps)

    def _evaluation(self, evaluation: EvaluationPoint) -> None:
        self._writer.add_scalar("evaluation/return", evaluation.mean, evaluation.steps)
