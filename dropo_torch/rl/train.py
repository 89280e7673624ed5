"""One loop for both algorithms: collect, learn, evaluate, keep."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from dropo_torch.errors import InputError
from dropo_torch.rl.checkpoint import Checkpoints
from dropo_torch.rl.collect import Collector
from dropo_torch.rl.evaluate import Evaluation, evaluate
from dropo_torch.rl.learner import Learner
from dropo_torch.rl.policy import Policy, make_policy
from dropo_torch.rl.ppo import PPO
from dropo_torch.rl.problem import TrainingProblem, World
from dropo_torch.rl.sac import SAC
from dropo_torch.rl.settings import PPOSettings, SACSettings
from dropo_torch.support.threads import single_thread

SCHEMA = "dropo-torch/train/1"
#: History entries that are kept: a run of many short iterations keeps some of them.
MAX_ENTRIES = 1000


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
class Progress:
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
    evaluations: tuple[Progress, ...]
    training: Evaluation
    nominal: Evaluation | None
    target: Evaluation | None
    steps: int
    episodes: int
    diverged: int
    repaired: int
    skipped: int
    seconds: float
    simulating: float
    learning: float
    seed: int
    stop_reason: str

    def document(self) -> dict[str, Any]:
        """Return the training as plain data."""
        worlds = {"distribution": self.training, "nominal": self.nominal, "target": self.target}
        return {
            "schema": SCHEMA,
            "algorithm": self.algorithm,
            "evaluation": {k: None if e is None else e.document() for k, e in worlds.items()},
            "steps": self.steps,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "simulating_seconds": self.simulating,
            "learning_seconds": self.learning,
            "diverged": self.diverged,
            "repaired_steps": self.repaired,
            "skipped_updates": self.skipped,
            "seed": self.seed,
            "stop_reason": self.stop_reason,
            "distribution": self.policy.distribution,
            "evaluations": [asdict(e) for e in self.evaluations],
            "returns": [
                {"steps": e.steps, "seconds": e.seconds, "mean": e.mean_return, "length": e.mean_length}
                for e in self.history
            ],
        }


def train(
    problem: TrainingProblem,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    on_progress: Callable[[TrainEntry, Progress | None], None] | None = None,
    on_start: Callable[[Sequence[TrainEntry], Sequence[Progress]], None] | None = None,
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
        if resume:
            run.restore()
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
    per_iteration = settings.num_envs * (settings.horizon if isinstance(settings, PPOSettings) else 1)
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


class _Run:
    """A training that is under way."""

    def __init__(self, problem: TrainingProblem, checkpoint: Path | None) -> None:
        self.problem, settings = problem, problem.settings
        self.env = problem.env(problem.training, settings.num_envs, problem.config.seed)
        self.policy = _fresh_policy(problem)
        self.learner = _make_learner(problem, self.policy)
        self.collector = Collector(self.env, self.policy.to_action)
        self.per_iteration = settings.num_envs * self.learner.horizon
        self.checkpoints = Checkpoints(checkpoint, problem.fingerprint, settings.checkpoint_seconds)
        self.steps, self.iterations, self.stride = 0, 0, 1
        self.spent, self.simulating, self.learning = 0.0, 0.0, 0.0
        self.history: list[TrainEntry] = []
        self.evaluations: list[Progress] = []
        self.best: tuple[float, dict[str, torch.Tensor]] | None = None
        self.begun = time.monotonic()

    @property
    def done(self) -> bool:
        """Whether no further iteration fits into the steps."""
        return self.steps + self.per_iteration > self.problem.settings.steps

    def iterate(self) -> tuple[TrainEntry, Progress | None]:
        """Collect, learn, evaluate if it is time, and keep the state if it is time."""
        settings = self.problem.settings
        before, begun = self.steps, time.monotonic()
        rollout = self.collector.collect(self.learner.act, self.learner.horizon)
        collected = time.monotonic()
        scalars = self.learner.update(rollout, before / settings.steps)
        self.simulating += collected - begun
        self.learning += time.monotonic() - collected
        self.steps += self.per_iteration
        self.iterations += 1
        every = settings.steps / settings.evaluations
        evaluation = self._evaluate() if self.done or self.steps // every > before // every else None
        entry = self._entry(scalars)
        self._remember(entry)
        if self.checkpoints.due() or self.done:
            self.checkpoints.save(self.state_dict())
        return entry, evaluation

    def result(self) -> Training:
        """Evaluate the best policy in all worlds, in episodes it has not been chosen by."""
        assert self.best is not None
        problem = self.problem
        self.policy.load_state_dict(self.best[1])
        self.policy.eval()

        def found(world: World | None, number: int) -> Evaluation | None:
            return None if world is None else self._episodes(world, number)

        training = self._episodes(problem.training, 1)
        nominal, target = found(problem.nominal, 2), found(problem.target, 3)
        return Training(
            policy=self.policy, algorithm=problem.algorithm, history=tuple(self.history),
            evaluations=tuple(self.evaluations), training=training, nominal=nominal, target=target, steps=self.steps,
            episodes=self.collector.episodes, diverged=int(self.env.num_diverged),
            repaired=int(self.env.num_repaired),
            skipped=self.learner.skipped, seconds=self._seconds(), simulating=self.simulating, learning=self.learning,
            seed=problem.config.seed, stop_reason="all steps are done",
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the run depends on."""
        device = self.problem.device
        return {
            "learner": self.learner.state_dict(),
            "collector": self.collector.state_dict(),
            "random": torch.get_rng_state(),
            "random_device": torch.cuda.get_rng_state(device) if device.startswith("cuda") else None,
            "counters": [self.steps, self.iterations, self.stride],
            "seconds": [self._seconds(), self.simulating, self.learning],
            "history": [asdict(e) for e in self.history],
            "evaluations": [asdict(e) for e in self.evaluations],
            "best": None if self.best is None else list(self.best),
        }

    def restore(self) -> None:
        """Go on from the checkpoint, where there is one."""
        state = self.checkpoints.load()
        if state is None:
            return
        self.learner.load_state_dict(state["learner"])
        self.collector.load_state_dict(state["collector"])
        self.steps, self.iterations, self.stride = state["counters"]
        self.spent, self.simulating, self.learning = state["seconds"]
        self.history = [TrainEntry(**e) for e in state["history"]]
        self.evaluations = [Progress(**e) for e in state["evaluations"]]
        self.best = None if state["best"] is None else (state["best"][0], state["best"][1])
        torch.set_rng_state(state["random"])
        if state["random_device"] is not None:
            torch.cuda.set_rng_state(state["random_device"], self.problem.device)

    def _evaluate(self) -> Progress:
        """Evaluate under the training's distribution, and keep the policy if it is the best."""
        found = self._episodes(self.problem.training, 0)
        score = found.mean if math.isfinite(found.mean) else -math.inf
        better = self.best is None or score > self.best[0]
        if better:
            self.best = (score, {k: v.detach().cpu().clone() for k, v in self.policy.state_dict().items()})
        progress = Progress(self.steps, found.mean, found.std, better)
        self.evaluations.append(progress)
        return progress

    def _episodes(self, world: World, number: int) -> Evaluation:
        """Episodes of the policy as it is; the same starts and parameters for the same number."""
        seed = ((self.problem.config.seed * 4 + number) * 1_000_003 + 17) % 2**63
        with _own_random_numbers(seed, self.problem.device):
            return evaluate(self.policy, self.problem.env(world, self.problem.settings.episodes, seed % 2**31))

    def _entry(self, scalars: dict[str, float]) -> TrainEntry:
        returns, lengths = self.collector.returns, self.collector.lengths
        return TrainEntry(
            steps=self.steps, seconds=self._seconds(), episodes=self.collector.episodes,
            mean_return=sum(returns) / len(returns) if returns else float("nan"),
            mean_length=sum(lengths) / len(lengths) if lengths else float("nan"),
            diverged=int(self.env.num_diverged), scalars=scalars,
        )  # fmt: skip

    def _remember(self, entry: TrainEntry) -> None:
        """Add an entry to the history; of very many, every second, fourth, ... is kept."""
        if self.iterations % self.stride == 0 or self.done:
            self.history.append(entry)
        if len(self.history) > MAX_ENTRIES:
            self.history = self.history[1::2]
            self.stride *= 2

    def _seconds(self) -> float:
        return self.spent + time.monotonic() - self.begun


