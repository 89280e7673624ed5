"""A policy: networks over normalized observations, what maps these to actions, and the file that holds it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import nn

from dropo_torch.errors import InputError
from dropo_torch.rl.checkpoint import load_tensors, save_tensors
from dropo_torch.support.given import reading

SCHEMA = "dropo-torch/policy/1"
Plain = Mapping[str, Any]
#: Normalized inputs are cut off here: a rare large one must not throw the network.
CLIP = 10.0
#: Least and largest logarithm of a state-dependent standard deviation.
LOG_STD = (-5.0, 2.0)

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}


class Normalizer(nn.Module):
    """Running mean and variance of inputs ``(..., n)``, float64 inside; maps them to mean 0 and standard deviation 1.

    Before the first update it changes nothing. An input that never varies becomes 0.
    """

    mean: torch.Tensor
    square: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))  # sum of squared deviations
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, values: torch.Tensor) -> None:
        """Take in inputs ``(..., n)`` (Chan et al. 1979, parallel variance)."""
        rows = values.flatten(0, -2).double()
        if not rows.numel():
            return
        total = self.count + len(rows)
        mean = rows.mean(0)
        delta = mean - self.mean
        self.square += ((rows - mean) ** 2).sum(0) + delta**2 * self.count * len(rows) / total
        self.mean += delta * len(rows) / total
        self.count += len(rows)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Return normalized inputs ``(..., n)``, float32, cut off at ±:data:`CLIP`."""
        variance = torch.where(self.count > 0, self.square / self.count.clamp(min=1) + 1e-8, 1.0)
        scaled = (values.double() - self.mean) / torch.sqrt(variance)
        return scaled.clamp(-CLIP, CLIP).float()


class Actor(nn.Module):
    """Maps features ``(..., n)`` to mean and standard deviation of actions in [-1, 1], ``(..., m)`` each.

    Args:
        num_observations, num_actions: n and m.
        hidden: widths of the hidden layers.
        head: ``"normal"``: a normal whose standard deviation is the same in every state, cut off at ±1 by whoever acts;
            ``"tanh"``: a squashed normal whose standard deviation depends on the state.
        activation: of the hidden layers: tanh, relu or elu.
        initial_std: with ``"normal"``: the standard deviation at the start.
    """

    def __init__(
        self,
        *,
        num_observations: int,
        num_actions: int,
        hidden: Sequence[int],
        head: str,
        activation: str,
        initial_std: float = 0.6,
    ) -> None:
        super().__init__()
        self.head = head
        self.network = mlp(num_observations, num_actions * (2 if head == "tanh" else 1), hidden, activation, 0.01)
        if head == "normal":
            self.log_std = nn.Parameter(torch.full((num_actions,), math.log(initial_std)))

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean (before squashing) and standard deviation."""
        out = self.network(features)
        if self.head == "normal":
            return out, self.log_std.exp().expand_as(out)
        mean, log_std = out.chunk(2, -1)
        low, high = LOG_STD
        return mean, torch.exp(low + 0.5 * (high - low) * (torch.tanh(log_std) + 1))

    def deterministic(self, features: torch.Tensor) -> torch.Tensor:
        """Return the action without noise, in [-1, 1], ``(..., m)``."""
        mean, _ = self(features)
        return torch.tanh(mean) if self.head == "tanh" else mean.clamp(-1, 1)


class ActionValue(nn.Sequential):
    """Layers that map features ``(..., n)`` and actions ``(..., m)`` to a value ``(..., 1)``."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        """Return the value of features and actions."""
        return super().forward(torch.cat(inputs, -1))


def mlp(inputs: int, outputs: int, hidden: Sequence[int], activation: str, gain: float) -> nn.Sequential:
    """Return a multilayer perceptron with orthogonal weights; ``gain`` scales those of the last layer."""
    layers: list[nn.Module] = []
    gains = [*[math.sqrt(2)] * len(hidden), gain]
    for sizes, scale in zip(itertools.pairwise([inputs, *hidden, outputs]), gains, strict=True):
        layer = nn.Linear(*sizes)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


class Policy(nn.Module):
    """A deterministic policy with its observation statistics.

    Args:
        architecture: num_observations n, num_actions m, hidden, head, activation and initial_std of the network.
        config: the training's config, as plain data.
        distribution: where the episodes' parameters came from, as plain data.

    Attributes:
        num_observations: width n of an observation.
        actor: the network.
        normalizer: statistics of the observations.
        low, high: bounds of the actions, ``(m,)`` each, finite.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, architecture: Plain, *, config: Plain | None = None, distribution: Plain | None = None) -> None:
        super().__init__()
        self.actor = Actor(**architecture)
        self.num_observations: int = architecture["num_observations"]
        self.normalizer = Normalizer(self.num_observations)
        self.register_buffer("low", -torch.ones(architecture["num_actions"]))
        self.register_buffer("high", torch.ones(architecture["num_actions"]))
        self.architecture = dict(architecture)
        self.config = dict(config or {})
        self.distribution = dict(distribution or {})

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
    policy.eval()
    numbers = [*policy.state_dict().values(), policy(torch.zeros(policy.num_observations))]
    if not all(bool(torch.isfinite(x).all()) for x in numbers):
        raise InputError(f"policy: {path} is damaged: its actions are no numbers; train it again, or take a copy")
    return policy
