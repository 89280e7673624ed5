"""Other ways from a log to a distribution: DROID, BayesSim, SimOpt, uniform boxes and the Laplace posterior.

Each is an :class:`~dropo_torch.optimizers.Optimizer`, so that one loop runs, reports and resumes them all.
"""

from __future__ import annotations

from dropo_torch.baselines.bayessim import BayesSimOptimizer
from dropo_torch.baselines.droid import DroidOptimizer
from dropo_torch.baselines.laplace import LaplaceOptimizer
from dropo_torch.baselines.mixture import Mixture
from dropo_torch.baselines.settings import (
    METHODS,
    BayesSimSettings,
    DroidSettings,
    SimOptSettings,
    UdrSettings,
    method_settings,
)
from dropo_torch.baselines.simopt import SimOptOptimizer, column_scales
from dropo_torch.baselines.udr import UdrOptimizer
from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, fit
from dropo_torch.optimizers import Optimizer
from dropo_torch.problem import Problem
from dropo_torch.trajectory import make_replay

__all__ = ["METHODS", "Mixture", "fit_method", "make_search"]


def make_search(problem: Problem) -> Optimizer | None:
    """Return what finds the distribution by the config's ``method``; ``None`` for DROPO's own optimizers.

    Raises:
        InputError: options that the method does not have.
    """
    config, objective = problem.config, problem.objective
    settings = method_settings(config.method, config.method_options)
    space, seed = problem.space, config.seed
    if isinstance(settings, UdrSettings):
        return UdrOptimizer(space, settings=settings, seed=seed)
    if isinstance(settings, DroidSettings):
        return DroidOptimizer(space, settings=settings, seed=seed)
    if config.method == "laplace":
        return LaplaceOptimizer(objective)
    if isinstance(settings, SimOptSettings | BayesSimSettings):
        history = objective.transitions.history
        replay = make_replay(problem.trajectories, problem.observation, settings.horizon, history=history)
        if isinstance(settings, SimOptSettings):
            return SimOptOptimizer(space, replay, column_scales(objective), settings=settings, seed=seed)
        if replay.horizon < 2:
            raise InputError("method: bayessim needs an episode of two transitions or more; this log has none")
        return BayesSimOptimizer(space, replay, objective.num_features, settings=settings, seed=seed)
    return None


def fit_method(problem: Problem) -> Fit:
    """Fit by a method of this module, without progress or checkpoint.

    Raises:
        InputError: ``method: dropo``, which is :func:`dropo_torch.fit`, and what :func:`make_search` raises.
    """
    search = make_search(problem)
    if search is None:
        raise InputError("method: dropo is fitted by dropo_torch.fit; expected one of " + ", ".join(METHODS[1:]))
    return fit(problem.objective, search=search, samples=problem.config.samples, seed=problem.config.seed)
