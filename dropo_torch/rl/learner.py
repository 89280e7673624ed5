"""What PPO and SAC share: a policy, a critic's inputs, an optimizer, and a state that can be kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict

from dropo_torch.errors import InputError
from dropo_torch.rl.networks import Normalizer
from dropo_torch.rl.policy import Policy

#: Updates in a row whose loss is not finite, after which training gives up.
PATIENCE = 20


class Learner(ABC):
    """Improves a policy from experience.

    Args:
        policy: what is improved, in place.
        num_parameters: width d of the episodes' parameters.
        privileged: whether the critic sees them.
    """

    #: Steps of every environment between two updates.
    horizon: int

    def __init__(self, policy: Policy, num_parameters: int, *, privileged: bool) -> None:
        self.policy = policy
        device = policy.low.device
        self._seen = Normalizer(num_parameters if privileged else 0).to(device)
        self.skipped = 0
        self._in_a_row = 0

    @property
    def num_features(self) -> int:
        """Width of the critic's input."""
        return self.policy.num_observations + len(self._seen.mean)

    @abstractmethod
    def act(
        self, observation: torch.Tensor, parameters: torch.Tensor
    ) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Return exploring actions in [-1, 1], ``(N, m)``, and what the update needs of them."""

    @abstractmethod
    def update(self, rollout: TensorDict, share: float) -> dict[str, float]:
        """Learn from steps ``(N, horizon)``; ``share`` of the run is done. Return scalars to look at."""

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Return what holds state, by name: each has ``state_dict`` and ``load_state_dict``."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that further learning depends on."""
        parts = {**self.parts(), "policy": self.policy, "seen": self._seen}
        counts = {"skipped": self.skipped, "in_a_row": self._in_a_row}
        return {**{name: part.state_dict() for name, part in parts.items()}, **counts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that :meth:`state_dict` returned."""
        for name, part in {**self.parts(), "policy": self.policy, "seen": self._seen}.items():
            part.load_state_dict(state[name])
        self.skipped, self._in_a_row = state["skipped"], state["in_a_row"]

    def _take_in(self, rollout: TensorDict) -> None:
        """Let the running statistics see new experience."""
        self.policy.normalizer.update(rollout["observation"])
        self._seen.update(rollout["parameters"][..., : len(self._seen.mean)])

    def _features(self, observation: torch.Tensor, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's and the critic's normalised inputs."""
        features = self.policy.normalizer(observation)
        width = len(self._seen.mean)
        if not width:
            return features, features
        return features, torch.cat([features, self._seen(parameters[..., :width])], -1)

    def _is_sound(self, loss: torch.Tensor) -> bool:
        """Whether a loss may be followed; counts those that may not."""
        if bool(torch.isfinite(loss)):
            self._in_a_row = 0
            return True
        self.skipped += 1
        self._in_a_row += 1
        if self._in_a_row >= PATIENCE:
            raise InputError(
                f"train: the loss was not finite for {PATIENCE} updates in a row; lower train.learning_rate, "
                "or scale the task's reward"
            )
        return False
