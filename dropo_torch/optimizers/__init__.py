"""Optimizers of φ, each asked for parameter vectors to simulate and told what came out."""

from dropo_torch.optimizers.adam import AdamOptimizer, AdamSettings
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.optimizers.cma import CMAOptimizer
from dropo_torch.optimizers.fisher import FisherOptimizer

__all__ = ["AdamOptimizer", "AdamSettings", "CMAOptimizer", "FisherOptimizer", "Optimizer", "Progress", "Request"]
