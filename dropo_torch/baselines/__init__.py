"""Other ways from a log to a distribution: DROID, BayesSim, SimOpt, uniform boxes and the Laplace posterior.

Each is an :class:`~dropo_torch.optimizers.Optimizer`, so that one loop runs, reports and resumes them all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dropo_torch.baselines.bayessim import BayesSimOptimizer
from dropo_torch.baselines.droid import DroidOptimizer
from dropo_torch.baselines.laplace import LaplaceOptimizer
from dropo_torch.baselines.mixture import Mixture
from dropo_torch.baselines.settings import METHODS, method_options, method_settings
from dropo_torch.baselines.simopt import SimOptOptimizer
from dropo_torch.baselines.udr import UdrOptimizer
from dropo_torch.config import Config
from dropo_torch.data.trajectory import make_replay
from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, HistoryEntry, fit
from dropo_torch.optimizers import Optimizer, Progress
from dropo_torch.problem import Problem
from dropo_torch.shooting import fit_sensed
from dropo_torch.shooting.posing import is_placeable, posed

__all__ = ["METHODS", "Mixture", "fit_problem", "make_search"]

#: The searches with settings of their own.
_SEARCHES = {kind.method: kind for kind in (BayesSimOptimizer, DroidOptimizer, SimOptOptimizer, UdrOptimizer)}
#: Those that replay the log, and whether replays are compared with the log about each window's start.
_REPLAYED = {"bayessim": True, "simopt": False}


def make_search(problem: Problem) -> Optimizer | None:
    """Return what finds the distribution by the config's ``method``; ``None`` for DROPO's own optimizers.

    Raises:
        InputError: options that the method does not have.
    """
    config, objective = problem.config, problem.objective
    if config.method != "dropo":
        _refuse_options_of_dropo(config)
    settings = method_settings(config.method, config.method_options)
    if config.method not in _SEARCHES:
        return LaplaceOptimizer(objective) if config.method == "laplace" else None
    given: dict[str, Any] = {"settings": settings, "seed": config.seed}
    if config.method in _REPLAYED:
        cut: dict[str, Any] = {"history": objective.transitions.history, "about_start": _REPLAYED[config.method]}
        cut |= {"past": objective.simulator.past, "since": problem.since}
        given["replay"] = make_replay(problem.trajectories, problem.observation, given["settings"].horizon, **cut)
    return _SEARCHES[config.method](objective, **given)


def _refuse_options_of_dropo(config: Config) -> None:
    """Raise an :class:`InputError` for a key that another method would ignore."""
    for key in ("optimizer", "budget", "population", "covariance", "entropy", "adam", "common_random_numbers"):
        given = getattr(config, key)
        if given != Config.model_fields[key].default:
            own = ", ".join(method_options(config.method)) or "none"
            raise InputError(
                f"{key}: {given!r} given, which method: {config.method} does not read; leave it out "
                f"(its method_options are: {own})"
            )


def fit_problem(
    problem: Problem,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    on_progress: Callable[[HistoryEntry, Progress], None] | None = None,
) -> Fit:
    """Fit as the config says: by its method and its options; see :func:`dropo_torch.fit`.

    Where the log does not show the states, they are estimated, too: :func:`dropo_torch.shooting.fit_sensed`; where it
    lacks only where a floating base is, by leg odometry first: :func:`dropo_torch.shooting.posing.posed`.

    Args:
        problem: the config, its model and its log, of :func:`dropo_torch.make_problem`.
        checkpoint: file in which the fit's state is kept after every batch.
        resume: go on from ``checkpoint`` where it exists; the result is that of a run never interrupted.
        on_progress: called after every batch with its entry of the history and how far the search is.

    Raises:
        InputError: options that the method does not have, a parameter without effect on this log, a checkpoint of
            another fit, or ``resume`` without one; of sensors, a model that diverges in every window.
    """
    if is_placeable(problem):
        problem = posed(problem)
    if problem.observation.is_sensed:
        make_search(problem)  # refuses options
        return fit_sensed(problem, checkpoint=checkpoint, resume=resume, on_progress=on_progress)
    settings, search = problem.config.fit_settings(), make_search(problem)
    kept: dict[str, Any] = {"checkpoint": checkpoint, "resume": resume, "fingerprint": problem.fingerprint}
    return fit(problem.objective, settings, search=search, on_progress=on_progress, **kept)