def _fresh_policy(problem: TrainingProblem) -> Policy:
    settings, task = problem.settings, problem.training.task
    low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (task.action_low, task.action_high))
    architecture = {
        "num_observations": task.num_observations, "num_actions": len(low), "hidden": list(settings.hidden),
        "activation": settings.activation, "head": "tanh" if isinstance(settings, SACSettings) else "normal",
        "initial_std": settings.initial_std if isinstance(settings, PPOSettings) else 1.0,
    }  # fmt: skip
    policy = make_policy(architecture, config=problem.config.document(), distribution=problem.distribution)
    policy.low.copy_(low)
    policy.high.copy_(high)
    return policy.to(problem.device)


def _make_learner(problem: TrainingProblem, policy: Policy) -> Learner:
    settings, width = problem.settings, len(problem.training.space)
    if isinstance(settings, SACSettings):
        return SAC(policy, width, num_envs=settings.num_envs, settings=settings)
    assert isinstance(settings, PPOSettings)
    return PPO(policy, width, num_envs=settings.num_envs, settings=settings)


@contextlib.contextmanager
def _own_random_numbers(seed: int, device: str) -> Iterator[None]:
    """Seed torch for a while; the caller's random numbers go on as if nothing had been."""
    with torch.random.fork_rng([device] if device.startswith("cuda") else []):
        torch.manual_seed(seed)
        yield
