"""Soft actor-critic on batches of environments, with TorchRL's loss and replay buffer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from dropo_torch.rl.learner import Learner
from dropo_torch.rl.policy import ActionValue, Policy, mlp
from dropo_torch.rl.settings import SACSettings


class SAC(Learner):
    """SAC with two critics, slow targets and an adapted temperature.

    Args:
        policy: what is improved, in place.
        num_parameters: width d of the episodes' parameters.
        settings: how it learns.
    """

    kept = (*Learner.kept, "seen_steps", "owed")

    def __init__(self, policy: Policy, num_parameters: int, settings: SACSettings) -> None:
        super().__init__(policy, num_parameters, settings)
        self.settings = settings
        self._num_actions = len(policy.low)
        entropy = -float(self._num_actions) if settings.target_entropy is None else settings.target_entropy
        shape = self.num_features + self._num_actions, 1, settings.hidden, settings.activation, 1.0
        in_keys, out_keys = ["critic_features", "action"], ["state_action_value"]
        actor = self._actor(TanhNormal)
        critics = [TensorDictModule(ActionValue(*mlp(*shape)), in_keys, out_keys) for _ in range(2)]
        self._loss = SACLoss(actor, critics, loss_function="l2", target_entropy=entropy, alpha_init=0.2)
        self._loss.make_value_estimator(gamma=settings.gamma)
        self._loss.to(self._device)
        self._targets = SoftUpdate(self._loss, tau=settings.tau)
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        self._memory = Memory(min(settings.buffer, max(settings.steps, 1)), settings.minibatch)
        self.parts |= {"loss": self._loss, "optimizer": self._optimizer, "memory": self._memory}
        self.seen_steps, self.owed = 0, 0.0

    def act(self, observation: torch.Tensor) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Return sampled actions; uniform ones during the warm-up."""
        if self.seen_steps < self.settings.warmup:
            return 2 * torch.rand(len(observation), self._num_actions, device=self._device) - 1, {}
        return TanhNormal(*self.policy.actor(self.policy.normalizer(observation))).sample(), {}

    def update(self, rollout: TensorDict, share: float) -> dict[str, float]:
        """Remember steps ``(N, 1)`` and learn from the memory as often as they allow."""
        flat = rollout.reshape(-1)
        self._take_in(flat)
        self._memory.extend(flat.detach().cpu())
        self.seen_steps += len(flat)
        if self.seen_steps < max(self.settings.warmup, self.settings.minibatch):
            return {}
        self.owed += self.settings.updates_per_step * len(flat)
        updates = int(self.owed)
        self.owed -= updates
        losses: Mapping[str, torch.Tensor] = {}
        for _ in range(updates):
            losses = self._gradient().detach()
        entries = {"loss_policy": "loss_actor", "loss_critic": "loss_qvalue", "alpha": "alpha", "entropy": "entropy"}
        return {name: float(losses[key]) for name, key in entries.items()} if updates else {}

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
        """Remembered steps with inputs normalized by today's statistics."""
        drawn = self._memory.sample().to(self._device)
        following = drawn["next"]
        features, seen = self._features(drawn["observation"], drawn["parameters"])
        features_next, seen_next = self._features(following["observation"], drawn["parameters"])
        kept = following.select("reward", "done", "terminated")
        after = {**kept, "features": features_next, "critic_features": seen_next}
        now = {"features": features, "critic_features": seen, "action": drawn["action"]}
        return TensorDict({**now, "next": after}, batch_size=drawn.batch_size)


class Memory(TensorDictReplayBuffer):
    """The last steps: TorchRL's replay buffer, whose state is no larger than what it holds.

    Args:
        capacity: steps that are remembered.
        minibatch: steps of a sample, drawn with replacement by the global generator.
    """

    def __init__(self, capacity: int, minibatch: int) -> None:
        super().__init__(storage=LazyTensorStorage(capacity), batch_size=minibatch)

    def state_dict(self) -> dict[str, Any]:
        """Return the steps in the order in which they are stored, and where the next one goes."""
        steps = self[:].exclude("index").flatten_keys(".").to_dict() if len(self) else {}
        return {"steps": steps, "writer": self.writer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Remember the steps of :meth:`state_dict`, each where it stood."""
        self.empty()
        if state["steps"]:
            count = len(state["steps"]["action"])
            self.extend(TensorDict(state["steps"], batch_size=[count]).unflatten_keys("."))
        self.writer.load_state_dict(state["writer"])
