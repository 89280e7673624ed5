"""Choosing ε by the elbow: raise it until the mean simulated next state fits no better."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, write_atomically

SCHEMA = "dropo-torch/sweep/1"
#: An error within this share of the smallest one counts as no larger.
TOLERANCE = 0.05


@dataclass(frozen=True)
class SweepPoint:
    """One fit of a sweep.

    Attributes:
        epsilon: ε.
        mse: mean squared difference between measured and simulated mean.
        log_likelihood: in nats.
        mean, std: the fitted distribution, name → value in its unit.
    """

    epsilon: float
    mse: float
    log_likelihood: float
    mean: dict[str, float]
    std: dict[str, float]


@dataclass(frozen=True)
class Sweep:
    """All fits of a sweep, by rising ε, the ε chosen and why."""

    points: tuple[SweepPoint, ...]
    chosen: float
    reason: str

    def document(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``."""
        return {
            "schema": SCHEMA,
            "chosen": self.chosen,
            "reason": self.reason,
            "points": [asdict(p) for p in self.points],
        }


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


def default_epsilons(measured: np.ndarray) -> list[float]:
    """Return nine values of ε, a decade apart, up to about a tenth of the measured columns' variance ``(T, m)``."""
    top = math.ceil(math.log10(max(float(np.mean(np.var(measured, axis=0))), 1e-12))) - 1
    return [10.0**k for k in range(top - 8, top + 1)]


def sweep_epsilon(
    fit_at: Callable[[float], Fit],
    epsilons: Sequence[float],
    *,
    fingerprint: str = "",
    store: Path | None = None,
    on_point: Callable[[SweepPoint], None] | None = None,
) -> Sweep:
    """Fit at each ε and choose by the elbow.

    Args:
        fit_at: fits at an ε.
        epsilons: the values to try.
        fingerprint: identifies config and log.
        store: file in which finished fits are kept; those of the same fingerprint are not repeated.
        on_point: called after each fit.

    Raises:
        InputError: fewer than three values, or one that is not positive.
    """
    values = sorted({float(e) for e in epsilons})
    if len(values) < 3 or not all(0 < value < math.inf for value in values):
        raise InputError(f"epsilons: {list(epsilons)} given; expected three or more positive numbers")
    done = _stored(store, fingerprint)
    for value in values:
        if value in done:
            continue
        result = fit_at(value)
        summary = result.distribution.summary()
        done[value] = SweepPoint(
            epsilon=value,
            mse=result.mse,
            log_likelihood=result.log_likelihood,
            mean={name: entry["mean"] for name, entry in summary.items()},
            std={name: entry["std"] for name, entry in summary.items()},
        )
        if store is not None:
            content = {"fingerprint": fingerprint, "points": [asdict(p) for p in done.values()]}
            write_atomically(store, json.dumps(content).encode())
        if on_point is not None:
            on_point(done[value])
    points = tuple(done[value] for value in values)
    chosen, reason = elbow(values, [p.mse for p in points])
    return Sweep(points, chosen, reason)


def _stored(store: Path | None, fingerprint: str) -> dict[float, SweepPoint]:
    """Finished fits of an earlier, interrupted sweep of the same config and log."""
    if store is None or not store.is_file():
        return {}
    try:
        content = json.loads(store.read_text())
        owner, points = content["fingerprint"], [SweepPoint(**p) for p in content["points"]]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"resume: {store} is no record of a sweep ({error}); start again without --resume") from None
    if owner != fingerprint:
        raise InputError(f"resume: {store} belongs to another config or log; start again without --resume")
    return {p.epsilon: p for p in points}
