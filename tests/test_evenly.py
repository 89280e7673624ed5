"""Rows that were taken evenly although their stamps jitter, and rows that were not."""

from __future__ import annotations

import numpy as np
import pytest

from dropo_torch.proposal.evenly import evenly

DT = 0.005


def motion(times: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Two joints that swing, with noise, ``(N, 2)``."""
    clean = np.stack([np.sin(3 * times) + 0.3 * np.sin(11 * times), 0.5 * np.cos(7 * times)], 1)
    return clean + noise * rng.standard_normal(clean.shape)


def starts(rows: int, *others: int) -> np.ndarray:
    found = np.zeros(rows, dtype=bool)
    found[[0, *others]] = True
    return found


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
@pytest.mark.parametrize("jitter", [0.1, 0.25])
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_even_rows_are_known_by_their_motion(noise: float, jitter: float, begin: float) -> None:
    """Whatever the stamps say, which may be seconds of an epoch; no row is missing then."""
    rng, times = np.random.default_rng(1), DT * np.arange(4000)
    stamps = begin + times + jitter * DT * rng.standard_normal(len(times))
    found = evenly(stamps, starts(len(times)), motion(times, noise, rng), float(np.median(np.diff(stamps))))
    assert found is not None
    assert found.dt == pytest.approx(DT, rel=1e-4)
    assert not found.missing.size


def test_missing_rows_are_found_beside_jitter() -> None:
    """Where they are missing, up to a few rows, and how far apart the others are."""
    rng, number = np.random.default_rng(2), np.arange(5000)
    gone = np.array([700, 1500, 1501, 2600, 4100])
    kept = np.setdiff1d(number, gone)
    times = DT * kept
    stamps = times + 0.2 * DT * rng.standard_normal(len(times))
    found = evenly(stamps, starts(len(times)), motion(times, 1e-4, rng), DT)
    assert found is not None
    truth = np.flatnonzero(np.diff(kept) > 1) + 1
    assert len(found.missing) == len(truth)
    assert (np.abs(found.missing - truth) <= 5).all()
    assert found.dt == pytest.approx(DT, rel=1e-3)


def test_each_episode_begins_by_itself() -> None:
    """What lies between episodes is no missing row."""
    rng, times = np.random.default_rng(3), DT * np.arange(2000)
    apart = times + 100.0 * (np.arange(2000) >= 1200)
    stamps = apart + 0.2 * DT * rng.standard_normal(2000)
    found = evenly(stamps, starts(2000, 1200), motion(apart, 1e-4, rng), DT)
    assert found is not None
    assert not found.missing.size
    assert found.dt == pytest.approx(DT, rel=1e-3)


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_rows_that_were_taken_when_their_stamps_say_are_not_even(noise: float) -> None:
    rng = np.random.default_rng(4)
    stamps = np.cumsum(DT * (1 + 0.25 * np.clip(rng.standard_normal(4000), -3, 3)))
    assert evenly(stamps, starts(4000), motion(stamps, noise, rng), DT) is None


def test_noise_alone_says_nothing() -> None:
    rng, times = np.random.default_rng(5), DT * np.arange(4000)
    stamps = times + 0.25 * DT * rng.standard_normal(4000)
    assert evenly(stamps, starts(4000), rng.standard_normal((4000, 2)), DT) is None
    assert evenly(stamps, starts(4000), np.ones((4000, 1)), DT) is None
    assert evenly(stamps[:20], starts(20), motion(times[:20], 0.0, rng), DT) is None
