"""Effects outside the simulation, from step to step: what reaches the actuators, and what the sensors show."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import torch
from torch.nn.functional import pad

from dropo_torch.effects.filters import extended, filters_of, observed_rates, rate_columns, sensed
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import EffectSet
from dropo_torch.effects.simulator import LONGEST_HISTORY
from dropo_torch.parameters import ParameterSpace


class RowFilters:
    """The effects on commands, or on measurements; every environment has its own numbers.

    Args:
        effects: the effects, of which those with the method count.
        method: ``"command"`` or ``"sense"``.
        num_envs: environments N.
        device: of the numbers.
    """

    def __init__(
        self, effects: EffectSet, method: Literal["command", "sense"], num_envs: int, device: torch.device
    ) -> None:
        setting = effects.setting
        self._acting = effects.having(method)
        self._skip, self._step = setting.frame_skip, float(setting.model.opt.timestep)
        zeros = torch.zeros(num_envs, 0, dtype=torch.float64, device=device)
        acting = ((e.effect, e.target, zeros.new_zeros(num_envs, len(e.fixed))) for e in self._acting.entries)
        self._filters = filters_of(acting, method, setting)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._filters)

    def _write(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Give environments ``rows`` the numbers in parameter vectors ``(k, d)``."""
        for entry, f in zip(self._acting.entries, self._filters, strict=True):
            f.values[rows] = torch.from_numpy(entry.values(values)).to(f.values.device)


class Commands(RowFilters):
    """All effects on commands. An episode begins with the filters settled at its first command.

    Args:
        effects: the effects, of which those on commands count.
        num_envs: environments N.
        device: of the commands.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, device: torch.device) -> None:
        super().__init__(effects, "command", num_envs, device)
        self._states = [f.values[:, :0] for f in self._filters]
        self._fresh = torch.ones(num_envs, 1, dtype=torch.bool, device=device)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` with parameter vectors ``(k, d)``."""
        self._write(rows, values)
        self._fresh[rows] = True

    def __call__(self, controls: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip, nu)`` as they act, of controls ``(N, nu)`` of an environment step."""
        signals, any_fresh = controls[:, None].repeat(1, self._skip, 1), bool(self._fresh.any())
        for i, f in enumerate(self._filters):
            signal, state = signals[:, :, f.column], self._states[i]
            if any_fresh:
                settled = f.effect.settled(signal[:, :1], f.values, self._step)
                kept = pad(state, (settled.shape[1] - state.shape[1], 0))  # of states, the last entries count
                state = torch.where(self._fresh, settled, kept)
            signals[:, :, f.column], self._states[i] = f.effect.command(signal, f.values, self._step, state)
        self._fresh = torch.zeros_like(self._fresh)
        return signals

    def state_dict(self) -> dict[str, Any]:
        """Return the filters' states."""
        return {"fresh": self._fresh.clone(), "memory": [state.clone() for state in self._states]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from states; the numbers have been given by :meth:`reset`."""
        self._states = [saved.to(self._fresh.device, copy=True) for saved in state["memory"]]
        self._fresh = state["fresh"].to(self._fresh.device, copy=True)


class Sensors(RowFilters):
    """Shows the states of N environments as their sensors do.

    Before an episode's start, as far as a late sensor looks back, an environment has moved with its initial velocity.

    Args:
        effects: the effects, of which those on sensors count.
        num_envs: environments N.
        space: the parameters.
        device: of the states.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, space: ParameterSpace, device: torch.device) -> None:
        super().__init__(effects, "sense", num_envs, device)
        setting = effects.setting
        self._index = torch.from_numpy(setting.observation.index).to(device)
        late = self._acting.look_back(space)
        steps = math.ceil(late / (self._step * self._skip) - 1e-9) if late < math.inf else LONGEST_HISTORY
        window = min(steps, LONGEST_HISTORY) * self._skip + self._skip + 1
        self._rates, self._rate_of = observed_rates(setting), torch.from_numpy(rate_columns(setting.model)).to(device)
        self._past = torch.zeros(num_envs, window, len(self._index), dtype=torch.float64, device=device)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` at true states ``(k, nq + nv)``, with values ``(k, d)``."""
        self._write(rows, values)
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
