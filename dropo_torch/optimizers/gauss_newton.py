"""Levenberg-Marquardt on the means: one vector simulated, its Jacobian by forward differences."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
import scipy.optimize
import torch
from scipy.stats import qmc

from dropo_torch.distribution import SearchBox
from dropo_torch.likelihood import STUDENT_DOF, robust_cholesky
from dropo_torch.objective import Reduce
from dropo_torch.optimizers.least_squares import bounded_step

#: Step of the forward differences, as a share of the search width.
DIFFERENCE_STEP = 1e-5
MAX_ITERATIONS = 40
#: Damping after a step that was no good, at least: with less, the next one would be the same.
LEAST_RAISED = 1e-3
#: Share by which the cost must fall for the patience of a stage to begin anew.
NOTABLE = 0.01
#: Points spread over the box from which to begin where the first one loses transitions.
STARTS = 16


@dataclass
class MeansStage:
    """Minimizes Σ rᵀC⁻¹r over μ inside its box, or a robust sum, by which no transition counts for all others.

    Attributes:
        low, high: the box of μ in coordinates, ``(d,)``.
        point: the best μ so far, ``(d,)``.
        shape: transitions and columns of the log, where the residuals' own size is to tell when μ is good enough;
            by default C tells.
        robust: whether the log-density is Student's t: beside a few transitions with an impact, which a wrong μ misses
            by orders of magnitude, the many smooth ones that lead to the right one would not count.
        patience: iterations after which it ends, if they have not made the cost notably smaller.
        cost: ½ Σ rᵀC⁻¹r at ``point``, over the transitions that do not diverge there.
        lost: how many do; no cost outweighs one.
        starts: other points to try before any step, the next one last, ``(d,)`` each.
        mark: the cost when it last became notably smaller.
        idle: iterations since then.
    """

    low: np.ndarray
    high: np.ndarray
    point: np.ndarray
    shape: tuple[int, int] | None = None
    robust: bool = False
    patience: int = MAX_ITERATIONS
    damping: float = 1e-3
    cost: float = np.inf
    lost: float = np.inf
    starts: list[np.ndarray] = field(default_factory=list)
    iterations: int = 0
    mark: float = np.inf
    idle: int = 0
    reason: str | None = None
    candidate: np.ndarray | None = None
    gradient: np.ndarray = field(default_factory=lambda: np.zeros(0))
    hessian: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    excess: np.ndarray = field(default_factory=lambda: np.zeros(0))
    squares: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def points(self) -> np.ndarray:
        """Return the stencil of the candidate: itself, then one moved point a parameter, ``(d + 1, d)``."""
        return np.concatenate([self._center[None], self._center + np.diag(self.steps)])

    def reduction(self) -> Reduce:
        """Return the reduction to cost, losses, normal equations and moments, ``(2 + 2d + 2d²,)``."""
        return partial(normal_equations, steps=torch.from_numpy(self.steps), robust=self.robust)

    def tell(self, sums: torch.Tensor) -> None:
        """Accept or reject the candidate, and propose the next one.

        Where transitions diverge at the first point, points spread over the box are tried before any step.
        """
        d = len(self.low)
        cost, lost = float(sums[0]), float(sums[1])
        step = np.inf if self.candidate is None else float(np.max(np.abs(self._center - self.point) / self._width))
        tries_starts = bool(self.starts)
        if self.candidate is None:
            self.starts = self._spread() if lost else []
        elif tries_starts:
            self.starts.pop()
        if np.isfinite(cost) and (lost, cost) < (self.lost, self.cost):
            gain = self.cost - cost if lost == self.lost else np.inf
            self.point = self._center
            self.cost, self.lost = cost, lost
            self.gradient, self.excess = sums[2 : 2 + 2 * d].numpy().reshape(2, d).copy()
            self.hessian, self.squares = sums[2 + 2 * d :].numpy().reshape(2, d, d).copy()
            self.damping = self.damping if tries_starts else max(self.damping / 8, 1e-12)
            if np.isfinite(gain) and (gain < 1e-4 * self.reduced_chi2 or step < 1e-10) and not self.starts:
                self.reason = "the means no longer improve"
        elif self.candidate is None:
            self.reason = "no simulation succeeded at the starting point"
        elif not tries_starts and step < 1e-9:
            self.reason = "the steps of the means have become too small"
        elif not tries_starts:
            self.damping = max(6 * self.damping, LEAST_RAISED)
        self._wait(0 if tries_starts else 1)
        if self.iterations >= MAX_ITERATIONS and self.reason is None:
            self.reason = f"{MAX_ITERATIONS} iterations of the means"
        if self.idle >= self.patience and self.reason is None:
            self.reason = f"{self.patience} iterations of the means have gained little"
        if self.reason is None and self.starts:
            self.candidate = self.starts[-1]
        elif self.reason is None:
            below, above = self.low - self.point, self.high - self.point
            move = bounded_step(self.hessian, -self.gradient, below, above, self.damping)
            self.candidate = np.clip(self.point + move, self.low, self.high)
            if np.array_equal(self.candidate, self.point):
                self.reason = "the means rest at the bounds"

    def _wait(self, iterations: int) -> None:
        """Count iterations, and those since the cost became notably smaller."""
        self.iterations += iterations
        if self.cost < (1 - NOTABLE) * self.mark:
            self.mark, self.idle = self.cost, 0
        else:
            self.idle += iterations

    def _spread(self) -> list[np.ndarray]:
        """Points that fill the box evenly, ``(d,)`` each."""
        shares = qmc.Halton(len(self.low), scramble=False).random(STARTS + 1)[1:]  # the first is a corner
        return list(self.low + shares * self._width)

    def first_std(self, box: SearchBox, significance: float = 0.0) -> np.ndarray:
        """Return a first guess of σ, ``(d,)``: the variances that explain the residuals' excess over C.

        One scoring step from σ = 0 in the linear model, with variances kept non-negative. Where the
        residuals do not exceed C, by ``significance`` standard errors, there is nothing to explain, and σ
        begins at its floor; else no lower than a hundredth of the width, from which it can still go either way.
        """
        if not len(self.excess):
            return np.clip(box.width / 40, box.min_std, box.max_std)
        if (self.excess <= significance * np.sqrt(2 * np.diag(self.squares))).all():
            return box.min_std.copy()
        scale = np.sqrt(np.maximum(np.diag(self.squares), 1e-300))
        variances = scipy.optimize.nnls(self.squares / np.outer(scale, scale), self.excess / scale)[0] / scale
        return np.clip(np.sqrt(variances), np.maximum(box.width / 100, box.min_std), box.max_std / 2)

    @property
    def reduced_chi2(self) -> float:
        """The residuals' mean square in units of C, over what μ leaves free; 1 if C tells. Losses do not count."""
        if self.shape is None:
            return 1.0
        transitions, columns = self.shape
        freedom = (transitions - self.lost) * columns - len(self.low)
        return float(2 * self.cost / max(1.0, freedom))

    @property
    def _width(self) -> np.ndarray:
        return self.high - self.low

    @property
    def _center(self) -> np.ndarray:
        """The candidate, or the point itself before there is one, ``(d,)``."""
        return self.point if self.candidate is None else self.candidate

    @property
    def steps(self) -> np.ndarray:
        """Signed steps of the candidate's differences, which stay inside the box, ``(d,)``."""
        step = DIFFERENCE_STEP * self._width
        return np.where(self._center + step > self.high, -step, step)


