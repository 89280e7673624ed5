"""Which rows stand for all of them."""

from __future__ import annotations

import numpy as np


def evenly(count: int, most: int) -> np.ndarray:
    """Return the numbers of at most so many of ``count`` rows, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, most).astype(int))
