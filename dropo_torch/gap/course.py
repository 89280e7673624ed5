"""How positions went on unseen data: as measured, and as predicted in open loop without and with the effects."""

from __future__ import annotations

import numpy as np

from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Course
from dropo_torch.gap.twin import Windows
from dropo_torch.gap.verify import Held

#: Predictions in a row that are shown, each from where the log is then, and positions, at most.
IN_A_ROW, MOST = 4, 6


def courses(evidence: Evidence, held: Held, before: Hypothesis, after: Hypothesis) -> tuple[Course, ...]:
    """Return the courses of the positions that the model as given predicts worst, in the model's order.

    Of all runs of stretches of held-out data, it is the one in which the error before is the median: no best case.

    Args:
        evidence: with the noise, by which errors are compared.
        held: the data.
        before, after: without and with the effects.
    """
    length, setting = held.rollouts.length, evidence.twin.setting
    windows = cut_windows(held.log, setting.observation, length, stride=length, since=held.since)
    columns = _positions(evidence)
    if not len(windows) or not columns.size:
        return ()
    sizes = evidence.noise[: len(evidence.chart.plain)][np.searchsorted(evidence.chart.plain, columns)]
    error = _errors(evidence, windows, before, columns) / sizes
    run = _middle(windows, np.sqrt((error**2).mean((1, 2))))
    error, windows = error[run], windows.select(run)
    found, _ = evidence.twin.predict([before.variant, after.variant], windows)
    worst = np.argsort(-np.sqrt((error**2).mean((0, 1))), kind="stable")[:MOST]
    time = (windows.steps[:, None] + np.arange(length + 1)) * setting.signals.timestep
    return tuple(
        Course(
            setting.observation.labels[c], setting.observation.units[c], time, windows.measured[..., c],
            found[0, ..., c], found[1, ..., c],
        )
        for c in sorted(columns[worst].tolist())
    )  # fmt: skip


def _positions(evidence: Evidence) -> np.ndarray:
    """Observed columns that are compared as they are and are positions."""
    observation, nq = evidence.twin.setting.observation, evidence.twin.setting.model.nq
    return np.array([c for c in evidence.chart.plain if observation.columns[c] < nq], dtype=int)


def _errors(evidence: Evidence, windows: Windows, hypothesis: Hypothesis, columns: np.ndarray) -> np.ndarray:
    """Errors of predictions ``(W, L, c)``; of what diverged, huge ones."""
    found, _ = evidence.twin.predict([hypothesis.variant], windows)
    error = (windows.measured - found[0])[:, 1:, columns]
    return np.nan_to_num(error, nan=1e6, posinf=1e6, neginf=1e6).clip(-1e6, 1e6)


def _middle(windows: Windows, error: np.ndarray) -> np.ndarray:
    """Return the rows of the run of windows of one episode whose error is the median of all runs' of that length.

    Args:
        windows: in the log's order.
        error: of each, ``(W,)``.
    """
    _, counts = np.unique(windows.episodes, return_counts=True)
    size = min(IN_A_ROW, int(counts.max()))
    starts = [s for s in range(len(windows) - size + 1) if windows.episodes[s] == windows.episodes[s + size - 1]]
    order = sorted(starts, key=lambda s: float(np.sqrt((error[s : s + size] ** 2).mean())))
    start = order[(len(order) - 1) // 2]
    return np.arange(start, start + size)
