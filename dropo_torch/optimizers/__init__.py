"""Optimizers of φ, each asked for parameter vectors to simulate and told what came out.

A new one is a module here, named in :func:`make_optimizer`, in ``OPTIMIZERS`` of :mod:`dropo_torch.optimizers.settings`
and in the config's key ``optimizer``.
"""

from dropo_torch.objective import Objective
from dropo_torch.optimizers.adam import AdamOptimizer as AdamOptimizer
from dropo_torch.optimizers.base import LikelihoodOptimizer
from dropo_torch.optimizers.base import Optimizer as Optimizer
from dropo_torch.optimizers.base import Progress as Progress
from dropo_torch.optimizers.base import Request as Request
from dropo_torch.optimizers.cma import CMAOptimizer as CMAOptimizer
from dropo_torch.optimizers.correlated import CorrelatedOptimizer
from dropo_torch.optimizers.fisher import FisherOptimizer as FisherOptimizer
from dropo_torch.optimizers.settings import AdamSettings as AdamSettings
from dropo_torch.optimizers.settings import FitSettings as FitSettings


def make_optimizer(objective: Objective, settings: FitSettings) -> Optimizer:
    """Return the optimizer that the settings name."""
    fisher = CorrelatedOptimizer if settings.covariance == "full" else FisherOptimizer
    kinds: dict[str, type[LikelihoodOptimizer]] = {"cma": CMAOptimizer, "adam": AdamOptimizer, "fisher": fisher}
    return kinds[settings.optimizer](objective, settings)
