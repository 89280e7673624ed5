"""Effects of sensors: what is measured is not the state."""

from __future__ import annotations

import numpy as np
import torch

from dropo_torch.effects.base import Effect, Quantity, Setting
from dropo_torch.effects.filters import differentiated
from dropo_torch.effects.path import SensedPath


class SensorEffect(Effect):
    """An effect of one observed column; those of quaternions, and velocities derived from others, are left out."""

    kind = "sensor"

    def targets(self, setting: Setting) -> list[str | None]:
        left_out = setting.masked.union(differentiated(setting).values(), *setting.observation.quaternions)
        labels = enumerate(setting.observation.labels)
        return [n for c, n in labels if c not in left_out and setting.signals.column[c] > 0]


class SensorBias(SensorEffect):
    """A measurement that is off by a constant."""

    name = "sensor_bias"
    sentence = "the measurement of {target} is off by a constant"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        c = setting.column(target)
        scale = float(setting.signals.column[c])
        return (Quantity("bias", setting.observation.units[c], 0.0, -10 * scale, 10 * scale, scale),)

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return path.shown[..., column] + values[:, :1]

    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        return shown[:, column] - values[:, 0]


class SensorScale(SensorEffect):
    """A measurement that is too large or too small by a factor."""

    name = "sensor_scale"
    sentence = "the measurement of {target} is too large or too small by a factor"
    differentiates = True

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("factor", "-", 1.0, 0.2, 5.0, 0.3),)

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return path.shown[..., column] * values[:, :1]

    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        return shown[:, column] / values[:, 0]


class SensorDelay(SensorEffect):
    """A measurement that comes late."""

    name = "sensor_delay"
    sentence = "the measurement of {target} comes late"
    shares = (0.4, 1.5)
    everywhere_like = ("actuator_delay",)
    differentiates = True

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("delay", "s", 0.0, 0.0, 5 * setting.signals.timestep, setting.signals.timestep),)

    def memory(self, values: np.ndarray) -> float:
        return float(values[0])

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        delay = values[:, :1]
        return torch.where(delay > 0, path.ago(column, delay), path.shown[..., column])

    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        return shown[:, column] + values[:, 0] * rates[:, column]
