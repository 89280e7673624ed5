"""One loop for both algorithms: collect, learn, evaluate, keep."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from dropo_torch.errors import InputError
from dropo_torch.rl.checkpoint import Stateful
from dropo_torch.rl.collect import Collector, Returns, evaluate
from dropo_torch.rl.learner import Learner
from dropo_torch.rl.policy import Policy
from dropo_torch.rl.ppo import PPO
from dropo_torch.rl.problem import TrainingProblem, World
from dropo_torch.rl.sac import SAC
from dropo_torch.rl.settings import SACSettings
from dropo_torch.support.checkpoint import Checkpoint
from dropo_torch.support.threads import single_thread

SCHEMA = "dropo-torch/train/1"
#: History entries that are kept: a run of many short iterations keeps every second, fourth, ... of them.
MAX_ENTRIES = 1000
#: A checkpoint may take this share of the time since the last.
SHARE = 0.05


@dataclass(frozen=True)
class TrainEntry:
    """The state of a training after an iteration.

    Attributes:
        steps: environment steps so far.
        seconds: time so far.
        episodes: finished episodes so far.
        mean_return, mean_length: of the last hundred finished episodes, with exploration; NaN before the first.
        diverged: simulations that diverged so far.
        scalars: losses and the like, by name.
    """

    steps: int
    seconds: float
    episodes: int
    mean_return: float
    mean_length: float
    diverged: int
    scalars: dict[str, float]


@dataclass(frozen=True)
class EvaluationPoint:
    """An evaluation under the training's distribution on the way.

    Attributes:
        steps: environment steps before it.
        mean, std: of the returns of its episodes.
        kept: whether it was the best so far; the best policy is the result.
    """

    steps: int
    mean: float
    std: float
    kept: bool


@dataclass(frozen=True)
class Training:
    """A trained policy and how it came about.

    Attributes:
        policy: the best of those evaluated on the way.
        algorithm: ppo or sac.
        history: entries along the run.
        evaluations: under the training's distribution, on the way.
        training, nominal, target: evaluations of the result in the worlds of the problem, where there are.
        steps, episodes: simulated in all, evaluations aside.
        diverged: simulations that diverged; each ended its episode.
        repaired: steps with a number that was not finite, which no loss has seen.
        skipped: updates that were left out because their loss was not finite.
        seconds: of the whole run.
        simulating, learning: seconds of them spent on experience and on gradients.
        seed: of everything random.
        stop_reason: why it ended.
    """

    policy: Policy
    algorithm: str
    history: tuple[TrainEntry, ...]
    evaluations: tuple[EvaluationPoint, ...]
    training: Returns
    nominal: Returns | None
    target: Returns | None
    steps: int
    episodes: int
    diverged: int
    repaired: int
    skipped: int
    seconds: float
    simulating: float
    learning: float
    seed: int
    stop_reason: str = "all steps are done"

    def document(self) -> dict[str, Any]:
        """Return the training as plain data."""
        worlds = {"distribution": self.training, "nominal": self.nominal, "target": self.target}
        columns = {"steps": "steps", "seconds": "seconds", "mean": "mean_return", "length": "mean_length"}
        same = ("algorithm", "steps", "episodes", "seconds", "diverged", "seed", "stop_reason")
        return {
            "schema": SCHEMA,
            **{name: getattr(self, name) for name in same},
            "evaluation": {k: None if e is None else e.document() for k, e in worlds.items()},
            "simulating_seconds": self.simulating,
            "learning_seconds": self.learning,
            "repaired_steps": self.repaired,
            "skipped_updates": self.skipped,
            "distribution": self.policy.distribution,
            "evaluations": [asdict(e) for e in self.evaluations],
            "returns": [{key: getattr(e, own) for key, own in columns.items()} for e in self.history],
        }


def train(
    problem: TrainingProblem,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    on_progress: Callable[[TrainEntry, EvaluationPoint | None], None] | None = None,
    on_start: Callable[[Sequence[TrainEntry], Sequence[EvaluationPoint]], None] | None = None,
) -> Training:
    """Train a policy under the problem's distribution.

    The same seed gives the same weights on the same machine at any number of threads, interrupted or not.

    Args:
        problem: of :func:`~dropo_torch.rl.problem.make_training`.
        checkpoint: file in which the state is kept between iterations.
        resume: go on from it.
        on_progress: called after every iteration, with the evaluation that followed it, if one did.
        on_start: called once before the first, with what an interrupted run had done.

    Raises:
        InputError: a checkpoint of another training; losses that stay infinite.
    """
    check_training(problem)
    with _own_random_numbers(problem.config.seed, problem.device), single_thread():
        run = _Run(problem, checkpoint)
        if resume and run.checkpoint is not None and run.checkpoint.path.is_file():
            run.load_state_dict(run.checkpoint.load())
        if on_start is not None:
            on_start(run.history, run.evaluations)
        while not run.done:
            entry, evaluation = run.iterate()
            if on_progress is not None:
                on_progress(entry, evaluation)
        return run.result()


def check_training(problem: TrainingProblem) -> None:
    """Refuse what could only fail, or learn nothing, before anything is written.

    Raises:
        InputError: too few steps, or a task, parameters, effects and a backend that do not fit each other.
    """
    settings = problem.settings
    per_iteration = settings.num_envs * settings.horizon
    if per_iteration > settings.steps:
        raise InputError(
            f"train.steps: {settings.steps} given, but one iteration takes {per_iteration} "
            "(num_envs times horizon); give more steps, or fewer environments"
        )
    if isinstance(settings, SACSettings) and settings.steps <= max(settings.warmup, settings.minibatch):
        raise InputError(
            f"train.steps: {settings.steps} given, but learning begins after train.warmup {settings.warmup} and "
            f"train.minibatch {settings.minibatch} steps; give more steps, or less of these"
        )
    problem.env(problem.training, 1, 0).reset()


class _Run(Stateful):
    """A training that is under way."""

    kept = ("steps", "simulating", "learning", "history", "evaluations", "best")

    def __init__(self, problem: TrainingProblem, checkpoint: Path | None) -> None:
        self.problem, settings, kinds = problem, problem.settings, (TrainEntry, EvaluationPoint)
        owner = (problem.fingerprint,)
        self.checkpoint = None if checkpoint is None else Checkpoint(checkpoint, "training", owner, kinds)
        self.env = problem.env(problem.training, settings.num_envs, problem.config.seed)
        self.policy = _fresh_policy(problem)
        kind: type[Learner] = SAC if isinstance(settings, SACSettings) else PPO
        self.learner = kind(self.policy, len(problem.training.space), settings)
        self.collector = Collector(self.env, self.policy.to_action)
        self.parts = {"learner": self.learner, "collector": self.collector}
        self.per_iteration = settings.num_envs * settings.horizon
        fullness = settings.steps // self.per_iteration / MAX_ENTRIES
        self.stride = 2 ** max(0, math.ceil(math.log2(fullness)))  # iterations from entry to entry
        self.steps, self.simulating, self.learning = 0, 0.0, 0.0
        self.history: list[TrainEntry] = []
        self.evaluations: list[EvaluationPoint] = []
        self.best: dict[str, torch.Tensor] = {}
        self.begun = time.monotonic()  # of a resumed run as if it had never been interrupted
        self.next_checkpoint = 0.0

    @property
    def done(self) -> bool:
        """Whether no further iteration fits into the steps."""
        return self.steps + self.per_iteration > self.problem.settings.steps

    def iterate(self) -> tuple[TrainEntry, EvaluationPoint | None]:
        """Collect, learn, evaluate if it is time, and keep the state if it is time."""
        settings = self.problem.settings
        before, begun = self.steps, time.monotonic()
        rollout = self.collector.collect(self.learner.act, settings.horizon)
        collected = time.monotonic()
        scalars = self.learner.update(rollout, before / settings.steps)
        self.simulating += collected - begun
        self.learning += time.monotonic() - collected
        self.steps += self.per_iteration
        every = settings.steps / settings.evaluations
        evaluation = self._evaluate() if self.done or self.steps // every > before // every else None
        entry = self._entry(scalars)
        if self.steps // self.per_iteration % self.stride == 0 or self.done:
            self.history.append(entry)
        if time.monotonic() >= self.next_checkpoint or self.done:
            self._save()
        return entry, evaluation

    def result(self) -> Training:
        """Evaluate the best policy in all worlds, in episodes that did not choose it."""
        problem, last = self.problem, self._entry({})
        self.policy.load_state_dict(self.best)
        self.policy.eval()
        return Training(
            algorithm=problem.algorithm,
            history=tuple(self.history),
            evaluations=tuple(self.evaluations),
            training=self._episodes(problem.training, 1),
            nominal=None if problem.nominal is None else self._episodes(problem.nominal, 2),
            target=None if problem.target is None else self._episodes(problem.target, 3),
            **{name: getattr(last, name) for name in ("steps", "episodes", "diverged")},
            **{name: getattr(self, name) for name in ("policy", "simulating", "learning")},
            repaired=self.env.num_repaired,
            skipped=self.learner.skipped,
            seconds=self._seconds(),
            seed=problem.config.seed,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the run depends on."""
        states = [torch.get_rng_state(), *map(torch.cuda.get_rng_state, _devices(self.problem.device))]
        return {**super().state_dict(), "random": states, "seconds": self._seconds()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that :meth:`state_dict` returned."""
        super().load_state_dict(state)
        self.begun -= state["seconds"]
        torch.set_rng_state(state["random"][0])
        for device, own in zip(_devices(self.problem.device), state["random"][1:], strict=True):
            torch.cuda.set_rng_state(own, device)

    def _save(self) -> None:
        """Write a checkpoint, if one is wanted, and say when the next is due."""
        if self.checkpoint is not None:
            begun = time.monotonic()
            self.checkpoint.save(self.state_dict())
            ended = time.monotonic()
            self.next_checkpoint = ended + max(self.problem.settings.checkpoint_seconds, (ended - begun) / SHARE)

    def _evaluate(self) -> EvaluationPoint:
        """Evaluate under the training's distribution, and keep the policy if it is the best."""
        found = self._episodes(self.problem.training, 0)
        best = max((e.mean for e in self.evaluations if math.isfinite(e.mean)), default=-math.inf)
        better = not self.evaluations or found.mean > best
        if better:
            self.best = {k: v.cpu().clone() for k, v in self.policy.state_dict().items()}
        self.evaluations.append(EvaluationPoint(self.steps, found.mean, found.std, better))
        return self.evaluations[-1]

    def _episodes(self, world: World, number: int) -> Returns:
        """Episodes of the policy as it is; the same initial states and parameters for the same number."""
        seed = ((self.problem.config.seed * 4 + number) * 1_000_003 + 17) % 2**63
        with _own_random_numbers(seed, self.problem.device):
            return evaluate(self.policy, self.problem.env(world, self.problem.settings.episodes, seed % 2**31))

    def _entry(self, scalars: dict[str, float]) -> TrainEntry:
        done = self.collector
        mean, length = (sum(late) / len(late) if late else math.nan for late in (done.returns, done.lengths))
        return TrainEntry(self.steps, self._seconds(), done.episodes, mean, length, self.env.num_diverged, scalars)

    def _seconds(self) -> float:
        return time.monotonic() - self.begun


def _fresh_policy(problem: TrainingProblem) -> Policy:
    settings, task = problem.settings, problem.training.task
    architecture = {
        "num_observations": task.num_observations,
        "num_actions": len(task.action_low),
        **{name: getattr(settings, name) for name in ("hidden", "activation", "head", "initial_std")},
    }
    policy = Policy(architecture, config=problem.config.document(), distribution=problem.training.source.document())
    policy.low.copy_(torch.as_tensor(task.action_low, dtype=torch.float32))
    policy.high.copy_(torch.as_tensor(task.action_high, dtype=torch.float32))
    return policy.to(problem.device)


def _devices(device: str) -> list[str]:
    """The devices with random numbers of their own, beside the CPU."""
    return [device] if device.startswith("cuda") else []


@contextlib.contextmanager
def _own_random_numbers(seed: int, device: str) -> Iterator[None]:
    """Seed torch for a while; the caller's random numbers go on as if nothing had been."""
    with torch.random.fork_rng(_devices(device)):
        torch.manual_seed(seed)
        yield
