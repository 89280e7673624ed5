"""Many environments that go on from step to step, each with its own parameters and hidden state."""

from __future__ import annotations

import abc
from typing import Any

import torch


class BatchStepper(abc.ABC):
    """Steps N environments of one model, each under its own parameters.

    Attributes:
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        num_states: width of a state, ``nq + nv``.
    """

    num_envs: int
    frame_skip: int
    num_states: int

    @abc.abstractmethod
    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: torch.Tensor) -> None:
        """Start new episodes in some environments; the others stay as they are.

        Args:
            rows: their numbers, ``(k,)`` int64.
            states: start states, ``(k, nq + nv)`` float64.
            values: parameter values, ``(k, d)`` float64.

        Raises:
            InputError: values that MuJoCo refuses.
        """

    @abc.abstractmethod
    def step(self, controls: torch.Tensor) -> torch.Tensor:
        """Make an environment step.

        Args:
            controls: S commands, each held for ``frame_skip / S`` physics steps, ``(N, S, nu)`` float64.

        Returns:
            The states after each command ``(N, S, nq + nv)``, float64; not finite, or beyond
            :data:`~dropo_torch.simulators.base.DIVERGED`, where one diverged.
        """

    @abc.abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return all that the next steps depend on, but for the parameters."""

    @abc.abstractmethod
    def load_state_dict(self, state: dict[str, Any], values: torch.Tensor) -> None:
        """Go on from a state of :meth:`state_dict`, with the parameters ``(N, d)`` of all environments."""
