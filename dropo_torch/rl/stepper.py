"""Many environments that go on from step to step, each with its own parameters and hidden state."""

from __future__ import annotations

import abc
from typing import Any

import torch

from dropo_torch.effects.placing import EffectSet
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.extras import extra


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
            states: initial states, ``(k, nq + nv)`` float64.
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


def make_stepper(
    backend: str, space: ParameterSpace, num_envs: int, *, frame_skip: int, effects: EffectSet | None = None,
    num_threads: int = 0, device: str = "cpu",
) -> BatchStepper:  # fmt: skip
    """Return the stepper of a backend.

    Args:
        backend: ``"mujoco"`` or ``"warp"``.
        space: what varies, over the model that is simulated.
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        effects: effects; the stepper has those inside the simulation.
        num_threads: threads of a CPU, 0 for all processors.
        device: of the ``"warp"`` backend.

    Raises:
        InputError: an unknown backend, a model or an effect that it does not support.
    """
    if backend == "mujoco":
        from dropo_torch.rl.mujoco_stepper import MujocoStepper

        return MujocoStepper(space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads)
    if backend == "warp":
        with extra("warp", "backend: warp"):
            from dropo_torch.rl.warp_stepper import WarpStepper
        return WarpStepper(
            space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads, device=device
        )
    raise InputError(f"backend: unknown {backend!r} for environments" + choices(backend, ("mujoco", "warp")))
