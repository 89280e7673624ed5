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
from dropo_torch.simulators.warp.types import Rows, Scratch, Tables, mat33, vec3, vec6, vec10

#: Stages kept from the forward for the backward, at most; beyond it the backward simulates again, chunk by chunk.
KEEP_BYTES = 1 << 30


@dataclass(frozen=True)
class Problem:
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

    rows: Rows
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
        self._scratch: dict[tuple[int, bool], Scratch] = {}
        self._free: list[tuple[int, Rows]] = []
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
        self, problem: Problem, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor, keep: bool
    ) -> tuple[torch.Tensor, list[Trace]]:
        """Return the states after each logged step ``(T·K·lag, nq + nv)``, and the traces of the chunks if kept."""
        out = torch.empty(problem.worlds * problem.lag, states.shape[1], dtype=torch.float64, device=states.device)
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, _flat(controls))]
        traces = []
        with self._lock, self._stream(states):
            for first, count in self.chunks(problem.worlds):
                part = wp.from_torch(out[first * problem.lag : (first + count) * problem.lag])
                trace = self._forward(problem, inputs, part, first, count, keep)
                if keep:
                    traces.append(trace)
        return out, traces

    def adjoint(
        self, problem: Problem, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor,
        out_bar: torch.Tensor, traces: list[Trace],
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
        """Return the adjoints of θ, states and controls; simulates again where there are no traces."""
        flat = _flat(controls)
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, flat)]
        columns = torch.zeros(problem.parameters, len(self.wanted), dtype=torch.float64, device=states.device)
        state_bar, control_bar = torch.zeros_like(states), torch.zeros_like(flat)
        totals = [wp.from_torch(x) for x in (columns, state_bar, control_bar)]
        with self._lock, self._stream(states):
            for number, (first, count) in enumerate(self.chunks(problem.worlds)):
                rows = slice(first * problem.lag, (first + count) * problem.lag)
                if traces:
                    trace = traces[number]
                else:
                    part = wp.empty((count * problem.lag, states.shape[1]), dtype=wp.float64, device=self.device)
                    trace = self._forward(problem, inputs, part, first, count, keep=True)
                self._backward(problem, inputs, trace, wp.from_torch(out_bar[rows]), totals, first, count)
                if not traces:
                    self.release([trace])
        theta_bar = torch.zeros_like(theta)
        theta_bar[:, self.wanted.to(theta.device)] = columns
        return theta_bar, state_bar, control_bar.reshape(controls.shape)

    def per_world(
        self, problem: Problem, theta: torch.Tensor, states: torch.Tensor, controls: torch.Tensor,
        directions: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
        """Return last states and, of every world on its own, vector-Jacobian products.

        Args:
            problem: with ``lag`` logged steps.
            theta, states, controls: as for :meth:`simulate`.
            directions: covectors of the last states, ``(J, nq + nv)``, the same for every world.

        Returns:
            States ``(T·K, nq + nv)``, and products with the Jacobians by the wanted columns of θ
            ``(T·K, J, wanted)`` and by the start states ``(T·K, J, nq + nv)``.
        """
        inputs = [wp.from_torch(x.detach()) for x in (theta, states, _flat(controls))]
        width, lag = states.shape[1], problem.lag
        after, by_theta, by_state = [], [], []
        with self._lock, self._stream(states):
            for first, count in self.chunks(problem.worlds):
                out = torch.empty(count * lag, width, dtype=torch.float64, device=states.device)
                trace = self._forward(problem, inputs, wp.from_torch(out), first, count, keep=True)
                after.append(out[lag - 1 :: lag])
                columns = []
                for direction in directions:
                    bar = torch.zeros_like(out)
                    bar[lag - 1 :: lag] = direction
                    theta_bar, state_bar, _ = self._worlds(problem, inputs, trace, wp.from_torch(bar), first, count)
                    columns.append((wp.to_torch(theta_bar).clone(), wp.to_torch(state_bar).clone()))
                self.release([trace])
                by_theta.append(torch.stack([c[0] for c in columns], 1))
                by_state.append(torch.stack([c[1] for c in columns], 1))
        return torch.cat(after), torch.cat(by_theta), torch.cat(by_state)

    def _forward(self, problem: Problem, inputs: list[Any], out: Any, first: int, count: int, keep: bool) -> Trace:
        self._load(kernel_forward)
        period = problem.lag * problem.skip + 1 if keep else 2
        slots = self._slots(count)
        rows = self._rows((count if keep else slots) * period * self.tables.nstage)
        alive = wp.empty(count, dtype=wp.int32, device=self.device)
        scratch = self._working(slots, adjoint=False)

        def launch(local: int, number: int, slot: int) -> None:
            wp.launch(
                kernel_forward.simulate_kernel, dim=number, device=self.device,
                inputs=[self.tables, scratch, rows, *inputs, out, alive, first + local, local, problem.parameters,
                        problem.each, problem.lag, problem.skip, period, slot, int(not self.is_cpu), int(keep)],
            )  # fmt: skip

        self._spread(launch, count)
        return Trace(rows, alive)

    def _backward(
        self, problem: Problem, inputs: list[Any], trace: Trace, out_bar: Any, totals: list[Any], first: int,
        count: int,
    ) -> None:  # fmt: skip
        lag, parameters = problem.lag, problem.parameters
        theta_bar, state_bar, control_bar = self._worlds(problem, inputs, trace, out_bar, first, count)
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
        self, problem: Problem, inputs: list[Any], trace: Trace, out_bar: Any, first: int, count: int
    ) -> tuple[Any, Any, Any]:
        """Adjoints of θ, states and controls, a row for every world (and logged step) of a chunk."""
        self._load(kernel_backward)
        theta, states, controls = inputs
        lag, period = problem.lag, problem.lag * self.skip + 1
        scratch = self._working(self._slots(count), adjoint=True)
        state_bar = wp.empty((count, states.shape[1]), dtype=wp.float64, device=self.device)
        control_bar = wp.zeros((count * lag, controls.shape[1]), dtype=wp.float64, device=self.device)
        theta_bar = wp.empty((count, len(self.wanted)), dtype=wp.float64, device=self.device)

        def launch(local: int, number: int, slot: int) -> None:
            wp.launch(
                kernel_backward.adjoint_kernel, dim=number, device=self.device,
                inputs=[self.tables, scratch, trace.rows, theta, controls, trace.alive, self.columns, out_bar,
                        state_bar, control_bar, theta_bar, first + local, local, problem.parameters, lag, self.skip,
                        period, slot, int(not self.is_cpu)],
            )  # fmt: skip

        self._spread(launch, count)
        return theta_bar, state_bar, control_bar

    def _slots(self, count: int) -> int:
        return min(self.num_threads, count) if self.is_cpu else count

    def _spread(self, launch: Any, count: int) -> None:
        """One contiguous slice of worlds for each thread; a launch on a CPU releases Python's lock."""
        threads = self._slots(count) if self.is_cpu else 1
        bounds = [count * i // threads for i in range(threads + 1)]
        if threads == 1:
            launch(0, count, 0)
            return
        with ThreadPoolExecutor(threads) as pool:
            jobs = [pool.submit(launch, a, b - a, i) for i, (a, b) in enumerate(pairwise(bounds))]
            for job in jobs:
                job.result()

    def _rows(self, number: int) -> Rows:
        """Memory of a number of stages, from those that a backward has given back."""
        for i, (size, rows) in enumerate(self._free):
            if size == number:
                del self._free[i]
                return rows
        return self._new_rows(number)

    def release(self, traces: list[Trace]) -> None:
        """Take the memory of traces back for the next call."""
        with self._lock:
            self._free = [(t.rows.qpos.shape[0], t.rows) for t in traces]

    def _stream(self, like: torch.Tensor) -> Any:
        """PyTorch's stream of a GPU as Warp's, so that kernels wait for tensors and tensors for kernels."""
        if self.is_cpu:
            return contextlib.nullcontext()
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))

    def _load(self, module: Any) -> None:
        """Compile or load kernels before threads launch them."""
        if module.__name__ not in self._loaded:
            wp.load_module(module, device=self.device)
            self._loaded.add(module.__name__)

    def _new_rows(self, number: int) -> Rows:
        m, rows = self.tables, Rows()
        soft = number if m.implicit else 1
        widths = dict.fromkeys(("qvel", "rate", "acc"), (number, m.nv))
        widths |= {"qpos": (number, m.nq), "hess": (number, m.nh), "soft": (soft, m.nv), "soft_hess": (soft, m.nh)}
        for name, (count, width) in widths.items():
            setattr(rows, name, wp.empty((count, max(width, 1)), dtype=wp.float64, device=self.device))
        if not m.has_ball:  # then a rate is a velocity
            rows.rate = rows.qvel
        rows.held = wp.empty(number, dtype=wp.int32, device=self.device)
        return rows

    def _working(self, slots: int, *, adjoint: bool) -> Scratch:
        """Scratch memory of a number of slots, made once."""
        key = (slots, adjoint)
        if key not in self._scratch:
            self._scratch[key] = self._new_scratch(slots, adjoint)
        return self._scratch[key]

    def _new_scratch(self, slots: int, adjoint: bool) -> Scratch:
        m, scratch = self.tables, Scratch()
        nb, nv, row, con = m.nb, m.nv, m.maxrow, m.maxcon
        real, number = wp.float64, wp.int32
        sizes: dict[str, tuple[Any, int]] = {
            "xpos": (vec3, nb), "xmat": (mat33, nb), "motion": (vec6, nv), "mass": (real, m.nh),
            "row_dof": (number, 3 * row), "row_coef": (vec3, row), "con_jac": (vec6, con * nv),
            "con_point": (vec3, con), "con_frame": (mat33, con), "con_hint": (vec3, con),
        }  # fmt: skip
        sizes |= dict.fromkeys(("velocity", "bias", "force"), (vec6, nb))
        sizes |= dict.fromkeys(("inertia", "composite"), (vec10, nb))
        sizes |= dict.fromkeys(("load", "step", "product", "work"), (real, nv))
        sizes |= dict.fromkeys(("row_kind", "row_index"), (number, row))
        sizes |= dict.fromkeys(("row_x", "row_aref", "row_d", "row_loss", "row_jar", "row_dir"), (real, row))
        sizes |= dict.fromkeys(("con_pair", "con_which"), (number, con))
        sizes |= dict.fromkeys(("con_dist", "con_d"), (real, con))
        sizes |= dict.fromkeys(("con_aref", "con_jar", "con_dir"), (vec6, con))
        if adjoint:
            forces = ("f_velocity", "f_accel", "f_total", "f_dual", "f_pose")
            sizes |= dict.fromkeys(("total", "dual", *forces), (vec6, nb))
            ends = ("pos_bar", "rate_bar", "pos_bar0")
            sizes |= dict.fromkeys(("lam", "qacc", "qd", "tangent", "vel_bar", "acc_bar", *ends), (real, nv))
            sizes |= dict.fromkeys(("stage_vel_bar", "stage_acc_bar", "stage_rate_bar"), (real, 4 * nv))
            sizes["grad"] = (real, self.size)
        for name, (dtype, width) in sizes.items():
            # a gap between slots, so that no two threads write one cache line
            array = wp.empty((slots, max(width, 1) + 16), dtype=dtype, device=self.device)
            setattr(scratch, name, array[:, : max(width, 1)])
        return scratch


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
        problem = Problem(len(states), len(theta), controls.shape[1], engine.skip)
        wanted = any(ctx.needs_input_grad[:3])
        keep = wanted and problem.worlds * engine.row_bytes(problem.lag) <= KEEP_BYTES
        out, traces = engine.simulate(problem, theta, states, controls, keep)
        ctx.save_for_backward(theta, states, controls)
        ctx.engine, ctx.problem, ctx.traces = engine, problem, traces
        return out.view(problem.transitions, problem.parameters, problem.lag, -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, out_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the adjoints of the inputs."""
        theta, states, controls = ctx.saved_tensors
        flat = _flat(out_bar).contiguous()
        bars = ctx.engine.adjoint(ctx.problem, theta, states, controls, flat, ctx.traces)
        # a second backward through the same graph simulates again
        ctx.engine.release(ctx.traces)
        ctx.traces = []
        return (*bars, None)
