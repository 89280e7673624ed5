"""The clock of a controller whose commands change between the rows of a log."""

from __future__ import annotations

import numpy as np
import pytest

from dropo_torch.data.preprocess import Preprocess, preprocess
from dropo_torch.data.recording import Recording
from dropo_torch.data.ticks import find_ticks
from dropo_torch.errors import InputError


def logged(period: float, rate: float, *, jitter: float = 0.0, seconds: float = 8.0, still: float = 0.1) -> tuple:
    """Rows of commands that change every ``period``: their times, the commands, and the ticks of the changes."""
    rng = np.random.default_rng(1)
    ticks = 0.0037 + period * np.arange(int(seconds / period))
    levels = rng.normal(size=(len(ticks), 2))
    for i in np.flatnonzero(rng.random(len(ticks)) < still):
        levels[i] = levels[i - 1]
    time = np.arange(int(seconds * rate)) / rate
    time = np.sort(time + jitter * rng.uniform(-1, 1, len(time)))
    held = np.searchsorted(ticks, time, side="right") - 1
    return time - time[0], levels[np.maximum(held, 0)], ticks - time[0], levels


@pytest.mark.parametrize(("period", "rate", "jitter"), [(0.02, 120.0, 0.0), (0.02, 120.0, 2e-4), (0.0331, 100.0, 0.0)])
def test_changes_are_put_back_to_the_ticks(period: float, rate: float, jitter: float) -> None:
    time, commands, true, _ = logged(period, rate, jitter=jitter)
    found = find_ticks(time, commands)
    assert found is not None
    assert found.period == pytest.approx(period, rel=1e-4)
    nearest = true[np.abs(found.time[:, None] - true).argmin(1)]
    late = time[found.rows] - nearest
    assert np.abs(found.time - nearest).max() < 0.1 * late.max()
    assert (np.diff(found.put_back(time)) > 0).all()


def test_commands_by_the_clock_of_the_rows_or_by_none_have_no_ticks() -> None:
    for period, rate in ((0.02, 100.0), (0.01, 100.0), (0.02, 50.0)):
        time, commands, *_ = logged(period, rate)
        assert find_ticks(time, commands) is None
    rng, time = np.random.default_rng(0), np.arange(1000) / 120
    changes = np.sort(rng.uniform(0, time[-1], 400))  # whenever something happens
    assert find_ticks(time, np.searchsorted(changes, time)[:, None].astype(float)) is None
    assert find_ticks(time, np.zeros((1000, 1))) is None


def recording(time: np.ndarray, commands: np.ndarray) -> Recording:
    return Recording(np.sin(time)[:, None], commands, time, np.zeros(len(time)), ("q",), ("u", "v"), source="log")


def test_what_acted_in_a_step_is_told_much_better_by_the_clock() -> None:
    time, commands, ticks, levels = logged(0.02, 120.0, still=0.0)
    fine = np.arange(0.1, 7.8, 1e-5)
    acted = levels[np.maximum(np.searchsorted(ticks, fine, side="right") - 1, 0)][:, 0]
    steps = acted[: len(acted) // 800 * 800].reshape(-1, 800).mean(1)  # of 8 ms
    errors = []
    for own in (False, True):
        options = Preprocess(dt=0.008, velocities=(), actions="mean", start=0.1, command_clock=own)
        log = preprocess(recording(time, commands), options)
        count = min(len(steps), len(log.actions))
        errors.append(float(np.sqrt(np.mean((log.actions[:count, 0] - steps[:count]) ** 2))))
    assert errors[1] < 0.1 * errors[0]


def test_a_clock_that_does_not_show_is_refused() -> None:
    time, commands, *_ = logged(0.02, 100.0)
    with pytest.raises(InputError, match="do not change by a clock that is not that of the rows; leave it out"):
        preprocess(recording(time, commands), Preprocess(dt=0.01, velocities=(), command_clock=True))
    with pytest.raises(InputError, match="command_clock is 1; expected true or false"):
        Preprocess(dt=0.01, command_clock=1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="command_clock has no meaning with actions: position"):
        Preprocess(dt=0.01, command_clock=True, actions="position")
