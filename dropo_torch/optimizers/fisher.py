"""Gauss-Newton on the means, then Fisher scoring on means and standard deviations: forward simulations suffice."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import torch

from dropo_torch.objective import Objective
from dropo_torch.optimizers.ascent import Ascent
from dropo_torch.optimizers.base import LikelihoodOptimizer, Progress, Request
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.sampled import SampledStage
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.optimizers.sigma_points import SigmaPointStage
from dropo_torch.support.random import stratified_uniforms

#: Refits of a log with uncertain initial states, each around their noise propagated at the last fit.
NOISY_ROUNDS = 6
#: The means have converged when no refit moves them by more than this share of their box.
AT_REST = 1e-3
#: Iterations of the means that may gain little.
PATIENCE = 8
#: Change of σ, as a share of it or of 1/20 of the search width, below which it has converged; and how often it is
#: fitted anew.
CONVERGED = 0.1
SPREAD_ROUNDS = 3


class FisherOptimizer(LikelihoodOptimizer):
    """Gauss-Newton on μ, then Fisher scoring on (μ, log σ); the default.

    On a log whose initial states are noisy, the noise is propagated at the current μ and the means are
    refitted until convergence; the scoring then works on that covariance. Where the
    simulation bends within the distribution, the scoring goes on over ``samples`` samples.

    With ``entropy`` β, the scoring maximizes the log-likelihood plus β Σ log σ: the entropy of p_φ but for a
    constant, as in E-DROPO (arXiv 2506.10133). It keeps σ open where the log alone would close it.

    Args:
        objective: its size, its parameters and whether it is noisy are used; it is not evaluated here.
        settings: samples, seed and entropy.
    """

    name = "fisher"
    STATE: ClassVar[tuple[str, ...]] = ("_means", "_scoring", "_round", "_linearised", "_explained", "_spread_round")
    KINDS = (MeansStage, SigmaPointStage, SampledStage)

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        super().__init__(objective, settings)
        self._uniforms = stratified_uniforms(settings.samples, len(self._space), settings.seed, 2)
        self._means = self._means_from(self._box.middle)
        self._scoring: SigmaPointStage | SampledStage | None = None
        self._round = 0
        self._linearised: np.ndarray | None = self._means.point if self._noisy else None
        self._explained: np.ndarray | None = None  # σ of the last round, which no window need be widened for
        self._spread_round = 0

    def ask(self) -> Request:
        """Return the points of the stage at work."""
        stage = self._scoring or self._means
        return Request(
            values=self._box.values(stage.points()),
            reduce=stage.reduction(),
            evaluations=1,
            linearise_at=self._linearised,
            linearise_std=self._explained,
            is_stencil=stage is self._means,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Hand the sums to the stage at work, and change stages when it has finished."""
        stage = self._scoring
        if stage is None:
            self._means.tell(sums)
            if self._means.reason is not None:
                self._after_means()
            return
        if self._settings.entropy:
            sums = stage.with_entropy(sums, self._settings.entropy)
        stage.tell(sums)
        if stage.reason is not None and isinstance(stage, SigmaPointStage) and stage.misleads:
            self._scoring = SampledStage(self._box, stage.mean, stage.std, uniforms=self._uniforms)
        elif stage.reason is not None and self._noisy:
            self._refit_if_moved(stage)

    @property
    def stop_reason(self) -> str | None:
        """The last stage's reason, in words."""
        return None if self._scoring is None else self._scoring.reason

    @property
    def progress(self) -> Progress:
        """Stage, best log-likelihood of that stage and a guess of the share done."""
        if self._scoring is not None:
            share = self._scoring.BEGUN_AT + 0.3 * min(1.0, self._scoring.iterations / 10)
            return Progress(self._scoring.TITLE, self._scoring.log_likelihood, share)
        done = self._round / (NOISY_ROUNDS + 1) if self._noisy else 0.0
        share = 0.4 * (done + (1 - done) * min(1.0, self._means.iterations / 10))
        return Progress("Gauss-Newton on the means", math.nan, share)

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the φ at which the last stage stopped."""
        stage = self._scoring
        return [(self._means.point, self._box.min_std) if stage is None else (stage.mean, stage.std)]

    def _means_from(self, point: np.ndarray) -> MeansStage:
        """The stage of the means; where they gain little, σ has to explain what is left, and the scoring moves both."""
        return MeansStage(self._box.low, self._box.high, point, robust=True, patience=PATIENCE)

    def _after_means(self) -> None:
        """Refit the means around the noise propagated at them until convergence, then go on to σ."""
        point, before = self._means.point, self._linearised
        if before is not None:
            self._linearised = point
            converged = bool((np.abs(point - before) <= AT_REST * self._box.width).all())
            if self._round < NOISY_ROUNDS and not converged:
                self._round += 1
                self._means = self._means_from(point)
                return
        self._scoring = SigmaPointStage(self._box, point, self._means.first_std(self._box))

    def _refit_if_moved(self, stage: Ascent) -> None:
        """Refit around noise whose windows are widened for what σ does not explain either, until σ has converged.

        The first fit takes what varies for outliers. It so finds a σ that is too small, but none where there is none:
        from there it grows.
        """
        before = self._box.min_std if self._explained is None else self._explained
        converged = bool((np.abs(stage.std - before) <= CONVERGED * np.maximum(stage.std, self._box.width / 20)).all())
        if self._spread_round < SPREAD_ROUNDS and not converged:
            self._spread_round += 1
            self._linearised, self._explained = stage.mean, stage.std
            self._scoring = SigmaPointStage(self._box, stage.mean, stage.std)
