"""One loop from an objective and an optimizer to a frozen result, with checkpoints."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.certify import certify, has_reference
from dropo_torch.distribution import Distribution
from dropo_torch.errors import InputError, choices
from dropo_torch.objective import Objective, draw_uniforms, no_effect
from dropo_torch.optimizers import AdamOptimizer, AdamSettings, CMAOptimizer, FisherOptimizer, Optimizer, Progress
from dropo_torch.optimizers.correlated import CorrelatedOptimizer
from dropo_torch.support.files import write_atomically, write_json

SCHEMA = "dropo-torch/fit/1"
OPTIMIZERS = ("fisher", "cma", "adam")


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
        stop_reason: why the optimizer stopped, in words.
        history: one entry a batch.
        method: how the distribution was found.
        extras: what that method found beside it, as plain data.
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
    method: str = "dropo"
    extras: Mapping[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the content of ``fit.json``."""
        same = len(set(self.epsilon)) == 1
        correlation = self.distribution.correlation
        return {
            "schema": SCHEMA,
            "method": self.method,
            "parameters": self.distribution.summary(),
            **({} if correlation is None else {"correlation": correlation.tolist()}),
            "log_likelihood": self.log_likelihood,
            "mse": self.mse,
            "epsilon": self.epsilon[0] if same else list(self.epsilon),
            "backend": self.backend,
            "optimizer": self.optimizer,
            "samples": self.samples,
            "evaluations": self.evaluations,
            "simulated_transitions": self.simulated_transitions,
            "diverged_simulations": self.diverged,
            "seconds": round(self.seconds, 3),
            "seed": self.seed,
            "stop_reason": self.stop_reason,
            **self.extras,
        }

    def save(self, path: str | Path) -> None:
        """Write ``fit.json``, whole or not at all."""
        write_json(Path(path), self.document())


def fit(
    objective: Objective,
    *,
    optimizer: str = "fisher",
    samples: int = 100,
    seed: int = 0,
    budget: int = 1000,
    population: int | None = None,
    common_random_numbers: bool = False,
    adam: AdamSettings | None = None,
    entropy: float = 0.0,
    covariance: str = "diagonal",
    checkpoint: str | Path | None = None,
    resume: bool = False,
    fingerprint: str = "",
    on_progress: Callable[[HistoryEntry, Progress], None] | None = None,
    search: Optimizer | None = None,
) -> Fit:
    """Fit the distribution of a simulator's parameters to a log.

    Args:
        objective: the likelihood of the log.
        optimizer: ``"fisher"``, ``"cma"`` or, on a differentiable simulator, ``"adam"``.
        samples: K, parameter vectors of each φ.
        seed: seeds every random number.
        budget, population, common_random_numbers: options of CMA-ES; see :class:`CMAOptimizer`.
        adam: how Adam steps.
        entropy: weight β of Σ log σ, the entropy of p_φ, beside the log-likelihood.
        covariance: ``"full"`` lets parameters vary together; with ``"fisher"``.
        checkpoint: file in which the fit's state is kept after every batch.
        resume: go on from ``checkpoint`` where it exists; the result is that of a run never interrupted.
        fingerprint: identifies the config and log; a checkpoint of another one is refused.
        on_progress: called after every batch.
        search: what finds the distribution in place of ``optimizer``, such as a method of
            :mod:`dropo_torch.baselines`.

    Raises:
        InputError: a parameter without effect on this log, an unknown optimizer, a checkpoint that does not fit;
            with Adam, a gradient that the differences of MuJoCo do not confirm on 20 transitions.
    """
    if optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer: unknown {optimizer!r}" + choices(optimizer, OPTIMIZERS))
    search = search or _optimizer(
        objective,
        optimizer,
        samples=samples,
        seed=seed,
        budget=budget,
        population=population,
        common_random_numbers=common_random_numbers,
        adam=adam,
        entropy=entropy,
        covariance=covariance,
    )
    path = None if checkpoint is None else Path(checkpoint)
    history = _restore(path, fingerprint, search, objective) if resume and path is not None else None
    if history is None:
        history = []
        refuse_dead_parameters(objective)
        if search.name == "adam" and has_reference(objective):
            certify(objective, max_transitions=20, points=1, seed=seed).check()
    history = _run(search, objective, history, path, fingerprint, on_progress)
    return _conclude(search, objective, history, samples, seed)


def _optimizer(
    objective: Objective,
    optimizer: str,
    *,
    samples: int,
    seed: int,
    budget: int,
    population: int | None,
    common_random_numbers: bool,
    adam: AdamSettings | None,
    entropy: float,
    covariance: str,
) -> Optimizer:
    """The optimizer of a name."""
    if covariance not in ("diagonal", "full"):
        raise InputError(f"covariance: {covariance!r} given; expected diagonal or full")
    if covariance == "full" and optimizer != "fisher":
        raise InputError(f"covariance: full needs optimizer: fisher; {optimizer} has independent parameters only")
    if entropy and optimizer == "adam":
        raise InputError("entropy: adam has no entropy bonus; use optimizer: fisher or cma")
    if optimizer == "cma":
        return CMAOptimizer(
            objective,
            samples=samples,
            seed=seed,
            budget=budget,
            population=population,
            common_random_numbers=common_random_numbers,
            entropy=entropy,
        )
    if optimizer == "adam":
        return AdamOptimizer(objective, settings=adam or AdamSettings(), seed=seed)
    kind = CorrelatedOptimizer if covariance == "full" else FisherOptimizer
    return kind(
        objective.simulator.parameters,
        samples=samples,
        seed=seed,
        noisy=objective.noise is not None,
        differentiable=objective.simulator.differentiable,
        entropy=entropy,
    )


