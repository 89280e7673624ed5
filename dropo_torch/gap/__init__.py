"""What is the model missing? Locate it, name it, add it, verify that the gap shrinks."""

from dropo_torch.gap.add import add
from dropo_torch.gap.given import as_given, find_gap_as_given
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Gap, LeftOut, NamedEffect, Place, Score, Strength
from dropo_torch.gap.rules import Rules
from dropo_torch.gap.run import find_gap, locate, name, open_loop, verify
from dropo_torch.gap.scene import Scene, prepare
from dropo_torch.gap.search import Naming

__all__ = [
    "Gap",
    "Hypothesis",
    "LeftOut",
    "NamedEffect",
    "Naming",
    "Place",
    "Rules",
    "Scene",
    "Score",
    "Strength",
    "add",
    "as_given",
    "find_gap",
    "find_gap_as_given",
    "locate",
    "name",
    "open_loop",
    "prepare",
    "verify",
]
