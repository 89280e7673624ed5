"""What ``dropo train`` does: a config and a folder in; a policy, its report and its numbers out."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from torchrl.record.loggers import TensorboardLogger

from dropo_torch.commands.progress import TrainProgress
from dropo_torch.commands.runs import check_log_option, prepare_folder, versions
from dropo_torch.config import Config
from dropo_torch.errors import InputError
from dropo_torch.report.train import WORLDS, evaluations, write_train_report
from dropo_torch.rl.problem import TrainingProblem, make_training
from dropo_torch.rl.train import EvaluationPoint, TrainEntry, Training, check_training, train
from dropo_torch.rl.video import chosen_frames, draw, record
from dropo_torch.support.files import write_json

#: The learning curves on TensorBoard have about this many points.
POINTS = 1000


def run_train(config: Config, out: Path, *, console: Console, resume: bool = False, log: str | None = None) -> Training:
    """Train, and write ``policy.pt``, ``train.json`` and ``report.html`` to ``out``.

    Args:
        config: the config.
        out: the folder; results of an earlier run there are moved aside, never overwritten.
        console: where progress and results are shown.
        resume: continue an interrupted run in ``out``.
        log: ``"tensorboard"`` writes the learning curves as TensorBoard events too, while it trains.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells every storage it allocates
    check_log_option(log)
    problem = make_training(config)
    checkpoint = out / "train-progress.pt"
    continued = resume and checkpoint.exists()
    _keep_distribution(problem, out, continued)
    check_training(problem)  # before an earlier run is moved aside
    prepare_folder(out, problem.model_path, resume=continued)
    curves = _Curves(out / "tensorboard", problem.settings.steps) if log == "tensorboard" else None
    with TrainProgress(console, problem.settings.steps) as progress:

        def show(entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
            progress.update(entry.steps, entry.mean_return)
            if curves is not None:
                curves.add(entry, evaluation)

        result = train(
            problem, checkpoint=checkpoint, resume=resume, on_progress=show,
            on_start=None if curves is None else curves.begin,
        )  # fmt: skip
    _write(problem, result, out)
    _show(result, out, console)
    return result


def _keep_distribution(problem: TrainingProblem, out: Path, continued: bool) -> None:
    """Refuse a folder whose earlier results, which would be moved aside, hold the distribution of this run."""
    path = problem.distribution_path
    if path is not None and not continued and path.resolve().parent == out.resolve():
        raise InputError(f"--out: {path} is the distribution of this run and would be moved aside; name another folder")


def _write(problem: TrainingProblem, result: Training, out: Path) -> None:
    result.policy.save(out / "policy.pt")
    world = problem.target or problem.nominal or problem.training
    env = problem.env(world, 1, problem.config.seed)
    states = record(result.policy, env)
    strip, note = draw(env.space.model, states[chosen_frames(len(states), env.task.timestep)])
    notes = [note] if note else []
    if problem.nominal is None:
        notes.append("Not evaluated in a nominal model: a number of an effect has no value of its own in the model.")
    write_train_report(
        out / "report.html", result, config=problem.config.document(), versions=versions(),
        title=f"Policy for {env.task.name}", strip=strip, notes=notes,
    )  # fmt: skip
    write_json(out / "train.json", result.document())


def _show(result: Training, out: Path, console: Console) -> None:
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
        soft_wrap=True, highlight=False,
    )  # fmt: skip
    for path in (out / "policy.pt", out / "report.html"):
        console.print(f"{path.stem}: {path}", soft_wrap=True, highlight=False, markup=False)


class _Curves:
    """Learning curves as TensorBoard events; a run that goes on writes those of its beginning again."""

    def __init__(self, folder: Path, steps: int) -> None:
        self._folder, self._every, self._next = folder, max(1, steps // POINTS), 0
        self._logger: TensorboardLogger | None = None

    def begin(self, history: Sequence[TrainEntry], evaluated: Sequence[EvaluationPoint]) -> None:
        """Start afresh with what an interrupted run had done."""
        shutil.rmtree(self._folder, ignore_errors=True)
        self._logger = TensorboardLogger(exp_name=self._folder.name, log_dir=str(self._folder.parent))
        for entry in history:
            self.add(entry, None)
        for evaluation in evaluated:
            self._evaluation(evaluation)

    def add(self, entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
        """Write an entry, unless one has just been written, and an evaluation."""
        assert self._logger is not None
        if evaluation is not None:
            self._evaluation(evaluation)
        if entry.steps < self._next:
            return
        self._next = entry.steps + self._every
        scalars = {"return": entry.mean_return, "length": entry.mean_length, "diverged": float(entry.diverged)}
        for name, value in {**scalars, **entry.scalars}.items():
            self._logger.log_scalar(f"train/{name}", value, step=entry.steps)

    def _evaluation(self, evaluation: EvaluationPoint) -> None:
        assert self._logger is not None
        self._logger.log_scalar("evaluation/return", evaluation.mean, step=evaluation.steps)
