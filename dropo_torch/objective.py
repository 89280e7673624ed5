"""The objective: the likelihood of one log under one simulator, as a function of φ."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch

from dropo_torch.data.features import Features, masked_columns
from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Transitions
from dropo_torch.distribution import Distribution, SearchBox
from dropo_torch.errors import InputError, choices
from dropo_torch.evaluator import Evaluator, Rows, Sums, Visit
from dropo_torch.initial_noise import InitialStateNoise, propagate_noise
from dropo_torch.likelihood import LogDensity, gaussian_log_density, likelihood_with_losses, student_log_density
from dropo_torch.simulators.base import Simulator

Orientation = Literal["rotation_vector", "angle"]
#: How an orientation enters the likelihood: by its rotation vector, or by the angle alone, as in the paper.
ORIENTATIONS: tuple[Orientation, ...] = ("rotation_vector", "angle")
#: ``reduce(features (t, P, m), measured (t, m), covariance (t, m, m)) -> (r,)``, summed over chunks.
Reduce = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Evaluation:
    """The sampled objective at one φ.

    Attributes:
        log_likelihood: sum over the log's transitions, in nats; −∞ where one is lost: fewer than two of its samples did
            not diverge.
        gaussian: the same by eq. 3, which it is on a log without noise.
        remaining: the log-likelihood of the transitions that are not lost.
        mse: mean squared difference between measured and simulated mean, over features and those transitions
            of which at least two samples did not diverge.
        diverged: number of simulations that diverged.
        simulated_transitions: logged steps that were simulated for it.
    """

    log_likelihood: float
    gaussian: float
    remaining: float
    mse: float
    diverged: int
    simulated_transitions: int

    def order(self, bonus: float = 0.0) -> tuple[int, float]:
        """Return what candidates are compared by, the best is largest: nothing outweighs a simulation that diverges.

        Args:
            bonus: what counts beside the log-likelihood.
        """
        value = self.remaining + bonus
        return -self.diverged, -math.inf if math.isnan(value) else value


class Objective:
    """The likelihood of one log under one simulator: a description that no evaluation changes.

    What the Gaussians compare are the :class:`~dropo_torch.data.features.Features` of the observed columns that are not
    masked. Where the measurement is noisy, evaluations take the noise of the initial states as
    :meth:`initial_noise` propagates it at some φ; without it, only the measured next states are noisy.

    Args:
        simulator: simulates the transitions.
        transitions: the log's windows.
        observation: what the log's columns are.
        epsilon: ε, variance added to each feature, scalar or one per feature; after scaling.
        noise: standard deviation of the measurement in each observed column, scalar or one per
            column; initial states are then uncertain too. ``None``: they are exact.
        mask: labels (or numbers) of observed columns which the likelihood leaves out.
        scaling: divide each column by its standard deviation over the log.
        orientation: whether orientations enter by their rotation vectors, or by the angles alone as in the paper.
        chunk_size: rows (transition, parameter vector) held at once.

    Raises:
        InputError: ε that is not positive, noise that is negative, or a wrong number of either; a mask of no column; an
            unknown orientation.
    """

    def __init__(
        self,
        simulator: Simulator,
        transitions: Transitions,
        observation: Observation,
        *,
        epsilon: float | Sequence[float] = 1e-5,
        noise: float | Sequence[float] | None = None,
        mask: Sequence[str | int] = (),
        scaling: bool = False,
        orientation: Orientation = "rotation_vector",
        chunk_size: int = 20_000,
    ) -> None:
        if orientation not in ORIENTATIONS:
            raise InputError(f"orientation: unknown {orientation!r}" + choices(orientation, ORIENTATIONS))
        self.simulator, self.transitions, self.observation = simulator, transitions, observation
        every = Features.of(observation, masked_columns(observation, mask))
        self._every_feature = every.scaled(transitions.measured) if scaling else every
        self.features = self._every_feature.compared()
        self.orientation = orientation
        self.evaluator = Evaluator(simulator, transitions, observation, self.features, chunk_size)
        self.box = SearchBox.of(simulator.parameters)
        self.epsilon = _per_entry("epsilon", epsilon, self.features.size, "feature", self.features.labels)
        given = None if noise is None else _per_entry("noise", noise, observation.size, "column", observation.labels)
        self.noise = given if given is not None and bool(given.any()) else None  # with 0 in all columns there is none
        end = self.feature_noise
        self._fixed = torch.diag(self.epsilon) + (0.0 if end is None else torch.diag(end**2))

    def on(self, transitions: Transitions) -> Objective:
        """Return the same objective over other transitions of the same log."""
        other = copy.copy(self)
        other.transitions, other.evaluator = transitions, replace(self.evaluator, transitions=transitions)
        return other

    def __len__(self) -> int:
        """Return the number of transitions T."""
        return len(self.transitions)

    @property
    def measured(self) -> torch.Tensor:
        """The measured features, ``(T, m)``."""
        return self.evaluator.measured

    @property
    def feature_noise(self) -> torch.Tensor | None:
        """Standard deviation of the measurement in each feature, ``(m,)``; ``None`` without noise."""
        return None if self.noise is None else torch.from_numpy(self.features.feature_noise(self.noise.numpy()))

    def noise_of(self, variance: float) -> list[float]:
        """Return the noise of each observed column, ``(n,)``, that gives each feature such a variance.

        Masked columns, which set the initial state, have noise as the others.
        """
        return self._every_feature.column_noise(np.full(self._every_feature.size, variance**0.5)).tolist()

    def initial_noise(
        self, mean: np.ndarray, std: np.ndarray | None = None, widen: bool = True
    ) -> InitialStateNoise | None:
        """Return the noise of the initial states propagated at μ and σ, in coordinates; ``None`` without noise.

        Args:
            mean: μ, ``(d,)``.
            std: σ, which then counts as explained where windows are widened, ``(d,)``.
            widen: whether to widen what it does not explain, as a search does; else the noise is as given, as the
                objective has it.
        """
        if self.noise is None:
            return None
        return propagate_noise(
            self.evaluator, self.box, mean, std, noise=self.noise, fixed=self._fixed, epsilon=self.epsilon, widen=widen
        )

    def initial_noise_of(self, distribution: Distribution) -> InitialStateNoise | None:
        """Return :meth:`initial_noise` at a distribution's μ, and at its σ unless that is a point estimate's."""
        return self.initial_noise(distribution.mean, self.box.varying(distribution.std))

    def target(self, rows: Rows, initial: InitialStateNoise | None = None) -> torch.Tensor:
        """Return the measured features ``(t, m)``, less the shift that the initial noise gives the prediction."""
        return self.measured[rows] if initial is None else self.measured[rows] - initial.shift[rows]

    def base_covariance(self, rows: Rows, initial: InitialStateNoise | None = None) -> torch.Tensor:
        """Return the covariance of features that no parameter explains, ``(t, m, m)``: ε and the noise."""
        if initial is not None:
            return torch.diag(self.epsilon) + initial.covariance[rows]
        return self._fixed.expand(len(self.measured[rows]), -1, -1)

    def comparing(self, reduce: Reduce, initial: InitialStateNoise | None = None) -> Visit:
        """Return what an evaluator is to make of simulated features, so that they are compared with the log."""
        return lambda features, rows: reduce(features, self.target(rows, initial), self.base_covariance(rows, initial))

    def map(
        self,
        values: np.ndarray | torch.Tensor,
        reduce: Reduce,
        rows: np.ndarray | None = None,
        initial: InitialStateNoise | None = None,
    ) -> Sums:
        """Simulate transitions under parameter values ``(P, d)``, in units, and sum ``reduce`` over chunks."""
        return self.evaluator.map(values, self.comparing(reduce, initial), rows)

    def simulated(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Return the observed columns ``(T, P, n)`` that the simulator gives for values ``(P, d)``, in units."""
        run, vectors = self.evaluator, torch.as_tensor(np.asarray(values), dtype=torch.float64)
        parts = (run.simulator.simulate(run.begun(b), run.controls[b], vectors) for b in run.blocks(len(vectors)))
        return torch.cat([after[..., self.observation.index] for after in parts])

    def values(self, mean: np.ndarray, std: np.ndarray, uniforms: torch.Tensor) -> torch.Tensor:
        """Return parameter values ``(P, K, d)``, in units, of φ ``(P, d)`` and base uniforms."""
        mu, sigma = (torch.as_tensor(x)[:, None, :] for x in (mean, std))
        return self.box.draw(uniforms.expand(len(mean), *uniforms.shape[-2:]), mu, sigma)

    @property
    def log_density(self) -> LogDensity:
        """What the objective makes of a residual and its covariance: eq. 3; Student's t where initial states are noisy.

        A start that is off by half a millimeter may miss a contact: such windows are outliers of any Gaussian.
        """
        return gaussian_log_density if self.noise is None else student_log_density

    def likelihood(self, num_phi: int = 1) -> Reduce:
        """Return the reduction to the sampled objective of P φ, ``(5 P,)``, P entries for each sum.

        The sums are log-likelihood, that of eq. 3, squared error, transitions that are left, and diverged samples.
        Lost transitions, of which fewer than two samples are left, count in the last alone.
        """
        num_angles = len(self.features.quaternions) if self.orientation == "angle" else 0
        return partial(sampled_likelihood, num_phi=num_phi, num_angles=num_angles, log_density=self.log_density)

    def evaluate(
        self, mean: np.ndarray, std: np.ndarray, uniforms: torch.Tensor, initial: InitialStateNoise | None = None
    ) -> list[Evaluation]:
        """Evaluate the sampled objective at several φ as one batch.

        Args:
            mean, std: μ and σ in coordinates, ``(P, d)`` each.
            uniforms: base uniforms, ``(K, d)`` common to all or ``(P, K, d)``.
            initial: noise of the initial states; the objective's own is propagated at each φ's μ, as given.
        """
        return self.evaluate_values(self.values(mean, std, uniforms), initial)

    def evaluate_values(self, values: torch.Tensor, initial: InitialStateNoise | None = None) -> list[Evaluation]:
        """Evaluate the sampled objective of P distributions given by their samples ``(P, K, d)``, in units."""
        sums = self.map(values.flatten(0, 1), self.likelihood(len(values)), initial=initial)
        cost = sums.simulated_transitions // len(values)
        found = []
        for value, gaussian, squared, kept, lost in sums.total.reshape(5, len(values)).T.tolist():
            whole = kept == len(self)
            mse = squared / (kept * self.features.size) if kept else math.nan
            likelihood, eq3 = (value, gaussian) if whole else (-math.inf, -math.inf)
            found.append(Evaluation(likelihood, eq3, value, mse, int(lost), cost))
        return found


