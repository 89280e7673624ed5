"""Sensor effects that go on from step to step: what the sensors of N environments show."""

from __future__ import annotations

import math

import numpy as np
import torch

from dropo_torch.effects.base import Effect, Path
from dropo_torch.effects.placing import EffectSet
from dropo_torch.effects.sensor import SensorBias, SensorDelay, SensorEffect, SensorScale, hermite
from dropo_torch.effects.simulator import LONGEST_HISTORY, rate_columns
from dropo_torch.parameters import ParameterSpace


class Sensors:
    """Shows the states of N environments as their sensors do.

    Before an episode's start, as far as a late sensor looks back, an environment has moved with the start's velocity.

    Args:
        effects: the effects, of which those on sensors count.
        num_envs: environments N.
        space: the parameters.
        device: of the states.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, space: ParameterSpace, device: torch.device) -> None:
        setting = effects.setting
        sensing = effects.matching(lambda e: e.acts_on_sensor)
        self._entries = sensing.entries
        self._skip, self._step = setting.frame_skip, float(setting.model.opt.timestep)
        self._index = torch.from_numpy(setting.observation.index).to(device)
        self._columns = [SensorEffect.column(setting, e.target) for e in self._entries]
        late = sensing.look_back(space, sensors=True)
        steps = math.ceil(late / (self._step * self._skip) - 1e-9) if late < math.inf else LONGEST_HISTORY
        self._window = min(steps, LONGEST_HISTORY) * self._skip + self._skip + 1
        places = {int(c): i for i, c in enumerate(setting.observation.index)}
        of = rate_columns(setting.model)
        self._rates = np.array([places.get(int(of[c]), -1) for c in setting.observation.index])
        self._state_rates = torch.from_numpy(of).to(device)
        shape = (num_envs, self._window, len(self._index))
        self._past = torch.zeros(shape, dtype=torch.float64, device=device)
        self._values = [torch.zeros(num_envs, len(e.fixed), dtype=torch.float64, device=device) for e in self._entries]

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._entries)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` at true states ``(k, nq + nv)``, with values ``(k, d)``."""
        for entry, own in zip(self._entries, self._values, strict=True):
            own[rows] = torch.from_numpy(entry.values(values)).to(own.device)
        known = self._state_rates >= 0
        rates = torch.where(known, states[:, self._state_rates.clamp(min=0)], 0.0)[:, self._index]
        ago = self._step * torch.arange(1 - self._window, 1, device=states.device, dtype=torch.float64)
        self._past[rows] = states[:, None, self._index] + ago[:, None] * rates[:, None]

    def record(self, fine: torch.Tensor) -> None:
        """Take in true states ``(N, skip, nq + nv)`` after each physics step."""
        self._past = torch.cat([self._past[:, fine.shape[1] :], fine[..., self._index]], 1)

    def show(self, states: torch.Tensor) -> torch.Tensor:
        """Return true states ``(N, nq + nv)`` with what the sensors show of them now in their places."""
        shown = states.clone()
        columns = self._past[:, -1].clone()
        for entry, column, values in zip(self._entries, self._columns, self._values, strict=True):
            kind = type(entry.effect)
            if kind is SensorBias:
                columns[:, column] += values[:, 0]
            elif kind is SensorScale:
                columns[:, column] *= values[:, 0]
            elif kind is SensorDelay:
                columns[:, column] = self._late(column, values[:, 0], columns[:, column])
            else:
                columns = self._called(entry.effect, column, values, columns)
        shown[:, self._index] = columns
        return shown

    def _late(self, column: int, delay: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
        """A column as it was ``delay`` seconds ago, ``(N,)``."""
        at = (self._window - 1 - delay / self._step).clamp(min=0.0)
        whole = at.long().clamp(max=self._window - 2)
        part = at - whole
        rows = torch.arange(len(delay), device=delay.device)
        left, right = self._past[rows, whole, column], self._past[rows, whole + 1, column]
        rate = int(self._rates[column])
        if rate >= 0:
            slope, next_slope = (self._step * self._past[rows, whole + i, rate] for i in (0, 1))
            value = hermite(left, right, slope, next_slope, part)
        else:
            value = (1 - part) * left + part * right
        return torch.where(delay > 0, value, now)

    def _called(self, effect: Effect, column: int, values: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """What any other effect makes of the columns ``(N, n)``."""
        fine, now, given = (x.cpu().numpy() for x in (self._past, columns, values))
        fine = fine[:, (self._window - 1) % self._skip :]
        out = np.empty_like(now)
        kinds, which = np.unique(given, axis=0, return_inverse=True)
        for k, numbers in enumerate(kinds):
            rows = which == k
            coarse = fine[rows, :: self._skip].copy()
            coarse[:, -1] = now[rows]
            path = Path(
                columns=coarse, fine=fine[rows], valid=np.ones(coarse.shape, dtype=bool), step=self._step,
                rates=self._rates,
            )  # fmt: skip
            out[rows] = effect.sense(path, column, numbers).columns[:, -1]
        return torch.from_numpy(out).to(columns.device)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what the sensors remember."""
        return {"past": self._past.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a memory; the numbers have been given by :meth:`reset`."""
        self._past = state["past"].to(self._past.device, copy=True)
