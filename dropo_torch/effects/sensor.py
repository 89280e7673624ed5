"""Effects of sensors: what is measured is not the state."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from dropo_torch.effects.base import Effect, Path, Quantity, Setting

Numbers = TypeVar("Numbers", np.ndarray, torch.Tensor)


class SensorEffect(Effect):
    """An effect of one observed column; columns of quaternions are left out."""

    kind = "sensor"
    native = False

    def targets(self, setting: Setting) -> list[str | None]:
        turned = {c for q in setting.observation.quaternions for c in q}
        labels = setting.observation.labels
        left_out = turned | setting.masked
        return [n for c, n in enumerate(labels) if c not in left_out and setting.signals.column[c] > 0]

    @staticmethod
    def column(setting: Setting, target: str | None) -> int:
        """Return the number of an observed column."""
        return setting.observation.labels.index(str(target))


class SensorBias(SensorEffect):
    """A measurement that is off by a constant."""

    name = "sensor_bias"
    sentence = "the measurement of {target} is off by a constant"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        c = self.column(setting, target)
        scale = float(setting.signals.column[c])
        return (Quantity("bias", setting.observation.units[c], 0.0, -10 * scale, 10 * scale, scale),)

    def sense(self, path: Path, column: int, values: np.ndarray) -> Path:
        columns = path.columns.copy()
        columns[..., column] += values[0]
        return replace(path, columns=columns)

    def unsense(self, start: np.ndarray, rate: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
        out = start.copy()
        out[:, column] -= values[0]
        return out


class SensorScale(SensorEffect):
    """A measurement that is too large or too small by a factor."""

    name = "sensor_scale"
    sentence = "the measurement of {target} is too large or too small by a factor"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("factor", "-", 1.0, 0.2, 5.0, 0.3),)

    def sense(self, path: Path, column: int, values: np.ndarray) -> Path:
        columns = path.columns.copy()
        columns[..., column] *= values[0]
        return replace(path, columns=columns)

    def unsense(self, start: np.ndarray, rate: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
        out = start.copy()
        out[:, column] /= values[0]
        return out


class SensorDelay(SensorEffect):
    """A measurement that comes late."""

    name = "sensor_delay"
    sentence = "the measurement of {target} comes late"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("delay", "s", 0.0, 0.0, 5 * setting.signals.timestep, setting.signals.timestep),)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([k * setting.signals.timestep]) for k in (0.4, 1.5)]

    def memory(self, values: np.ndarray) -> float:
        return float(values[0])

    def sense(self, path: Path, column: int, values: np.ndarray) -> Path:
        """Interpolate the fine path at earlier instants; those before the window are not known."""
        delay = float(values[0])
        if delay <= 0:
            return path
        num_steps, fine = path.columns.shape[1] - 1, path.fine
        skip = (fine.shape[1] - 1) // num_steps
        at = np.arange(num_steps + 1) * skip - delay / path.step
        known = at >= -1e-9
        at = np.maximum(at, 0.0)
        whole = np.minimum(at.astype(int), fine.shape[1] - 2)
        part = at - whole
        left, right = fine[:, whole, column], fine[:, whole + 1, column]
        rate = int(path.rates[column])
        if rate >= 0:
            h = path.step
            slopes = fine[:, whole, rate] * h, fine[:, whole + 1, rate] * h
            value = hermite(left, right, *slopes, part)
        else:
            value = (1 - part) * left + part * right
        columns, valid = path.columns.copy(), path.valid.copy()
        columns[..., column] = value
        valid[:, ~known, column] = False
        return replace(path, columns=columns, valid=valid)

    def unsense(self, start: np.ndarray, rate: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
        out = start.copy()
        out[:, column] += values[0] * rate[:, column]
        return out


def hermite(left: Numbers, right: Numbers, slope: Numbers, next_slope: Numbers, part: Numbers) -> Numbers:
    """Return the cubic interpolation between two values with their slopes a step, at a part of the step."""
    t2, t3 = part**2, part**3
    ends = (2 * t3 - 3 * t2 + 1) * left + (3 * t2 - 2 * t3) * right
    return ends + (t3 - 2 * t2 + part) * slope + (t3 - t2) * next_slope
