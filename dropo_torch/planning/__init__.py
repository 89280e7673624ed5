"""The motion to record next: what tells a config's parameters apart best, within the robot's limits."""

from dropo_torch.planning.ground import Ground, prepare
from dropo_torch.planning.plan import Plan, make_plan

__all__ = ["Ground", "Plan", "make_plan", "prepare"]
