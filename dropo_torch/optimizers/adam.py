"""Adam on φ with reparameterised samples, for simulators that differentiate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from dropo_torch.distribution import SearchBox, values_from_uniforms
from dropo_torch.errors import InputError, choices
from dropo_torch.objective import Objective, draw_uniforms
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.parameters import ParameterSpace

_BETAS = (0.9, 0.99)
_TINY = 1e-12
#: Steps before the gradient's running size is trusted.
_WARM_UP = 10


@dataclass(frozen=True)
class AdamSettings:
    """How Adam steps, in φ scaled to [0, 4] as for CMA-ES.

    Attributes:
        steps: the most it takes.
        batch: transitions of a minibatch; the whole log where that is shorter.
        samples: parameter vectors of each step.
        learning_rate: of the first half of the steps, falling to a hundredth of it by a cosine.
        clip: largest entry of a minibatch's gradient, in multiples of that entry's running root mean square:
            a single transition at a stiff contact must not slow the steps that follow.
        plateau: steps without a better smoothed likelihood after which it stops.
        common_random_numbers: the same samples at every step instead of fresh ones.
    """

    steps: int = 1600
    batch: int = 25
    samples: int = 16
    learning_rate: float = 0.05
    clip: float = 3.0
    plateau: int = 1600
    common_random_numbers: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "samples", "learning_rate", "clip", "plateau"):
            if not getattr(self, name) > 0:
                raise InputError(f"adam.{name}: {getattr(self, name)} given; expected a positive number")
        if self.samples < 2:
            raise InputError("adam.samples: 1 given; a covariance needs 2 or more")

    def rate(self, step: int) -> float:
        """Return the learning rate of a step: constant for half of them, then a cosine."""
        half = self.steps / 2
        if step < half:
            return self.learning_rate
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (step - half) / half)))


def adam_settings(given: Mapping[str, Any]) -> AdamSettings:
    """Return the settings of a config's ``adam``.

    Raises:
        InputError: an unknown key, or a value that is no positive number.
    """
    known = {f.name: f.type for f in fields(AdamSettings)}
    for key, value in given.items():
        if key not in known:
            raise InputError(f"adam: unknown key {key!r}" + choices(key, known))
        if not isinstance(value, (int, float)):
            raise InputError(f"adam.{key}: {value!r} given; expected a number")
    return AdamSettings(**given)


class AdamOptimizer(Optimizer):
    """Stochastic gradient ascent of the sampled likelihood over minibatches of transitions.

    Args:
        objective: its reduction and its simulator's gradients are used; it is not evaluated here.
        settings: how it steps.
        seed: seeds minibatches and samples.
    """

    name = "adam"

    def __init__(self, objective: Objective, *, settings: AdamSettings, seed: int) -> None:
        if not objective.simulator.differentiable:
            raise InputError(
                f"optimizer: adam needs gradients, which backend {objective.simulator.name} has not; "
                + objective.simulator.remedy
            )
        self._objective = objective
        self._space: ParameterSpace = objective.simulator.parameters
        self._box = SearchBox.of(self._space)
        self._settings, self._seed = settings, seed
        self._batch = min(settings.batch, len(objective))
        self._noisy = objective.noise is not None
        dim = 2 * len(self._space)
        self._phi = np.full(dim, SearchBox.WIDTH / 2)
        self._first, self._second = np.zeros(dim), np.zeros(dim)
        self._step = 0
        self._smoothed, self._best, self._best_step = float("nan"), -np.inf, 0
        self._average = self._phi.copy()
        self._reason: str | None = None

    def ask(self) -> Request:
        """Return a minibatch of transitions under a few samples, with the gradient wanted."""
        return Request(
            values=self._values(torch.from_numpy(self._phi)).detach().numpy(),
            reduce=self._objective.likelihood_reduction(1),
            evaluations=1,
            linearise_at=self._center(),
            rows=self._rows(),
            gradient=True,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Step along the gradient of the minibatch's log-likelihood."""
        assert gradient is not None
        value = float(sums[0]) / self._batch
        phi = torch.from_numpy(self._phi.copy()).requires_grad_(True)
        (pulled,) = torch.autograd.grad(self._values(phi), phi, gradient.reshape(-1, len(self._space)))
        force = np.nan_to_num(pulled.numpy() / self._batch)
        if self._step >= _WARM_UP:
            usual = np.sqrt(self._second / (1 - _BETAS[1] ** self._step))
            force = np.clip(force, -self._settings.clip * usual, self._settings.clip * usual)
        self._step += 1
        self._first = _BETAS[0] * self._first + (1 - _BETAS[0]) * force
        self._second = _BETAS[1] * self._second + (1 - _BETAS[1]) * force**2
        first, second = (m / (1 - b**self._step) for m, b in zip((self._first, self._second), _BETAS, strict=True))
        move = self._settings.rate(self._step) * first / (np.sqrt(second) + _TINY)
        self._phi = np.clip(self._phi + move, 0.0, SearchBox.WIDTH)
        self._average = 0.9 * self._average + 0.1 * self._phi if self._step > 10 else self._phi.copy()
        self._watch(value)

    @property
    def stop_reason(self) -> str | None:
        """Why it has stopped, in words."""
        return self._reason

    @property
    def progress(self) -> Progress:
        """Smoothed log-likelihood of the whole log, and the share of steps taken."""
        scale = len(self._objective)
        return Progress("Adam", self._smoothed * scale, self._step / self._settings.steps)

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the running average of φ, and the last φ."""
        return [self._box.denormalise(self._average), self._box.denormalise(self._phi)]

    def state(self) -> dict[str, Any]:
        """Return everything that changes, as plain data."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        for name in _STATE:
            setattr(self, name, state[name])

    def _values(self, phi: torch.Tensor) -> torch.Tensor:
        """Parameter values ``(K, d)``, in units, of scaled φ; differentiable."""
        box, d = self._box, len(self._space)
        low, width, least, most = (torch.as_tensor(x) for x in (box.low, box.width, box.min_std, box.max_std))
        mean = low + phi[:d] / SearchBox.WIDTH * width
        std = least * (most / least) ** (phi[d:] / SearchBox.WIDTH)
        draw = 0 if self._settings.common_random_numbers else self._step
        uniforms = draw_uniforms(self._settings.samples, d, self._seed, 5, draw)
        return values_from_uniforms(uniforms, mean, std, self._space.limits, self._space.is_log)

    def _rows(self) -> np.ndarray:
        """The transitions of this step: consecutive parts of a shuffle that is redrawn every epoch."""
        total, per_epoch = len(self._objective), max(1, len(self._objective) // self._batch)
        epoch, part = divmod(self._step, per_epoch)
        order = np.random.default_rng((self._seed, 6, epoch)).permutation(total)
        return np.sort(order[part * self._batch : (part + 1) * self._batch])

    def _center(self) -> np.ndarray | None:
        """μ at which the start noise is propagated: refreshed every epoch or hundred steps."""
        if not self._noisy:
            return None
        if self._step % 100 == 0:
            self._linearised = self._box.denormalise(self._average)[0]
        return self._linearised

    def _watch(self, value: float) -> None:
        """Smooth the likelihood and stop on a plateau or after the last step."""
        self._smoothed = value if math.isnan(self._smoothed) else 0.98 * self._smoothed + 0.02 * value
        if self._smoothed > self._best + 1e-3 * max(1.0, abs(self._best) if math.isfinite(self._best) else 1.0) / 10:
            self._best, self._best_step = self._smoothed, self._step
        if self._step >= self._settings.steps:
            self._reason = f"{self._settings.steps} steps are taken"
        elif self._step - self._best_step > self._settings.plateau:
            self._reason = f"the smoothed likelihood has not risen for {self._settings.plateau} steps"

    _linearised: np.ndarray | None = None


_STATE = (
    "_phi", "_first", "_second", "_step", "_smoothed", "_best", "_best_step", "_average", "_reason", "_linearised",
)  # fmt: skip
