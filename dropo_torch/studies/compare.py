"""One objective, one log, several optimizers and backends: what each finds, and what it costs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.errors import InputError, choices
from dropo_torch.fit import Fit
from dropo_torch.objective import Objective
from dropo_torch.studies.study import Store
from dropo_torch.support.parallel import Workers
from dropo_torch.support.random import draw_uniforms

SCHEMA = "dropo-torch/compare/1"
#: optimizer-backend pairs that are compared.
METHODS = ("fisher-mujoco", "fisher-warp", "adam-warp", "cma-mujoco", "cma-warp")
#: Points of a run's history whose sampled likelihood is computed for the curves.
CURVE_POINTS = 12


@dataclass(frozen=True)
class CurvePoint:
    """A run at one moment.

    Attributes:
        simulated_transitions: logged steps simulated so far.
        seconds: time spent so far.
        log_likelihood: the sampled objective at the φ of that moment, on draws common to all methods.
        error: largest error of a mean, as a share of its value in the reference; NaN without one.
    """

    simulated_transitions: int
    seconds: float
    log_likelihood: float
    error: float


@dataclass(frozen=True)
class Run:
    """One method on one seed.

    Attributes:
        method: ``optimizer-backend``.
        seed: of the optimizer's random numbers.
        log_likelihood, simulated_transitions, seconds, stop_reason: of the fit.
        mean, std: what was found, name → value in its unit.
        to_percent: simulated transitions until every mean was, and stayed, within 1 % of the reference; or ``None``.
        to_permille: the same for 0.1 %.
        curve: the run's history, thinned.
    """

    method: str
    seed: int
    log_likelihood: float
    simulated_transitions: int
    seconds: float
    stop_reason: str
    mean: dict[str, float]
    std: dict[str, float]
    to_percent: int | None
    to_permille: int | None
    curve: tuple[CurvePoint, ...]


@dataclass(frozen=True)
class Comparison:
    """All runs, and the values that errors are measured against."""

    runs: tuple[Run, ...]
    reference: dict[str, float]
    reference_is: str

    def document(self) -> dict[str, Any]:
        """Return the content of ``compare.json``."""
        return {"schema": SCHEMA} | asdict(self)


def compare(
    fit_with: Callable[..., tuple[Fit, Objective]],
    *,
    methods: Sequence[str],
    seeds: Sequence[int],
    reference: dict[str, float] | None,
    store: Path | None = None,
    fingerprint: str = "",
    workers: Workers = 1,
    on_run: Callable[[Run], None] = lambda run: None,
) -> Comparison:
    """Run every method on every seed.

    Args:
        fit_with: ``fit_with(optimizer, backend, seed, threads=...)`` → the fit and the objective it maximized; where
            there are several workers it is pickled.
        methods: of :data:`METHODS`.
        seeds: of the optimizers' random numbers.
        reference: known values of the parameters; ``None`` for the means of the run with the best likelihood.
        store: file in which finished runs are kept; those of the same fingerprint are not repeated.
        fingerprint: identifies config and log.
        workers: processes that fit side by side, or ``"ray"``. What is found does not depend on it, but seconds do.
        on_run: called after each run.

    Raises:
        InputError: an unknown method.
    """
    for method in methods:
        if method not in METHODS:
            raise InputError(f"methods: unknown {method!r}" + choices(method, METHODS))
    kept: Store[dict[str, Any]] = Store(store, fingerprint, "comparison", dict)

    raw = kept.results(
        {f"{method}/{seed}": (method, seed) for method in methods for seed in seeds},
        functools.partial(_run, fit_with=fit_with),
        workers,
        lambda found: on_run(_judge(found, reference or found["mean"])),
    )
    best = max(raw, key=lambda r: r["log_likelihood"])
    values = reference or best["mean"]
    known = "the values the log was recorded with" if reference else f"the means of {best['method']}, the likeliest run"
    return Comparison(tuple(_judge(r, values) for r in raw), values, known)


def _run(
    task: tuple[str, int], *, fit_with: Callable[..., tuple[Fit, Objective]], threads: int
) -> dict[str, Any]:  # fmt: skip
    """Fit by a method from a seed, and return the run as plain data."""
    method, seed = task
    return _record(method, seed, *fit_with(*method.split("-"), seed, threads=threads))


def _record(method: str, seed: int, fit: Fit, objective: Objective) -> dict[str, Any]:
    """A run as plain data, with the likelihood along its history on draws common to all methods."""
    history = fit.history
    picked = np.unique(np.geomspace(1, len(history), min(CURVE_POINTS, len(history))).astype(int)) - 1
    uniforms = draw_uniforms(fit.samples, len(fit.distribution), fit.seed, 0)
    likelihood = {}
    for i in picked.tolist():
        mean, std = history[i].mean, np.maximum(history[i].std, objective.box.min_std)
        found = objective.evaluate(mean[None], std[None], uniforms, objective.initial_noise(mean, widen=False))[0]
        likelihood[str(i)] = found.log_likelihood
    summary = fit.distribution.summary()
    centers = [type(fit.distribution).over(objective.simulator.parameters, h.mean, h.std).center for h in history]
    return {
        "method": method,
        "seed": seed,
        **{key: getattr(fit, key) for key in ("log_likelihood", "simulated_transitions", "seconds", "stop_reason")},
        **{key: {n: e[key] for n, e in summary.items()} for key in ("mean", "std")},
        "history": [[h.simulated_transitions, h.seconds, *c.tolist()] for h, c in zip(history, centers, strict=True)],
        "likelihood": likelihood,
    }


def _judge(raw: dict[str, Any], reference: dict[str, float]) -> Run:
    """A recorded run with its errors against a reference."""
    values = np.array([reference[name] for name in raw["mean"]])
    history = np.array(raw["history"])
    error = np.max(np.abs(history[:, 2:] - values) / np.maximum(np.abs(values), 1e-12), axis=1)

    def reached(limit: float) -> int | None:
        """Simulated transitions from which the error stays within a limit."""
        first = np.flatnonzero(np.append(True, error > limit))[-1]
        return int(history[first, 0]) if first < len(history) else None

    points = ((int(i), value) for i, value in raw["likelihood"].items())
    curve = tuple(CurvePoint(int(history[i, 0]), float(history[i, 1]), value, float(error[i])) for i, value in points)
    plain = {k: v for k, v in raw.items() if k not in ("history", "likelihood")}
    return Run(**plain, to_percent=reached(1e-2), to_permille=reached(1e-3), curve=curve)
