"""The two ways to search: what is named must explain all windows, or most of them where contacts part the log."""

from __future__ import annotations

import numpy as np

from dropo_torch.gap.accept import everywhere, extend, is_done
from dropo_torch.gap.evidence import caps_of
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.naming import State
from dropo_torch.gap.refit import Refit
from dropo_torch.gap.rules import clears, significant


class Strategy:
    """Least squares on all windows: what is named must explain them together."""

    def caps(self, base: Refit) -> np.ndarray:
        """Return factors of the windows' residuals ``(W,)`` in all further fits, after the first one."""
        return caps_of(base.cost.windows, base.cost.degrees)

    def clears(self, base: Refit, current: Refit) -> bool:
        """Return whether effects are right although something else remains in some windows."""
        return False

    def refine(self, ground: Ground, state: State) -> State:
        """Return the state with what was just accepted put better."""
        return extend(ground, state) if significant(state.current.cost, ground.rules) else state


class ContactWindows(Strategy):
    """A robust cost: what is named must be right in most windows, and those that it leaves far off count little."""

    def caps(self, base: Refit) -> np.ndarray:
        """Return 1: the robust cost bounds what a window counts."""
        return np.ones(len(base.factor))

    def clears(self, base: Refit, current: Refit) -> bool:
        """Return whether most windows, far off before, are now right."""
        return clears(base, current)

    def refine(self, ground: Ground, state: State) -> State:
        """Return the state with the last effect at all its targets, where something is left to explain."""
        return super().refine(ground, state) if is_done(ground, state) else everywhere(ground, state)
