"""Adam on φ with reparameterised samples, for simulators that differentiate.

Adam (Kingma and Ba 2015) gives every coordinate a rate of its own, which is slow where parameters trade off against
each other: the valley of the likelihood then lies across the coordinates. As in SOAP (Vyas et al. 2024), Adam
therefore runs in the eigenbasis of a preconditioner, here the Gauss-Newton matrix Σ JᵀC⁻¹J of the means, and no
step along an eigenvector is longer than Newton's, gradient / eigenvalue.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from dropo_torch.distribution import SearchBox, to_values, values_from_uniforms
from dropo_torch.errors import InputError, choices
from dropo_torch.objective import Objective, Reduce, draw_uniforms
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.parameters import ParameterSpace

#: Memory of the gradient and of its square. Both are short: over a fit gradients shrink by many orders of magnitude,
#: and a long memory of their size would hold the steps back.
_BETAS = (0.8, 0.9)
_TINY = 1e-300
#: Steps before the gradient's running size is trusted.
_WARM_UP = 10
#: The first learning rate of the second stage, as a share of the first stage's.
_JOINT_RATE = 0.2
#: Standard errors by which residuals must exceed their covariance for deviations to leave their floor at once.
_SIGNIFICANCE = 3.0
#: Steps between two refreshes of the start noise at the current μ.
_RELINEARISE = 100


@dataclass(frozen=True)
class AdamSettings:
    """How Adam steps, in φ scaled to [0, 4] as for CMA-ES.

    Attributes:
        steps: of each of its two stages: the means alone, then means and deviations.
        batch: transitions of a minibatch while means and deviations move, twice as many for the means alone;
            the whole log where that is shorter.
        samples: parameter vectors of each step of the second stage; the first simulates μ only.
        learning_rate: the first of the means alone, falling linearly to 0; a fifth of it for means and deviations.
        refresh: steps after which the basis of the means is computed anew.
        clip: largest entry of a minibatch's gradient, in multiples of that entry's running root mean square:
            a single transition at a stiff contact must not slow the steps that follow.
        common_random_numbers: the same samples at every step instead of fresh ones.
    """

    steps: int = 200
    batch: int = 25
    samples: int = 16
    learning_rate: float = 0.5
    refresh: int = 20
    clip: float = 3.0
    common_random_numbers: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "samples", "learning_rate", "refresh", "clip"):
            if not getattr(self, name) > 0:
                raise InputError(f"adam.{name}: {getattr(self, name)} given; expected a positive number")
        if self.samples < 2:
            raise InputError("adam.samples: 1 given; a covariance needs 2 or more")

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0 over both stages."""
        first = self.learning_rate * (1.0 if step < self.steps else _JOINT_RATE)
        return first * (1 - step % self.steps / self.steps)


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
    """Stochastic gradient ascent of the sampled likelihood over minibatches of transitions, in two stages.

    First the means alone, with deviations at their floor: weighted least squares, one simulation a transition. The
    residuals that are left give a first guess of the deviations. Then both on samples. With m and v the running
    mean and mean square of the gradient (as in Adam, bias corrected), λ an eigenvalue of the minibatch's
    Gauss-Newton matrix per transition, α the learning rate and α₀ its setting, the means move along an
    eigenvector by α m / max(√v, α₀ λ): Adam's bounded step far away, a damped Newton step near by. The matrix is
    computed anew every few steps from a stencil of d + 1 points on a minibatch, and the moments turn along.

    The deviations move by their logarithms, but Adam sees the gradients of their variances: those do not vanish
    towards the floor, so that a deviation can leave it and reach it again.

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
        self._noisy = objective.noise is not None
        d = len(self._space)
        self._phi = np.concatenate([np.full(d, SearchBox.WIDTH / 2), np.zeros(d)])
        self._first, self._second = np.zeros(2 * d), np.zeros(2 * d)
        self._basis, self._curvature, self._refreshed = np.eye(d), np.zeros(d), -1
        self._step = 0
        self._smoothed = float("nan")
        self._linearised: np.ndarray | None = None

    def ask(self) -> Request:
        """Return a minibatch of transitions, with the gradient wanted or, at a refresh, for the Gauss-Newton matrix."""
        if self._noisy and self._step % _RELINEARISE == 0:
            self._linearised = self._box.denormalise(self._phi)[0]
        if self._is_refresh_due:
            stage = self._means_stage()
            return Request(
                values=to_values(stage.points(), self._space.is_log),
                reduce=self._normal_equations(stage),
                evaluations=0,
                linearise_at=self._linearised,
                rows=None if self._is_new_stage else self._rows(),
                is_stencil=True,
            )
        return Request(
            values=self._values(torch.from_numpy(self._phi)).detach().numpy(),
            reduce=self._objective.likelihood_reduction(1) if self._is_joint else self._means_reduction(),
            evaluations=1,
            linearise_at=self._linearised,
            rows=self._rows(),
            gradient=True,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Turn the basis, or step along the gradient of the minibatch's log-likelihood."""
        if gradient is None:
            self._refresh(sums)
            return
        phi = torch.from_numpy(self._phi.copy()).requires_grad_(True)
        (pulled,) = torch.autograd.grad(self._values(phi), phi, gradient.reshape(-1, len(self._space)))
        value = float(sums[0]) / self._batch
        self._smoothed = value if math.isnan(self._smoothed) else 0.9 * self._smoothed + 0.1 * value
        self._advance(self._to_basis(np.nan_to_num(pulled.numpy() / self._batch)))

    @property
    def stop_reason(self) -> str | None:
        """Why it has stopped, in words."""
        return f"{self._step} steps are taken" if self._step >= 2 * self._settings.steps else None

    @property
    def progress(self) -> Progress:
        """Smoothed log-likelihood of the whole log, and the share of steps taken."""
        stage = "Adam on means and deviations" if self._is_joint else "Adam on the means"
        return Progress(stage, self._smoothed * len(self._objective), self._step / (2 * self._settings.steps))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the last φ."""
        return [self._box.denormalise(self._phi)]

    def state(self) -> dict[str, Any]:
        """Return everything that changes, as plain data."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        for name in _STATE:
            setattr(self, name, state[name])

    @property
    def _is_joint(self) -> bool:
        """Whether deviations move too."""
        return self._step >= self._settings.steps

    @property
    def _batch(self) -> int:
        """Transitions of this step's minibatch."""
        return min(self._settings.batch * (1 if self._is_joint else 2), len(self._objective))

    @property
    def _is_new_stage(self) -> bool:
        """Whether the deviations are about to move for the first time."""
        return self._step == self._settings.steps

    @property
    def _is_refresh_due(self) -> bool:
        return self._step % self._settings.steps % self._settings.refresh == 0 and self._refreshed != self._step

    def _advance(self, force: np.ndarray) -> None:
        """One step of Adam along a gradient ``(2d,)`` whose part of the means is in the basis."""
        taken = self._step % self._settings.steps
        if taken >= _WARM_UP:
            usual = np.sqrt(self._second / (1 - _BETAS[1] ** taken))
            force = np.clip(force, -self._settings.clip * usual, self._settings.clip * usual)
        self._first = _BETAS[0] * self._first + (1 - _BETAS[0]) * force
        self._second = _BETAS[1] * self._second + (1 - _BETAS[1]) * force**2
        first, second = (m / (1 - b ** (taken + 1)) for m, b in zip((self._first, self._second), _BETAS, strict=True))
        d, rate = len(self._space), self._settings.rate(self._step)
        size = np.sqrt(second + _TINY)
        size[:d] = np.maximum(size[:d], self._settings.learning_rate * self._curvature)
        move = rate * first / size
        move[:d] = self._basis @ move[:d]
        self._phi = np.clip(self._phi + move, 0.0, SearchBox.WIDTH)
        self._step += 1

    def _to_basis(self, force: np.ndarray) -> np.ndarray:
        """A gradient by φ with its means in the basis, and variances in the place of logarithmic deviations."""
        d, ratio = len(self._space), np.log(self._box.max_std / self._box.min_std)
        if not self._is_joint:
            return np.concatenate([self._basis.T @ force[:d], np.zeros(d)])
        variance = np.exp(2 * ratio * self._phi[d:] / SearchBox.WIDTH)  # in units of its floor
        return np.concatenate([self._basis.T @ force[:d], force[d:] / variance])

    def _refresh(self, sums: torch.Tensor) -> None:
        """Take eigenvectors and eigenvalues of the Gauss-Newton matrix, and turn the moments along.

        Where the deviations begin to move, it gives their first guess too.
        """
        d, stage = len(self._space), self._means_stage()
        stage.tell(sums)
        scale = self._box.width / SearchBox.WIDTH
        count = len(self._objective) if self._is_new_stage else self._batch
        self._curvature, basis = np.linalg.eigh(stage.hessian * np.outer(scale, scale) / count)
        turn = basis.T @ self._basis
        self._first = np.concatenate([turn @ self._first[:d], self._first[d:]])
        self._second = np.concatenate([turn**2 @ self._second[:d], self._second[d:]])
        if self._is_new_stage:
            self._first, self._second, self._smoothed = np.zeros(2 * d), np.zeros(2 * d), float("nan")
            guess = stage.deviations(self._box, significance=_SIGNIFICANCE)
            self._phi = np.concatenate([self._phi[:d], self._box.normalise(stage.point, guess)[d:]])
        self._basis, self._refreshed = basis, self._step

    def _values(self, phi: torch.Tensor) -> torch.Tensor:
        """Parameter values ``(K, d)``, in units, of scaled φ; differentiable. μ alone while deviations rest."""
        box, d = self._box, len(self._space)
        low, width, least, most = (torch.as_tensor(x) for x in (box.low, box.width, box.min_std, box.max_std))
        mean = low + phi[:d] / SearchBox.WIDTH * width
        if not self._is_joint:
            is_log = torch.as_tensor(self._space.is_log)
            return (torch.where(is_log, torch.exp(mean), mean) if self._space.is_log.any() else mean)[None]
        std = least * (most / least) ** (phi[d:] / SearchBox.WIDTH)
        draw = 0 if self._settings.common_random_numbers else self._step
        uniforms = draw_uniforms(self._settings.samples, d, self._seed, 5, draw)
        return values_from_uniforms(uniforms, mean, std, self._space.limits, self._space.is_log)

    def _means_reduction(self) -> Reduce:
        """The likelihood of one vector: of two equal ones, whose covariance is nil."""
        pair = self._objective.likelihood_reduction(1)
        return lambda features, measured, covariance: pair(features.expand(-1, 2, -1), measured, covariance)

    def _means_stage(self) -> MeansStage:
        """The stencil around μ, and what its sums say."""
        return MeansStage(self._box.low, self._box.high, self._box.denormalise(self._phi)[0])

    def _normal_equations(self, stage: MeansStage) -> Reduce:
        """The stencil's reduction; deviations that move count as covariance, by the linear model."""
        plain = stage.reduction()
        if not self._is_joint or self._is_new_stage:
            return plain
        spread = torch.from_numpy(self._box.denormalise(self._phi)[1])
        steps = torch.from_numpy(np.diag(stage.points()[1:] - stage.point).copy())

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            moved = torch.nan_to_num(features[:, 1:] - features[:, :1]) * (spread / steps)[:, None]
            return plain(features, measured, covariance + moved.mT @ moved)

        return reduce

    def _rows(self) -> np.ndarray:
        """The transitions of this step: consecutive parts of a shuffle that is redrawn every epoch."""
        total = len(self._objective)
        epoch, part = divmod(self._step, max(1, total // self._batch))
        order = np.random.default_rng((self._seed, 6, epoch)).permutation(total)
        return np.sort(order[part * self._batch : (part + 1) * self._batch])


_STATE = ("_phi", "_first", "_second", "_basis", "_curvature", "_refreshed", "_step", "_smoothed", "_linearised")
