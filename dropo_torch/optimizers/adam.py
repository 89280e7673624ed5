"""Adam on φ with reparameterized samples, for simulators that differentiate.

Adam (Kingma and Ba 2015) gives every coordinate a rate of its own, which is slow where parameters trade off against
each other: the valley of the likelihood then lies across the coordinates. As in SOAP (Vyas et al. 2024), Adam
therefore runs in the eigenbasis of a preconditioner, here the Gauss-Newton matrix Σ JᵀC⁻¹J of the means, and no
step along an eigenvector is longer than Newton's, gradient / eigenvalue.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from dropo_torch.distribution import SearchBox, tensor_values
from dropo_torch.errors import InputError
from dropo_torch.objective import Objective, Reduce
from dropo_torch.optimizers.base import LikelihoodOptimizer, Progress, Request
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.support.random import draw_uniforms

#: Memory of the gradient and of its square. Both are short: over a fit gradients shrink by many orders of magnitude,
#: and a long memory of their size would hold the steps back.
_BETAS = (0.8, 0.9)
_TINY = 1e-300
#: Steps before the gradient's running size is trusted.
_WARM_UP = 10
#: Standard errors by which residuals must exceed their covariance for σ to leave its floor at once.
_SIGNIFICANCE = 3.0
#: Steps after which the noise of the initial states is propagated anew, at the current μ.
_RELINEARIZE = 100


class AdamOptimizer(LikelihoodOptimizer):
    """Stochastic gradient ascent of the sampled likelihood over minibatches of transitions, in two stages.

    First the means alone, with σ at its floor: weighted least squares, one simulation a transition. The
    residuals that are left give a first guess of σ. Then both on samples. With m and v the running
    mean and mean square of the gradient (as in Adam, bias corrected), λ an eigenvalue of the minibatch's
    Gauss-Newton matrix per transition, α the learning rate and α₀ its setting, the means move along an
    eigenvector by α m / max(√v, α₀ λ): Adam's bounded step far away, a damped Newton step near by. The matrix is
    computed anew every few steps from a stencil of d + 1 points on a minibatch, and the moments turn along.

    σ moves by its logarithm, but Adam sees the gradient of its square, which does not vanish
    towards the floor, so that σ can leave it and reach it again.

    What diverges has no gradient: where a larger share of a minibatch does than where the least did so far, the step is
    half the way back there.

    Args:
        objective: its reduction and its simulator's gradients are used; it is not evaluated here.
        settings: how it steps, and the seed of minibatches and samples.
    """

    name = "adam"
    improves = False  # from far away it may need all of its steps
    STATE = ("_phi", "_first", "_second", "_basis", "_curvature", "_refreshed", "_step", "_smoothed", "_linearised",
             "_least", "_stable")  # fmt: skip

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        if not objective.simulator.differentiable:
            raise InputError(
                f"optimizer: adam needs gradients, which backend {objective.simulator.name} has not; "
                + objective.simulator.remedy
            )
        super().__init__(objective, settings)
        self._adam = settings.adam
        d = len(self._space)
        self._phi = np.concatenate([np.full(d, SearchBox.WIDTH / 2), np.zeros(d)])
        self._first, self._second = np.zeros(2 * d), np.zeros(2 * d)
        self._basis, self._curvature, self._refreshed = np.eye(d), np.zeros(d), -1
        self._step, self._smoothed = 0, math.nan
        self._linearised: np.ndarray | None = None
        self._least, self._stable = math.inf, self._phi  # the least share of a minibatch that diverged, and where last

    def ask(self) -> Request:
        """Return a minibatch of transitions, with the gradient wanted or, at a refresh, for the Gauss-Newton matrix."""
        if self._noisy and self._step % _RELINEARIZE == 0:
            self._linearised = self._box.denormalize(self._phi)[0]
        if self._is_refresh_due:
            stage = self._means_stage()
            return Request(
                values=self._box.values(stage.points()),
                reduce=self._normal_equations(stage),
                evaluations=0,
                linearise_at=self._linearised,
                widen=self._is_new_stage,
                rows=None if self._is_new_stage else self._rows(),
                is_stencil=True,
            )
        return Request(
            values=self._values(torch.from_numpy(self._phi)).numpy(),
            reduce=self._objective.likelihood() if self._is_joint else self._means_reduction(),
            evaluations=1,
            linearise_at=self._linearised,
            widen=False,
            rows=self._rows(),
            gradient=True,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Turn the basis, or step along the gradient of the minibatch's log-likelihood."""
        if gradient is None:
            self._refresh(sums)
            return
        lost = float(sums[4]) / (self._batch * len(gradient))
        if lost > self._least:
            self._phi, self._first = 0.5 * (self._phi + self._stable), np.zeros_like(self._first)
            self._step += 1
            return
        self._least, self._stable = lost, self._phi
        phi = torch.from_numpy(self._phi.copy()).requires_grad_(True)
        (pulled,) = torch.autograd.grad(self._values(phi), phi, gradient.reshape(-1, len(self._space)))
        value = float(sums[0]) / self._batch
        self._smoothed = value if math.isnan(self._smoothed) else 0.9 * self._smoothed + 0.1 * value
        self._advance(self._to_basis(np.nan_to_num(pulled.numpy() / self._batch)))

    @property
    def stop_reason(self) -> str | None:
        """Why it has stopped, in words."""
        return f"{self._step} steps are taken" if self._step >= 2 * self._adam.steps else None

    @property
    def progress(self) -> Progress:
        """Smoothed log-likelihood of the whole log, and the share of steps taken."""
        stage = "Adam on means and standard deviations" if self._is_joint else "Adam on the means"
        return Progress(stage, self._smoothed * len(self._objective), self._step / (2 * self._adam.steps))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the last φ, and the last at which no more diverged than anywhere."""
        last = [self._phi] if np.array_equal(self._phi, self._stable) else [self._phi, self._stable]
        return [self._box.denormalize(phi) for phi in last]

    @property
    def _is_joint(self) -> bool:
        """Whether σ moves too."""
        return self._step >= self._adam.steps

    @property
    def _batch(self) -> int:
        """Transitions of this step's minibatch."""
        return min(self._adam.batch * (1 if self._is_joint else 2), len(self._objective))

    @property
    def _is_new_stage(self) -> bool:
        """Whether σ is about to move for the first time."""
        return self._step == self._adam.steps

    @property
    def _is_refresh_due(self) -> bool:
        return self._step % self._adam.steps % self._adam.refresh == 0 and self._refreshed != self._step

    def _advance(self, force: np.ndarray) -> None:
        """One step of Adam along a gradient ``(2d,)`` whose part of the means is in the basis."""
        taken = self._step % self._adam.steps
        if taken >= _WARM_UP:
            most = self._adam.clip * np.sqrt(self._second / (1 - _BETAS[1] ** taken))
            force = np.clip(force, -most, most)
        self._first = _BETAS[0] * self._first + (1 - _BETAS[0]) * force
        self._second = _BETAS[1] * self._second + (1 - _BETAS[1]) * force**2
        first, second = (m / (1 - b ** (taken + 1)) for m, b in zip((self._first, self._second), _BETAS, strict=True))
        d, rate = len(self._space), self._adam.rate(self._step)
        size = np.sqrt(second + _TINY)
        size[:d] = np.maximum(size[:d], self._adam.learning_rate * self._curvature)
        move = rate * first / size
        move[:d] = self._basis @ move[:d]
        self._phi = np.clip(self._phi + move, 0.0, SearchBox.WIDTH)
        self._step += 1

    def _to_basis(self, force: np.ndarray) -> np.ndarray:
        """A gradient by φ with its means in the basis, and variances in the place of log σ."""
        d, ratio = len(self._space), np.log(self._box.max_std / self._box.min_std)
        variance = np.exp(2 * ratio * self._phi[d:] / SearchBox.WIDTH)  # in units of its floor
        return np.concatenate([self._basis.T @ force[:d], force[d:] / variance if self._is_joint else np.zeros(d)])

    def _refresh(self, sums: torch.Tensor) -> None:
        """Take eigenvectors and eigenvalues of the Gauss-Newton matrix, and turn the moments along.

        Where σ begins to move, it gives its first guess too.
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
            self._first, self._second, self._smoothed = np.zeros(2 * d), np.zeros(2 * d), math.nan
            guess = stage.first_std(self._box, significance=_SIGNIFICANCE)
            self._phi = np.concatenate([self._phi[:d], self._box.normalize(stage.point, guess)[d:]])
        self._basis, self._refreshed = basis, self._step

    def _values(self, phi: torch.Tensor) -> torch.Tensor:
        """Parameter values ``(K, d)``, in units, of scaled φ; differentiable. μ alone in the first stage."""
        box, d = self._box, len(self._space)
        low, width, least, most = (torch.as_tensor(x) for x in (box.low, box.width, box.min_std, box.max_std))
        mean = low + phi[:d] / SearchBox.WIDTH * width
        if not self._is_joint:
            return tensor_values(mean, box.is_log)[None]
        std = least * (most / least) ** (phi[d:] / SearchBox.WIDTH)
        draw = 0 if self._adam.common_random_numbers else self._step
        uniforms = draw_uniforms(self._adam.samples, d, self._settings.seed, 5, draw)
        return box.draw(uniforms, mean, std)

    def _means_reduction(self) -> Reduce:
        """The likelihood of one vector: of two equal ones, whose covariance is nil."""
        pair = self._objective.likelihood()
        return lambda features, measured, covariance: pair(features.expand(-1, 2, -1), measured, covariance)

    def _means_stage(self) -> MeansStage:
        """The stencil around μ, and what its sums say."""
        return MeansStage(self._box.low, self._box.high, self._box.denormalize(self._phi)[0])

    def _normal_equations(self, stage: MeansStage) -> Reduce:
        """The stencil's reduction; a σ that moves counts as covariance, by the linear model."""
        plain = stage.reduction()
        if not self._is_joint or self._is_new_stage:
            return plain
        spread = torch.from_numpy(self._box.denormalize(self._phi)[1])
        steps = torch.from_numpy(np.diag(stage.points()[1:] - stage.point).copy())

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            moved = torch.nan_to_num(features[:, 1:] - features[:, :1]) * (spread / steps)[:, None]
            return plain(features, measured, covariance + moved.mT @ moved)

        return reduce

    def _rows(self) -> np.ndarray:
        """The transitions of this step: consecutive parts of a shuffle that is redrawn every epoch."""
        total = len(self._objective)
        epoch, part = divmod(self._step, max(1, total // self._batch))
        order = np.random.default_rng((self._settings.seed, 6, epoch)).permutation(total)
        return np.sort(order[part * self._batch : (part + 1) * self._batch])
