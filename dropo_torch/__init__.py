"""Fit a distribution over a simulator's dynamics parameters to a log of the real robot.

>>> import dropo_torch as dropo
>>> problem = dropo.make_problem(dropo.load_config("robot.yaml"))
>>> result = dropo.fit(problem.objective)
>>> result.distribution.save("distribution.json")
"""

from typing import TYPE_CHECKING, Any

from dropo_torch import baselines, gap
from dropo_torch.config import Config, load_config, make_config
from dropo_torch.data.observation import Observation, parse_observation
from dropo_torch.data.preprocess import Preprocess, preprocess
from dropo_torch.data.readers import read_recording, read_trajectories
from dropo_torch.data.recording import Recording
from dropo_torch.data.trajectory import Trajectories, Transitions, make_transitions
from dropo_torch.diagnostics import Diagnostics, diagnose
from dropo_torch.distribution import Distribution
from dropo_torch.effects import Effect, Placed, Quantity
from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, fit
from dropo_torch.likelihood import log_likelihood
from dropo_torch.models.export import export_model
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FitSettings
from dropo_torch.parameters import Parameter, ParameterSpace
from dropo_torch.problem import Problem, make_problem
from dropo_torch.simulators import Simulator, make_simulator

if TYPE_CHECKING:
    from dropo_torch.rl.policy import load_policy


def __getattr__(name: str) -> Any:
    """Import what needs TorchRL, which takes seconds, when it is asked for."""
    if name == "load_policy":
        from dropo_torch.rl.policy import load_policy

        return load_policy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Config",
    "Diagnostics",
    "Distribution",
    "Effect",
    "Fit",
    "FitSettings",
    "InputError",
    "Objective",
    "Observation",
    "Parameter",
    "ParameterSpace",
    "Placed",
    "Preprocess",
    "Problem",
    "Quantity",
    "Recording",
    "Simulator",
    "Trajectories",
    "Transitions",
    "baselines",
    "diagnose",
    "export_model",
    "fit",
    "gap",
    "load_config",
    "load_policy",
    "log_likelihood",
    "make_config",
    "make_problem",
    "make_simulator",
    "make_transitions",
    "parse_observation",
    "preprocess",
    "read_recording",
    "read_trajectories",
]
