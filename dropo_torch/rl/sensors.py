"""Effects on measurements from step to step: what the sensors of N environments show."""

from __future__ import annotations

import math

import numpy as np
import torch

from dropo_torch.effects.filters import Filter, extended, observed_rates, rate_columns, sensed
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet
from dropo_torch.effects.simulator import LONGEST_HISTORY
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
        setting, sensing = effects.setting, effects.having("sense")
        self._entries = sensing.entries
        self._skip, self._step = setting.frame_skip, float(setting.model.opt.timestep)
        self._index = torch.from_numpy(setting.observation.index).to(device)
        late = sensing.look_back(space)
        steps = math.ceil(late / (self._step * self._skip) - 1e-9) if late < math.inf else LONGEST_HISTORY
        window = min(steps, LONGEST_HISTORY) * self._skip + self._skip + 1
        self._rates, self._rate_of = observed_rates(setting), torch.from_numpy(rate_columns(setting.model)).to(device)
        self._past = torch.zeros(num_envs, window, len(self._index), dtype=torch.float64, device=device)
        self._filters = [
            Filter(e.effect, setting.column(e.target), self._past.new_zeros(num_envs, len(e.fixed)))
            for e in self._entries
        ]

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._entries)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` at true states ``(k, nq + nv)``, with values ``(k, d)``."""
        for entry, f in zip(self._entries, self._filters, strict=True):
            f.values[rows] = torch.from_numpy(entry.values(values)).to(f.values.device)
        rates = torch.where(self._rate_of >= 0, states[:, self._rate_of], 0.0)[:, self._index]
        start = states[:, None, self._index]
        self._past[rows] = extended(start, rates, 0.0, self._past.shape[1] - 1, self._step)

    def record(self, fine: torch.Tensor) -> None:
        """Take in true states ``(N, skip, nq + nv)`` after each physics step."""
        self._past = torch.cat([self._past[:, fine.shape[1] :], fine[..., self._index]], 1)

    def show(self, states: torch.Tensor) -> torch.Tensor:
        """Return true states ``(N, nq + nv)`` with what the sensors show of them now in their places."""
        shown = states.clone()
        path = SensedPath.of(self._past, 1, self._skip, self._step, self._rates)
        shown[:, self._index] = sensed(path, self._filters)[:, 0]
        return shown

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what the sensors remember."""
        return {"past": self._past.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a memory; the numbers have been given by :meth:`reset`."""
        self._past = state["past"].to(self._past.device, copy=True)
