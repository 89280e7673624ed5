"""Experience: a policy acts in a batch of environments; what happens is kept, or judged by whole episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from dropo_torch.rl.checkpoint import Stateful
from dropo_torch.rl.env import RandomizedEnv
from dropo_torch.rl.policy import Policy

#: Finished episodes whose returns are averaged into the learning curve.
WINDOW = 100

#: Maps observations ``(N, n)`` to actions in [-1, 1], and what else is to be kept.
Act = Callable[[torch.Tensor], tuple[torch.Tensor, Mapping[str, torch.Tensor]]]


class Collector(Stateful):
    """Steps a batch of environments, and goes on where it stopped.

    Args:
        env: N environments, which reset on their own and give finite numbers only.
        to_action: maps actions in [-1, 1] to the environment's units.

    Attributes:
        returns, lengths: of the last :data:`WINDOW` finished episodes.
        episodes: finished episodes.
    """

    kept = ("returns", "lengths", "episodes", "_return", "_length")

    def __init__(self, env: RandomizedEnv, to_action: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self._env, self._to_action = env, to_action
        self.parts = {"env": env}
        self._return = torch.zeros(env.num_envs, dtype=torch.float64)
        self._length = torch.zeros(env.num_envs, dtype=torch.int64)
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.episodes = 0
        env.reset()

    @torch.no_grad()
    def collect(self, act: Act, horizon: int) -> TensorDict:
        """Return ``horizon`` steps of every environment, batch ``(N, horizon)``.

        Entries: observation, parameters (of width 0 where nothing varies), action (in [-1, 1]), what ``act`` adds, and
        below next: observation, reward, done and terminated.
        """
        rows, now = [], self._env.now()
        for _ in range(horizon):
            observation = now.get("observation")
            unit, extra = act(observation)
            now.set("action", self._to_action(unit).to(self._env.action_spec.dtype))
            parameters = now.get("parameters", observation[:, :0])
            after, now = self._env.step_and_maybe_reset(now)
            found = after.get("next")
            self._count(found.get("reward")[:, 0], found.get("done")[:, 0])
            ends = found.select("observation", "reward", "done", "terminated")
            step = {"observation": observation, "parameters": parameters, "action": unit, **extra, "next": ends}
            rows.append(TensorDict._new_unsafe(step, batch_size=unit.shape[:1]))
        return torch.stack(rows, 1)

    def _count(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        """Add up returns, and note those of finished episodes."""
        self._return += reward.cpu()
        self._length += 1
        ended = done.cpu()
        self.returns = [*self.returns, *self._return[ended].tolist()][-WINDOW:]
        self.lengths = [*self.lengths, *self._length[ended].tolist()][-WINDOW:]
        self.episodes += int(ended.sum())
        self._return[ended] = 0.0
        self._length[ended] = 0


@dataclass(frozen=True)
class Returns:
    """Returns of the episodes of a policy in one world.

    Attributes:
        returns: undiscounted sum of rewards of each episode.
        lengths: steps of each.
        diverged: episodes whose simulation diverged; they end there.
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    diverged: int

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return float(np.std(self.returns, ddof=1)) if len(self.returns) > 1 else 0.0

    @property
    def standard_error(self) -> float:
        """Standard error of the mean."""
        return self.std / math.sqrt(len(self.returns))

    def document(self) -> dict[str, Any]:
        """Return them as plain data."""
        return {"episodes": len(self.returns), "mean": self.mean, "std": self.std, **asdict(self)}


@torch.no_grad()
def evaluate(policy: Policy, env: RandomizedEnv) -> Returns:
    """Return the first episode of each environment of a fresh batch, acted without noise."""
    count = env.num_envs
    total, length = torch.zeros(count, dtype=torch.float64), torch.zeros(count, dtype=torch.int64)
    going, diverged = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    now = env.reset()
    while bool(going.any()):
        now.set("action", policy(now.get("observation")).to(env.action_spec.dtype))
        after, now = env.step_and_maybe_reset(now)
        after = after.get("next")
        total += torch.where(going, after.get("reward")[:, 0].cpu().double(), 0.0)
        length += going
        diverged |= going & after.get("diverged")[:, 0].cpu()
        going &= ~after.get("done")[:, 0].cpu()
    return Returns(tuple(total.tolist()), tuple(length.tolist()), int(diverged.sum()))
