"""MuJoCo's physics as NVIDIA Warp kernels, differentiable in states, controls and model parameters.

:class:`~dropo_torch.simulators.warp.simulator.WarpSimulator` is the backend; importing it needs the extra ``warp``.

Where things stand: ``support`` decides what is simulated, ``layout`` says what θ consists of, ``tables`` and
``fields`` turn a model and parameter vectors into arrays, ``types`` lists what the tables of a model and the memory
of a world hold, ``kinematics``, ``forces``, ``fluid``, ``ellipsoid``, ``slopes``, ``tendons``, ``rows``, ``welds``,
``collide``, ``boxes``, ``hull``, ``convex``, ``touch``, ``contact``, ``cone``, ``soft`` and ``solver`` are the physics
with their adjoints, ``stage`` and ``integrate`` put them together, ``engine`` runs the kernels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dropo_torch.support.extras import extra

if TYPE_CHECKING:
    from dropo_torch.simulators.warp.simulator import WarpSimulator

__all__ = ["WarpSimulator"]


def __getattr__(name: str) -> Any:
    """Import the simulator, and Warp with it, on first use."""
    if name == "WarpSimulator":
        with extra("warp", "backend: warp"):
            from dropo_torch.simulators.warp.simulator import WarpSimulator
        return WarpSimulator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