def sampled_likelihood(
    simulated: torch.Tensor,
    measured: torch.Tensor,
    covariance: torch.Tensor,
    num_phi: int,
    num_angles: int,
    log_density: LogDensity,
) -> torch.Tensor:
    """Return the sums of :meth:`Objective.likelihood`, ``(5 P,)``, of features ``(t, P K, m)``."""
    values, gaussian, squared, lost = likelihood_with_losses(
        simulated.unflatten(1, (num_phi, -1)), measured[:, None], covariance[:, None], num_angles, log_density
    )
    kept = (simulated.shape[1] // num_phi - lost >= 2).sum(0).double()
    return torch.cat([values.sum(0), gaussian.sum(0), squared.nansum(0), kept, lost.sum(0)])


#: Of ε and of the standard deviation of noise: beyond, a covariance has no digits left beside the other columns'.
LIMITS = {"epsilon": (1e-20, 1e20), "noise": (0.0, 1e10)}


def _per_entry(key: str, given: float | Sequence[float], count: int, what: str, labels: Sequence[str]) -> torch.Tensor:
    """A scalar or list of the config as a tensor ``(count,)`` of positive numbers."""
    try:
        entries = torch.as_tensor(np.asarray(given, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{key}: {given!r} given; expected a number or a list of {count}") from None
    if entries.ndim > 1 or (entries.ndim == 1 and len(entries) != count):
        shape = len(entries) if entries.ndim == 1 else tuple(entries.shape)
        raise InputError(f"{key}: {shape} values given; expected one, or one per {what}: {', '.join(labels)}")
    entries = entries.expand(count).clone()
    low, high = LIMITS[key]
    if not bool(((entries >= low) & (entries <= high)).all()):
        least = "positive numbers" if key == "epsilon" else "numbers of at least 0"
        raise InputError(f"{key}: {given} given; expected {least}, from {low:g} to {high:g}")
    return entries
