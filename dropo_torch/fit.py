"""One loop from an objective and an optimizer to a frozen result, with checkpoints."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dropo_torch.certify import certify, has_reference
from dropo_torch.distribution import Distribution, to_coordinates
from dropo_torch.errors import InputError
from dropo_torch.evaluator import Sums
from dropo_torch.excitation import refuse_dead_parameters
from dropo_torch.initial_noise import InitialStateNoise
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FitSettings, Optimizer, Progress, Request, make_optimizer
from dropo_torch.support.checkpoint import Checkpoint
from dropo_torch.support.files import write_json
from dropo_torch.support.random import draw_uniforms
from dropo_torch.verdict import Judgment, hopeless_at

SCHEMA = "dropo-torch/fit/1"
#: Share of a search after which it is asked once whether it is hopeless to go on.
LOOK_AT = 0.4
#: Distributions that are judged in the end, at most, where simulations diverge under all those before.
RETREATS = 12
#: Keys of ``fit.json``, before what a method adds; ``correlation`` only where parameters vary together.
KEYS = (
    "schema", "method", "verdict", "verdict_reason", "parameters", "standard_errors", "correlation", "log_likelihood",
    "log_likelihood_eq3", "mse", "epsilon", "backend", "optimizer", "samples", "evaluations", "simulated_transitions",
    "diverged_simulations", "seconds", "seed", "stop_reason",
)  # fmt: skip


@dataclass(frozen=True)
class HistoryEntry:
    """The state of a fit after one batch.

    Attributes:
        evaluations: evaluations of the objective so far.
        simulated_transitions: logged steps simulated so far.
        seconds: time spent so far, over all sessions of the fit.
        log_likelihood: the best the optimizer has seen in this stage; NaN before the first.
        stage: what the optimizer was doing.
        mean, std: the best φ so far, in coordinates, ``(d,)`` each.
    """

    evaluations: int
    simulated_transitions: int
    seconds: float
    log_likelihood: float
    stage: str
    mean: np.ndarray
    std: np.ndarray


#: Called after every batch.
OnProgress = Callable[[HistoryEntry, Progress], None]


@dataclass(frozen=True)
class Estimated:
    """What a fit has estimated beside its distribution, where the log does not show the states.

    Attributes:
        objective: the likelihood of the log's transitions from the estimated states.
        standard_error: of each mean, in coordinates, states being unknown, ``(d,)``.
        correlation: of the estimates of the means, ``(d, d)``.
        unjoined: coordinates in which the model does not lead from one window to the next, and by how much, in words.
    """

    objective: Objective
    standard_error: np.ndarray
    correlation: np.ndarray
    unjoined: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fit:
    """A fitted distribution and how it was found.

    Attributes:
        distribution: p_φ.
        log_likelihood: the sampled objective at φ, in nats, on draws that no optimizer has seen.
        mse: mean squared difference between measured and simulated mean next states, in (scaled) units.
        epsilon: ε, one per compared column.
        backend, optimizer: names.
        samples, seed: K and the seed.
        evaluations: evaluations of the objective by the optimizer.
        simulated_transitions: logged steps simulated altogether, checks and the final value included.
        diverged: simulations that diverged in the final evaluation.
        seconds: time spent, over all sessions of the fit.
        stop_reason: why the optimizer stopped, in words, the caveat included.
        caveat: what to know before the distribution is used; empty where there is nothing.
        history: one entry a batch.
        method: how the distribution was found.
        extras: what that method found beside it, as plain data.
        judgment: whether the model explains the log, once that was judged.
        log_likelihood_eq3: the log-likelihood by eq. 3, which it is on a log without noise.
        estimated: what else was estimated, where the log does not show the states.
    """

    distribution: Distribution
    log_likelihood: float
    mse: float
    epsilon: tuple[float, ...]
    backend: str
    optimizer: str
    samples: int
    seed: int
    evaluations: int
    simulated_transitions: int
    diverged: int
    seconds: float
    stop_reason: str
    history: tuple[HistoryEntry, ...]
    caveat: str = ""
    method: str = "dropo"
    extras: Mapping[str, Any] = field(default_factory=dict)
    judgment: Judgment | None = None
    log_likelihood_eq3: float = math.nan
    estimated: Estimated | None = None

    def document(self) -> dict[str, Any]:
        """Return the content of ``fit.json``."""
        correlation, judgment = self.distribution.correlation, self.judgment
        plain = vars(self) | {
            "schema": SCHEMA,
            "verdict": judgment and judgment.verdict,
            "verdict_reason": judgment and judgment.reason,
            "standard_errors": judgment and judgment.standard_errors,
            "parameters": self.distribution.summary(),
            "correlation": None if correlation is None else correlation.tolist(),
            "epsilon": self.epsilon[0] if len(set(self.epsilon)) == 1 else list(self.epsilon),
            "diverged_simulations": self.diverged,
            "seconds": round(self.seconds, 3),
        }
        return {key: plain[key] for key in KEYS if plain[key] is not None} | dict(self.extras)

    def save(self, path: str | Path) -> None:
        """Write ``fit.json``, whole or not at all."""
        write_json(Path(path), self.document())


@torch.inference_mode(mode=False)  # gradients are taken whether or not the caller has switched them off
@torch.enable_grad()
def fit(
    objective: Objective,
    settings: FitSettings | None = None,
    *,
    search: Optimizer | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    fingerprint: str = "",
    on_progress: OnProgress | None = None,
) -> Fit:
    """Fit the distribution of a simulator's parameters to a log.

    Args:
        objective: the likelihood of the log.
        settings: the optimizer and what it is told, by default :class:`FitSettings`'s own; those of a config are
            :meth:`Config.fit_settings`.
        search: what finds the distribution in place of the settings' optimizer, such as a method of
            :mod:`dropo_torch.baselines`.
        checkpoint: file in which the fit's state is kept after every batch.
        resume: go on from ``checkpoint`` where it exists; the result is that of a run never interrupted.
        fingerprint: identifies the config, beside the log, its noise, the bounds and the settings, which are compared
            anyway; a checkpoint of another fit is refused.
        on_progress: called after every batch.

    Raises:
        InputError: a parameter without effect on this log, a checkpoint that does not fit, or ``resume`` without one;
            with Adam, a gradient that the differences of MuJoCo do not confirm on 20 transitions.
    """
    if objective.observation.is_sensed:
        raise InputError("observation: it names sensors and not the whole state; fit_problem estimates it")
    settings = settings or FitSettings()
    search = search or make_optimizer(objective, settings)
    if resume and checkpoint is None:
        raise InputError("resume: there is no checkpoint to go on from; name its file: checkpoint=PATH")
    owner = (fingerprint, search.method, search.name, repr(settings), _digest(objective))
    kept = None if checkpoint is None else Checkpoint(Path(checkpoint), "fit", owner, (HistoryEntry, *search.KINDS))
    state = _restored(kept, search, objective) if resume and kept is not None else None
    if state is None:
        state = _State(simulated_transitions=refuse_dead_parameters(objective))
        if search.name == "adam" and has_reference(objective):
            certify(objective, max_transitions=20, points=1, seed=settings.seed).check()
    _run(search, objective, state, kept, on_progress)
    return _conclude(search, objective, state, settings)


@dataclass
class _State:
    """Where a fit stands, beside its optimizer."""

    simulated_transitions: int
    history: list[HistoryEntry] = field(default_factory=list)
    initial: InitialStateNoise | None = None
    hopeless: str | None = None  # why, empty where it is not; None before that was looked at

    @property
    def spent(self) -> tuple[int, float]:
        """Evaluations and seconds so far."""
        return (self.history[-1].evaluations, self.history[-1].seconds) if self.history else (0, 0.0)


def _run(
    search: Optimizer, objective: Objective, state: _State, kept: Checkpoint | None, on_progress: OnProgress | None
) -> None:
    """Ask and tell until the optimizer stops; keep the state after every batch."""
    evaluations, seconds = state.spent
    begun = time.monotonic() - seconds
    while search.stop_reason is None and not state.hopeless:
        request = search.ask()
        at, rest = request.linearise_at, (request.linearise_std, request.widen)
        if at is not None and (state.initial is None or not state.initial.is_at(at, *rest)):
            state.initial = noise_of(objective, request)
            state.simulated_transitions += state.initial.simulated_transitions if state.initial else 0
        sums = answer(objective, request, state.initial)
        search.tell(sums.total, sums.gradient)
        evaluations += request.evaluations
        state.simulated_transitions += sums.simulated_transitions
        progress = search.progress
        if state.hopeless is None and search.improves and progress.fraction >= LOOK_AT:
            state.hopeless = hopeless_at(objective, search.candidates()[0][0])
        cost = (evaluations, state.simulated_transitions, time.monotonic() - begun)
        entry = HistoryEntry(*cost, progress.log_likelihood, progress.stage, *map(np.array, search.candidates()[0]))
        state.history.append(entry)
        if kept is not None:
            kept.save({
                "optimizer": search.state(),
                "history": state.history,
                "simulated_transitions": state.simulated_transitions,
                "hopeless": state.hopeless,
                "linearised": state.initial and (state.initial.mean, state.initial.std, state.initial.is_widened),
            })  # fmt: skip
        if on_progress is not None:
            on_progress(entry, progress)


def noise_of(objective: Objective, request: Request) -> InitialStateNoise | None:
    """Return the noise of initial states around which a request is answered."""
    at = request.linearise_at
    return None if at is None else objective.initial_noise(at, request.linearise_std, request.widen)


def answer(objective: Objective, request: Request, initial: InitialStateNoise | None = None) -> Sums:
    """Simulate what an optimizer asks for, around the noise of the initial states."""
    run, values = objective.evaluator, request.values
    if request.replay is not None:
        return run.map_replay(request.replay, values, request.reduce)
    visit = objective.comparing(request.reduce, initial)
    if request.gradient:
        return run.gradient(values, visit, request.rows)
    if request.is_stencil and request.rows is None and run.has_cheaper_jacobian:
        return run.map_linear(values, visit)
    return run.map(values, visit, request.rows)


def _conclude(search: Optimizer, objective: Objective, state: _State, settings: FitSettings) -> Fit:
    """Evaluate the candidates on draws of their own and return the best."""
    begun = time.monotonic()
    evaluations, seconds = state.spent
    space = objective.simulator.parameters
    uniforms = draw_uniforms(settings.samples, len(space), settings.seed, 0)
    results = []
    waiting = search.distributions(space)
    while waiting:
        candidate = waiting.pop(0)
        initial = objective.initial_noise(candidate.mean, widen=False)
        evaluation = objective.evaluate_values(candidate.rsample(uniforms)[None], initial)[0]
        results.append((evaluation.order(search.bonus(candidate)), candidate, evaluation))
        state.simulated_transitions += sum(x.simulated_transitions for x in (evaluation, initial) if x is not None)
        if evaluation.diverged and search.method == "dropo" and len(results) < RETREATS:
            waiting += _retreat(objective, candidate, uniforms, state)
    _, distribution, best = max(results, key=lambda r: r[0])
    dropped = distribution.correlation is None and any(c.correlation is not None for _, c, _ in results)
    remark = "makes the log no likelier: parameters vary independently" if dropped else ""
    return Fit(
        distribution=distribution,
        log_likelihood=best.log_likelihood,
        log_likelihood_eq3=best.gaussian,
        mse=best.mse,
        epsilon=tuple(objective.epsilon.tolist()),
        backend=objective.simulator.name,
        optimizer=search.name,
        samples=settings.samples,
        seed=settings.seed,
        evaluations=evaluations,
        simulated_transitions=state.simulated_transitions,
        diverged=best.diverged,
        seconds=seconds + time.monotonic() - begun,
        stop_reason=("it is hopeless" if state.hopeless else search.stop_reason or "")
        + (f", but {remark}" if remark else ""),
        history=tuple(state.history),
        caveat=f"a full covariance {remark}" if remark else search.caveat,
        method=search.method,
        extras=search.extras(),
    )


def _retreat(
    objective: Objective, distribution: Distribution, uniforms: torch.Tensor, state: _State
) -> list[Distribution]:
    """The distribution of those samples under which fewest simulations diverge; none where they are all alike."""
    values = distribution.rsample(uniforms)
    found = objective.map(values, lambda features, *_: (~torch.isfinite(features).all(-1)).sum(0).double())
    state.simulated_transitions += found.simulated_transitions
    kept = (found.total == found.total.min()).numpy()
    if kept.all():
        return []
    drawn, box = to_coordinates(values.numpy(), distribution.is_log), objective.box
    share = drawn[kept].std(0) / np.maximum(drawn.std(0), 1e-300)
    std = np.clip(distribution.std * share**2, box.min_std, distribution.std)
    return [replace(distribution, mean=np.clip(drawn[kept].mean(0), box.low, box.high), std=std)]


def _restored(kept: Checkpoint, search: Optimizer, objective: Objective) -> _State | None:
    """Restore the state of a fresh optimizer and its fit; ``None`` where there is none yet."""
    if not kept.path.is_file():
        return None
    content = kept.load()
    search.restore(content["optimizer"])
    state = _State(content["simulated_transitions"], content["history"], hopeless=content["hopeless"])
    if content["linearised"] is not None:
        state.initial = objective.initial_noise(*content["linearised"])  # already counted
    return state


def _digest(objective: Objective) -> str:
    """What tells one log, its noise and its parameters from another."""
    log, found = objective.transitions, hashlib.sha256()
    noise = () if objective.noise is None else (objective.noise.numpy(),)
    box = objective.box
    for array in (log.states, log.controls, log.measured, objective.epsilon.numpy(), *noise, box.low, box.high):
        found.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return found.hexdigest()
