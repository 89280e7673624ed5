"""Choosing ε by the elbow: raise it until the mean simulated next state fits no better.

Or, where initial states are as noisy as the ends of transitions: raise the noise of both until the log is no likelier.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.fit import Fit
from dropo_torch.objective import Objective
from dropo_torch.studies.study import Store
from dropo_torch.support.parallel import Workers

SCHEMA = "dropo-torch/sweep/1"
#: An error within this share of the smallest one counts as no larger.
TOLERANCE = 0.05
#: ε beside a noise of initial states and ends, as a share of its variance: the noise stands for all.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class SweepPoint:
    """One fit of a sweep.

    Attributes:
        epsilon: ε.
        mse: mean squared difference between measured and simulated mean.
        log_likelihood: in nats.
        mean, std: the fitted distribution, name → value in its unit.
        robust_log_likelihood: of a sweep with noisy initial states: the one that may be compared between noises, in
            nats.
    """

    epsilon: float
    mse: float
    log_likelihood: float
    mean: dict[str, float]
    std: dict[str, float]
    robust_log_likelihood: float | None = None

    @classmethod
    def of(cls, epsilon: float, fit: Fit, *, noisy_starts: bool = False) -> SweepPoint:
        """Return what a sweep keeps of a fit."""
        summary = fit.distribution.summary()
        mean, std = ({name: entry[key] for name, entry in summary.items()} for key in ("mean", "std"))
        return cls(epsilon, fit.mse, fit.log_likelihood, mean, std, fit.log_likelihood if noisy_starts else None)


@dataclass(frozen=True)
class Sweep:
    """All fits of a sweep, by rising ε, the ε chosen and why.

    Attributes:
        points: the fits.
        chosen: the ε to use; with noisy initial states the variance of the noise.
        reason: why, in words.
        noisy_starts: whether ε stood for the variance of initial states and ends alike.
    """

    points: tuple[SweepPoint, ...]
    chosen: float
    reason: str
    noisy_starts: bool = False

    def document(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``."""
        return {"schema": SCHEMA} | asdict(self)


def elbow(epsilons: Sequence[float], errors: Sequence[float]) -> tuple[float, str]:
    """Return the ε beyond which the error no longer falls, and the reason in words.

    Errors at a smaller ε that are as small by chance, with larger ones between, do not count.

    Args:
        epsilons: rising values.
        errors: mean squared errors of the fits at them; one that is not finite never counts as small.

    Raises:
        InputError: no error is finite.
    """
    errors = [e if math.isfinite(e) else math.inf for e in errors]
    best = min(errors)
    if math.isinf(best):
        raise InputError("epsilons: no fit at any of them predicts the log; see what `dropo fit` says about it")
    slack = TOLERANCE * best + 0.01 * min(epsilons)
    first = errors.index(best)
    while first > 0 and errors[first - 1] <= best + slack:
        first -= 1
    chosen = epsilons[first]
    if first == 0:
        return chosen, (
            f"the error is as small at the smallest value tried ({errors[0]:.3g}) as at any larger one, so {chosen:g} "
            "or less: the simulation explains the log with next to no noise"
        )
    if first == len(epsilons) - 1:
        return chosen, (
            f"the error still falls at the largest value tried ({errors[-1]:.3g}); the elbow may lie above {chosen:g}: "
            "sweep further"
        )
    return chosen, (
        f"raising it to {chosen:g} brings the error down to {errors[first]:.3g}; no larger value lowers it by more "
        f"than {100 * TOLERANCE:g} %"
    )


