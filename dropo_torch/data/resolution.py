"""The resolution of a measured column: the steps in which its values come."""

from __future__ import annotations

import numpy as np

#: Gaps below this share of a column's range are rounding; a gap is whole up to this share of a step; share of them.
ROUNDING, WHOLE, MOST = 1e-9, 0.02, 0.95


def resolution(values: np.ndarray) -> float:
    """Return the step of which all differences between values are multiples; 0 where there is none, or too few values.

    Values that were printed have one, too: that of their last digit.
    """
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < 3:
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > ROUNDING * (levels[-1] - levels[0])]
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    whole = np.abs(gaps / step - np.round(gaps / step)) < WHOLE
    return step if whole.mean() > MOST else 0.0
