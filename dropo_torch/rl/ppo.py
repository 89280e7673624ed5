"""Proximal policy optimization on batches of environments, with TorchRL's loss and generalized advantages."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from dropo_torch.rl.learner import Learner
from dropo_torch.rl.policy import Normalizer, Policy, mlp
from dropo_torch.rl.settings import PPOSettings

#: What an update tells → its entry in TorchRL's loss.
_SCALARS = {
    "loss_policy": "loss_objective",
    "loss_critic": "loss_critic",
    "kl": "kl_approx",
    "clip_fraction": "clip_fraction",
}
#: How TorchRL's loss is used, whatever the settings.
_LOSS = {"loss_critic_type": "l2", "normalize_advantage": True, "functional": False, "log_explained_variance": False}


class PPO(Learner):
    """PPO with clipped ratios, rewards scaled by their running return, and an early end of epochs.

    Statistics of observations and returns move between two rollouts only, so that at the first gradient after a
    rollout the policy is the one that acted.

    Args:
        policy: what is improved, in place.
        num_parameters: width d of the episodes' parameters.
        settings: how it learns.
    """

    def __init__(self, policy: Policy, num_parameters: int, settings: PPOSettings) -> None:
        super().__init__(policy, num_parameters, settings)
        self.settings = settings
        network = mlp(self.num_features, 1, settings.hidden, settings.activation, 1.0).to(self._device)
        self._critic = TensorDictModule(network, in_keys=["critic_features"], out_keys=["state_value"])
        entropy = {"entropy_bonus": settings.entropy > 0, "entropy_coeff": settings.entropy}
        actor = self._actor(IndependentNormal)
        self._loss = ClipPPOLoss(actor, self._critic, clip_epsilon=settings.clip, **entropy, **_LOSS)
        self._loss.set_keys(sample_log_prob="log_prob")
        self._advantage = GAE(gamma=settings.gamma, lmbda=settings.lambda_, value_network=None, vectorized=True)
        self._optimizer = torch.optim.Adam(
            [*policy.actor.parameters(), *network.parameters()], lr=settings.learning_rate, eps=1e-5, fused=True
        )
        self._scale = ReturnScale(settings.num_envs, settings.gamma).to(self._device)
        self.parts |= {"critic": self._critic, "optimizer": self._optimizer, "scale": self._scale}

    def act(self, observation: torch.Tensor) -> tuple[torch.Tensor, Mapping[str, torch.Tensor]]:
        """Return sampled actions, whose excess over ±1 the environment does not see, and their log-probabilities."""
        distribution = IndependentNormal(*self.policy.actor(self.policy.normalizer(observation)))
        action = distribution.sample()
        return action, {"log_prob": distribution.log_prob(action)}

    def update(self, rollout: TensorDict, share: float) -> dict[str, float]:
        """Learn from steps ``(N, horizon)``."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * (1 - share if self.settings.anneal else 1.0)
        data = self._prepared(rollout)
        scalars = self._epochs(data)
        self._take_in(rollout)
        std = float(self.policy.actor.log_std.detach().exp().mean())
        return {**scalars, "reward_scale": float(self._scale.factor), "std": std}

    @torch.no_grad()
    def _prepared(self, rollout: TensorDict) -> TensorDict:
        """Normalized inputs, advantages and value targets of all steps, batch ``(N · horizon,)``."""
        following = rollout["next"]
        self._scale.update(following["reward"][..., 0], following["done"][..., 0])
        features, seen = self._features(rollout["observation"], rollout["parameters"])
        _, seen_next = self._features(following["observation"], rollout["parameters"])
        value, reward = self._critic.module, following["reward"] * self._scale.factor
        after = {**following.select("done", "terminated"), "state_value": value(seen_next), "reward": reward}
        data = TensorDict({"state_value": value(seen), "next": after}, batch_size=rollout.batch_size)
        self._advantage(data)
        kept = {**rollout.select("action", "log_prob"), **data.select("advantage", "value_target")}
        inputs = {"features": features, "critic_features": seen}
        return TensorDict({**inputs, **kept}, batch_size=rollout.batch_size).reshape(-1)

    def _epochs(self, data: TensorDict) -> dict[str, float]:
        """Pass over the data in minibatches until the policy has moved enough."""
        settings, sums, updates, epochs = self.settings, torch.zeros(4, dtype=torch.float64), 0, 0
        while epochs < settings.epochs:
            epochs += 1
            divergence, batches = 0.0, 0
            for rows in torch.randperm(len(data), device=data["action"].device).split(settings.minibatch):
                losses = self._loss(data[rows])
                if not self._step(losses):
                    continue
                sums += torch.stack([losses[key] for key in _SCALARS.values()]).detach().cpu().double()
                divergence, batches, updates = divergence + float(losses["kl_approx"]), batches + 1, updates + 1
            if divergence > settings.target_kl * max(batches, 1):
                break
        means = (sums / max(updates, 1)).tolist()
        return {**dict(zip(_SCALARS, means, strict=True)), "epochs": float(epochs)}

    def _step(self, losses: TensorDict) -> bool:
        """Follow a gradient, unless the loss is not finite."""
        loss = losses["loss_objective"] + losses["loss_critic"]
        if self.settings.entropy > 0:
            loss = loss + losses["loss_entropy"]
        if not self._is_sound(loss):
            return False
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for module in (self.policy.actor, self._critic):
            nn.utils.clip_grad_norm_(module.parameters(), self.settings.max_grad_norm)
        self._optimizer.step()
        return True


class ReturnScale(nn.Module):
    """Scales rewards so that discounted returns have standard deviation 1; adapts to those seen so far."""

    running: torch.Tensor

    def __init__(self, num_envs: int, gamma: float) -> None:
        super().__init__()
        self._gamma = gamma
        self._statistics = Normalizer(1)
        self.register_buffer("running", torch.zeros(num_envs, dtype=torch.float64))

    @property
    def factor(self) -> torch.Tensor:
        """What rewards are multiplied by."""
        count, square = self._statistics.count, self._statistics.square[0]
        return torch.rsqrt(torch.where(count > 0, square / count.clamp(min=1), 1.0) + 1e-8).float()

    @torch.no_grad()
    def update(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        """Take in rewards and ends of episodes ``(N, T)``."""
        running, seen = self.running.clone(), torch.empty_like(reward, dtype=torch.float64)
        for t in range(reward.shape[1]):
            running = running * self._gamma + reward[:, t].double()
            seen[:, t] = running
            running = torch.where(done[:, t], 0.0, running)
        self.running.copy_(running)
        self._statistics.update(seen[..., None])
