"""What both parts of the Hopper study share: how large they are, the methods, and how a log is fitted and compared."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch

from dropo_torch.baselines import fit_problem
from dropo_torch.problem import Problem

from . import LINKS
from .record import HopperLog

#: Methods of Table 1, with BayesSim's features.
METHODS = (("dropo", ""), ("droid", ""), ("bayessim", "mdnn"), ("bayessim", "mdrff"))
#: The parameter that is none where the model is wrong.
UNMODELED = "torso_mass"


@dataclass(frozen=True)
class Size:
    """How large a part of the study is.

    Attributes:
        seeds: logs of each kind.
        episodes, steps: of a log, and transitions of each.
        samples: K.
        droid_budget: simulations of the log by DROID.
        simulations, horizon: of BayesSim, and the logged steps that it replays.
        backend: of all fits. The logs are MuJoCo's own.
    """

    seeds: int = 3
    episodes: int = 2
    steps: int = 500
    samples: int = 100
    droid_budget: int = 2000
    simulations: int = 1000
    horizon: int = 50
    backend: Literal["mujoco", "warp"] = "warp"


def method_keys(method: str, features: str, size: Size) -> dict[str, Any]:
    """Return what a config says of its method, with BayesSim's features, and of the simulations."""
    options = {
        "droid": {"budget": size.droid_budget},
        "bayessim": {"simulations": size.simulations, "horizon": size.horizon, "features": features or "mdnn"},
    }
    return {
        "method": method,
        "method_options": options.get(method, {}),
        "backend": size.backend,
        "samples": size.samples,
    }


def fitted(problem: Problem, log: HopperLog) -> dict[str, Any]:
    """Fit a log, and return what was found beside what is true."""
    begun = time.monotonic()
    fit = fit_problem(problem)
    seconds = time.monotonic() - begun
    return {
        "truth": truth_of(log),
        "transitions": len(log.actions),
        "wall_seconds": round(seconds, 3),
        "fit": fit.document(),
    }


def truth_of(log: HopperLog) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation of the masses that were in force in a log."""
    drawn = zip(LINKS, log.masses.T, strict=True)
    return {f"{link}_mass": {"mean": float(m.mean()), "std": float(m.std())} for link, m in drawn}


def mse_at(problem: Problem, values: Mapping[str, float]) -> float:
    """Return the mean squared error of the log's predicted ends at values of the parameters."""
    row = [values[name] for name in problem.simulator.parameters.names]
    two = torch.tensor([[row, row]], dtype=torch.float64)  # a likelihood needs two samples; both are the same
    return problem.objective.evaluate_values(two)[0].mse
