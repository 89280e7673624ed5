"""Soft actor-critic on batches of environments, with TorchRL's loss and replay buffer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from dropo_torch.rl.learner import Learner
from dropo_torch.rl.networks import ActionValue
from dropo_torch.rl.policy import Policy
from dropo_torch.rl.settings import SACSettings


class SAC(Learner):
    """SAC with two critics, slow targets and an adapted temperature.

    Args:
        policy: what is improved, in place.
        num_parameters: width d of the episodes' parameters.
        num_envs: N.
        settings: how it learns.
    """

    horizon = 1

    def __init__(self, policy: Policy, num_parameters: int, *, num_envs: int, settings: SACSettings) -> None:
        super().__init__(policy, num_parameters, privileged=settings.privileged_critic)
        self.settings = settings
        self._device = policy.low.device
        self._num_actions = len(policy.low)
        actor = ProbabilisticActor(
            TensorDictModule(policy.actor, in_keys=["features"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, log_prob_key="log_prob",
        )  # fmt: skip
        entropy = -float(self._num_actions) if settings.target_entropy is None else settings.target_entropy
        self._loss = SACLoss(
            actor, [self._critic(), self._critic()], loss_function="l2", target_entropy=entropy, alpha_init=0.2
        )
        self._loss.make_value_estimator(gamma=settings.gamma)
        self._loss.to(self._device)
        self._targets = SoftUpdate(self._loss, tau=settings.tau)
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        self._memory = Memory(min(settings.buffer, max(settings.steps, 1)), settings.minibatch)
        self._seen_steps = 0
        self._owed = 0.0

    def act(
        self, observation: torch.Tensor, parameters: torch.Tensor
    ) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Return sampled actions; uniform ones during the warm-up."""
        if self._seen_steps < self.settings.warmup:
            return 2 * torch.rand(len(observation), self._num_actions, device=self._device) - 1, {}
        return TanhNormal(*self.policy.actor(self.policy.normalizer(observation))).sample(), {}

    def update(self, rollout: TensorDict, share: float) -> dict[str, float]:
        """Remember steps ``(N, 1)`` and learn from the memory as often as they allow."""
        flat = rollout.reshape(-1)
        self._take_in(flat)
        self._memory.extend(flat)
        self._seen_steps += len(flat)
        if self._seen_steps < max(self.settings.warmup, self.settings.minibatch):
            return {}
        self._owed += self.settings.updates_per_step * len(flat)
        updates = int(self._owed)
        self._owed -= updates
        scalars: dict[str, float] = {}
        for number in range(updates):
            losses = self._gradient().detach()
            if number == updates - 1:
                scalars = {
                    "loss_policy": float(losses["loss_actor"]), "loss_critic": float(losses["loss_qvalue"]),
                    "alpha": float(losses["alpha"]), "entropy": float(losses["entropy"]),
                }  # fmt: skip
        return scalars

    def parts(self) -> dict[str, Any]:
        """Return what holds state beside the policy."""
        return {"loss": self._loss, "optimizer": self._optimizer, "memory": self._memory, "schedule": _Schedule(self)}

    def _critic(self) -> TensorDictModule:
        network = ActionValue(
            self.num_features, self._num_actions, hidden=self.settings.hidden, activation=self.settings.activation
        )
        return TensorDictModule(network, in_keys=["critic_features", "action"], out_keys=["state_action_value"])

    def _gradient(self) -> TensorDict:
        """One gradient of policy, critics and temperature, and a step of the targets."""
        losses = self._loss(self._batch())
        loss = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]
        if self._is_sound(loss):
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self._optimizer.step()
            self._targets.step()
        return losses

    @torch.no_grad()
    def _batch(self) -> TensorDict:
        """Remembered steps with inputs normalised by today's statistics."""
        drawn = self._memory.sample().to(self._device)
        following = drawn["next"]
        features, seen = self._features(drawn["observation"], drawn["parameters"])
        features_next, seen_next = self._features(following["observation"], drawn["parameters"])
        return TensorDict(
            {
                "features": features, "critic_features": seen, "action": drawn["action"],
                "next": {
                    "features": features_next, "critic_features": seen_next, "reward": following["reward"],
                    "done": following["done"], "terminated": following["terminated"],
                },
            },
            batch_size=drawn.batch_size,
        )  # fmt: skip


class Memory:
    """The last steps: TorchRL's replay buffer, whose state is no larger than what it holds.

    Args:
        capacity: steps that are remembered.
        minibatch: steps of a sample.
    """

    def __init__(self, capacity: int, minibatch: int) -> None:
        self._capacity = capacity
        self._buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=minibatch)
        self._written = 0

    def __len__(self) -> int:
        """Return the number of steps that are remembered."""
        return len(self._buffer)

    def extend(self, steps: TensorDict) -> None:
        """Remember steps, the oldest are forgotten."""
        self._buffer.extend(steps.detach().cpu())
        self._written += len(steps)

    def sample(self) -> TensorDict:
        """Return steps drawn with replacement, by the global generator."""
        return self._buffer.sample().exclude("index")

    def state_dict(self) -> dict[str, Any]:
        """Return the steps, oldest first."""
        if not len(self):
            return {"steps": {}, "written": 0}
        first = self._written % self._capacity if self._written > self._capacity else 0
        held = self._buffer[:].exclude("index")
        rows = torch.arange(len(self)).roll(-first)
        return {"steps": held[rows].flatten_keys(".").to_dict(), "written": self._written}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Remember the steps of :meth:`state_dict`, each where it stood."""
        self._buffer.empty()
        self._written = 0
        if not state["steps"]:
            return
        steps = TensorDict(state["steps"], batch_size=[len(state["steps"]["action"])]).unflatten_keys(".")
        first = state["written"] % self._capacity if state["written"] > self._capacity else 0
        if first:  # turn the ring until the oldest stands where it stood
            self._buffer.extend(steps[:first].clone())
        self._buffer.extend(steps)
        self._written = state["written"]


class _Schedule:
    """The counters that decide when SAC learns."""

    def __init__(self, learner: SAC) -> None:
        self._learner = learner

    def state_dict(self) -> dict[str, Any]:
        return {"steps": self._learner._seen_steps, "owed": self._learner._owed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._learner._seen_steps, self._learner._owed = state["steps"], state["owed"]
