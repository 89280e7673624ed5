"""The motion to record next: what ``dropo plan`` makes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.observation import parse_observation
from dropo_torch.diagnostics import CONFOUNDED
from dropo_torch.errors import InputError
from dropo_torch.parameters import object_names
from dropo_torch.planning.ground import FEWEST, Ground, rollout
from dropo_torch.planning.information import Information, information_of
from dropo_torch.planning.limits import Kept, Limit
from dropo_torch.planning.search import Found, search
from dropo_torch.problem import make_problem
from dropo_torch.simulators import Simulator
from dropo_torch.support.checkpoint import Checkpoint
from dropo_torch.support.report import Report

SCHEMA = "dropo-torch/plan/1"
#: States between two at which a search looks at forces, contacts and the workspace; share of limits that it allows.
EVERY, SHARE = 10, 0.96
#: Factors of an amplitude that are tried at least and at most so that a motion comes near a limit.
LEAST, MOST = 0.02, 4.0
#: Nats that an excess of the size of a limit costs, and any excess at all.
PENALTY, ANY = 60.0, 2.0
#: Factors of an amplitude at least and at most by which a motion is brought near a limit.
LEAST, MOST = 0.02, 4.0
#: Times that a motion is reduced until it keeps all limits, and factor of the amplitude, or less, each time.
ATTEMPTS, LESS = 45, 0.93
#: Factor of the amplitude below which it is told.
REDUCED = 0.9
#: σ from which on effects count as told apart.
SURELY = 4.0
#: Share of its bounds' width above which a parameter's standard error counts as none.
UNKNOWN = 0.25


@dataclass(frozen=True, eq=False)
class Plan:
    """A motion to record, and what it is to tell.

    Attributes:
        ground: what it was planned on.
        commands: ``(N, nu)``.
        states: expected, of the model at the point, ``(N + 1, nq + nv)``.
        kept: how far it goes in its limits, at every physics step, of all models.
        scale: factor by which its amplitude was reduced to keep them.
        told: what it tells.
        found: the search.
        seconds: what it took.
        apart: σ by which it tells each pair of tied effects apart; empty where it tells parameters.
    """

    ground: Ground
    commands: np.ndarray
    states: np.ndarray
    kept: Kept
    scale: float
    told: Information
    found: Found
    seconds: float
    apart: tuple[float, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """Seconds of the states, ``(N + 1,)``."""
        return self.ground.timestep * np.arange(len(self.states))

    @property
    def actuators(self) -> list[str]:
        """Names of the commands."""
        return object_names(self.ground.model, "actuator")

    @property
    def columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the states."""
        whole = parse_observation(self.ground.model, None)
        return whole.labels, whole.units

    @property
    def errors(self) -> dict[str, np.ndarray | None]:
        """Standard errors in units: of the log so far (``None`` without one), of the plan alone, and of both."""
        ground = self.ground
        unit = np.where(ground.problem.space.is_log, ground.values[0], 1.0)
        both = ground.known + self.told
        log = unit * ground.known.errors(ground.width) if ground.has_log else None
        return {"log": log, "plan": unit * self.told.errors(ground.width), "both": unit * both.errors(ground.width)}

    @property
    def unidentified(self) -> list[str]:
        """Parameters that log and plan together do not tell."""
        together = (self.ground.known + self.told).errors(self.ground.width)
        names = self.ground.problem.space.names
        return [n for n, e, w in zip(names, together, self.ground.width, strict=True) if e > UNKNOWN * w]

    @property
    def ties(self) -> list[tuple[str, str, float]]:
        """Pairs of tied effects, and by how many σ the motion tells them apart."""
        pairs = () if self.ground.ties is None else self.ground.ties.ties
        return [(t.one, t.other, sigma) for t, sigma in zip(pairs, self.apart, strict=True)]

    @property
    def remarks(self) -> list[str]:
        """What to know before the motion is recorded, in sentences."""
        ground = self.ground
        found = [_told(*tie) for tie in self.ties]
        if not ground.settled:
            found.append(
                "The model does not come to rest where the motion starts: begin there at rest, held by hand or a stand."
            )
        if self.unidentified:
            found.append(f"Neither log nor plan tells {', '.join(self.unidentified)}.")
        found += [f"{a} and {b} are not told apart (correlation {r:.2f})." for a, b, r in self.confounded]
        if self.scale < REDUCED:
            found.append(
                f"The amplitude was reduced to {100 * self.scale:.0f} % so that other possible models keep the limits."
            )
        if ground.noise_source == "the log":
            keys = {"noise": ground.config.noise, "epsilon": ground.config.epsilon}
            found.append(f"The noise is what the log shows; a fit that is to reach these errors needs {_listed(keys)}.")
        return found

    @property
    def confounded(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters that log and plan together do not tell apart, with their correlation."""
        covariance = (self.ground.known + self.told).covariance(self.ground.width)
        sizes, names = np.sqrt(np.diag(covariance)), self.ground.problem.space.names
        found = []
        for i, j in itertools.combinations(range(len(names)), 2):
            r = float(covariance[i, j] / (sizes[i] * sizes[j]))
            if abs(r) > CONFOUNDED:
                found.append((names[i], names[j], r))
        return found

    def document(self) -> dict[str, Any]:
        """Return the content of ``plan.json``."""
        ground, labels = self.ground, self.columns[0]
        objective = ground.problem.objective
        noise, observed = objective.noise, ground.problem.observation.labels
        return {
            "schema": SCHEMA,
            "duration": round(ground.steps * ground.timestep, 9),
            "timestep": ground.timestep,
            "commands": ground.steps,
            "start": dict(zip(labels[: ground.model.nq], ground.starts[0, : ground.model.nq].tolist(), strict=True)),
            "at_rest": ground.settled,
            "parameters": self._parameters(),
            "unidentified": self.unidentified,
            "confounded": [{"parameters": [a, b], "correlation": r} for a, b, r in self.confounded],
            "ties": [{"effect": a, "other": b, "sigma": sigma} for a, b, sigma in self.ties],
            "limits": [self._limit(i, x) for i, x in enumerate(ground.limits.limits)],
            "scale": self.scale,
            "models": len(ground.values),
            "noise": None if noise is None else dict(zip(observed, noise.tolist(), strict=True)),
            "epsilon": objective.epsilon.tolist(),
            "noise_source": ground.noise_source,
            "search": {
                "evaluations": self.found.evaluations, "nats": -self.found.cost, "stop_reason": self.found.why,
                "seed": ground.config.seed,
            },
            "seconds": round(self.seconds, 3),
        }  # fmt: skip

    def _parameters(self) -> dict[str, dict[str, Any]]:
        """Of each parameter where it is taken to be, its bounds, and its standard errors, in units and relative."""
        ground, space, errors = self.ground, self.ground.problem.space, self.errors
        found = {}
        for i, parameter in enumerate(space.parameters):
            value = float(ground.values[0, i])
            own = {k: None if e is None else float(e[i]) for k, e in errors.items()}
            found[parameter.name] = {
                "value": value, "unit": parameter.unit, "low": parameter.low, "high": parameter.high,
                "standard_error": own,
                "relative": {k: None if e is None or not value else e / abs(value) for k, e in own.items()},
            }  # fmt: skip
        return found

    def _limit(self, i: int, limit: Limit) -> dict[str, Any]:
        low, high = (float(x[0, i]) for x in (self.kept.lowest, self.kept.highest))
        margin = min(low - limit.low, limit.high - high)
        return {
            "kind": limit.kind, "name": limit.name, "unit": limit.unit, "low": limit.low, "high": limit.high,
            "source": limit.source, "lowest": low, "highest": high, "margin": margin,
        }  # fmt: skip


def _told(one: str, other: str, sigma: float) -> str:
    """By how much two effects would be told apart, in a sentence."""
    if sigma < SURELY:
        return (
            f"No motion that was tried would tell {one} from {other} (at best {sigma:.1f} σ): on this robot they may "
            "be the same thing."
        )
    return f"It would tell {one} from {other} by {sigma:.0f} σ."


def _listed(keys: Mapping[str, Any]) -> str:
    """Keys of a config as it has them."""
    each = ((k, v if isinstance(v, list) else [v]) for k, v in keys.items())
    return " and ".join(f"{k}: [{', '.join(f'{x:.3g}' for x in v)}]" for k, v in each)


def make_plan(
    ground: Ground, *, checkpoint: Path | None = None, resume: bool = False, report: Report | None = None
) -> Plan:
    """Return the motion that tells most of the parameters, with what is known of them, within all limits.

    It maximizes the determinant of the information of the log so far and of the motion together; or, to tell tied
    effects apart, their least separation. Limits are kept by the model at the point, and by others that the bounds and
    the log leave possible.

    Args:
        ground: of :func:`~dropo_torch.planning.ground.prepare`.
        checkpoint: file in which the search's state is kept.
        resume: go on from it where it exists; the result is that of a run never interrupted.
        report: is told the stage and its share.

    Raises:
        InputError: limits that no motion keeps, by name; a checkpoint of another plan.
    """
    began, tell, settings = time.perf_counter(), report or (lambda stage, share: None), ground.settings
    kept = None
    if checkpoint is not None:
        asked = (f"{ground.steps}", repr(ground.values.tolist()))
        kept = Checkpoint(checkpoint, "plan", (ground.config.fingerprint(), ground.problem.fingerprint, *asked))
    found = search(
        cost_of(ground), ground.family, seed=ground.config.seed, evaluations=settings.evaluations,
        population=settings.population, report=tell, kept=kept, resume=resume,
    )  # fmt: skip
    return finished(ground, found, tell, began)


def cost_of(ground: Ground) -> Callable[[np.ndarray], np.ndarray]:
    """Return what motions cost: less the more they tell, and more for what they exceed."""

    def cost(numbers: np.ndarray) -> np.ndarray:
        commands, states, kept = moved(ground, numbers, amplitudes(ground, numbers))
        finite, costs = np.isfinite(states).all((1, 2, 3)), np.full(len(numbers), np.nan)
        if finite.any():
            excess = kept.total[finite]
            worth = np.array(value(ground, states[finite][:, 0], commands[finite]))
            costs[finite] = worth + PENALTY * excess + ANY * (excess > 0)
        return costs

    return cost


def value(ground: Ground, states: np.ndarray, commands: np.ndarray) -> list[float]:
    """Return of motions ``(P, N + 1, nq + nv)`` what is to be small, in nats.

    It is the logarithm of the volume of the errors, or minus that of the σ by which tied effects are told apart.
    """
    if ground.ties is None:
        return [(ground.known + own).volume(ground.width) for own in ground.told(states, commands)]
    pairs = zip(states, commands, strict=True)
    apart = [min(ground.ties.apart(ground.log_of(s[None], u[None]))) for s, u in pairs]
    return [-float(np.log(max(sigma, 1e-6))) for sigma in apart]


def amplitudes(ground: Ground, numbers: np.ndarray) -> np.ndarray:
    """Return by what amplitudes of motions ``(P, dimensions)`` are scaled: their share of what the model may have."""
    commands = ground.commands(ground.family.paths(numbers))
    kept = ground.limits.kept([ground.model], ground.states(commands), commands, ground.timestep, every=None)
    room = np.nan_to_num(ground.limits.room(kept, ground.starts[0]), nan=LEAST)
    return np.asarray(SHARE * ground.family.share(numbers) * np.clip(room, LEAST, MOST))


def moved(ground: Ground, numbers: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, Kept]:
    """Return commands ``(P, N, nu)``, states of all models ``(P, K, N + 1, nq + nv)``, and how far motions go."""
    commands = ground.commands(ground.family.paths(numbers, scale))
    states = ground.states(commands, len(ground.values))
    kept = ground.limits.kept(ground.models, states, commands, ground.timestep, every=EVERY, share=SHARE)
    return commands, states, kept


def finished(ground: Ground, found: Found, tell: Report, began: float) -> Plan:
    """Return the plan of a motion that was found, reduced until it keeps all limits at every physics step.

    Raises:
        InputError: no amplitude keeps them; it names the one that is exceeded most.
    """
    fine, skip = fine_simulator(ground), ground.problem.simulator.frame_skip
    step, models, kept = ground.timestep / skip, ground.models, None
    whole = scale = float(amplitudes(ground, found.numbers[None])[0])
    for attempt in range(ATTEMPTS):
        tell("checking limits at every physics step", attempt / ATTEMPTS)
        commands = ground.commands(ground.family.paths(found.numbers[None], scale))
        each = np.repeat(commands, skip, axis=1)
        states = rollout(fine, ground.starts, each, ground.values)
        if not np.isfinite(states).all():
            scale *= LESS
            continue
        kept = ground.limits.kept(models, states, each, step, per=skip)
        if kept.total[0] == 0:
            shown = states[0, 0, ::skip]
            tells = information_of(ground.problem_of(shown, commands[0]).objective, ground.point)[0]
            apart = () if ground.ties is None else tuple(ground.ties.apart(ground.log_of(shown[None], commands)))
            seconds = time.perf_counter() - began
            return Plan(ground, commands[0], shown, kept, scale / whole, tells, found, seconds, apart)
        room = float(ground.limits.room(kept, ground.starts[0])[0])
        scale *= float(np.clip(np.nan_to_num(room, nan=1.0, posinf=1.0), 0.5, LESS))
    raise InputError(f"plan: {_exceeded(ground, kept)}")


def fine_simulator(ground: Ground) -> Simulator:
    """Return a simulator that gives the state at every physics step."""
    rows = ground.config.lag + FEWEST
    still = ground.log_of(np.tile(ground.starts[0], (1, rows + 1, 1)), np.zeros((1, rows, ground.model.nu)))
    still = replace(still, dt=ground.timestep / ground.problem.simulator.frame_skip)
    return make_problem(ground.config.model_copy(update={"frame_skip": 1}), log=still).simulator


def _exceeded(ground: Ground, kept: Kept | None) -> str:
    """Which limit no amplitude keeps, and what would help."""
    if kept is None:
        return "the simulation diverges whatever the amplitude; check the model's step and the bounds of the parameters"
    if kept.touching[0] is not None:
        a, b = kept.touching[0]
        return (
            f"{a} and {b} touch whatever the amplitude; let them by plan.touch: [[{a}, {b}]], or start elsewhere by "
            "plan.start"
        )
    worst = int(np.nanargmax(kept.excess[0]))
    limit, low, high = ground.limits.limits[worst], kept.lowest[0, worst], kept.highest[0, worst]
    reached = high if high - limit.high > limit.low - low else low
    whose = (
        "" if len(ground.values) == 1
        else "; the motion must keep it for the model and for others that bounds and log leave possible: narrow the "
        "bounds, plan at a fit (--at), or set plan.models: 0"
    )  # fmt: skip
    return (
        f"the {limit.kind} of {limit.name} reaches {reached:.4g} {limit.unit} at any amplitude, beyond its limits "
        f"from {limit.low:.4g} to {limit.high:.4g} ({limit.source}){whose}"
    )
