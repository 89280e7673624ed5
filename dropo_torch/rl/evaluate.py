"""How well a policy does: returns of whole episodes without exploration."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from dropo_torch.rl.env import RandomizedEnv
from dropo_torch.rl.policy import Policy


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
