"""Simulating a log in chunks whose size does not depend on T·K, and summing what is made of each."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from dropo_torch.data.features import Features
from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import MOST_BEFORE, Replay, StatesBefore, Transitions
from dropo_torch.errors import InputError
from dropo_torch.simulators.base import Simulator
from dropo_torch.support.threads import single_thread

#: Some of a log's transitions.
Rows = slice | torch.Tensor
#: ``visit(features (t, P, m), rows) -> (r,)``, summed over chunks.
Visit = Callable[[torch.Tensor, Rows], torch.Tensor]
#: ``reduce(features (w, P, H, m), measured (w, H, m), controls (w, H, nu)) -> (r,)``, summed over replayed windows.
ReplayReduce = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, eq=False)
class Sums:
    """What an evaluation gave, and what it took.

    Attributes:
        total: the sums, ``(r,)``.
        simulated_transitions: logged steps that were simulated for them.
        gradient: of the first sum in the parameter values, ``(P, d)``, where it was asked for.
    """

    total: torch.Tensor
    simulated_transitions: int
    gradient: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class Evaluator:
    """Simulates the transitions of a log; the sums depend neither on the number of threads nor on earlier calls.

    Attributes:
        simulator: simulates the transitions.
        transitions: the log's windows, T of them.
        observation: what the log's columns are.
        features: what of them is compared.
        chunk_size: rows (transition, parameter vector) held at once.
    """

    simulator: Simulator
    transitions: Transitions
    observation: Observation
    features: Features
    chunk_size: int

    def __len__(self) -> int:
        """Return the number of transitions T."""
        return len(self.transitions)

    @cached_property
    def states(self) -> torch.Tensor:
        """Simulator states at the windows' starts, ``(T, num_states)``."""
        return _tensor(self.transitions.states)

    @cached_property
    def controls(self) -> torch.Tensor:
        """Controls of the windows, ``(T, history + lag, nu)``."""
        return _tensor(self.transitions.controls)

    @cached_property
    def columns(self) -> torch.Tensor:
        """Observed columns measured at the windows' ends, ``(T, n)``."""
        return _tensor(self.transitions.measured)

    @property
    def columns_at_start(self) -> torch.Tensor:
        """Observed columns measured at the windows' starts, ``(T, n)``."""
        return self.states[:, self.observation.index]

    @cached_property
    def measured(self) -> torch.Tensor:
        """Their features, ``(T, m)``; rotations are 0."""
        return self.features.values(self.columns, self.columns)

    @property
    def has_cheaper_jacobian(self) -> bool:
        """Whether one backward pass a column costs less than one simulation a parameter (a pass costs about 1.5)."""
        passes = 1.5 * self.observation.size
        return hasattr(self.simulator, "jacobian") and passes < len(self.simulator.parameters)

    def blocks(self, vectors: int, count: int | None = None) -> Iterator[slice]:
        """Return slices of ``count`` transitions, all by default, that may be simulated at once under P vectors."""
        count, size = len(self) if count is None else count, self.chunk_size
        if (past := self.transitions.past) is not None:
            size = min(size, max(1, MOST_BEFORE // (past.count * past.padded.shape[1])))
        step = max(1, size // max(1, vectors))
        return (slice(a, min(a + step, count)) for a in range(0, count, step))

    def begun(self, rows: Rows, states: torch.Tensor | None = None) -> torch.Tensor:
        """Return what a simulator is given to begin some transitions with: the states, after those of their past.

        Args:
            rows: t of the transitions.
            states: M states from which to begin each, ``(t, M, num_states)``, in place of the logged one.
        """
        given = self.states[rows][:, None] if states is None else states
        return _after_past(self.transitions.past, rows, given).flatten(0, 1)

    def after(self, rows: Rows, values: torch.Tensor, states: torch.Tensor | None = None) -> torch.Tensor:
        """Simulate some transitions under parameter values ``(P, d)``, in units; NaN where one diverges.

        Args:
            rows: t of the transitions.
            values: parameter values.
            states: M states from which to begin each, ``(t, M, num_states)``, in place of the logged one.

        Returns:
            Features ``(t, P, m)``, or ``(t * M, P, m)``.
        """
        controls, measured = self.controls[rows], self.columns[rows]
        begun = self.begun(rows, states)
        if states is not None:
            controls, measured = (x.repeat_interleave(states.shape[1], 0) for x in (controls, measured))
        columns = self.simulator.simulate(begun, controls, values)[..., self.observation.index]
        return self.features.values(columns, measured[:, None].expand_as(columns))

    def map(self, values: np.ndarray | torch.Tensor, visit: Visit, rows: np.ndarray | None = None) -> Sums:
        """Simulate transitions under parameter values ``(P, d)``, in units, and sum ``visit`` over chunks.

        Args:
            values: parameter values.
            visit: what to sum.
            rows: the transitions to simulate; ``None`` for all of them.
        """
        vectors = _tensor(values)
        picked = self._picked(len(vectors), rows)
        return Sums(_total(lambda p: visit(self.after(p, vectors), p), picked), self._cost(len(vectors), rows))

    def gradient(self, values: np.ndarray | torch.Tensor, visit: Visit, rows: np.ndarray | None = None) -> Sums:
        """Do what :meth:`map` does, with the gradient of the first sum in ``values``.

        Raises:
            InputError: a simulator without gradients.
        """
        if not self.simulator.differentiable:
            raise InputError(f"backend: {self.simulator.name} has no gradients; {self.simulator.remedy}")
        leaf = _tensor(values).requires_grad_(True)
        slope = torch.zeros_like(leaf)

        def part(picked: Rows) -> torch.Tensor:
            sums = visit(self.after(picked, leaf), picked)
            if sums.requires_grad:  # it does not where all of them diverge
                slope.add_(torch.nan_to_num(torch.autograd.grad(sums[0], leaf)[0]))
            return sums.detach()

        return Sums(_total(part, self._picked(len(leaf), rows)), self._cost(len(leaf), rows), slope)

    def map_linear(self, values: np.ndarray | torch.Tensor, visit: Visit) -> Sums:
        """Do what :meth:`map` does for vectors close to the first, by exact derivatives there."""
        vectors = _tensor(values)
        directions = torch.eye(self.simulator.num_states, dtype=torch.float64)[self.observation.index]

        def part(block: slice) -> torch.Tensor:
            after, slope, _ = self.simulator.jacobian(  # type: ignore[attr-defined]
                self.states[block], self.controls[block], vectors[:1], directions
            )
            moved = torch.einsum("tmd,pd->tpm", slope[:, 0], vectors - vectors[0])
            columns = after[..., self.observation.index] + moved
            return visit(self.features.values(columns, self.columns[block][:, None].expand_as(columns)), block)

        # a backward pass counts as a simulation
        return Sums(_total(part, self.blocks(len(directions) + 1)), self._cost(len(directions), None))

    def map_replay(self, replay: Replay, values: np.ndarray | torch.Tensor, reduce: ReplayReduce) -> Sums:
        """Replay windows open loop under parameter values ``(P, d)``, in units, and sum ``reduce`` over them.

        Args:
            replay: the windows: W of H logged steps each.
            values: parameter values.
            reduce: what to sum; a replay that diverges is NaN throughout.
        """
        vectors = _tensor(values)
        states, controls, measured = (torch.from_numpy(x) for x in (replay.states, replay.controls, replay.measured))

        def part(block: slice) -> torch.Tensor:
            begun = _after_past(replay.past, block, states[block][:, None]).flatten(0, 1)
            after = self.simulator.rollout(begun, controls[block], vectors)[..., self.observation.index]
            logged = measured[block]
            about = logged[:, :1].expand_as(logged) if replay.about_start else logged
            features = self.features.values(after, about[:, None].expand_as(after))
            return reduce(features, self.features.values(logged, about), controls[block][:, replay.history :])

        steps = len(vectors) * replay.horizon
        return Sums(_total(part, self.blocks(steps, len(states))), len(states) * steps)

    def _picked(self, vectors: int, rows: np.ndarray | None) -> Iterator[Rows]:
        """The chosen transitions, in chunks."""
        if rows is None:
            return self.blocks(vectors)
        chosen = torch.as_tensor(rows)
        return (chosen[block] for block in self.blocks(vectors, len(rows)))

    def _cost(self, vectors: int, rows: np.ndarray | None) -> int:
        """Logged steps in a simulation of the chosen transitions."""
        return (len(self) if rows is None else len(rows)) * vectors * self.transitions.lag


def _tensor(values: np.ndarray | torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))


def _after_past(past: StatesBefore | None, rows: Rows, states: torch.Tensor) -> torch.Tensor:
    """States ``(t, M, num_states)`` after those of the rows before, ``(t, M, P + 1, num_states)``; alone where none."""
    if past is None:
        return states
    before = torch.from_numpy(past[rows.numpy() if isinstance(rows, torch.Tensor) else rows])
    return torch.cat([before[:, None].expand(-1, states.shape[1], -1, -1), states[:, :, None]], 2)


def _total(part: Callable[..., torch.Tensor], chunks: Iterator[Rows]) -> torch.Tensor:
    """The sum of parts, chunk by chunk; the simulator has threads of its own, torch's would only get in their way."""
    with single_thread():
        return functools.reduce(operator.add, map(part, chunks))
