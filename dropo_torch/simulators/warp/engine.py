"""Runs the kernels: memory, chunks of worlds, threads, and the ``torch.autograd.Function``."""

from __future__ import annotations

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import warp as wp

from dropo_torch.simulators.warp import kernel_backward, kernel_forward
from dropo_torch.simulators.warp.types import ADJOINT, IMPLICIT, SCRATCH, TRAJECTORY, Chunk, Tables, World

#: Stages kept from the forward for the backward, at most; beyond it the backward simulates again, chunk by chunk.
KEEP_BYTES = 1 << 30


@dataclass(frozen=True)
class Batch:
    """One call: how many transitions, parameter vectors, logged steps and physics steps of each.

    Paired, each transition has a parameter vector of its own; otherwise each is simulated under all of them.
    """

    transitions: int
    parameters: int
    lag: int
    skip: int
    paired: bool = False

    @property
    def each(self) -> int:
        """Number of simulations of a transition."""
        return 1 if self.paired else self.parameters

    @property
    def worlds(self) -> int:
        """Number of simulations."""
        return self.transitions * self.each


@dataclass(frozen=True)
class Trace:
    """What the backward needs of a chunk that was simulated."""

    memory: dict[str, Any]
    alive: Any


class Engine:
    """Simulates and differentiates worlds of one model on one device.

    Args:
        tables: the model.
        size: length of θ.
        wanted: columns of θ whose gradient is wanted.
        skip: physics steps of a logged step.
        chunk_size: worlds in memory at a time.
        num_threads: threads of a CPU.
        device: Warp's name of the device.
    """

    def __init__(
        self, tables: Tables, size: int, wanted: np.ndarray, *, skip: int, chunk_size: int, num_threads: int,
        device: str,
    ) -> None:  # fmt: skip
        self.tables, self.size, self.skip = tables, size, skip
        self.chunk_size, self.device = chunk_size, device
        self.is_cpu = wp.get_device(device).is_cpu
        self.num_threads = num_threads if self.is_cpu else 1
        self.columns = wp.array(wanted, dtype=wp.int32, device=device)
        self.wanted = torch.from_numpy(wanted.astype(np.int64))
        m = tables
        self._sizes = {
            "qpos": m.nq, "dof": m.nv, "triangle": m.nh, "body": m.nb, "row": m.maxrow, "contact": m.maxcon,
            "jacobian": m.maxcon * m.nv, "stage": 4 * m.nv, "theta": size,
        }  # fmt: skip
        self._scratch: dict[tuple[int, bool], dict[str, Any]] = {}
        self._free: list[dict[str, Any]] = []
        self._lock = threading.RLock()  # one call at a time in the scratch memory
        self._loaded: set[str] = set()

    def row_bytes(self, lag: int) -> int:
        """Bytes that one world keeps for its backward."""
        m = self.tables
        implicit = m.nv + m.nh if m.implicit else 0
        return 8 * (lag * self.skip + 1) * m.nstage * (m.nq + 3 * m.nv + m.nh + implicit)

    def chunks(self, worlds: int) -> list[tuple[int, int]]:
        """``(first, count)`` of the chunks of worlds."""
        return [(i, min(self.chunk_size, worlds - i)) for i in range(0, worlds, self.chunk_size)]

    def simulate(
        self, batch: Batch, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor, keep: bool
    ) -> tuple[torch.Tensor, list[Trace]]:
        """Return the states after each logged step ``(T·K·lag, nq + nv)``, and the traces of the chunks if kept."""
        out = torch.empty(batch.worlds * batch.lag, states.shape[1], dtype=torch.float64, device=states.device)
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, _flat(controls))]
        traces = []
        with self._lock, self._stream(states):
            for first, count in self.chunks(batch.worlds):
                part = wp.from_torch(out[first * batch.lag : (first + count) * batch.lag])
                trace = self._forward(batch, inputs, part, first, count, keep)
                if keep:
                    traces.append(trace)
        return out, traces

    def adjoint(
        self, batch: Batch, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor,
        out_bar: torch.Tensor, traces: list[Trace],
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
        """Return the adjoints of θ, states and controls; simulates again where there are no traces."""
        flat = _flat(controls)
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, flat)]
        columns = torch.zeros(batch.parameters, len(self.wanted), dtype=torch.float64, device=states.device)
        state_bar, control_bar = torch.zeros_like(states), torch.zeros_like(flat)
        totals = [wp.from_torch(x) for x in (columns, state_bar, control_bar)]
        with self._lock, self._stream(states):
            for number, (first, count) in enumerate(self.chunks(batch.worlds)):
                rows = slice(first * batch.lag, (first + count) * batch.lag)
                if traces:
                    trace = traces[number]
                else:
                    part = wp.empty((count * batch.lag, states.shape[1]), dtype=wp.float64, device=self.device)
                    trace = self._forward(batch, inputs, part, first, count, keep=True)
                self._backward(batch, inputs, trace, wp.from_torch(out_bar[rows]), totals, first, count)
                if not traces:
                    self.release([trace])
        theta_bar = torch.zeros_like(theta)
        theta_bar[:, self.wanted.to(theta.device)] = columns
        return theta_bar, state_bar, control_bar.reshape(controls.shape)

    def per_world(
        self, batch: Batch, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor,
        directions: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
        """Return last states and, of every world on its own, vector-Jacobian products.

        Args:
            batch: with ``lag`` logged steps.
            theta, states, controls: as for :meth:`simulate`.
            directions: covectors of the last states, ``(J, nq + nv)``, the same for every world.

        Returns:
            States ``(T·K, nq + nv)``, and products with the Jacobians by the wanted columns of θ
            ``(T·K, J, wanted)`` and by the start states ``(T·K, J, nq + nv)``.
        """
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, _flat(controls))]
        width, lag = states.shape[1], batch.lag
        after, by_theta, by_state = [], [], []
        with self._lock, self._stream(states):
            for first, count in self.chunks(batch.worlds):
                out = torch.empty(count * lag, width, dtype=torch.float64, device=states.device)
                trace = self._forward(batch, inputs, wp.from_torch(out), first, count, keep=True)
                after.append(out[lag - 1 :: lag])
                columns = []
                for direction in directions:
                    bar = torch.zeros_like(out)
                    bar[lag - 1 :: lag] = direction
                    theta_bar, state_bar, _ = self._worlds(batch, inputs, trace, wp.from_torch(bar), first, count)
                    columns.append((wp.to_torch(theta_bar).clone(), wp.to_torch(state_bar).clone()))
                self.release([trace])
                by_theta.append(torch.stack([c[0] for c in columns], 1))
                by_state.append(torch.stack([c[1] for c in columns], 1))
        return torch.cat(after), torch.cat(by_theta), torch.cat(by_state)

    def _forward(self, batch: Batch, inputs: list[Any], out: Any, first: int, count: int, keep: bool) -> Trace:
        period = batch.lag * batch.skip + 1 if keep else 2
        memory = self._trajectory((count if keep else self._slots(count)) * period * self.tables.nstage)
        alive = wp.empty(count, dtype=wp.int32, device=self.device)
        arguments = [*inputs, alive, out]
        self._launch(
            kernel_forward.simulate_kernel, batch, memory, arguments, first, count, period=period, keep=keep,
            adjoint=False,
        )  # fmt: skip
        return Trace(memory, alive)

    def _backward(
        self, batch: Batch, inputs: list[Any], trace: Trace, out_bar: Any, totals: list[Any], first: int,
        count: int,
    ) -> None:  # fmt: skip
        lag, parameters = batch.lag, batch.parameters
        theta_bar, state_bar, control_bar = self._worlds(batch, inputs, trace, out_bar, first, count)
        touched = (first + count - 1) // parameters - first // parameters + 1
        wp.launch(
            kernel_backward.sum_over_transitions, dim=(parameters, len(self.wanted)), device=self.device,
            inputs=[theta_bar, totals[0], first, count, parameters],
        )  # fmt: skip
        for bar, total, width in ((state_bar, totals[1], 1), (control_bar, totals[2], lag)):
            wp.launch(
                kernel_backward.sum_over_parameters, dim=(touched, width, bar.shape[1]), device=self.device,
                inputs=[bar, total, first, count, parameters, width],
            )  # fmt: skip

    def _worlds(
        self, batch: Batch, inputs: list[Any], trace: Trace, out_bar: Any, first: int, count: int
    ) -> tuple[Any, Any, Any]:
        """Adjoints of θ, states and controls, a row for every world (and logged step) of a chunk."""
        theta, states, controls = inputs
        lag = batch.lag
        state_bar = wp.empty((count, states.shape[1]), dtype=wp.float64, device=self.device)
        control_bar = wp.zeros((count * lag, controls.shape[1]), dtype=wp.float64, device=self.device)
        theta_bar = wp.empty((count, len(self.wanted)), dtype=wp.float64, device=self.device)
        arguments = [theta, controls, trace.alive, self.columns, out_bar, state_bar, control_bar, theta_bar]
        self._launch(
            kernel_backward.adjoint_kernel, batch, trace.memory, arguments, first, count,
            period=lag * batch.skip + 1, keep=True, adjoint=True,
        )  # fmt: skip
        return theta_bar, state_bar, control_bar

    def _launch(
        self, kernel: Any, batch: Batch, memory: dict[str, Any], arguments: list[Any], first: int, count: int, *,
        period: int, keep: bool, adjoint: bool,
    ) -> None:  # fmt: skip
        """Launch a kernel on the worlds of a chunk: on a CPU one contiguous slice for each thread.

        A launch on a CPU releases Python's lock.
        """
        if kernel.module.name not in self._loaded:  # compiled or loaded before threads launch it
            wp.load_module(kernel.module.name, device=self.device)
            self._loaded.add(kernel.module.name)
        world = _struct(World, self._working(self._slots(count), adjoint) | memory)

        def launch(local: int, number: int, slot: int) -> None:
            chunk = _struct(Chunk, {
                "first": first + local, "local": local, "nparam": batch.parameters, "each": batch.each,
                "lag": batch.lag, "skip": batch.skip, "period": period, "slot": slot,
                "slot_stride": int(not self.is_cpu), "keep": int(keep),
            })  # fmt: skip
            wp.launch(kernel, dim=number, inputs=[self.tables, world, chunk, *arguments], device=self.device)

        threads = self._slots(count) if self.is_cpu else 1
        if threads == 1:
            launch(0, count, 0)
            return
        bounds = [count * i // threads for i in range(threads + 1)]
        with ThreadPoolExecutor(threads) as pool:
            for job in [pool.submit(launch, a, b - a, i) for i, (a, b) in enumerate(pairwise(bounds))]:
                job.result()

    def _slots(self, count: int) -> int:
        return min(self.num_threads, count) if self.is_cpu else count

    def _trajectory(self, rows: int) -> dict[str, Any]:
        """Memory of a number of stages, from those that a backward has given back."""
        for i, memory in enumerate(self._free):
            if len(memory["qpos"]) == rows:
                return self._free.pop(i)
        memory = self._allocate(TRAJECTORY, rows) | self._allocate(IMPLICIT, rows if self.tables.implicit else 1)
        if not self.tables.has_ball:  # then a rate is a velocity
            memory["rate"] = memory["qvel"]
        return memory | {"held": wp.empty(rows, dtype=wp.int32, device=self.device)}

    def release(self, traces: list[Trace]) -> None:
        """Take the memory of traces back for the next call."""
        with self._lock:
            self._free = [t.memory for t in traces]

    def _stream(self, like: torch.Tensor) -> Any:
        """PyTorch's stream of a GPU as Warp's, so that kernels wait for tensors and tensors for kernels."""
        if self.is_cpu:
            return contextlib.nullcontext()
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))

    def _working(self, slots: int, adjoint: bool) -> dict[str, Any]:
        """Scratch memory of a number of slots, made once."""
        key = (slots, adjoint)
        if key not in self._scratch:
            # a gap between slots, so that no two threads write one cache line
            self._scratch[key] = self._allocate(SCRATCH | ADJOINT if adjoint else SCRATCH, slots, gap=16)
        return self._scratch[key]

    def _allocate(self, fields: dict[str, tuple[Any, str]], rows: int, gap: int = 0) -> dict[str, Any]:
        """Arrays of fields of a world, with a number of rows."""
        arrays = {}
        for name, (dtype, size) in fields.items():
            width = max(self._sizes[size], 1)
            arrays[name] = wp.empty((rows, width + gap), dtype=dtype, device=self.device)[:, :width]
        return arrays


