"""Optimizers of φ, each asked for parameter vectors to simulate and told what came out."""

from dropo_torch.objective import Objective
from dropo_torch.optimizers.adam import AdamOptimizer
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.optimizers.cma import CMAOptimizer
from dropo_torch.optimizers.correlated import CorrelatedOptimizer
from dropo_torch.optimizers.fisher import FisherOptimizer
from dropo_torch.optimizers.settings import AdamSettings, FitSettings

__all__ = [
    "AdamOptimizer",
    "AdamSettings",
    "CMAOptimizer",
    "CorrelatedOptimizer",
    "FisherOptimizer",
    "FitSettings",
    "Optimizer",
    "Progress",
    "Request",
    "make_optimizer",
]


def make_optimizer(objective: Objective, settings: FitSettings) -> Optimizer:
    """Return the optimizer that the settings name."""
    if settings.optimizer == "cma":
        return CMAOptimizer(objective, settings)
    if settings.optimizer == "adam":
        return AdamOptimizer(objective, settings)
    kind = CorrelatedOptimizer if settings.covariance == "full" else FisherOptimizer
    return kind(objective, settings)
