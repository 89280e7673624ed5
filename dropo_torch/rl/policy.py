"""A trained policy: what maps an observation to an action, and the file that holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import nn

from dropo_torch.errors import InputError
from dropo_torch.rl.checkpoint import load_tensors, save_tensors
from dropo_torch.rl.networks import Actor, Normalizer
from dropo_torch.support.given import reading

SCHEMA = "dropo-torch/policy/1"
Plain = Mapping[str, Any]


class Policy(nn.Module):
    """A deterministic policy with its observation statistics.

    Args:
        architecture: num_observations n, num_actions m, hidden, head, activation and initial_std of the network.
        config: the training's config, as plain data.
        distribution: where the episodes' parameters came from, as plain data.

    Attributes:
        actor: the network.
        normalizer: statistics of the observations.
        low, high: bounds of the actions, ``(m,)`` each, finite.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, architecture: Plain, *, config: Plain | None = None, distribution: Plain | None = None) -> None:
        super().__init__()
        self.actor = Actor(**architecture)
        self.normalizer = Normalizer(architecture["num_observations"])
        self.register_buffer("low", -torch.ones(architecture["num_actions"]))
        self.register_buffer("high", torch.ones(architecture["num_actions"]))
        self.architecture = dict(architecture)
        self.config = dict(config or {})
        self.distribution = dict(distribution or {})

    @property
    def num_observations(self) -> int:
        """Width n of an observation."""
        return len(self.normalizer.mean)

    @overload
    def forward(self, observation: torch.Tensor) -> torch.Tensor: ...
    @overload
    def forward(self, observation: np.ndarray | Sequence[float]) -> np.ndarray: ...
    @torch.no_grad()
    def forward(self, observation: torch.Tensor | np.ndarray | Sequence[float]) -> torch.Tensor | np.ndarray:
        """Return the action ``(..., m)`` at an observation ``(..., n)``, in the environment's units.

        Tensors give tensors, arrays and lists give arrays.

        Raises:
            InputError: an observation of another width.
        """
        given = torch.as_tensor(observation, device=self.low.device)
        if given.ndim < 1 or given.shape[-1] != self.num_observations:
            raise InputError(
                f"policy: observation of shape {tuple(given.shape)} given; expected (..., {self.num_observations})"
            )
        action = self.to_action(self.actor.deterministic(self.normalizer(given)))
        return action if isinstance(observation, torch.Tensor) else action.cpu().numpy()

    def to_action(self, unit: torch.Tensor) -> torch.Tensor:
        """Return actions in the environment's units of actions in [-1, 1]; what lies outside is cut off."""
        return self.low + (unit.clamp(-1, 1) + 1) * 0.5 * (self.high - self.low)

    def save(self, path: str | Path) -> None:
        """Write the policy with its config and distribution, whole or not at all."""
        plain = {name: getattr(self, name) for name in ("architecture", "config", "distribution")}
        save_tensors(Path(path), {"schema": SCHEMA, "weights": self.state_dict(), **plain})


def load_policy(path: str | Path) -> Policy:
    """Read a ``policy.pt``; no code in the file is run.

    >>> policy = load_policy("policy.pt")
    >>> action = policy(observation)

    Raises:
        InputError: a missing file, or one that holds no policy.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"policy: no file {path}; expected a policy.pt that dropo train has written")
    with reading(f"policy: {path}", "a policy that dropo train has written"):
        content = load_tensors(path)
        if content["schema"] != SCHEMA:
            raise InputError(f"policy: {path} is of schema {content['schema']!r}; expected {SCHEMA!r}")
        policy = Policy(content["architecture"], config=content["config"], distribution=content["distribution"])
        policy.load_state_dict(content["weights"])
    return policy.eval()
