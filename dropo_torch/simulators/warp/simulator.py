"""The simulator: MuJoCo's physics with gradients of states, controls and model parameters."""

from __future__ import annotations

import copy
import os
from typing import ClassVar

import mujoco
import torch
import warp as wp

from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import DIVERGED, Numbers, Simulator
from dropo_torch.simulators.hidden import POSE, prescribed_bodies
from dropo_torch.simulators.warp.engine import Batch, Engine, Simulate
from dropo_torch.simulators.warp.filters import FilterStarts
from dropo_torch.simulators.warp.support import remarks


class WarpSimulator(Simulator):
    """Simulates transitions with MuJoCo's own physics, written as NVIDIA Warp kernels in float64.

    The constraint batch of every step is solved to convergence, and the gradient is exact at that solution. A
    parameter vector means a copy of the model with the numbers written and ``mj_setConst`` run, as for the
    MuJoCo backend; the gradient includes what that derives.

    Args:
        model: the model, of the subset in ``docs/warp.md``.
        parameters: what varies.
        frame_skip: physics steps of one logged transition, each under the same control.
        chunk_size: simulations in memory at a time; results do not depend on it.
        num_threads: threads on a CPU, all cores by default; results do not depend on it.
        device: ``"cpu"`` or a CUDA device such as ``"cuda:0"``.
        history: logged steps before each transition whose controls come with it, ``(T, history + lag, nu)``: filters of
            actuators are replayed over them. Without history, they start settled at the first control.

    Raises:
        InputError: the model or a parameter is outside the subset (all reasons in one message), its actuators have a
            hidden state that no log holds, or a number is below 1.
    """

    differentiable: ClassVar[bool] = True
    name: ClassVar[str] = "warp"

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        parameters: ParameterSpace,
        frame_skip: int,
        chunk_size: int = 4096,
        num_threads: int | None = None,
        device: str = "cpu",
        history: int = 0,
    ) -> None:
        threads = (os.cpu_count() or 1) if num_threads is None else num_threads
        for option, value in (("frame_skip", frame_skip), ("chunk_size", chunk_size), ("num_threads", threads)):
            if value < 1:
                raise InputError(f"{option}: {value} given; expected 1 or more")
        model = copy.copy(model)
        derive(model)
        self.parameters, self.frame_skip, self.history = parameters, frame_skip, history
        self.num_states = model.nq + model.nv
        self.num_controls = model.nu + POSE * len(prescribed_bodies(model))
        self.timestep = model.opt.timestep * frame_skip
        self._engine = Engine(
            model, parameters, skip=frame_skip, chunk_size=chunk_size, num_threads=threads, device=device
        )
        self.notes = remarks(model)
        self._filters = FilterStarts(model, skip=frame_skip, history=history)
        self._constants = torch.from_numpy(
            self._engine.fields.columns("dynprm").reshape(-1, 3)[self._filters.actuators, 0]
        )
        self._device = wp.device_to_torch(device)

    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each transition ``(T, K, lag, nq + nv)``, differentiable in all three arguments.

        A quaternion in ``states`` need not be normalized; those returned are. See :meth:`Simulator.rollout`.
        """
        states, controls, values = self.tensors(states, controls, values)
        origin = states.device
        shape = (len(states), len(values), controls.shape[1] - self.history, self.num_states)
        if 0 in shape[:2]:
            return states.new_zeros(shape, dtype=torch.float64)
        theta = self._engine.fields(values.to("cpu", torch.float64))
        start, inputs = self._inputs(states, controls, theta[:, self._constants])
        theta = theta.to(self._device).contiguous()
        out: torch.Tensor = Simulate.apply(theta, start, inputs, self._engine)[..., : self.num_states]
        lost = ~(out.detach().abs() < DIVERGED).flatten(2).all(-1)
        if bool(lost.any()):
            out = out.masked_fill(lost[..., None, None], torch.nan)
        return out.to(origin)

    def jacobian(
        self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor, directions: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the states after ``lag`` transitions and each transition's own derivatives.

        One backward pass a direction; with none given, one a state column.

        Args:
            states, controls, values: as for :meth:`simulate`.
            directions: covectors of the states, ``(J, nq + nv)``; by default the unit vectors.

        Returns:
            States ``(T, K, nq + nv)``, and the directions' products with the derivatives by the values
            ``(T, K, J, d)`` and by the initial states ``(T, K, J, nq + nv)``.
        """
        self.check_arguments(states, controls, values)
        rows = torch.eye(self.num_states, dtype=torch.float64) if directions is None else directions
        states, controls = states.detach(), controls.detach()
        theta, slope = self._engine.fields.with_derivative(values.detach().to("cpu", torch.float64))
        start, inputs = self._inputs(states, controls, theta[:, self._constants])
        rows = torch.nn.functional.pad(rows, (0, start.shape[1] - self.num_states))
        batch = Batch(theta.to(self._device).contiguous(), start, inputs, self.frame_skip)
        found = self._engine.per_world(batch, rows.to(self._device).contiguous())
        after, by_theta, by_start = (x.cpu().unflatten(0, (len(states), len(values))) for x in found)
        by_theta = by_theta + self._by_filters(controls, theta, by_start[..., self.num_states :])
        by_values = torch.einsum("tkjw,kwd->tkjd", by_theta, slope)
        return after[..., : self.num_states], by_values, by_start[..., : self.num_states]

    def _inputs(
        self, states: torch.Tensor, controls: torch.Tensor, constants: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Initial states with activations, of transitions or, where time constants differ, of worlds; and controls."""
        states, controls = (x.to("cpu", torch.float64) for x in (states, controls))
        start = states
        if len(self._constants):
            shared = not (constants.requires_grad or (constants != constants[:1]).any())
            acting = self._filters(controls, constants[:1] if shared else constants)
            start = torch.cat([states[:, None].expand(-1, acting.shape[1], -1), acting], 2).flatten(0, 1)
        return start.to(self._device).contiguous(), controls[:, self.history :].to(self._device).contiguous()

    def _by_filters(self, controls: torch.Tensor, theta: torch.Tensor, by_activation: torch.Tensor) -> torch.Tensor:
        """What time constants add by where the filters start to derivatives by θ's wanted columns."""
        out = torch.zeros(*by_activation.shape[:-1], len(self._engine.wanted), dtype=torch.float64)
        if len(self._constants):
            leaf = theta[:, self._constants].expand(len(controls), -1, -1).contiguous().requires_grad_(True)
            with torch.enable_grad():
                acting = self._filters(controls.to("cpu", torch.float64), leaf)
                slope = torch.autograd.grad(acting.sum(), leaf, allow_unused=True)[0]
            if slope is not None:
                same = (self._constants[:, None] == self._engine.wanted).double()
                out = (by_activation * slope[:, :, None]) @ same
        return out
