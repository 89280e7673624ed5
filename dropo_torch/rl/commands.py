"""Command filters that go on from step to step: what reaches the actuators of N environments."""

from __future__ import annotations

import abc

import mujoco
import numpy as np
import torch

from dropo_torch.effects.actuator import (
    ActuatorBacklash,
    ActuatorDeadband,
    ActuatorDelay,
    ActuatorLag,
    actuator_number,
)
from dropo_torch.effects.placing import EffectSet, Entry
from dropo_torch.effects.simulator import LONGEST_HISTORY


class CommandFilter(abc.ABC):
    """One effect on one actuator's commands; every environment has its own numbers and memory.

    An episode begins with the filter settled at its first command.

    Args:
        entry: the effect.
        num_envs: environments N.
        actuator: the actuator's number.
        step: seconds of a physics step.
        skip: physics steps of an environment step.
        device: of the commands.
    """

    def __init__(
        self, entry: Entry, num_envs: int, *, actuator: int, step: float, skip: int, device: torch.device
    ) -> None:
        self.entry, self.actuator, self.step, self.skip = entry, actuator, step, skip
        self.values = torch.zeros(num_envs, len(entry.fixed), dtype=torch.float64, device=device)
        self.fresh = torch.ones(num_envs, 1, dtype=torch.bool, device=device)
        self.memory = torch.zeros(num_envs, 0, dtype=torch.float64, device=device)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` with parameter vectors ``(k, d)``."""
        self.values[rows] = torch.from_numpy(self.entry.values(values)).to(self.values.device)
        self.fresh[rows] = True

    def __call__(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip)`` of the next physics steps as they act."""
        first = signal[:, :1]
        if self.memory.shape[1]:
            self.memory = torch.where(self.fresh, first, self.memory)
        out = self.filter(signal)
        self.fresh = torch.zeros_like(self.fresh)
        return out

    @abc.abstractmethod
    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip)`` as they act, and update ``memory``."""

    def keep(self, width: int) -> None:
        """Let the memory hold ``width`` numbers an environment; it grows by its oldest."""
        missing = width - self.memory.shape[1]
        if missing > 0:
            oldest = self.memory[:, :1] if self.memory.shape[1] else self.memory.new_zeros(len(self.memory), 1)
            self.memory = torch.cat([oldest.expand(-1, missing), self.memory], 1)


class DelayFilter(CommandFilter):
    """:class:`~dropo_torch.effects.actuator.ActuatorDelay`: the memory holds past commands."""

    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands as they act; see :meth:`CommandFilter.filter`."""
        steps = self.values[:, :1] / self.step
        whole = steps.floor()
        part = steps - whole
        width = self.memory.shape[1]
        full = torch.cat([self.memory, signal], 1)
        at = width + torch.arange(signal.shape[1], device=signal.device) - whole.long()
        self.memory = full[:, signal.shape[1] :]
        return (1 - part) * full.gather(1, at) + part * full.gather(1, at - 1)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes, with memory enough for the longest delay."""
        super().reset(rows, values)
        self.keep(int(self.values[:, 0].max() / self.step) + 1)


class LagFilter(CommandFilter):
    """:class:`~dropo_torch.effects.actuator.ActuatorLag`: the memory is the filter's output."""

    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands as they act; see :meth:`CommandFilter.filter`."""
        self.keep(1)
        tau = self.values[:, 0]
        absent = tau <= 1e-6 * self.step
        ratio = self.step / torch.where(absent, torch.ones_like(tau), tau)
        decay, mean = torch.exp(-ratio), -torch.expm1(-ratio) / ratio
        before, out = torch.where(self.fresh, signal[:, :1], self.memory)[:, 0], torch.empty_like(signal)
        for s in range(signal.shape[1]):
            now = signal[:, s]
            out[:, s] = torch.where(absent, now, now + (before - now) * mean)
            before = torch.where(absent, now, (1 - decay) * now + decay * before)
        self.memory = before[:, None]
        return out


class DeadbandFilter(CommandFilter):
    """:class:`~dropo_torch.effects.actuator.ActuatorDeadband`: it remembers nothing."""

    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands as they act; see :meth:`CommandFilter.filter`."""
        return signal.sign() * (signal.abs() - self.values[:, :1]).clamp(min=0.0)


class BacklashFilter(CommandFilter):
    """:class:`~dropo_torch.effects.actuator.ActuatorBacklash`: the memory is what it holds."""

    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands as they act; see :meth:`CommandFilter.filter`."""
        self.keep(1)
        half = 0.5 * self.values[:, 0]
        held, out = torch.where(self.fresh, signal[:, :1], self.memory)[:, 0], torch.empty_like(signal)
        for s in range(signal.shape[1]):
            held = torch.maximum(torch.minimum(held, signal[:, s] + half), signal[:, s] - half)
            out[:, s] = held
        self.memory = held[:, None]
        return out


class HistoryFilter(CommandFilter):
    """Any other effect, called on the episode's last commands; the memory holds them."""

    def filter(self, signal: torch.Tensor) -> torch.Tensor:
        """Return commands as they act; see :meth:`CommandFilter.filter`."""
        if not self.memory.shape[1]:
            self.keep(LONGEST_HISTORY * self.skip)
            self.memory = torch.where(self.fresh, signal[:, :1], self.memory)
        full = torch.cat([self.memory, signal], 1)
        self.memory = full[:, signal.shape[1] :]
        given, values = full.cpu().numpy(), self.values.cpu().numpy()
        out = np.empty(signal.shape)
        kinds, which = np.unique(values, axis=0, return_inverse=True)
        for k, numbers in enumerate(kinds):
            found = self.entry.effect.command(given[which == k], self.actuator, self.step, numbers)
            out[which == k] = found[:, -signal.shape[1] :]
        return torch.from_numpy(out).to(signal.device)


_FILTERS: dict[type, type[CommandFilter]] = {
    ActuatorDelay: DelayFilter, ActuatorLag: LagFilter, ActuatorDeadband: DeadbandFilter,
    ActuatorBacklash: BacklashFilter,
}  # fmt: skip


class Commands:
    """All command filters of N environments.

    Args:
        effects: the effects, of which those on commands count.
        num_envs: environments N.
        model: the model without effects.
        skip: physics steps of an environment step.
        device: of the commands.
    """

    def __init__(
        self, effects: EffectSet, num_envs: int, *, model: mujoco.MjModel, skip: int, device: torch.device
    ) -> None:
        self._skip = skip
        self._columns = []
        self._filters: list[CommandFilter] = []
        for entry in effects.matching(lambda e: e.acts_on_command).entries:
            actuator = actuator_number(model, entry.target)
            make = _FILTERS.get(type(entry.effect), HistoryFilter)
            step = float(model.opt.timestep)
            self._filters.append(make(entry, num_envs, actuator=actuator, step=step, skip=skip, device=device))
            self._columns.append(int(model.actuator_ctrladr[actuator]))

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._filters)

    def reset(self, rows: torch.Tensor, values: np.ndarray) -> None:
        """Begin episodes in environments ``rows`` with parameter vectors ``(k, d)``."""
        for f in self._filters:
            f.reset(rows, values)

    def __call__(self, controls: torch.Tensor) -> torch.Tensor:
        """Return commands ``(N, skip, nu)`` as they act, of controls ``(N, nu)`` of an environment step."""
        signals = controls[:, None].repeat(1, self._skip, 1)
        for f, column in zip(self._filters, self._columns, strict=True):
            signals[:, :, column] = f(signals[:, :, column])
        return signals

    def state_dict(self) -> list[dict[str, torch.Tensor]]:
        """Return the filters' memories."""
        return [{"fresh": f.fresh.clone(), "memory": f.memory.clone()} for f in self._filters]

    def load_state_dict(self, state: list[dict[str, torch.Tensor]]) -> None:
        """Go on from memories; the numbers have been given by :meth:`reset`."""
        for f, saved in zip(self._filters, state, strict=True):
            f.fresh, f.memory = (saved[k].to(f.fresh.device, copy=True) for k in ("fresh", "memory"))
