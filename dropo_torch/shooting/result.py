"""A fit of a log whose states are unknown: parameters with standard errors, and the states that go with them."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.trajectory import make_transitions
from dropo_torch.distribution import Distribution
from dropo_torch.errors import InputError
from dropo_torch.excitation import refuse_dead_parameters
from dropo_torch.fit import Estimated, Fit, HistoryEntry, OnProgress
from dropo_torch.objective import LIMITS, Objective
from dropo_torch.optimizers import Progress
from dropo_torch.problem import Problem
from dropo_torch.shooting.components import uncertainty, unjoined
from dropo_torch.shooting.equations import Normal, Point, Residuals, Scales, residuals, slopes
from dropo_torch.shooting.search import LOOKS, Search, begin, improved
from dropo_torch.shooting.windows import Windows
from dropo_torch.support.checkpoint import Checkpoint
from dropo_torch.support.random import draw_uniforms


def fit_sensed(
    problem: Problem, *, checkpoint: Path | None = None, resume: bool = False, on_progress: OnProgress | None = None
) -> Fit:
    """Fit parameters to a log of sensors together with the states that it does not show.

    The log is cut into windows that follow on each other. Each has an initial state of its own (multiple shooting);
    where it begins about where the one before ends, the closer the better the model joins them. Parameters and states
    are one problem of least squares; measurements are weighed by their noise, given or estimated.

    Args:
        problem: its observation is sensed.
        checkpoint: file in which the state is kept after every look at the residuals.
        resume: go on from ``checkpoint`` where it exists; the result is that of a run never interrupted.
        on_progress: called after every look.

    Raises:
        InputError: a model that diverges in every window, a parameter without effect, a checkpoint that does not fit.
    """
    windows, known = Windows.of(problem), _known_noise(problem)
    kept = None if checkpoint is None else Checkpoint(checkpoint, "fit", _owner(problem, known), (Search, HistoryEntry))
    restored = kept.load() if resume and kept is not None and kept.path.is_file() else None
    search, history = (None, []) if restored is None else (restored["search"], restored["history"])
    begun = time.monotonic() - (history[-1].seconds if history else 0.0)
    if search is None:
        search = begin(windows, problem.config.seed)
        at = residuals(windows, search.point)
        if at.lost.all():
            raise InputError(
                "observation: no initial state was found from which the model can be simulated; check frame_skip, "
                "bounds and the model"
            )
        spent = refuse_dead_parameters(_objective(problem, windows, search.point, search.scales))
        search = replace(search, simulated_transitions=spent)
    while search.reason is None:
        search = improved(windows, search, known)
        at = residuals(windows, search.point)
        progress = Progress("Gauss-Newton on parameters and states", _log_likelihood(at, search.scales), _share(search))
        history = [*history, _entry(search, progress, time.monotonic() - begun, problem.objective)]
        if kept is not None:
            kept.save({"search": search, "history": history})
        if on_progress is not None:
            on_progress(history[-1], progress)
    return _concluded(problem, windows, search, tuple(history), time.monotonic() - begun)


def _concluded(
    problem: Problem, windows: Windows, search: Search, history: tuple[HistoryEntry, ...], seconds: float
) -> Fit:
    """The fit: its standard errors, the objective about the estimated states, and what the residuals say."""
    config, box, scales = problem.config, windows.box, search.scales
    at = residuals(windows, search.point)
    slope = slopes(windows, search.point, at)
    normal = Normal.of(at, slope, scales)
    error, correlation = uncertainty(at, slope, scales, normal)
    error, objective = error * box.width, _objective(problem, windows, search.point, scales)
    is_posterior = config.method == "laplace"
    std = np.maximum(error, box.min_std) if is_posterior else box.min_std
    distribution = Distribution.over(
        problem.space, search.point.mean, std, correlation=correlation if is_posterior else None
    )
    uniforms = draw_uniforms(config.samples, len(distribution), config.seed, 0)
    value = objective.evaluate_values(distribution.rsample(uniforms)[None])[0]
    return Fit(
        distribution=distribution,
        log_likelihood=value.log_likelihood,
        log_likelihood_eq3=value.gaussian,
        mse=value.mse,
        epsilon=tuple(objective.epsilon.tolist()),
        backend=problem.simulator.name,
        optimizer="gauss-newton",
        samples=config.samples,
        seed=config.seed,
        evaluations=search.stencils,
        simulated_transitions=search.simulated_transitions + value.simulated_transitions,
        diverged=value.diverged,
        seconds=seconds,
        stop_reason=search.reason or "",
        history=history,
        method=config.method,
        extras=_extras(windows, at, scales),
        estimated=Estimated(objective, error, correlation, _jumps(windows, at, unjoined(at, slope, scales, normal))),
    )


def _jumps(windows: Windows, at: Residuals, told: np.ndarray) -> tuple[str, ...]:
    """By how much states jump from one window to the next, in words, where that is no accident."""
    size, chart = np.sqrt(np.square(at.links[at.follows]).mean(0)) * windows.sizes, windows.chart
    return tuple(f"{chart.labels[i]} {size[i]:.2g} {chart.units[i]}" for i in np.flatnonzero(told))


def _extras(windows: Windows, at: Residuals, scales: Scales) -> dict[str, Any]:
    """The noise of each column and the joins of states between windows, in their units."""
    moves = np.sqrt(np.square(at.links[at.follows]).mean(0)) if at.follows.any() else np.zeros(len(windows.sizes))
    noise = dict(zip(windows.features.labels, (scales.noise * windows.features.scale).tolist(), strict=True))
    joins = dict(zip(windows.chart.labels, (moves * windows.sizes).tolist(), strict=True))
    return {"windows": {"count": len(windows), "steps": windows.length}, "noise": noise, "joins": joins}


def _objective(problem: Problem, windows: Windows, point: Point, scales: Scales) -> Objective:
    """The likelihood of single transitions from the states that windows lead through, with the noise as ε."""
    log, width = problem.trajectories, point.states.shape[1]
    every = make_transitions(log, problem.observation, history=problem.simulator.history, since=problem.since)
    path, values = np.empty((len(windows), windows.length, width)), windows.box.values(point.mean)[None]
    path[:, 0] = point.states
    for rows in windows.blocks(1):
        path[rows, 1:] = windows.paths(rows, point.states[rows][:, None], values)[:, 0, 0, :-1, :width]
    alive = np.isfinite(path).all((1, 2))
    rows = windows.rows[alive, None] + np.arange(windows.length)
    chosen = every.select(np.searchsorted(every.rows, rows.ravel()))
    states = chosen.states.copy()
    states[:, :width] = path[alive].reshape(-1, width)
    low, high = LIMITS["epsilon"]
    epsilon = np.clip(scales.noise**2, low, high).tolist()
    return Objective(
        problem.simulator, replace(chosen, states=states), problem.observation, epsilon=epsilon,
        mask=problem.config.mask,
    )  # fmt: skip


def _known_noise(problem: Problem) -> np.ndarray | None:
    """The noise of each compared feature as the config has it, ``(m,)``, or ``None``."""
    objective = problem.objective
    return None if objective.noise is None else objective.features.feature_noise(objective.noise.numpy())


def _log_likelihood(at: Residuals, scales: Scales) -> float:
    """The log-likelihood of measurements and joins, but for what the states' uncertainty takes off it."""
    repeats = at.measured.shape[1] // len(scales.noise)
    counted = repeats * (~at.lost).sum() * np.log(scales.noise).sum() + at.follows.sum() * np.log(scales.link).sum()
    constant = 0.5 * math.log(2 * math.pi) * (at.measured[~at.lost].size + at.links[at.follows].size)
    return -at.cost(scales)[1] - float(counted) - constant


def _share(search: Search) -> float:
    """A guess of the share that is done."""
    return 1.0 if search.reason else min(0.95, search.looks / (0.5 * LOOKS))


def _entry(search: Search, progress: Progress, seconds: float, objective: Objective) -> HistoryEntry:
    return HistoryEntry(
        search.stencils, search.simulated_transitions, seconds, progress.log_likelihood, progress.stage,
        search.point.mean, objective.box.min_std,
    )  # fmt: skip


def _owner(problem: Problem, noise: np.ndarray | None) -> tuple[str, ...]:
    """What tells one fit from another."""
    digest = hashlib.sha256(b"" if noise is None else noise.tobytes()).hexdigest()
    return problem.fingerprint, problem.config.method, digest