def refuse_dead_parameters(objective: Objective) -> None:
    """Raise an :class:`InputError` that names every parameter without effect on the log."""
    dead = no_effect(objective)
    if not dead:
        return
    space = objective.simulator.parameters
    where = "; ".join(f"{p.name!r} ({p.where})" for p in space.parameters if p.name in dead)
    raise InputError(
        f"parameters: {where} moves no compared column of this log anywhere in its bounds; "
        "leave it out, or log a motion that excites it"
    )


def _run(
    search: Optimizer,
    objective: Objective,
    history: list[HistoryEntry],
    path: Path | None,
    fingerprint: str,
    on_progress: Callable[[HistoryEntry, Progress], None] | None,
) -> list[HistoryEntry]:
    """Ask and tell until the optimizer stops; keep the state after every batch."""
    begun = time.monotonic() - (history[-1].seconds if history else 0.0)
    evaluations = history[-1].evaluations if history else 0
    while search.stop_reason is None:
        request = search.ask()
        at, std = request.linearise_at, request.linearise_std
        if at is not None and not (_same(at, objective.linearised_at) and _same(std, objective.linearised_std)):
            objective.linearise(at, std)
        if request.replay is not None:
            search.tell(objective.map_replay(request.replay, request.values, request.reduce))
        elif request.gradient:
            search.tell(*objective.gradient(request.values, request.reduce, request.rows))
        elif request.is_stencil and request.rows is None and objective.has_cheaper_jacobian:
            search.tell(objective.map_linear(request.values, request.reduce))
        else:
            search.tell(objective.map(request.values, request.reduce, request.rows))
        evaluations += request.evaluations
        progress = search.progress
        mean, std = search.candidates()[0]
        entry = HistoryEntry(
            evaluations=evaluations,
            simulated_transitions=objective.simulated_transitions,
            seconds=time.monotonic() - begun,
            log_likelihood=progress.log_likelihood,
            stage=progress.stage,
            mean=np.array(mean),
            std=np.array(std),
        )
        history.append(entry)
        if path is not None:
            _save_checkpoint(path, fingerprint, search, objective, history)
        if on_progress is not None:
            on_progress(entry, progress)
    return history


def _conclude(search: Optimizer, objective: Objective, history: list[HistoryEntry], samples: int, seed: int) -> Fit:
    """Evaluate the candidates on draws of their own and return the best."""
    begun = time.monotonic()
    spent = history[-1].seconds if history else 0.0
    space = objective.simulator.parameters
    uniforms = draw_uniforms(samples, len(space), seed, 0)
    results = []
    for candidate in search.distributions(space):
        objective.linearise(candidate.mean, objective.varying(candidate.std))
        evaluation = objective.evaluate_values(candidate.rsample(uniforms)[None])[0]
        results.append((evaluation.log_likelihood + search.bonus(candidate), candidate, evaluation))
    _, distribution, best = max(results, key=lambda r: -math.inf if math.isnan(r[0]) else r[0])
    objective.linearise(distribution.mean, objective.varying(distribution.std))
    dropped = distribution.correlation is None and any(c.correlation is not None for _, c, _ in results)
    remark = ", but makes the log no likelier: parameters vary independently" if dropped else ""
    return Fit(
        distribution=distribution,
        log_likelihood=best.log_likelihood,
        mse=best.mse,
        epsilon=tuple(objective.epsilon.tolist()),
        backend=objective.simulator.name,
        optimizer=search.name,
        samples=samples,
        seed=seed,
        evaluations=history[-1].evaluations if history else 0,
        simulated_transitions=objective.simulated_transitions,
        diverged=best.diverged,
        seconds=spent + time.monotonic() - begun,
        stop_reason=(search.stop_reason or "") + remark,
        history=tuple(history),
        method=search.method,
        extras=search.extras(),
    )


def _same(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


def _save_checkpoint(
    path: Path, fingerprint: str, search: Optimizer, objective: Objective, history: list[HistoryEntry]
) -> None:
    state = {
        "fingerprint": fingerprint,
        "optimizer": search.name,
        "state": search.state(),
        "history": [vars(entry) for entry in history],
        "simulated_transitions": objective.simulated_transitions,
        "linearised": (objective.linearised_at, objective.linearised_std),
    }
    write_atomically(path, pickle.dumps(state))


def _restore(path: Path, fingerprint: str, search: Optimizer, objective: Objective) -> list[HistoryEntry] | None:
    """Restore a checkpoint into a fresh optimizer; ``None`` where there is none yet."""
    if not path.is_file():
        return None
    try:
        state = pickle.loads(path.read_bytes())
        owner, stored = (state["fingerprint"], state["optimizer"])
        if owner == fingerprint and stored == search.name:
            search.restore(state["state"])
            history = [HistoryEntry(**entry) for entry in state["history"]]
            simulated, (linearised_at, linearised_std) = state["simulated_transitions"], state["linearised"]
    except Exception as error:
        raise InputError(f"resume: {path} is no checkpoint of a fit ({error}); start again without --resume") from None
    if owner != fingerprint or stored != search.name:
        raise InputError(
            f"resume: {path} belongs to another config, log or optimizer; restore those, "
            "or start again without --resume"
        )
    if linearised_at is not None:
        objective.linearise(linearised_at, linearised_std)
    objective.simulated_transitions = simulated
    return history


def without_history(result: Fit) -> Fit:
    """Return a fit without its history, for comparison."""
    return replace(result, history=(), seconds=0.0)
