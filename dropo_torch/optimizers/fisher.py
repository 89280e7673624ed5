"""Gauss-Newton on the means, then Fisher scoring on means and deviations over sigma points.

Both stages need forward simulations only. The likelihood's Gaussians come from a quadratic
model of the simulation around μ, built from the 2d + 1 points μ and μ ± σᵢeᵢ, which replaces sampling:
with z the truncated standard normal, s(μ + σz) ≈ s₀ + Σ Aᵢzᵢ + ½ Σ Bᵢzᵢ².
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from dropo_torch.distribution import (
    Distribution,
    SearchBox,
    coordinate_limits,
    to_values,
    truncated_interval,
    truncated_moments,
)
from dropo_torch.likelihood import LOST_TRANSITION, gaussian_log_density
from dropo_torch.objective import Reduce, draw_uniforms
from dropo_torch.optimizers.base import Optimizer, Progress, Request, entropy_of
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.sampled import MAX_DAMPING, SampledStage, judge, scoring_step
from dropo_torch.parameters import ParameterSpace

MAX_ITERATIONS = 60
#: Fisher scoring stops after two accepted steps in a row that each gain less than this, in nats.
SMALL_GAIN = 0.01
#: Refits of a log with uncertain starts, each around the start noise propagated at the last fit.
NOISY_ROUNDS = 6
#: The means rest when no refit moves them by more than this share of their box.
AT_REST = 1e-3
#: Change of σ, as a share of it or of 1/20 of the search width, below which it rests; and how often it is fitted anew.
RESTS = 0.1
SPREAD_ROUNDS = 3
#: Curvature that counts for more than this in the likelihood calls for sampling, in nats.
MUCH_BENDING = 1.0


@dataclass
class ScoringStage:
    """Maximises the sigma-point likelihood over μ and log σ.

    Attributes:
        box: bounds of μ and σ in coordinates.
        limits: physical limits in coordinates, low and high, ``(d,)`` each.
        mean, std: the best φ so far, ``(d,)`` each.
    """

    box: SearchBox
    limits: tuple[np.ndarray, np.ndarray]
    mean: np.ndarray
    std: np.ndarray
    damping: float = 1e-2
    log_likelihood: float = -np.inf
    iterations: int = 0
    small_gains: int = 0
    reason: str | None = None
    candidate: tuple[np.ndarray, np.ndarray] | None = None
    sums: np.ndarray | None = None

    def points(self) -> np.ndarray:
        """Return the sigma points of the candidate, ``(2d + 1, d)``: μ, then all μ + σ, then all μ − σ."""
        mean, std = self.candidate or (self.mean, self.std)
        up, down = self._reach(mean, std)
        return np.concatenate([mean[None], mean + np.diag(up), mean - np.diag(down)])

    def reduction(self) -> Reduce:
        """Return the reduction to log-likelihood, scores, Fisher matrices and bending, ``(2 + 2d + 2d²,)``."""
        mean, std = self.candidate or (self.mean, self.std)
        up, down = self._reach(mean, std)
        low, high = self.limits
        a, b = truncated_interval(*(torch.as_tensor(x) for x in (mean, std, low, high)))
        moments = torch.stack(truncated_moments(a, b))
        reach = torch.from_numpy(np.stack([up / std, down / std]))
        sigma = torch.from_numpy(std)

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            return scores(features, measured, covariance, sigma, reach, moments)

        return reduce

    def tell(self, sums: torch.Tensor) -> None:
        """Accept or reject the candidate, and propose the next one."""
        judge(self, sums, small_gain=SMALL_GAIN, max_damping=MAX_DAMPING, max_iterations=MAX_ITERATIONS)
        if self.reason is None:
            self._propose()

    def state(self) -> dict[str, Any]:
        """Return everything but the box and the limits."""
        return {k: v for k, v in vars(self).items() if k not in ("box", "limits")}

    @property
    def bending(self) -> float:
        """Share of the covariance that the simulation's curvature makes, summed over the log, in nats."""
        return 0.0 if self.sums is None else float(self.sums[-1])

    def _propose(self) -> None:
        """Set the next candidate, or stop where the step cannot gain anything."""
        assert self.sums is not None
        d = len(self.mean)
        mean, std = scoring_step(self.mean, self.std, self.sums, self.box, self.damping)
        move = np.concatenate([mean - self.mean, np.log(std / self.std)])
        if float(self.sums[1 : 1 + 2 * d] @ move) < SMALL_GAIN:
            self.reason = f"no step promises {SMALL_GAIN:g} nat"
        self.candidate = (mean, std)

    def _reach(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the sigma points lie above and below μ: σ, less at a physical limit, ``(d,)`` each."""
        low, high = self.limits
        tiny = 1e-9 * self.box.width
        up = np.where(mean + std <= high, std, np.maximum(high - mean, 0))
        down = np.where(mean - std >= low, std, np.maximum(mean - low, 0))
        return np.where(up < tiny, 0, up), np.where(down < tiny, 0, down)


def scores(
    features: torch.Tensor,
    measured: torch.Tensor,
    covariance: torch.Tensor,
    std: torch.Tensor,
    reach: torch.Tensor,
    moments: torch.Tensor,
) -> torch.Tensor:
    """Return log-likelihood, scores, Fisher information of (μ, log σ) and bending, ``(2 + 2d + 2d²,)``.

    Derivatives treat the Jacobian of the simulation as constant.

    Args:
        features: at the sigma points, ``(t, 2d + 1, m)``.
        measured: ``(t, m)``.
        covariance: what no parameter explains, ``(t, m, m)``.
        std: σ, ``(d,)``.
        reach: how many σ the upper and lower points lie away, ``(2, d)``; 0 for a point at a limit.
        moments: E[z], E[z²], E[z⁴] of the truncated standard normal, ``(3, d)``.
    """
    d = len(std)
    alive = torch.isfinite(features).flatten(1).all(-1)
    lost = float((~alive).sum()) * LOST_TRANSITION
    features, measured, covariance = features[alive], measured[alive], covariance[alive]
    base = features[:, 0]
    slope, bend = _divided_differences(base, features[:, 1 : 1 + d], features[:, 1 + d :], reach)
    first, second, fourth = moments[..., None]
    variance = second - first**2
    mean = base + (slope * first + 0.5 * bend * second).sum(1)
    spread = variance.sqrt() * slope
    curved = 0.5 * (fourth - second**2).clamp(min=0).sqrt() * bend
    total = covariance + spread.mT @ spread + curved.mT @ curved
    residual = measured - mean
    value = gaussian_log_density(residual, total).sum() + lost
    solved = torch.linalg.solve(total, torch.cat([residual[:, None], slope], 1).mT)  # C⁻¹[r, A], (t, m, 1 + d)
    weighted = (slope @ solved[..., :1])[..., 0]  # Aᵀ C⁻¹ r
    gram = slope @ solved[..., 1:]  # Aᵀ C⁻¹ A
    v = variance[:, 0]
    score_mean = weighted.sum(0) / std
    drift = (first[:, 0] * weighted).sum(0)  # the mean of z moves with σ where the truncation is lopsided
    score_log = v * (weighted.square() - torch.diagonal(gram, dim1=-2, dim2=-1)).sum(0) + drift
    fisher_mean = gram.sum(0) / torch.outer(std, std)
    fisher_log = 2 * torch.outer(v, v) * gram.square().sum(0) + torch.outer(first[:, 0], first[:, 0]) * gram.sum(0)
    bending = (curved * torch.linalg.solve(total, curved.mT).mT).sum()
    return torch.cat([value[None], score_mean, score_log, fisher_mean.flatten(), fisher_log.flatten(), bending[None]])


def _divided_differences(
    base: torch.Tensor, upper: torch.Tensor, lower: torch.Tensor, reach: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Slopes A and bends B per unit of z, ``(t, d, m)`` each, from points at +p and −q deviations."""
    p, q = reach[0][:, None], reach[1][:, None]
    rise, fall = upper - base[:, None], base[:, None] - lower
    safe_p, safe_q = (torch.where(x > 0, x, torch.ones_like(x)) for x in (p, q))
    right, left = rise / safe_p, fall / safe_q
    both = (p > 0) & (q > 0)
    slope = torch.where(both, (q * right + p * left) / (p + q).clamp(min=1e-300), torch.where(p > 0, right, left))
    bend = torch.where(both, 2 * (right - left) / (p + q).clamp(min=1e-300), torch.zeros_like(slope))
    return slope, bend


class FisherOptimizer(Optimizer):
    """Gauss-Newton on μ, then Fisher scoring on (μ, log σ); the default.

    On a log whose start states are noisy, the noise is propagated at the current μ and the means are
    refitted until they rest; the scoring then works on that covariance. Where the
    simulation bends within the distribution, the scoring goes on over ``samples`` samples; with exact
    gradients of their likelihood where the simulator is ``differentiable``.

    With ``entropy`` β, the scoring maximises the log-likelihood plus β Σ log σ: the entropy of p_φ but for a
    constant, as in E-DROPO (arXiv 2506.10133). It keeps deviations open that the log alone would close.
    """

    name = "fisher"

    def __init__(
        self,
        space: ParameterSpace,
        *,
        samples: int = 100,
        seed: int = 0,
        noisy: bool = False,
        differentiable: bool = False,
        entropy: float = 0.0,
    ) -> None:
        self._space = space
        self._entropy = entropy
        self._differentiable = differentiable and not entropy  # the exact scores know nothing of the bonus
        self._noisy = noisy
        self._box = SearchBox.of(space)
        self._limits = coordinate_limits(space.limits, space.is_log)
        self._uniforms = draw_uniforms(samples, len(space), seed, 2)
        self._means = MeansStage(self._box.low, self._box.high, self._box.middle)
        self._scoring: ScoringStage | None = None
        self._sampled: SampledStage | None = None
        self._round = 0
        self._linearised: np.ndarray | None = self._means.point if noisy else None
        self._explained: np.ndarray | None = None  # σ of the last round, which no window need be widened for
        self._spread_round = 0

    def ask(self) -> Request:
        """Return the points of the stage at work."""
        stage = self._sampled or self._scoring or self._means
        return Request(
            values=to_values(stage.points(), self._space.is_log),
            reduce=stage.reduction(),
            evaluations=1,
            linearise_at=self._linearised,
            linearise_std=self._explained,
            gradient=self._differentiable and stage is self._sampled,
            is_stencil=stage is self._means,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Hand the sums to the stage at work, and change stages when it has finished."""
        if self._sampled is not None:
            self._sampled.tell(self._with_entropy(self._sampled, sums), gradient)
            self._after_deviations(self._sampled)
        elif self._scoring is not None:
            self._scoring.tell(self._with_entropy(self._scoring, sums))
            if self._scoring.reason is not None and self._misleads(self._scoring):
                self._sampled = SampledStage(
                    self._box,
                    self._limits,
                    self._uniforms,
                    self._scoring.mean,
                    self._scoring.std,
                    is_log=self._space.is_log,
                )
            else:
                self._after_deviations(self._scoring)
        else:
            self._means.tell(sums)
            if self._means.reason is not None:
                self._after_means()

    @property
    def stop_reason(self) -> str | None:
        """The last stage's reason, in words."""
        if self._sampled is not None:
            return self._sampled.reason
        return None if self._scoring is None else self._scoring.reason

    @property
    def progress(self) -> Progress:
        """Stage, best log-likelihood of that stage and a guess of the share done."""
        if self._sampled is not None:
            share = 0.7 + 0.3 * min(1.0, self._sampled.iterations / 10)
            return Progress("Fisher scoring on samples", self._sampled.log_likelihood, share)
        if self._scoring is not None:
            share = 0.4 + 0.3 * min(1.0, self._scoring.iterations / 10)
            return Progress("Fisher scoring on sigma points", self._scoring.log_likelihood, share)
        done = self._round / (NOISY_ROUNDS + 1) if self._noisy else 0.0
        return Progress(
            "Gauss-Newton on the means", float("nan"), 0.4 * (done + (1 - done) * min(1.0, self._means.iterations / 10))
        )

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the φ at which the last stage stopped."""
        stage = self._sampled or self._scoring
        return [(self._means.point, self._box.min_std) if stage is None else (stage.mean, stage.std)]

    def state(self) -> dict[str, Any]:
        """Return all stages as plain data."""
        return {
            "means": dict(vars(self._means)),
            "scoring": None if self._scoring is None else self._scoring.state(),
            "sampled": None if self._sampled is None else self._sampled.state(),
            "round": self._round,
            "linearised": self._linearised,
            "explained": self._explained,
            "spread_round": self._spread_round,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._means = MeansStage(**state["means"])
        self._scoring = self._sampled = None
        if state["scoring"] is not None:
            self._scoring = ScoringStage(self._box, self._limits, **state["scoring"])
        if state["sampled"] is not None:
            self._sampled = SampledStage(
                self._box, self._limits, self._uniforms, is_log=self._space.is_log, **state["sampled"]
            )
        self._round, self._linearised = state["round"], state["linearised"]
        self._spread_round, self._explained = state["spread_round"], state["explained"]

    def extras(self) -> dict[str, Any]:
        """Return the weight of the entropy, where there is one."""
        return {"entropy": self._entropy} if self._entropy else {}

    def bonus(self, distribution: Distribution) -> float:
        """Return the weighted entropy."""
        return self._entropy * entropy_of(distribution) if self._entropy else 0.0

    def _with_entropy(self, stage: ScoringStage | SampledStage, sums: torch.Tensor) -> torch.Tensor:
        """Add the bonus to a stage's objective and to its scores of log σ.

        Where it holds a deviation open, residuals are smaller than their covariance, and the likelihood bends by 2β
        where its Fisher information is next to nothing: that is added too, or steps overshoot.
        """
        if not self._entropy:
            return sums
        std = (stage.candidate or (stage.mean, stage.std))[1]
        d, added = len(std), sums.clone()
        added[0] += self._entropy * float(np.log(std).sum())
        added[1 + d : 1 + 2 * d] += self._entropy
        added[1 + 2 * d + d * d : 1 + 2 * d + 2 * d * d].view(d, d).diagonal().add_(2 * self._entropy)
        return added

    def _after_means(self) -> None:
        """Refit the means around the noise propagated at them until they rest, then go on to the deviations."""
        point, before = self._means.point, self._linearised
        if before is not None:
            self._linearised = point
            rests = bool((np.abs(point - before) <= AT_REST * self._box.width).all())
            if self._round < NOISY_ROUNDS and not rests:
                self._round += 1
                self._means = MeansStage(self._box.low, self._box.high, point)
                return
        self._scoring = ScoringStage(self._box, self._limits, point, self._means.deviations(self._box))

    def _after_deviations(self, stage: ScoringStage | SampledStage) -> None:
        """Refit around noise whose windows are widened for what σ does not explain either, until σ rests.

        The first fit takes what varies for outliers. It so finds deviations that are too small, but none where there
        are none: from there they grow.
        """
        if stage.reason is None or not self._noisy or self._spread_round >= SPREAD_ROUNDS:
            return
        before = self._box.min_std if self._explained is None else self._explained
        if bool((np.abs(stage.std - before) <= RESTS * np.maximum(stage.std, self._box.width / 20)).all()):
            return
        self._spread_round += 1
        self._linearised, self._explained = stage.mean, stage.std
        self._scoring, self._sampled = ScoringStage(self._box, self._limits, stage.mean, stage.std), None

    @staticmethod
    def _misleads(stage: ScoringStage) -> bool:
        """Whether sigma points are no good description of the simulation at this φ."""
        return stage.log_likelihood > -np.inf and (stage.bending > MUCH_BENDING or stage.damping > MAX_DAMPING)