def _struct(kind: Any, fields: dict[str, Any]) -> Any:
    """A Warp struct with fields set."""
    struct = kind()
    for name, value in fields.items():
        setattr(struct, name, value)
    return struct


def _flat(x: torch.Tensor) -> torch.Tensor:
    """All but the last axis as one."""
    return x.reshape(x.shape[:-1].numel(), x.shape[-1])


class Simulate(torch.autograd.Function):
    """``(θ, states, controls) → states after each logged step``, with the adjoint kernels as its backward."""

    @staticmethod
    def forward(
        ctx: Any, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor, engine: Engine
    ) -> torch.Tensor:
        """Return ``(T, K, lag, nq + nv)`` of θ ``(K, P)``, states ``(T, nq + nv)`` and controls ``(T, lag, nu)``."""
        batch = Batch(len(states), len(theta), controls.shape[1], engine.skip)
        wanted = any(ctx.needs_input_grad[:3])
        keep = wanted and batch.worlds * engine.row_bytes(batch.lag) <= KEEP_BYTES
        out, traces = engine.simulate(batch, theta, states, controls, keep)
        ctx.save_for_backward(theta, states, controls)
        ctx.engine, ctx.batch, ctx.traces = engine, batch, traces
        return out.view(batch.transitions, batch.parameters, batch.lag, -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, out_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the adjoints of the inputs."""
        theta, states, controls = ctx.saved_tensors
        flat = _flat(out_bar).contiguous()
        bars = ctx.engine.adjoint(ctx.batch, theta, states, controls, flat, ctx.traces)
        # a second backward through the same graph simulates again
        ctx.engine.release(ctx.traces)
        ctx.traces = []
        return (*bars, None)
