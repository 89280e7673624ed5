"""A simulator that is known in closed form, and the likelihood of a log under it."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch

from dropo_torch.data.observation import generic_observation
from dropo_torch.data.trajectory import Transitions
from dropo_torch.objective import Objective
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import Numbers, Simulator


class LinearSimulator(Simulator):
    """s' = A s + B u + C f(ξ): everything about it is known in closed form.

    Args:
        space: ξ, d parameters of no MuJoCo model.
        effect: C, ``(n, d)``.
        transition: A, ``(n, n)``; 0 by default.
        control: B, ``(n, nu)``; by default one control that does nothing.
        transform: f, differentiable; the identity by default.

    Attributes:
        calls: how often it was asked to simulate.
    """

    differentiable: ClassVar[bool] = True
    name: ClassVar[str] = "linear"

    def __init__(
        self,
        space: ParameterSpace,
        effect: np.ndarray,
        *,
        transition: np.ndarray | None = None,
        control: np.ndarray | None = None,
        transform: Callable[[torch.Tensor], torch.Tensor] = lambda x: x,
    ) -> None:
        self.parameters, self.frame_skip, self.timestep = space, 1, 1.0
        self.effect = torch.as_tensor(effect, dtype=torch.float64)
        n = self.num_states = len(self.effect)
        self.transition, self.control = (
            torch.as_tensor(np.zeros(shape) if given is None else given, dtype=torch.float64)
            for given, shape in ((transition, (n, n)), (control, (n, 1)))
        )
        self.num_controls = self.control.shape[1]
        self.transform = transform
        self.calls = 0

    def simulate(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after ``lag`` transitions; see :meth:`Simulator.simulate`."""
        return self.rollout(states, controls, values)[:, :, -1]

    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each transition; see :meth:`Simulator.rollout`."""
        states, controls, values = self.tensors(states, controls, values)
        self.calls += 1
        drift = _apply(self.effect, self.transform(values))
        now = states[:, None].expand(-1, len(values), -1)
        out = []
        for u in controls.unbind(1):
            now = _apply(self.transition, now) + _apply(self.control, u)[:, None] + drift
            out.append(now)
        return torch.stack(out, 2)


def _apply(matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """The products of a matrix with each row, which do not depend on how many rows there are."""
    return (rows[..., None, :] * matrix).sum(-1)


def linear_objective(simulator: LinearSimulator, measured: np.ndarray, **options: object) -> Objective:
    """Return the likelihood of measured next states ``(T, n)``, from zero initial states under zero controls."""
    number = len(measured)
    return Objective(
        simulator,
        Transitions(
            states=np.zeros((number, simulator.num_states)),
            controls=np.zeros((number, 1, simulator.num_controls)),
            measured=np.asarray(measured, dtype=np.float64),
            rows=np.arange(number),
            episodes=np.zeros(number, dtype=int),
        ),
        generic_observation(simulator.num_states),
        **options,  # type: ignore[arg-type]
    )
