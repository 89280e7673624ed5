"""Simulators behind one interface: many transitions under many parameter vectors, as one batch."""

from __future__ import annotations

from typing import Any

from dropo_torch.errors import InputError, choices
from dropo_torch.models.load import load_model
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import Simulator
from dropo_torch.simulators.gymnasium import Adapter, CheckedAdapter, GymnasiumSimulator, MujocoEnvAdapter
from dropo_torch.simulators.mujoco import MujocoSimulator

__all__ = [
    "Adapter",
    "CheckedAdapter",
    "GymnasiumSimulator",
    "MujocoEnvAdapter",
    "MujocoSimulator",
    "Simulator",
    "make_simulator",
]

BACKENDS = ("mujoco", "warp", "gymnasium")


def make_simulator(
    backend: str,
    model: Any,
    *,
    parameters: ParameterSpace,
    frame_skip: int = 1,
    num_threads: int = 0,
    chunk_size: int = 10_000,
    device: str = "cpu",
    history: int = 0,
    sensors: bool = False,
) -> Simulator:
    """Return the simulator of a backend.

    Args:
        backend: ``"mujoco"``, ``"warp"`` (differentiable) or ``"gymnasium"``.
        model: the model or its path; for ``"gymnasium"`` an adapter, or a function of the parameter
            space that makes one.
        parameters: what varies.
        frame_skip: physics steps (for ``"gymnasium"``: the adapter's steps) per logged transition.
        num_threads: threads, 0 for all processors.
        chunk_size: simulations held in memory at once.
        device: of the ``"warp"`` backend, ``"cpu"`` or a GPU such as ``"cuda:0"``.
        history: logged steps of controls before each transition, for actuators' filters; not of ``"gymnasium"``.
        sensors: whether states are extended by ``sensordata``; of ``"mujoco"`` alone.

    Raises:
        InputError: an unknown backend, or a model that it does not support.
    """
    if sensors and backend != "mujoco":
        raise InputError(f"backend: {backend} simulates no sensors, which observation names; use backend: mujoco")
    if backend == "mujoco":
        return MujocoSimulator(
            model, parameters=parameters, frame_skip=frame_skip, num_threads=num_threads, chunk_size=chunk_size,
            history=history, sensors=sensors,
        )  # fmt: skip
    if backend == "gymnasium":
        return GymnasiumSimulator(model, parameters=parameters, frame_skip=frame_skip)
    if backend != "warp":
        raise InputError(f"backend: unknown {backend!r}" + choices(backend, BACKENDS))
    from dropo_torch.simulators.warp import WarpSimulator

    return WarpSimulator(
        load_model(model),
        parameters=parameters,
        frame_skip=frame_skip,
        chunk_size=min(chunk_size, 4096) if device == "cpu" else chunk_size,
        num_threads=num_threads or None,
        device=device,
        history=history,
    )
