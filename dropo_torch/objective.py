"""The objective: the likelihood of one log under one simulator, as a function of φ.

It simulates in chunks whose size does not depend on T·K, and sums what a reduction makes of each.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Replay, Transitions
from dropo_torch.distribution import SearchBox, base_uniforms, to_values, values_from_uniforms
from dropo_torch.errors import InputError, choices
from dropo_torch.likelihood import (
    LogDensity,
    gaussian_log_density,
    likelihood_with_losses,
    propagate,
    rotation_vector,
    student_log_density,
    widening,
)
from dropo_torch.simulators.base import Simulator

#: Antithetic pairs of start noise per noisy column, and their seed.
NOISE_DRAWS = 2
NOISE_SEED = 4

#: ``reduce(features (t, P, m), measured (t, m), covariance (t, m, m)) -> (r,)``, summed over chunks.
Reduce = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
#: ``reduce(features (w, P, H, m), measured (w, H, m), controls (w, H, nu)) -> (r,)``, summed over replayed windows.
ReplayReduce = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Evaluation:
    """The sampled objective at one φ.

    Attributes:
        log_likelihood: sum over the log's transitions, in nats.
        mse: mean squared difference between measured and simulated mean, over features and those transitions
            of which at least two samples did not diverge.
        diverged: number of simulations that diverged.
        simulated_transitions: logged steps that were simulated for it.
    """

    log_likelihood: float
    mse: float
    diverged: int
    simulated_transitions: int


class Objective:
    """The likelihood of one log under one simulator.

    *Features* are what the Gaussians compare: the observed columns without the masked ones, each
    divided by its scale, and for each observed quaternion the rotation vector from its measured to its
    simulated value (measured value 0) after the other columns.

    Args:
        simulator: simulates the transitions.
        transitions: the log's windows.
        observation: what the log's columns are.
        epsilon: ε, variance added to each feature, scalar or one per feature; after scaling.
        noise: standard deviation of the measurement in each observed column, scalar or one per
            column; the start states are then uncertain too. ``None``: starts are exact.
        mask: labels (or numbers) of observed columns which the likelihood leaves out.
        scaling: divide each column by its standard deviation over the log.
        chunk_size: rows (transition, parameter vector) held at once.

    Raises:
        InputError: ε or noise that is not positive or has the wrong length; a masked column that is none.
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
        chunk_size: int = 20_000,
    ) -> None:
        self.simulator = simulator
        self.transitions = transitions
        self.observation = observation
        self.box = SearchBox.of(simulator.parameters)
        self.simulated_transitions = 0
        self.linearised_at: np.ndarray | None = None
        self._chunk_size = chunk_size
        self._states = torch.from_numpy(np.ascontiguousarray(transitions.states, dtype=np.float64))
        self._controls = torch.from_numpy(np.ascontiguousarray(transitions.controls, dtype=np.float64))
        measured = torch.from_numpy(np.ascontiguousarray(transitions.measured, dtype=np.float64))
        quaternions = [q for q in observation.quaternions if not masked_columns(observation, mask) & set(q)]
        taken = {c for q in observation.quaternions for c in q} | masked_columns(observation, mask)
        self._plain = [c for c in range(observation.size) if c not in taken]
        self._quaternions = [list(q) for q in quaternions]
        if not self._plain and not self._quaternions:
            raise InputError("mask: every column is masked; leave at least one")
        self.labels = tuple(observation.labels[c] for c in self._plain) + tuple(
            f"{observation.labels[q[0]].split('[')[0]}.rotation[{axis}]" for q in self._quaternions for axis in "xyz"
        )
        self.units = tuple(observation.units[c] for c in self._plain) + ("rad",) * (3 * len(self._quaternions))
        self.scale = (
            _scales(measured[:, self._plain], len(self._quaternions))
            if scaling
            else torch.ones(self.num_features, dtype=torch.float64)
        )
        self._column_scale = _scales(measured, 0) if scaling else torch.ones(observation.size, dtype=torch.float64)
        self._raw = measured
        self.measured = self.features(measured, measured)
        self.epsilon = _per_entry("epsilon", epsilon, self.num_features, "feature", self.labels)
        self.noise = (
            None if noise is None else _per_entry("noise", noise, observation.size, "column", observation.labels)
        )
        if self.noise is not None and not bool(self.noise.any()):
            self.noise = None  # no noise in any column: the starts are exact
        self._noise_covariance: torch.Tensor | None = None
        self._noise_shift: torch.Tensor | None = None
        self.linearised_std: np.ndarray | None = None
        self.widening: torch.Tensor | None = None

    def on(self, transitions: Transitions) -> Objective:
        """Return the same objective over other transitions of the same log, not yet linearised."""
        other = copy.copy(self)
        other.transitions = transitions
        other._states = torch.from_numpy(np.ascontiguousarray(transitions.states, dtype=np.float64))
        other._controls = torch.from_numpy(np.ascontiguousarray(transitions.controls, dtype=np.float64))
        other._raw = torch.from_numpy(np.ascontiguousarray(transitions.measured, dtype=np.float64))
        other.measured = other.features(other._raw, other._raw)
        other.simulated_transitions = 0
        other.linearised_at, other._noise_covariance, other._noise_shift = None, None, None
        other.linearised_std, other.widening = None, None
        return other

    @property
    def num_features(self) -> int:
        """Number of features m."""
        return len(self._plain) + 3 * len(self._quaternions)

    def __len__(self) -> int:
        """Return the number of transitions T."""
        return len(self.transitions)

    def features(self, observed: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Return features ``(..., m)`` of observed columns ``(..., n)`` beside their measured values."""
        parts = [observed[..., self._plain]]
        for q in self._quaternions:
            parts.append(rotation_vector(measured[..., q].expand_as(observed[..., q]), observed[..., q]))
        return torch.cat(parts, -1) / self.scale

    def map(self, values: np.ndarray | torch.Tensor, reduce: Reduce, rows: np.ndarray | None = None) -> torch.Tensor:
        """Simulate transitions under parameter values ``(P, d)`` and sum ``reduce`` over chunks.

        The chunks do not depend on the number of threads, and neither does the sum.

        Args:
            values: parameter values in their units, ``(P, d)``.
            reduce: what to sum.
            rows: the transitions to simulate; ``None`` for all of them.
        """
        values = torch.as_tensor(np.asarray(values), dtype=torch.float64)
        chosen = None if rows is None else torch.as_tensor(rows)
        total: torch.Tensor | None = None
        for block in _blocks(len(self) if rows is None else len(rows), max(1, self._chunk_size // max(1, len(values)))):
            picked = block if chosen is None else chosen[block]
            with single_thread():  # the simulator has threads of its own; torch's would only get in their way
                features = self._simulate(self._states[picked], picked, values)
                part = reduce(features, self.target(picked), self.base_covariance(picked))
                total = part if total is None else total + part
        assert total is not None
        return total

    def map_replay(self, replay: Replay, values: np.ndarray | torch.Tensor, reduce: ReplayReduce) -> torch.Tensor:
        """Replay windows open loop under parameter values ``(P, d)`` and sum ``reduce`` over them.

        Args:
            replay: the windows: W of H logged steps each.
            values: parameter values in their units, ``(P, d)``.
            reduce: what to sum; a replay that diverges is NaN throughout.
        """
        values = torch.as_tensor(np.asarray(values), dtype=torch.float64)
        states, controls, measured = (torch.from_numpy(x) for x in (replay.states, replay.controls, replay.measured))
        total: torch.Tensor | None = None
        for block in _blocks(len(states), max(1, self._chunk_size // max(1, len(values) * replay.horizon))):
            after = self.simulator.rollout(states[block], controls[block], values)[..., self.observation.index]
            with single_thread():
                logged = measured[block]
                about = logged[:, :1].expand_as(logged) if replay.about_start else logged
                compared = self.features(logged, about)
                features = self.features(after, about[:, None].expand_as(after))
                part = reduce(features, compared, controls[block][:, replay.history :])
                total = part if total is None else total + part
        self.simulated_transitions += len(states) * len(values) * replay.horizon
        assert total is not None
        return total

    @property
    def has_cheaper_jacobian(self) -> bool:
        """Whether one backward pass a column costs less than one simulation a parameter (a pass costs about 1.5)."""
        passes = 1.5 * self.observation.size
        return hasattr(self.simulator, "jacobian") and passes < len(self.simulator.parameters)

    def map_linear(self, values: np.ndarray | torch.Tensor, reduce: Reduce) -> torch.Tensor:
        """Do what :meth:`map` does for vectors close to the first, by exact derivatives there."""
        values = torch.as_tensor(np.asarray(values), dtype=torch.float64)
        directions = torch.eye(self.simulator.num_states, dtype=torch.float64)[self.observation.index]
        total: torch.Tensor | None = None
        for block in _blocks(len(self), max(1, self._chunk_size // (len(directions) + 1))):
            after, slope, _ = self.simulator.jacobian(  # type: ignore[attr-defined]
                self._states[block], self._controls[block], values[:1], directions
            )
            with single_thread():
                base = after[..., self.observation.index]
                observed = base + torch.einsum("tmd,pd->tpm", slope[:, 0], values - values[0])
                features = self.features(observed, self._raw[block][:, None].expand_as(observed))
                part = reduce(features, self.target(block), self.base_covariance(block))
                total = part if total is None else total + part
        self.simulated_transitions += len(self) * len(directions) * self.transitions.lag  # a pass counts as one
        assert total is not None
        return total

    def gradient(
        self, values: np.ndarray | torch.Tensor, reduce: Reduce, rows: np.ndarray | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the sums of ``reduce`` and the gradient of the first one in ``values`` ``(P, d)``.

        Args:
            values: parameter values in their units, ``(P, d)``.
            reduce: as for :meth:`map`.
            rows: the transitions to simulate; ``None`` for all of them.

        Raises:
            InputError: a simulator without gradients.
        """
        if not self.simulator.differentiable:
            raise InputError(f"backend: {self.simulator.name} has no gradients; {self.simulator.remedy}")
        leaf = torch.as_tensor(np.asarray(values), dtype=torch.float64).requires_grad_(True)
        chosen = torch.arange(len(self)) if rows is None else torch.as_tensor(rows)
        total: torch.Tensor | None = None
        slope = torch.zeros_like(leaf)
        for block in _blocks(len(chosen), max(1, self._chunk_size // len(leaf))):
            part = chosen[block]
            with single_thread():  # minibatches are small: more threads cost more than they give
                features = self._simulate(self._states[part], part, leaf)
                sums = reduce(features, self.target(part), self.base_covariance(part))
                if sums.requires_grad:  # it does not where all of them diverge
                    slope += torch.nan_to_num(torch.autograd.grad(sums[0], leaf)[0])
            total = sums.detach() if total is None else total + sums.detach()
        assert total is not None
        return total, slope

    def evaluate(self, mean: np.ndarray, std: np.ndarray, uniforms: torch.Tensor) -> list[Evaluation]:
        """Evaluate the sampled objective at several φ as one batch.

        Args:
            mean, std: μ and σ in coordinates, ``(P, d)`` each.
            uniforms: base uniforms, ``(K, d)`` common to all or ``(P, K, d)``.
        """
        return self.evaluate_values(self.values(mean, std, uniforms))

    def evaluate_values(self, values: torch.Tensor) -> list[Evaluation]:
        """Evaluate the sampled objective of P distributions given by their samples ``(P, K, d)``, in units."""
        num_phi = len(values)
        before = self.simulated_transitions
        sums = self.map(values.reshape(-1, values.shape[-1]), self.likelihood_reduction(num_phi)).reshape(4, num_phi)
        cost = (self.simulated_transitions - before) // num_phi
        found = zip(*sums.tolist(), strict=True)
        return [
            Evaluation(value, squared / (kept * self.num_features) if kept else math.nan, int(lost), cost)
            for value, squared, kept, lost in found
        ]

    def robust_log_likelihood(self, mean: np.ndarray, values: torch.Tensor) -> float:
        """Return the log-likelihood of φ under Student's t distribution, with the noise as it is given.

        The Gaussian one widens what the noise does not explain, window by window, and so hardly tells a noise that is
        too small; this one may be compared between noises.

        Args:
            mean: μ in coordinates, ``(d,)``, at which the starts' noise is propagated.
            values: samples of φ, ``(K, d)``, in units.
        """
        other = self.on(self.transitions)
        other.linearise(mean, widened=False)
        sums = other.map(values, other.likelihood_reduction(1, student_log_density))
        self.simulated_transitions += other.simulated_transitions
        return float(sums[0])

    def values(self, mean: np.ndarray, std: np.ndarray, uniforms: torch.Tensor) -> torch.Tensor:
        """Return parameter values ``(P, K, d)``, in units, of φ ``(P, d)`` and base uniforms."""
        space = self.simulator.parameters
        mu, sigma = (torch.as_tensor(x)[:, None, :] for x in (mean, std))
        return values_from_uniforms(
            uniforms.expand(len(mean), *uniforms.shape[-2:]), mu, sigma, space.limits, space.is_log
        )

    def likelihood_reduction(self, num_phi: int, log_density: LogDensity = gaussian_log_density) -> Reduce:
        """Return the reduction to log-likelihood, squared error, transitions and divergences of P φ, ``(4 P,)``.

        The squared error counts only transitions of which some samples are left.
        """

        def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
            samples = features.unflatten(1, (num_phi, -1))
            values, squared, lost = likelihood_with_losses(
                samples, measured[:, None], covariance[:, None], self._angles, log_density
            )
            return torch.cat([values.sum(0), squared.nansum(0), squared.isfinite().sum(0).double(), lost.sum(0)])

        return reduce

    def target(self, block: slice | torch.Tensor) -> torch.Tensor:
        """Return the measured features ``(t, m)``, less the shift that the start noise gives the prediction."""
        return self.measured[block] if self._noise_shift is None else self.measured[block] - self._noise_shift[block]

    def base_covariance(self, block: slice | torch.Tensor) -> torch.Tensor:
        """Return the covariance of features that no parameter explains, ``(t, m, m)``: ε and the noise."""
        fixed = torch.diag(self.epsilon)
        count = block.stop - block.start if isinstance(block, slice) else len(block)
        if self.noise is None:
            return fixed.expand(count, -1, -1)
        if self._noise_covariance is None:  # not yet linearised: the measured ends' own noise
            return (fixed + torch.diag(self._end_variance())).expand(count, -1, -1)
        return fixed + self._noise_covariance[block]

    def linearise(self, mean: np.ndarray, std: np.ndarray | None = None, *, widened: bool = True) -> None:
        """Propagate the start states' noise through the simulation at μ ``(d,)``, in coordinates.

        Statistical linearisation: each start state is simulated from antithetic draws of its noise. The
        mean of the outcomes shifts the prediction. The regression of the outcomes on the draws gives
        G and with it the covariance G diag(ν) Gᵀ, to which the variance that the regression leaves is
        added: a contact that some draws make and others do not. Windows that the result still does
        not explain, nor parameters that vary with deviation σ ``(d,)`` around μ, have their covariance ``widened``, as
        under Student's t distribution. Without noise, nothing happens.
        """
        if self.noise is None:
            return
        values = torch.from_numpy(to_values(np.asarray(mean), self.simulator.parameters.is_log))[None]
        columns = [i for i in range(self.observation.size) if self.noise[i] > 0]
        half = draw_normals(NOISE_DRAWS * len(columns), len(columns), NOISE_SEED)
        draws = torch.cat([torch.zeros(1, len(columns), dtype=torch.float64), half, -half])
        fixed = torch.diag(self.epsilon) + torch.diag(self._end_variance())
        shifts, covariances, factors = [], [], []
        for block in _blocks(len(self), max(1, self._chunk_size // len(draws))):
            features = self._simulate(self._perturbed(block, columns, draws), block, values, copies=len(draws))
            with single_thread():
                outcomes = features.reshape(-1, len(draws), self.num_features)
                shift, covariance = propagate(outcomes, draws)
                centre = torch.nan_to_num(outcomes[:, 0])
                total = covariance + fixed
                spread = 0.0 if std is None else self._spread(block, np.asarray(mean), std)
                factor = widening(self.measured[block] - centre - shift, total + spread)
                if widened:
                    total = total * factor[:, None, None]
            shifts.append(shift)
            covariances.append(total - torch.diag(self.epsilon))
            factors.append(factor)
        self._noise_shift, self._noise_covariance = torch.cat(shifts), torch.cat(covariances)
        self.linearised_at = np.asarray(mean, dtype=np.float64).copy()
        self.linearised_std = None if std is None else np.asarray(std, dtype=np.float64).copy()
        self.widening = torch.cat(factors)

    def varying(self, std: np.ndarray) -> np.ndarray | None:
        """Return σ ``(d,)`` for :meth:`linearise`; ``None`` where each is at its floor, a point estimate."""
        return None if (std <= 2 * self.box.min_std).all() else np.asarray(std)

    def _spread(self, block: slice, mean: np.ndarray, std: np.ndarray) -> torch.Tensor:
        """Covariance of features by parameters that vary with σ around μ, to first order, ``(t, m, m)``."""
        box = self.box
        ends = np.clip(mean + np.concatenate([np.diag(std), -np.diag(std)]), box.low, box.high)
        values = torch.from_numpy(to_values(ends, self.simulator.parameters.is_log))
        features = self._simulate(self._states[block], block, values)
        reach = torch.from_numpy(2 * std / np.maximum(np.diag(ends[: len(std)] - ends[len(std) :]), 1e-300))
        half = torch.nan_to_num(0.5 * (features[:, : len(std)] - features[:, len(std) :]) * reach[:, None])
        return half.mT @ half

    def simulated(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Return the observed columns ``(T, P, n)`` that the simulator gives for values ``(P, d)``, in units."""
        values = torch.as_tensor(np.asarray(values), dtype=torch.float64)
        parts = []
        for block in _blocks(len(self), max(1, self._chunk_size // len(values))):
            states = self.simulator.simulate(self._states[block], self._controls[block], values)
            parts.append(states[..., self.observation.index])
        self.simulated_transitions += len(self) * len(values) * self.transitions.lag
        return torch.cat(parts)

    @property
    def _angles(self) -> int:
        """Number of rotation vectors at the end of the features."""
        return len(self._quaternions)

    def _simulate(
        self, states: torch.Tensor, block: slice | torch.Tensor, values: torch.Tensor, copies: int = 1
    ) -> torch.Tensor:
        """Features ``(t * copies, P, m)`` after the controls of a block of transitions, NaN where diverged."""
        controls, raw = self._controls[block], self._raw[block]
        if copies > 1:
            controls, raw = controls.repeat_interleave(copies, 0), raw.repeat_interleave(copies, 0)
        after = self.simulator.simulate(states, controls, values)[..., self.observation.index]
        self.simulated_transitions += len(states) * len(values) * self.transitions.lag
        return self.features(after, raw[:, None].expand_as(after))

    def _perturbed(self, block: slice, columns: list[int], draws: torch.Tensor) -> torch.Tensor:
        """Start states moved by draws ``(M, c)`` of the noise of c columns, ``(t * M, num_states)``."""
        assert self.noise is not None
        states = self._states[block]
        moved = states[:, None].repeat(1, len(draws), 1)
        for position, column in enumerate(columns):
            moved[..., self.observation.columns[column]] += self.noise[column] * draws[:, position]
        for q in self.observation.quaternions:
            target = self.observation.index[list(q)]
            moved[..., target] = moved[..., target] / moved[..., target].norm(dim=-1, keepdim=True)
        return moved.reshape(-1, states.shape[1])

    @property
    def noise_deviation(self) -> torch.Tensor | None:
        """Standard deviation of the measurement in each feature, ``(m,)``; ``None`` without noise."""
        return None if self.noise is None else self._end_variance().sqrt()

    def noise_of(self, variance: float) -> list[float]:
        """Return the noise of each observed column, ``(n,)``, that gives each feature such a variance.

        Masked columns, which set the start, have noise as the others.
        The inverse of what a given ``noise`` does to the features; quaternions turn by twice their noise.
        """
        deviations = variance**0.5 * self._column_scale
        deviations[[c for q in self.observation.quaternions for c in q]] = 0.5 * variance**0.5
        return deviations.tolist()

    def _end_variance(self) -> torch.Tensor:
        """Variance of the measured features, ``(m,)``; a quaternion's noise ν turns by 2ν."""
        assert self.noise is not None
        plain = self.noise[self._plain]
        turned = [2 * self.noise[q].mean().expand(3) for q in self._quaternions]
        return (torch.cat([plain, *turned]) / self.scale) ** 2


def no_effect(objective: Objective, *, max_transitions: int = 500) -> list[str]:
    """Return the names of parameters that move no compared column of this log.

    Each is moved to 1/4 and 4/5 of its box with the others in the middle, as it is itself for comparison: an effect
    that is even about the middle shows, too. First on transitions spread over the log, then, where nothing moved, on
    all of them.
    """
    box, space = objective.box, objective.simulator.parameters
    d = len(space)
    points = np.repeat(box.middle[None], 2 * d + 1, axis=0)
    points[np.arange(d), np.arange(d)] = box.low + 0.25 * box.width
    points[np.arange(d) + d, np.arange(d)] = box.low + 0.8 * box.width
    values = to_values(points, space.is_log)

    def count_moved(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        moved = features[:, : 2 * d] - features[:, 2 * d :]
        change = torch.nan_to_num(moved, nan=1.0).abs().unflatten(1, (2, d)).amax(1)
        magnitude = 1e-12 * torch.nan_to_num(features).abs().amax((0, 1))
        return (change > magnitude).sum((0, 2)).double()

    spread = np.unique(np.linspace(0, len(objective) - 1, max_transitions).astype(int))
    sparse = objective.on(objective.transitions.select(spread))
    if bool((sparse.map(values, count_moved) > 0).all()):
        return []
    counts = objective.map(values, count_moved)
    return [name for name, count in zip(space.names, counts, strict=True) if count == 0]


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Run torch on one thread, so that sums do not depend on how many there are."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def draw_uniforms(num_samples: int, num_parameters: int, *seeds: int) -> torch.Tensor:
    """Draw base uniforms ``(K, d)`` from a generator of its own, a pure function of the seeds."""
    return base_uniforms(num_samples, num_parameters, torch.Generator().manual_seed(derived_seed(*seeds)))


def derived_seed(*seeds: int) -> int:
    """Return a seed that torch accepts, a pure function of seeds of any size."""
    return int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]) >> 1


def draw_normals(num_draws: int, width: int, seed: int) -> torch.Tensor:
    """Draw standard normals ``(num_draws, width)``, a pure function of the seed."""
    return torch.special.ndtri(draw_uniforms(num_draws, width, seed))


def _blocks(total: int, rows: int) -> Iterator[slice]:
    return (slice(a, min(a + rows, total)) for a in range(0, total, rows))


def masked_columns(observation: Observation, mask: Sequence[str | int]) -> set[int]:
    """Observed columns that the mask names; one column of a quaternion stands for all four."""
    found: set[int] = set()
    for entry in mask:
        if isinstance(entry, int) and not isinstance(entry, bool) and 0 <= entry < observation.size:
            column = entry
        elif str(entry) in observation.labels:
            column = observation.labels.index(str(entry))
        else:
            raise InputError(f"mask: no observed column {entry!r}" + choices(entry, observation.labels))
        found |= next((set(q) for q in observation.quaternions if column in q), {column})
    return found


def _scales(measured: torch.Tensor, num_rotations: int) -> torch.Tensor:
    deviation = measured.std(0, unbiased=False)
    deviation = torch.where(deviation > 0, deviation, torch.ones_like(deviation))
    return torch.cat([deviation, torch.ones(3 * num_rotations, dtype=torch.float64)])


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
    lowest = float(entries.min())
    if not bool(torch.isfinite(entries).all()) or lowest < 0 or (key == "epsilon" and lowest <= 0):
        raise InputError(f"{key}: {given} given; expected positive numbers")
    return entries
