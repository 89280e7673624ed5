"""Whole windows of a log, simulated under many variants of the model at once."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from dropo_torch.effects.base import Placed, Setting, applied, find_effect
from dropo_torch.effects.engine import Past, Variant, VariantEngine, parts, past_rows, remembered_from, whole_ratio
from dropo_torch.effects.filters import (
    Filter,
    extended,
    filtered,
    observed_rates,
    placed_filters,
    sensed,
    settled_after,
    unsensed,
)
from dropo_torch.effects.path import SensedPath
from dropo_torch.models.constants import velocity_lead
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.hidden import filters_known

#: Bytes of filtered commands that are kept; of the last candidate, in any case.
KEPT = 2**27
#: Sets of initial states that are kept where loops have to be closed.
CLOSED = 16


@dataclass(frozen=True)
class Windows:
    """Stretches of a log, each simulated from its own start.

    Attributes:
        measured: observed columns at L + 1 instants, the start included, ``(W, L + 1, n)``.
        rates: time derivatives of the columns at the starts, as the log shows them, ``(W, n)``.
        episodes: episode of each window, ``(W,)``.
        steps: logged step of each window's start within its episode, ``(W,)``.
        commands: commands of every episode at every logged step, the last one repeated, ``(E, N, nu)``.
        unseen: positions at the starts that no column has and that follow from the log, ``(W, k)``.
        starts: observed columns from which they are simulated, ``(W, n)``; by default :attr:`usual`.
        smooth: these columns by the rows around, ``(W, n)``, where single rows are too noisy to begin at.
        gains: noise of each column at each instant relative to that of a sample, ``(W, L + 1, n)``; 1 by default.
        observed: observed columns of every episode at every logged step, the last ones repeated, ``(E, N, n)``, where
            what was before a window is known.
    """

    measured: np.ndarray
    rates: np.ndarray
    episodes: np.ndarray
    steps: np.ndarray
    commands: np.ndarray
    unseen: np.ndarray | None = None
    starts: np.ndarray | None = None
    smooth: np.ndarray | None = None
    gains: np.ndarray | None = None
    observed: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.measured)

    @property
    def begins(self) -> np.ndarray:
        """Observed columns from which they are simulated, ``(W, n)``."""
        return self.usual if self.starts is None else self.starts

    @property
    def usual(self) -> np.ndarray:
        """Observed columns from which they are simulated unless better ones are known, ``(W, n)``."""
        return self.measured[:, 0] if self.smooth is None else self.smooth

    @property
    def length(self) -> int:
        """Logged steps L of a window."""
        return self.measured.shape[1] - 1

    def select(self, rows: np.ndarray | slice) -> Windows:
        """Return the given windows."""
        names = ("measured", "rates", "episodes", "steps", "unseen", "starts", "smooth", "gains")
        given = {name: getattr(self, name) for name in names}
        return replace(self, **{name: array[rows] for name, array in given.items() if array is not None})


class Twin:
    """Simulates windows under variants of the model.

    Args:
        setting: the model as given, and the log's columns.
        space: the declared parameters.
        num_threads: threads, 0 for all processors; results do not depend on it.
        chunk_size: simulations at a time.
        warp: simulate with the Warp backend wherever it can; MuJoCo does the rest, with the same physics.
        standing: effects that every variant has, of the declared parameters' values ``(d,)``; those of the config.
        coarser: the one of which this is the same with a finer step, whose transitions count these, too.

    Attributes:
        warp: whether Warp simulates wherever it can.
        rates: for a column, the column that is its time derivative, or -1, ``(n,)``.
        simulated_transitions: logged transitions simulated so far.
    """

    def __init__(
        self, setting: Setting, space: ParameterSpace, *, num_threads: int = 0, chunk_size: int = 6000,
        warp: bool = False, standing: Callable[[np.ndarray], tuple[Placed, ...]] | None = None,
        coarser: Twin | None = None,
    ) -> None:  # fmt: skip
        self.setting, self.space, self._standing, self._chunk = setting, space, standing, chunk_size
        self.num_threads, self.warp = num_threads, warp
        self._engine = VariantEngine(setting, space, num_threads=num_threads, warp=warp)
        self.rates = np.array(observed_rates(setting))
        self._commands: np.ndarray | None = None
        self._filtered: dict[tuple, np.ndarray] = {}
        self._closed: dict[bytes, np.ndarray] = {}
        self.simulated_transitions, self._finer, self._coarser = 0, dict[Placed, Twin](), coarser

    def finer(self, step: Placed) -> Twin:
        """Return the same with the physics step that an effect sets: of filters and effects, too."""
        if step not in self._finer:
            model = applied(self.setting.model, [step])
            ratio = round(self.setting.model.opt.timestep / model.opt.timestep)
            setting = replace(self.setting, model=model, frame_skip=self.setting.frame_skip * ratio)
            self._finer[step] = Twin(
                setting, self.space, num_threads=self.num_threads, chunk_size=self._chunk, warp=self.warp,
                standing=self._standing, coarser=self,
            )  # fmt: skip
        return self._finer[step]

    @property
    def eased(self) -> Twin:
        """The same with a step under which differences cost less, where this one has a finer one than they need.

        What changes with initial states and other numbers changes alike: see :meth:`Effect.eased`.
        """
        if self._coarser is None:
            return self
        setting, effect = self._coarser.setting, find_effect("integration")
        step = effect.eased(setting, (effect.quantities(setting, None)[0].low,))
        if step[0] <= self.setting.model.opt.timestep:
            return self
        return self._coarser.finer(Placed(effect, None, step))

    def effects(self, variant: Variant) -> tuple[Placed, ...]:
        """Return all effects of a variant, those that every variant has among them."""
        standing = () if self._standing is None else self._standing(np.asarray(variant.declared))
        return (*standing, *variant.placed)

    def predict(
        self,
        variants: Sequence[Variant],
        windows: Windows,
        starts: np.ndarray | None = None,
        pushes: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate every window under every variant.

        Args:
            variants: the hypotheses, K of them.
            windows: the stretches of the log.
            starts: observed columns at the starts as the sensors would show them, ``(W, n)`` for all variants or
                ``(K, W, n)``; the windows' own by default.
            pushes: generalized forces in every logged step, ``(K, L, nv)``, the same in all windows; none by default.

        Returns:
            What the sensors would show, ``(K, W, L + 1, n)``, NaN where a simulation diverged, and which entries
            the simulation can know, of the same shape.
        """
        if any(twins := [self._filtering(v) for v in variants]):
            return self._predict_apart(twins, variants, windows, starts, pushes)
        num_k, num_w, length = len(variants), len(windows), windows.length
        variants = [replace(v, placed=self.effects(v)) for v in variants]
        shown = windows.begins if starts is None else starts
        shown = np.broadcast_to(shown, (num_k, num_w, shown.shape[-1]))
        out = np.full((num_k, num_w, length + 1, shown.shape[-1]), np.nan)
        valid = np.ones(out.shape, dtype=bool)
        models, index = self._engine.models(variants), self.setting.observation.index
        for fine in (False, True):
            members = [k for k, v in enumerate(variants) if models[k] is not None and v.has("sense") == fine]
            calls = parts(len(members), max(1, self._chunk // max(1, num_w)))
            for part, rows in itertools.product([members[c] for c in calls], parts(num_w, self._chunk)):
                chosen, given = [variants[k] for k in part], windows.select(rows)
                states = np.stack([self._states(variants[k], models[k], shown[k, rows], given) for k in part])
                signals = np.stack([self._signals(v, given) for v in chosen])
                forces = None if pushes is None else pushes[part]
                own = [models[k] for k in part]
                past = self._past(chosen, given)
                path = self._engine.paths(chosen, own, states, signals, fine=fine, pushes=forces, past=past)
                truth = np.concatenate([states[:, :, None, index], path[..., index]], 2)
                for k, columns in zip(part, truth, strict=True):
                    out[k, rows], valid[k, rows] = self._shown(variants[k], columns, length)
        for twin in filter(None, (self, self._coarser)):
            twin.simulated_transitions += num_k * num_w * length
        return out, valid

    def _filtering(self, variant: Variant) -> Twin | None:
        """The twin with the finer step under which a variant's filters act; ``None`` where that is this one."""
        placed = self.effects(variant)
        step = next((p for p in placed if p.effect.steps), None)
        if step is None or step.values[0] == self.setting.model.opt.timestep:
            return None
        if not any(p.effect.has("command") or p.effect.has("sense") for p in placed):
            return None  # physics alone is stepped finer by the engine, with other variants
        return self.finer(step) if whole_ratio(self.setting.model.opt.timestep, step.values[0]) else None

    def _predict_apart(
        self, twins: Sequence[Twin | None], variants: Sequence[Variant], windows: Windows, starts: np.ndarray | None,
        pushes: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """:meth:`predict` where some variants have twins of their own."""
        out = np.full((len(variants), *windows.measured.shape), np.nan)
        valid = np.ones(out.shape, dtype=bool)
        for twin in dict.fromkeys(twins):
            rows = [k for k, own in enumerate(twins) if own is twin]
            shown = starts[rows] if starts is not None and starts.ndim == 3 else starts
            given = [variants[k] for k in rows], windows, shown, None if pushes is None else pushes[rows]
            out[rows], valid[rows] = (twin or self).predict(*given)
        return out, valid

    def settled(self, variant: Variant, commands: np.ndarray) -> np.ndarray:
        """Return the logged step of each episode from which on the log tells all that acts in a variant, ``(E,)``.

        Those are its commands as they act, and what it remembers of the motion before.

        Args:
            variant: the hypothesis.
            commands: commands of the episodes' logged steps, ``(E, N, nu)``.
        """
        filters = placed_filters(self.effects(variant), "command", self.setting)
        skip, lengths = self.setting.frame_skip, np.full(len(commands), commands.shape[1])
        found = settled_after(commands, filters, skip, float(self.setting.model.opt.timestep))
        known = np.maximum(found, filters_known(self._engine.lead, skip, lengths))
        return np.maximum(known, remembered_from(lengths, self._rows_before(self.effects(variant))))

    def knows(self, variant: Variant, windows: Windows) -> np.ndarray:
        """Return whether all that acts in a window under a variant follows from the log, ``(W,)`` bool."""
        return windows.steps >= self.settled(variant, windows.commands)[windows.episodes]

    def _shown(self, variant: Variant, path: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what a variant's sensors show of true paths ``(W, ·, n)``, and what is known: nothing lies before."""
        skip, step = (path.shape[1] - 1) // length, float(self.setting.model.opt.timestep)
        truth = SensedPath.of(torch.from_numpy(path), length + 1, skip, step, tuple(self.rates))
        sensors = placed_filters(variant.placed, "sense", self.setting)
        valid = np.ones(truth.shown.shape, dtype=bool)
        for f in sensors:
            valid[..., f.column] &= truth.known(f.effect.memory(f.values[0].numpy())).numpy()
        return sensed(truth, sensors).numpy(), valid

    def _states(
        self, variant: Variant, model: mujoco.MjModel | None, shown: np.ndarray, windows: Windows
    ) -> np.ndarray:
        """Return states ``(W, nq + nv)`` of which the sensors show ``shown``, to begin simulations of a model."""
        sensors, observation = placed_filters(variant.placed, "sense", self.setting), self.setting.observation
        rates = windows.rates.copy()
        for f in sensors:  # what a late sensor shows later is the truth of now
            late = f.effect.memory(f.values[0].numpy())
            if late > 0:
                steps = late / self.setting.signals.timestep
                rates[:, f.column] = secants(windows.measured[:, :, f.column], steps) / late
        true = self._true(torch.tensor(shown), torch.from_numpy(rates), sensors).numpy()
        if self.setting.slopes and model is not None:  # which were taken as the model as given begins
            slopes = list(self.setting.slopes)
            true[:, slopes] += (self.setting.lead - velocity_lead(model)) * rates[:, slopes]
        states = self._full(true, windows.unseen)
        for q in observation.quaternions:
            at = observation.index[list(q)]
            states[:, at] /= np.linalg.norm(states[:, at], axis=1, keepdims=True)
        return states

    def _full(self, columns: np.ndarray, unseen: np.ndarray | None) -> np.ndarray:
        """:meth:`Observation.full`; where loops are closed, which takes longer, the last ones are kept."""
        if self.setting.observation.loops is None or unseen is None:
            return self.setting.observation.full(columns, unseen)
        key = columns.tobytes() + unseen.tobytes()
        if key not in self._closed:
            if len(self._closed) >= CLOSED:
                self._closed.pop(next(iter(self._closed)))
            self._closed[key] = self.setting.observation.full(columns, unseen)
        return self._closed[key].copy()

    def _true(self, shown: torch.Tensor, rates: torch.Tensor, sensors: Sequence[Filter]) -> torch.Tensor:
        """Return the true columns ``(W, n)`` of which sensors show ``shown``, and whose time derivatives are ``rates``.

        Late ones to second order: a position's derivative is its velocity, and that changes as the log shows.
        """
        known = np.flatnonzero(self.rates >= 0)
        rates, curvature = rates.clone(), torch.zeros_like(rates)
        curvature[:, known] = rates[:, self.rates[known]]
        rates[:, known] = shown[:, self.rates[known]]
        true = unsensed(shown, rates, sensors)
        late = max((f.effect.memory(f.values[0].numpy()) for f in sensors), default=0.0)
        if not 0 < late < np.inf:
            return true
        step = float(self.setting.model.opt.timestep)
        rates[:, known] = true[:, self.rates[known]]
        past = extended(true[:, None], rates, curvature[:, None], int(np.ceil(late / step)) + 1, step)
        there = SensedPath.of(past, 1, self.setting.frame_skip, step, tuple(self.rates))
        return true + shown - sensed(there, sensors)[:, 0]

    def _rows_before(self, placed: Sequence[Placed]) -> int:
        """Rows before a window that tell what effects remember."""
        seconds = max((p.effect.memory(np.array(p.values)) for p in placed if p.effect.has("replay")), default=0.0)
        return past_rows(seconds, self.setting.signals.timestep)

    def _past(self, variants: Sequence[Variant], windows: Windows) -> Past | None:
        """Return what was before windows, where an effect remembers it and the log shows it."""
        before, skip = max(self._rows_before(v.placed) for v in variants), self.setting.frame_skip
        if windows.observed is None or not before:
            return None
        if self.setting.observation.loops is not None:
            return None
        rows = min(before, int(windows.steps.max(initial=0)))
        at = windows.steps[:, None] + np.arange(-rows, 1)
        columns = windows.observed[windows.episodes[:, None], np.maximum(at, 0)]
        states = self.setting.observation.full(columns.reshape(-1, columns.shape[-1])).reshape(*at.shape, -1)
        states[at < 0] = np.nan
        commands = [
            self._acting(v, windows)[windows.episodes[:, None], np.maximum(at[:, :-1], 0) * skip] for v in variants
        ]
        return Past(states, np.stack(commands))

    def _signals(self, variant: Variant, windows: Windows) -> np.ndarray:
        """Return commands as they act in every physics step of every window ``(W, L·skip, nu)``."""
        skip, length = self.setting.frame_skip, windows.length
        at = np.maximum(windows.steps[:, None] * skip + np.arange(-self._engine.lead, length * skip), 0)
        return self._acting(variant, windows)[windows.episodes[:, None], at]

    def _acting(self, variant: Variant, windows: Windows) -> np.ndarray:
        """Return commands as they act in every physics step of every episode ``(E, N·skip, nu)``."""
        if self._commands is not windows.commands:
            self._commands, self._filtered = windows.commands, {}
        key = tuple((p.key, p.values) for p in variant.placed if p.effect.has("command"))
        if key not in self._filtered:
            if sum(known.nbytes for known in self._filtered.values()) > KEPT:
                self._filtered.clear()
            filters = placed_filters(variant.placed, "command", self.setting)
            step = float(self.setting.model.opt.timestep)
            self._filtered[key] = filtered(np.repeat(windows.commands, self.setting.frame_skip, axis=1), filters, step)
        return self._filtered[key]


def secants(path: np.ndarray, steps: float) -> np.ndarray:
    """Return by how much paths ``(W, L + 1)`` change over some steps from their start, by a cubic, ``(W,)``."""
    count = min(4, path.shape[1])
    first = min(max(int(steps) - 1, 0), path.shape[1] - count)
    nodes = np.arange(first, first + count)
    apart = nodes[:, None] - nodes + np.eye(count)
    weights = np.where(np.eye(count) > 0, 1.0, (steps - nodes) / apart).prod(1)
    return path[:, nodes] @ weights - path[:, 0]
