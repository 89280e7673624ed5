"""The Laplace posterior of the point estimate: how well the log identifies *one* vector of parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dropo_torch.diagnostics import estimates
from dropo_torch.distribution import Distribution
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.optimizers.fisher import AT_REST, NOISY_ROUNDS
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.parameters import ParameterSpace


class LaplaceOptimizer(Optimizer):
    """Gauss-Newton on the means, and the normal of the likelihood's curvature there.

    The transitions of the log are simulated one by one from their logged states, as for DROPO. The covariance is
    s² (ΣJᵀC⁻¹J)⁻¹ with C of ε and the noise, and s² the reduced χ² of the residuals: ε only weighs the columns, the
    size of the residuals is the log's own. A normal of the box's width is its prior, for what the log does not
    identify. It says how uncertain a fixed vector is, not how much parameters vary.

    Args:
        objective: gives the reduction and the size of the log; it is not evaluated here.
    """

    name = "gauss-newton"
    method = "laplace"
    STATE = ("_means", "_linearised", "_round")
    KINDS = (MeansStage,)

    def __init__(self, objective: Objective) -> None:
        self._box = objective.box
        self._shape = (len(objective), objective.features.size)
        self._means = MeansStage(self._box.low, self._box.high, self._box.middle, self._shape)
        self._linearised: np.ndarray | None = None if objective.noise is None else self._means.point
        self._round = 0

    def ask(self) -> Request:
        """Return the stencil of the means."""
        values, reduce = self._box.values(self._means.points()), self._means.reduction()
        return Request(values, reduce, evaluations=1, linearise_at=self._linearised, is_stencil=True)

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Hand the sums to the means; start anew around noise propagated at them until convergence."""
        self._means.tell(sums)
        before = self._linearised
        if self._means.reason is None or before is None or self._round >= NOISY_ROUNDS:
            return
        point = self._means.point
        if bool((np.abs(point - before) > AT_REST * self._box.width).any()):
            self._round, self._linearised = self._round + 1, point
            self._means = MeansStage(self._box.low, self._box.high, point, self._shape)

    @property
    def stop_reason(self) -> str | None:
        """Why the means stopped."""
        return self._means.reason

    @property
    def progress(self) -> Progress:
        """How far the means may be."""
        done = self._round / (NOISY_ROUNDS + 1) if self._linearised is not None else 0.0
        share = done + (1 - done) * min(1.0, self._means.iterations / 10)
        return Progress("Gauss-Newton on the means", float("nan"), share)

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the point estimate and its standard errors."""
        error, _ = self._posterior()
        return [(self._means.point, np.maximum(error, self._box.min_std))]

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the posterior with its correlation."""
        (mean, std), (_, correlation) = self.candidates()[0], self._posterior()
        return [Distribution.over(space, mean, std, correlation=correlation)]

    def extras(self) -> dict[str, Any]:
        """Return the reduced χ², 1 where ε (and the noise) are as large as the residuals."""
        return {"reduced_chi2": self._means.reduced_chi2}

    def _posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard errors ``(d,)`` and correlations ``(d, d)``."""
        d = len(self._box.low)
        if not self._means.hessian.any():  # nothing has been simulated yet, or nothing survived
            return self._box.width.copy(), np.eye(d)
        width = np.outer(self._box.width, self._box.width)
        scale = self._means.reduced_chi2
        shared = self._means.hessian * width + scale * np.eye(d)  # in widths: the prior has σ = 1
        error, correlation = estimates(shared)
        return np.sqrt(scale) * error * self._box.width, correlation
