"""Effects on commands from step to step: what reaches the actuators of N environments."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import pad

from dropo_torch.effects.placing import EffectSet


class Commands:
    """All effects on commands; every environment has its own numbers and state.

    An episode begins with the filters settled at its first command.

    Args:
        effects: the effects, of which those on commands count.
        num_envs: environments N.
        device: of the commands.
    """

    def __init__(self, effects: EffectSet, num_envs: int, *, device: torch.device) -> None:
        setting = effects.setting
        self._entries = effects.having("command").entries
        self._skip, self._step = setting.frame_skip, float(setting.model.opt.timestep)
        self._columns = [setting.command_column(e.target) for e in self._entries]
        self._values = [torch.zeros(num_envs, len(e.fixed), dtype=torch.float64, device=device) for e in self._entries]
        self._states = [torch.zeros(num_envs, 0, dtype=torch.float64, device=device) for _ in self._entries]
        self._fresh, self._any_fresh = torch.ones(num_envs, 1, dtype=torch.bool, device=device), True

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._entries)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` with parameter vectors ``(k, d)``."""
        for entry, own in zip(self._entries, self._values, strict=True):
            own[rows] = torch.from_numpy(entry.values(values)).to(own.device)
        self._fresh[rows] = True
        self._any_fresh = True

    def __call__(self, controls: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip, nu)`` as they act, of controls ``(N, nu)`` of an environment step."""
        signals = controls[:, None].repeat(1, self._skip, 1)
        for i, (entry, column, values) in enumerate(zip(self._entries, self._columns, self._values, strict=True)):
            signal, state = signals[:, :, column], self._states[i]
            if self._any_fresh:
                settled = entry.effect.settled(signal[:, :1], values, self._step)
                kept = pad(state, (settled.shape[1] - state.shape[1], 0))  # of states, the last entries count
                state = torch.where(self._fresh, settled, kept)
            signals[:, :, column], self._states[i] = entry.effect.command(signal, values, self._step, state)
        if self._any_fresh:
            self._fresh, self._any_fresh = torch.zeros_like(self._fresh), False
        return signals

    def state_dict(self) -> list[dict[str, torch.Tensor]]:
        """Return the filters' states."""
        return [{"fresh": self._fresh.clone(), "memory": state.clone()} for state in self._states]

    def load_state_dict(self, state: list[dict[str, torch.Tensor]]) -> None:
        """Go on from states; the numbers have been given by :meth:`reset`."""
        device = self._fresh.device
        self._states = [saved["memory"].to(device, copy=True) for saved in state]
        self._fresh = state[0]["fresh"].to(device, copy=True)
        self._any_fresh = bool(self._fresh.any())
