"""Checks of one's own simulator, optimizer or effect, by the laws that this package's own keep.

Each is one call, which raises a :class:`ConformanceError` for the first law that does not hold and returns a
:class:`Report` of those that do. Nothing else in the package imports this.
"""

from dropo_torch.testing.effects import check_effect
from dropo_torch.testing.laws import ConformanceError, Report
from dropo_torch.testing.linear import LinearSimulator, linear_objective
from dropo_torch.testing.optimizers import KnownProblem, check_optimizer, linear_problem
from dropo_torch.testing.simulators import Tolerance, check_simulator, converged, mujoco_reference

__all__ = [
    "ConformanceError",
    "KnownProblem",
    "LinearSimulator",
    "Report",
    "Tolerance",
    "check_effect",
    "check_optimizer",
    "check_simulator",
    "converged",
    "linear_objective",
    "linear_problem",
    "mujoco_reference",
]
