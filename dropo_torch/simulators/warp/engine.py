"""Runs the kernels: memory, chunks of worlds, threads, and the ``torch.autograd.Function``."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import kernel_backward, kernel_forward
from dropo_torch.simulators.warp.fields import Fields
from dropo_torch.simulators.warp.pairs import candidate_pairs
from dropo_torch.simulators.warp.parts import parts_of
from dropo_torch.simulators.warp.start import LOADING, start_warp
from dropo_torch.simulators.warp.support import check_support
from dropo_torch.simulators.warp.tables import build_tables, convex_sizes
from dropo_torch.simulators.warp.types import ADJOINT, IMPLICIT, SCRATCH, TRAJECTORY, Chunk, Tables, World, fill
from dropo_torch.simulators.warp.varied import coinciding

#: Stages kept from the forward for the backward, at most; beyond it the backward simulates again, chunk by chunk.
KEEP_BYTES = 1 << 30
#: Physics steps of all worlds times degrees of freedom below which threads cost a launch more than they save.
ALONE = 8000


@dataclass(frozen=True)
class Batch:
    """What one call simulates: transitions under parameter vectors, each simulation a world.

    Attributes:
        theta: parameter vectors as θ, ``(K, P)``.
        states: initial states with activations, ``(T, nq + nv + na)``, or one for each world, ``(T·K, nq + nv + na)``.
        controls: controls of every logged step, ``(T, lag, nu)``, and what else acts in it, behind them.
        skip: physics steps of a logged step.
        paired: whether each transition has a parameter vector of its own (``T = K``); otherwise each is simulated
            under all of them.
        applied: whether generalized forces, ``nv`` of them, stand at the end.
        wrenched: whether wrenches on the bodies, ``6 nbody`` of them as in ``xfrc_applied``, stand after the controls.
    """

    theta: torch.Tensor
    states: torch.Tensor
    controls: torch.Tensor
    skip: int
    paired: bool = False
    applied: bool = False
    wrenched: bool = False

    @property
    def lag(self) -> int:
        """Number of logged steps."""
        return self.controls.shape[1]

    @property
    def each(self) -> int:
        """Number of simulations of a transition."""
        return 1 if self.paired else len(self.theta)

    @property
    def worlds(self) -> int:
        """Number of simulations."""
        return len(self.controls) * self.each

    @cached_property
    def arrays(self) -> list[Any]:
        """θ, states and controls (a row per logged step) as Warp arrays."""
        return [wp.from_torch(x.detach()) for x in (self.theta, self.states, _flat(self.controls))]

    def empty(self, *shape: int) -> torch.Tensor:
        """Memory for results."""
        return torch.empty(*shape, dtype=torch.float64, device=self.states.device)


@dataclass(frozen=True)
class Trace:
    """What the backward needs of a chunk that was simulated: which worlds, their stages, and which are still finite."""

    first: int
    count: int
    memory: dict[str, Any]
    alive: Any


class Engine:
    """Simulates and differentiates worlds of one model on one device.

    Args:
        model: the model, with everything ``mj_setConst`` derives up to date.
        space: what varies.
        skip: physics steps of a logged step.
        chunk_size: worlds in memory at a time.
        num_threads: threads of a CPU, 0 for all processors.
        device: Warp's name of the device.

    Attributes:
        fields: what maps parameter vectors to θ.

    Raises:
        InputError: a model or a parameter outside the subset, or an unknown device.
    """

    def __init__(
        self, model: mujoco.MjModel, space: ParameterSpace, *, skip: int, chunk_size: int, num_threads: int, device: str
    ) -> None:
        pairs = candidate_pairs(model)
        check_support(model, space, pairs)
        model = coinciding(model, space)
        self.fields = Fields(model, space, pairs)
        self.skip, self.chunk_size, self.device = skip, chunk_size, device
        start_warp()
        with LOADING:
            try:
                self.is_cpu = wp.get_device(device).is_cpu
            except Exception:
                names = ", ".join(str(d) for d in wp.get_devices())
                raise InputError(f"device: Warp has no {device!r}; there are: {names}") from None
            m = self.tables = build_tables(model, space, pairs, self.fields.sections, device)
            self._tables = wp.array([m], dtype=Tables, device=device)
            self.columns = wp.array(self.fields.wanted, dtype=wp.int32, device=device)
        self.num_threads = (num_threads or os.cpu_count() or 1) if self.is_cpu else 1
        self.wanted = torch.from_numpy(self.fields.wanted.astype(np.int64))
        self._sizes = {
            "qpos": m.nq, "dof": m.nv, "triangle": m.nh, "body": m.nb, "row": m.maxrow, "contact": m.maxcon,
            "tendon": m.nten, "arm": len(m.ten_dof) if m.nten else 0, "geom": model.ngeom, "pair": m.npair,
            "jacobian": m.maxcon * m.nv, "stage": 4 * m.nv, "theta": self.fields.size,
            "soft": m.nv * m.nv if m.full else m.nh, "full_body": m.nb * m.full, "full_dof": m.nv * m.full,
            "activation": m.na, "stage_activation": 4 * m.na,
        }  # fmt: skip
        self._sizes |= convex_sizes(model, pairs, m.maxcon)
        parts = parts_of(m, convex=self._sizes["convex"] > 0)
        with LOADING:
            self._simulate = kernel_forward.simulate_kernel(parts)
            self._adjoint = kernel_backward.adjoint_kernel(parts)
        self._may_overflow = int(m.pair_most.numpy().sum()) > m.maxcon
        self._worlds: dict[tuple[int, bool], World] = {}
        self._free: list[dict[str, Any]] = []
        self._last: dict[str, Any] | None = None
        self._lock = threading.RLock()  # one call at a time in the scratch memory
        self._loaded: set[Any] = set()

    def row_bytes(self, lag: int) -> int:
        """Bytes that one world keeps for its backward."""
        fields = TRAJECTORY | IMPLICIT if self.tables.implicit else TRAJECTORY
        width = sum(self._sizes[size] for _, size in fields.values())
        return 8 * (lag * self.skip + 1) * self.tables.nstage * width

    def simulate(self, batch: Batch, keep: bool) -> tuple[torch.Tensor, list[Trace]]:
        """Return states after logged steps ``(T·K·lag, nq + nv + na)``, and the traces of the chunks if kept."""
        out = batch.empty(batch.worlds * batch.lag, batch.states.shape[1])
        traces = []
        with self._lock, self._stream(batch):
            for first, count in self._chunks(batch):
                trace = self._forward(batch, out[first * batch.lag : (first + count) * batch.lag], first, count, keep)
                if keep:
                    traces.append(trace)
        return out, traces

    def repeated(self, batch: Batch, out: torch.Tensor) -> Callable[[], None]:
        """Return what simulates a batch whenever it is called, into ``out``, from what then stands in its tensors.

        Launches are prepared once: where a step at a time is simulated, they would take longer than the steps.

        Args:
            batch: what is simulated.
            out: the states after each logged step, ``(T·K·lag, nq + nv + na)``.
        """
        calls, traces = [], []
        with self._lock, self._stream(batch):
            chunks = self._chunks(batch)
            slots = self._slots(max(count for _, count in chunks))
            memory = self._trajectory(slots * _period(batch, False) * self.tables.nstage)
            world = self._fresh_world(slots, memory, adjoint=False)
            for first, count in chunks:
                trace = Trace(first, count, memory, wp.empty(count, dtype=wp.int32, device=self.device))
                rows = wp.from_torch(out[first * batch.lag : (first + count) * batch.lag])
                arguments = [*batch.arrays, trace.alive, rows]
                calls.append(self._launches(self._simulate, world, batch, trace, arguments, False))
                traces.append(trace)
            recorded = [[call(record_cmd=True).launch for call in slices] for slices in calls]

        def run(_kept: object = calls) -> None:  # what was recorded points into the arrays of the calls
            with self._lock, self._stream(batch):
                for slices, trace in zip(recorded, traces, strict=True):
                    _at_once(slices)
                    self._check_contacts(trace)

        return run

    def adjoint(
        self, batch: Batch, out_bar: torch.Tensor, traces: list[Trace]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the adjoints of θ, states and controls; simulates again where there are no traces."""
        columns = batch.empty(len(batch.theta), len(self.wanted)).zero_()
        state_bar, control_bar = torch.zeros_like(batch.states), torch.zeros_like(batch.controls)
        totals = [wp.from_torch(x) for x in (columns, state_bar, _flat(control_bar))]
        with self._lock, self._stream(batch):
            for number, (first, count) in enumerate(self._chunks(batch)):
                bar = out_bar[first * batch.lag : (first + count) * batch.lag]
                trace = traces[number] if traces else self._forward(batch, torch.empty_like(bar), first, count, True)
                self._add(batch, trace, self._backward(batch, trace, bar), totals)
                if not traces:
                    self.release([trace])
        theta_bar = torch.zeros_like(batch.theta)
        theta_bar[:, self.wanted.to(theta_bar.device)] = columns
        return theta_bar, state_bar, control_bar

    def per_world(self, batch: Batch, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return last states and, of every world on its own, vector-Jacobian products.

        Args:
            batch: what is simulated.
            directions: covectors of the last states, ``(J, nq + nv + na)``, the same for every world.

        Returns:
            States ``(T·K, nq + nv + na)``, and products with the Jacobians by the wanted columns of θ
            ``(T·K, J, wanted)`` and by the initial states ``(T·K, J, nq + nv + na)``.
        """
        last = slice(batch.lag - 1, None, batch.lag)
        parts = []
        with self._lock, self._stream(batch):
            for first, count in self._chunks(batch):
                out = batch.empty(count * batch.lag, batch.states.shape[1])
                trace = self._forward(batch, out, first, count, True)
                bars = []
                for direction in directions:
                    bar = torch.zeros_like(out)
                    bar[last] = direction
                    bars.append([wp.to_torch(x).clone() for x in self._backward(batch, trace, bar)[:2]])
                self.release([trace])
                parts.append((out[last], *(torch.stack(bar, 1) for bar in zip(*bars, strict=True))))
        after, by_theta, by_state = (torch.cat(part) for part in zip(*parts, strict=True))
        return after, by_theta, by_state

    def release(self, traces: list[Trace]) -> None:
        """Take the memory of traces back for the next call."""
        with self._lock:
            self._free = [t.memory for t in traces]

    def _forward(self, batch: Batch, out: torch.Tensor, first: int, count: int, keep: bool) -> Trace:
        """Simulate a chunk into the rows ``out`` of its logged steps."""
        rows = (count if keep else self._slots(count)) * _period(batch, keep) * self.tables.nstage
        memory = self._trajectory(rows) if keep else self._passing(rows)
        trace = Trace(first, count, memory, wp.empty(count, dtype=wp.int32, device=self.device))
        self._launch(self._simulate, batch, trace, [*batch.arrays, trace.alive, wp.from_torch(out)], keep)
        self._check_contacts(trace)
        return trace

    def _check_contacts(self, trace: Trace) -> None:
        """Raise where a world had more contacts than there is memory for, if that can be."""
        if self._may_overflow and bool((trace.alive.numpy() < 0).any()):
            raise InputError(
                f"backend warp: more than {self.tables.maxcon} contacts in one simulation; let fewer geoms touch "
                "(contype, conaffinity, <exclude>), or use backend mujoco"
            )

    def _backward(self, batch: Batch, trace: Trace, out_bar: torch.Tensor) -> list[Any]:
        """Adjoints of θ, states and controls, a row for every world (and logged step) of a chunk."""
        theta, states, controls = batch.arrays
        shapes = ((trace.count, len(self.wanted)), (trace.count, states.shape[1]))
        bars = [wp.empty(shape, dtype=wp.float64, device=self.device) for shape in shapes]
        bars.append(wp.zeros((trace.count * batch.lag, controls.shape[1]), dtype=wp.float64, device=self.device))
        arguments = [theta, controls, trace.alive, self.columns, wp.from_torch(out_bar), *bars]
        self._launch(self._adjoint, batch, trace, arguments, True)
        return bars

    def _add(self, batch: Batch, trace: Trace, bars: list[Any], totals: list[Any]) -> None:
        """Add the adjoints of a chunk's worlds to those of parameter vectors, states and controls."""
        first, count, parameters = trace.first, trace.count, len(batch.theta)
        wp.launch(
            kernel_backward.sum_over_transitions, dim=(parameters, len(self.wanted)), device=self.device,
            inputs=[bars[0], totals[0], first, count, parameters],
        )  # fmt: skip
        each = (batch.worlds // len(batch.states), parameters)
        for bar, total, width, shared in zip(bars[1:], totals[1:], (1, batch.lag), each, strict=True):
            touched = (first + count - 1) // shared - first // shared + 1
            wp.launch(
                kernel_backward.sum_over_parameters, dim=(touched, width, bar.shape[1]), device=self.device,
                inputs=[bar, total, first, count, shared, width],
            )  # fmt: skip

    def _launch(self, kernel: Any, batch: Batch, trace: Trace, arguments: list[Any], keep: bool) -> None:
        """Launch a kernel on the worlds of a chunk."""
        world = self._world(self._slots(trace.count), trace.memory, kernel is self._adjoint)
        _at_once(self._launches(kernel, world, batch, trace, arguments, keep))

    def _launches(
        self, kernel: Any, world: Any, batch: Batch, trace: Trace, arguments: list[Any], keep: bool
    ) -> list[Callable[..., Any]]:
        """What launches a kernel on the worlds of a chunk: on a CPU one contiguous slice for each thread."""
        if kernel.module not in self._loaded:  # compiled or loaded before threads launch it
            wp.load_module(kernel.module.name, device=self.device)
            self._loaded.add(kernel.module)

        def launch(local: int, number: int, slot: int) -> Callable[..., Any]:
            chunk = fill(Chunk(), {
                "first": trace.first + local, "local": local, "nparam": len(batch.theta), "each": batch.each,
                "start_each": batch.worlds // len(batch.states),
                "lag": batch.lag, "skip": batch.skip, "period": _period(batch, keep), "slot": slot,
                "slot_stride": int(not self.is_cpu), "keep": int(keep),
                "applied": int(batch.applied), "wrenched": int(batch.wrenched),
            })  # fmt: skip
            inputs = [self._tables, world, chunk, *arguments]
            return partial(wp.launch, kernel, dim=number, inputs=inputs, device=self.device)

        work = trace.count * batch.lag * batch.skip * self.tables.nv
        threads = self._slots(trace.count) if self.is_cpu and work >= ALONE else 1
        bounds = [trace.count * i // threads for i in range(threads + 1)]
        return [launch(a, b - a, i) for i, (a, b) in enumerate(pairwise(bounds))]

    def _chunks(self, batch: Batch) -> list[tuple[int, int]]:
        """``(first, count)`` of the chunks of worlds."""
        return [(i, min(self.chunk_size, batch.worlds - i)) for i in range(0, batch.worlds, self.chunk_size)]

    def _slots(self, count: int) -> int:
        return min(self.num_threads, count) if self.is_cpu else count

    def _stream(self, batch: Batch) -> Any:
        """PyTorch's stream of a GPU as Warp's, so that kernels wait for tensors and tensors for kernels."""
        if self.is_cpu:
            return contextlib.nullcontext()
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(batch.states.device)))

    def _passing(self, rows: int) -> dict[str, Any]:
        """Memory of a number of stages that no backward asks for, made once."""
        if self._last is None or len(self._last["held"]) != rows:
            self._last = self._trajectory(rows)
        return self._last

    def _trajectory(self, rows: int) -> dict[str, Any]:
        """Memory of a number of stages, from those that a backward has given back."""
        for i, memory in enumerate(self._free):
            if len(memory["held"]) == rows:
                return self._free.pop(i)
        memory = self._allocate(TRAJECTORY, rows) | self._allocate(IMPLICIT, rows if self.tables.implicit else 1)
        if not self.tables.has_ball:  # then a rate is a velocity
            memory["rate"] = memory["qvel"]
        return memory | {"held": wp.empty(rows, dtype=wp.int32, device=self.device)}

    def _world(self, slots: int, memory: dict[str, Any], adjoint: bool) -> World:
        """Working memory of a number of slots, made once, with that of the trajectories."""
        key = (slots, adjoint)
        if key not in self._worlds:
            self._worlds[key] = self._fresh_world(slots, {}, adjoint=adjoint)
        return fill(self._worlds[key], memory)

    def _fresh_world(self, slots: int, memory: dict[str, Any], *, adjoint: bool) -> World:
        # a gap between slots, so that no two threads write one cache line
        own = self._allocate(SCRATCH | ADJOINT if adjoint else SCRATCH, slots, gap=16)
        own["full"] = wp.zeros(slots, dtype=wp.int32, device=self.device)
        if not self.tables.nweld:  # then nothing is added to M
            own["quad"] = own["mass"]
        return fill(World(), own | memory)

    def _allocate(self, fields: dict[str, tuple[Any, str]], rows: int, gap: int = 0) -> dict[str, Any]:
        """Arrays of fields of a world, with a number of rows."""
        arrays = {}
        for name, (dtype, size) in fields.items():
            width = max(self._sizes[size], 1)
            arrays[name] = wp.empty((rows, width + gap), dtype=dtype, device=self.device)[:, :width]
        return arrays


def _at_once(launches: Sequence[Callable[..., Any]]) -> None:
    """Make launches, each on a thread of its own; a launch on a CPU releases Python's lock."""
    if len(launches) == 1:
        launches[0]()
        return
    jobs = [_pool(os.getpid(), len(launches)).submit(launch) for launch in launches]
    wait(jobs)  # all of them, also where one fails: they share memory with the next
    for job in jobs:
        job.result()


@cache
def _pool(_process: int, count: int) -> ThreadPoolExecutor:
    """Threads of this process: one that was forked has none of its parent's."""
    return ThreadPoolExecutor(count, thread_name_prefix="warp")


def _period(batch: Batch, keep: bool) -> int:
    """Steps of a trajectory that are in memory."""
    return batch.lag * batch.skip + 1 if keep else 2


def _flat(x: torch.Tensor) -> torch.Tensor:
    """All but the last axis as one."""
    return x.reshape(x.shape[:-1].numel(), x.shape[-1])


class Simulate(torch.autograd.Function):
    """``(θ, states, controls) → states after each logged step``, with the adjoint kernels as its backward."""

    @staticmethod
    def forward(
        ctx: Any, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor, engine: Engine
    ) -> torch.Tensor:
        """Return ``(T, K, lag, nq + nv + na)`` of θ, states and controls; see :class:`Batch`."""
        batch = Batch(theta, states, controls, engine.skip)
        wanted = any(ctx.needs_input_grad[:3])
        keep = wanted and batch.worlds * engine.row_bytes(batch.lag) <= KEEP_BYTES
        out, traces = engine.simulate(batch, keep)
        ctx.save_for_backward(theta, states, controls)
        ctx.engine, ctx.traces = engine, traces
        return out.view(len(controls), len(theta), batch.lag, -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, out_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the adjoints of the inputs."""
        theta, states, controls = ctx.saved_tensors
        batch = Batch(theta, states, controls, ctx.engine.skip)
        bars = ctx.engine.adjoint(batch, _flat(out_bar).contiguous(), ctx.traces)
        # a second backward through the same graph simulates again
        ctx.engine.release(ctx.traces)
        ctx.traces = []
        return (*bars, None)