def normal_equations(
    features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor, steps: torch.Tensor, robust: bool = False
) -> torch.Tensor:
    """Return cost, gradient and Gauss-Newton matrix of ½ Σ rᵀC⁻¹r, and two moments for σ, ``(2 + 2d + 2d²,)``.

    The robust cost is ½ (ν + m) Σ log(1 + rᵀC⁻¹r / ν), whose matrix is that of the reweighted squares.

    The order is cost, transitions lost, gradient, Σ (JᵀC⁻¹r)² − diag JᵀC⁻¹J, Gauss-Newton matrix, Σ (JᵀC⁻¹J)².

    Args:
        features: at μ, then at μ + stepᵢeᵢ, ``(t, d + 1, m)``.
        measured: ``(t, m)``.
        covariance: ``(t, m, m)``.
        steps: ``(d,)``.
        robust: whether the cost is the robust one.
    """
    base, moved = features[:, 0], features[:, 1:]
    alive = torch.isfinite(base).all(-1)
    lost = (~alive).sum().to(base.dtype)
    jacobian = torch.nan_to_num((moved - base[:, None]) / steps[:, None])  # a diverged column says nothing
    jacobian = torch.where(alive[:, None, None], jacobian, 0.0)
    residual = torch.where(alive[:, None], measured - base, 0.0)
    factor = robust_cholesky(covariance)
    both = torch.cat([residual[..., None], jacobian.mT], -1)
    white = torch.linalg.solve_triangular(factor, both, upper=False)  # (t, m, 1 + d)
    chi2 = white[..., 0].square().sum(-1)
    cost = 0.5 * chi2.sum()
    if robust:
        freedom = STUDENT_DOF + white.shape[1]
        cost = 0.5 * freedom * torch.log1p(chi2 / STUDENT_DOF).sum()
        white = white * (freedom / (STUDENT_DOF + chi2)).sqrt()[:, None, None]
    r, jac = white[..., 0], white[..., 1:]
    gradient = -(jac * r[..., None]).sum((0, 1))
    flat = jac.flatten(0, 1)
    gram = jac.mT @ jac
    pulled = (jac.mT @ r[..., None])[..., 0]
    excess = (pulled.square() - torch.diagonal(gram, dim1=-2, dim2=-1)).sum(0)
    parts = (cost, lost, gradient, excess, flat.T @ flat, gram.square().sum(0))
    return torch.cat([part.flatten() for part in parts])
