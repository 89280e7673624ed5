"""What learns: multilayer perceptrons over normalised inputs, and the running statistics that normalise them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import nn

#: Normalised inputs are cut off here: a rare large one must not throw the network.
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
        """Return normalised inputs ``(..., n)``, float32, cut off at ±:data:`CLIP`."""
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
    widths = [inputs, *hidden]
    for before, after in itertools.pairwise(widths):
        layers += [_linear(before, after, math.sqrt(2)), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers, _linear(widths[-1], outputs, gain))


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
