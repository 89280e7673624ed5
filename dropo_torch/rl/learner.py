"""What PPO and SAC share: a policy, a critic's inputs, an optimizer, and a state that can be kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor

from dropo_torch.errors import InputError
from dropo_torch.rl.checkpoint import Stateful
from dropo_torch.rl.policy import Normalizer, Policy
from dropo_torch.rl.settings import TrainSettings

#: Updates in a row whose loss is not finite, after which training gives up.
PATIENCE = 20


class Learner(Stateful, ABC):
    """Improves a policy from experience.

    Args:
        policy: what is improved, in place.
        num_parameters: width d of the episodes' parameters.
        settings: how it learns.
    """

    kept: tuple[str, ...] = ("skipped", "in_a_row")

    def __init__(self, policy: Policy, num_parameters: int, settings: TrainSettings) -> None:
        self.policy = policy
        self._device = policy.low.device
        self._seen = Normalizer(num_parameters if settings.privileged_critic else 0).to(self._device)
        self.num_features = policy.num_observations + len(self._seen.mean)  # width of the critic's input
        self.parts = {"policy": policy, "seen": self._seen}
        self.skipped, self.in_a_row = 0, 0

    @abstractmethod
    def act(self, observation: torch.Tensor) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Return exploring actions in [-1, 1], ``(N, m)``, and what the update needs of them."""

    @abstractmethod
    def update(self, rollout: TensorDict, share: float) -> dict[str, float]:
        """Learn from steps ``(N, horizon)``; ``share`` of the run is done. Return scalars to look at."""

    def _actor(self, distribution: type) -> ProbabilisticActor:
        """The policy's network as the losses take it, with actions of the given distribution."""
        keys, told = ["loc", "scale"], {"return_log_prob": True, "log_prob_key": "log_prob"}
        network = TensorDictModule(self.policy.actor, in_keys=["features"], out_keys=keys)
        return ProbabilisticActor(network, in_keys=keys, distribution_class=distribution, **told)

    def _take_in(self, rollout: TensorDict) -> None:
        """Let the running statistics see new experience."""
        self.policy.normalizer.update(rollout["observation"])
        self._seen.update(rollout["parameters"][..., : len(self._seen.mean)])

    def _features(self, observation: torch.Tensor, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's and the critic's normalized inputs."""
        features = self.policy.normalizer(observation)
        return features, torch.cat([features, self._seen(parameters[..., : len(self._seen.mean)])], -1)

    def _is_sound(self, loss: torch.Tensor) -> bool:
        """Whether a loss may be followed; counts those that may not."""
        sound = bool(torch.isfinite(loss))
        self.skipped += not sound
        self.in_a_row = 0 if sound else self.in_a_row + 1
        if self.in_a_row >= PATIENCE:
            raise InputError(
                f"train: the loss was not finite for {PATIENCE} updates in a row; lower train.learning_rate, "
                "or scale the task's reward"
            )
        return sound
