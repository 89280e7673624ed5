"""What is the model missing? Find it, name it, add it, show the gap shrink."""

from dropo_torch.gap.add import add
from dropo_torch.gap.result import Gap, NamedEffect, Place, Score, Strength
from dropo_torch.gap.run import Scene, find_gap, prepare

__all__ = ["Gap", "NamedEffect", "Place", "Scene", "Score", "Strength", "add", "find_gap", "prepare"]
