"""The stepper of a backend."""

from __future__ import annotations

from dropo_torch.effects.placing import EffectSet
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.batch_stepper import BatchStepper
from dropo_torch.rl.mujoco_stepper import MujocoStepper

BACKENDS = ("mujoco", "warp")


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
        return MujocoStepper(space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads)
    if backend == "warp":
        try:
            from dropo_torch.rl.warp_stepper import WarpStepper
        except ImportError as error:
            if error.name != "warp":
                raise
            raise InputError("backend: warp-lang is not installed; pip install warp-lang") from None
        return WarpStepper(
            space, num_envs, frame_skip=frame_skip, effects=effects, num_threads=num_threads, device=device
        )
    raise InputError(f"backend: unknown {backend!r} for environments" + choices(backend, BACKENDS))
