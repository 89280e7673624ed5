"""The steps in which measured values come."""

from __future__ import annotations

import numpy as np
import pytest

from dropo_torch.data.resolution import resolution

WALK = np.cumsum(np.random.default_rng(0).normal(size=600))
COUNT = 2 * np.pi / 2048


def counted(step: float, offset: float = 0.0) -> np.ndarray:
    """A walk in steps of a size."""
    return np.round(WALK / step) * step + offset


@pytest.mark.parametrize(
    ("values", "step"),
    [
        (counted(0.01), 0.01),
        (counted(COUNT, 0.1), COUNT),
        (np.deg2rad(counted(0.1)), np.deg2rad(0.1)),
        (counted(0.01).astype(np.float32).astype(float), 0.01),
        (np.append(counted(0.01), np.nan), 0.01),
        (WALK.round(4), 1e-4),  # as it is printed
    ],
)
def test_values_come_in_steps(values: np.ndarray, step: float) -> None:
    assert resolution(values) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("values", [WALK, counted(0.01) + 1e-3 * WALK, np.zeros(9), np.array([0.0, 1.0]), np.array([])])
def test_what_has_no_steps_has_none(values: np.ndarray) -> None:
    assert resolution(values) == 0