def likeliest(epsilons: Sequence[float], log_likelihoods: Sequence[float]) -> tuple[float, str]:
    """Return the variance of the noise beyond which the log is no likelier, and the reason in words.

    Args:
        epsilons: rising values.
        log_likelihoods: robust ones of the fits at them, in nats; one that is not finite is never the largest.

    Raises:
        InputError: none is finite.
    """
    values = [v if math.isfinite(v) else -math.inf for v in log_likelihoods]
    best = values.index(max(values))
    if math.isinf(values[best]):
        raise InputError("epsilons: no fit at any of them predicts the log; see what `dropo fit` says about it")
    chosen = epsilons[best]
    if best == 0:
        return chosen, f"no larger noise makes the log likelier: its variance is {chosen:g} or less"
    if best == len(epsilons) - 1:
        return chosen, f"the log still becomes likelier at the largest value tried, {chosen:g}: sweep further"
    below, above = (values[best] - values[i] for i in (best - 1, best + 1))
    return chosen, (
        f"with noise of variance {chosen:g} on initial states and ends the log is likeliest, by {below:.3g} nats "
        f"against {epsilons[best - 1]:g} and {above:.3g} against {epsilons[best + 1]:g}"
    )


def epsilon_keys(given: float | Sequence[float], epsilon: float) -> dict[str, Any]:
    """Return the config's ``epsilon``: the value, or values of that geometric mean in the ratios of those given."""
    if not isinstance(given, Sequence):
        return {"epsilon": epsilon}
    ratios = np.asarray(given) / np.exp(np.mean(np.log(given)))
    return {"epsilon": [float(f"{epsilon * ratio:.4g}") for ratio in ratios]}


def noise_keys(objective: Objective, variance: float) -> dict[str, Any]:
    """Return the config's ``noise`` and ``epsilon`` for a variance of every measurement, in compared features."""
    noise = objective.noise_of(variance)
    return {"noise": noise[0] if len(set(noise)) == 1 else noise, "epsilon": NEGLIGIBLE * variance}


def default_epsilons(measured: np.ndarray) -> list[float]:
    """Return nine values of ε, a decade apart, up to about a tenth of the measured columns' variance ``(T, m)``."""
    top = math.ceil(math.log10(max(float(np.mean(np.var(measured, axis=0))), 1e-12))) - 1
    return [10.0**k for k in range(top - 8, top + 1)]


def rising(epsilons: Sequence[float]) -> list[float]:
    """Return the values to try, each once, in rising order.

    Raises:
        InputError: fewer than three values, or one that is not positive.
    """
    values = sorted({float(e) for e in epsilons})
    if len(values) < 3 or not all(0 < value < math.inf for value in values):
        raise InputError(f"epsilons: {list(epsilons)} given; expected three or more positive numbers")
    return values


def sweep_epsilon(
    point_at: Callable[..., SweepPoint],
    epsilons: Sequence[float],
    *,
    noisy_starts: bool = False,
    fingerprint: str = "",
    store: Path | None = None,
    workers: Workers = 1,
    on_point: Callable[[SweepPoint], None] = lambda point: None,
) -> Sweep:
    """Fit at each ε and choose by the elbow, or with noisy initial states by the robust log-likelihood.

    Args:
        point_at: fits at an ε: ``point_at(epsilon, threads=...)``; where there are several workers it is pickled.
        epsilons: the values to try.
        noisy_starts: whether ε stands for the variance of initial states and ends alike; its points are then judged by
            their robust log-likelihood.
        fingerprint: identifies config and log.
        store: file in which finished fits are kept; those of the same fingerprint are not repeated.
        workers: processes that fit side by side, or ``"ray"``. The result does not depend on it.
        on_point: called after each fit.

    Raises:
        InputError: fewer than three values, or one that is not positive.
    """
    values = rising(epsilons)
    kept = Store(store, fingerprint + ("-noisy-starts" if noisy_starts else ""), "sweep", SweepPoint)
    points = tuple(kept.results({repr(value): value for value in values}, point_at, workers, on_point))
    if noisy_starts:
        robust = [math.nan if p.robust_log_likelihood is None else p.robust_log_likelihood for p in points]
        chosen, reason = likeliest(values, robust)
    else:
        chosen, reason = elbow(values, [p.mse for p in points])
    return Sweep(points, chosen, reason, noisy_starts)
