"""Simulation-based calibration: how often the interval of a fitted distribution holds what it should.

Logs are simulated under known parameters, with the starts and actions of a given log, and fitted. Two questions:

``fixed``    one vector of parameters holds throughout, drawn from the search box: is it inside the interval?
``varying``  every transition has parameters of its own, drawn around such a vector: which share is inside?

In both, starts are exact and the ends have noise. A method that says how uncertain a fixed value is should pass the
first, one that says how much a value varies the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy.special
import torch

from dropo_torch.baselines import Mixture, fit_problem
from dropo_torch.data.trajectory import make_transitions
from dropo_torch.distribution import SearchBox, to_values
from dropo_torch.fit import Fit
from dropo_torch.problem import Problem

Kind = Literal["fixed", "varying"]
KINDS: tuple[Kind, ...] = ("fixed", "varying")
LEVELS = (0.5, 0.9)
#: Truths of ``varying`` logs are drawn around this inner share of the search box; those of ``fixed`` ones, all over it.
_INNER = 0.6
#: Draws of a mixture of which its quantiles are taken.
_DRAWS = 20_000
#: Deviation of the parameters of ``varying`` logs, as a share of the search width.
SPREAD = 0.1


@dataclass(frozen=True)
class Trial:
    """One fit of one simulated log.

    Attributes:
        kind: what the log is.
        method: of the fit.
        log: number of the log.
        inside: level → share of each parameter's true values inside its central interval, name → share.
        width: level → width of the interval as a share of the search box, name → share.
        error: of the mean, as a share of the search box, name → share.
    """

    kind: str
    method: str
    log: int
    inside: dict[str, dict[str, float]]
    width: dict[str, dict[str, float]]
    error: dict[str, float]


@dataclass(frozen=True)
class Coverage:
    """All trials of a method on one kind of log, for one parameter.

    Attributes:
        kind, method: as of the trials.
        parameter: name.
        level: of the intervals.
        covered: mean share inside, over logs.
        low, high: 95 % interval of ``covered``, the logs taken as independent.
        width: mean width of the intervals, as a share of the search box.
        logs: number of logs.
    """

    kind: str
    method: str
    parameter: str
    level: float
    covered: float
    low: float
    high: float
    width: float
    logs: int


def synthesise(problem: Problem, truths: np.ndarray, noise: np.ndarray, seed: int) -> Problem:
    """Return the problem with a log simulated under known parameters, from its episodes' starts and actions.

    Args:
        problem: whose log gives starts and actions; without effects that remember.
        truths: parameters of each transition, in units, ``(T, d)``.
        noise: deviation of the noise on each observed column of the ends of transitions, ``(n,)``.
        seed: of the noise.
    """
    log, observation, simulator = problem.trajectories, problem.observation, problem.simulator
    columns, index = list(observation.log_columns), observation.index
    starts = observation.states(log.observations)
    before, after = log.observations.copy(), log.next_observations.copy()
    state = torch.from_numpy(starts[:1].copy())
    for t in range(len(log)):
        if t == 0 or log.terminals[t - 1]:
            state = torch.from_numpy(starts[t : t + 1].copy())
        before[t, columns] = state[0].numpy()[index]
        control = torch.from_numpy(log.actions[t : t + 1, None].copy())
        state = simulator.simulate(state, control, torch.from_numpy(truths[t : t + 1].copy()))[:, 0]
        after[t, columns] = state[0].numpy()[index]
    after[:, columns] += noise * np.random.default_rng(seed).standard_normal((len(log), len(columns)))
    made = replace(log, observations=before, next_observations=after)
    lag = problem.objective.transitions.lag
    return replace(
        problem, trajectories=made, objective=problem.objective.on(make_transitions(made, observation, lag=lag))
    )


def with_seed(problem: Problem, seed: int) -> Problem:
    """Return the problem whose fit draws other random numbers, so that fits of several logs are independent."""
    return replace(problem, config=problem.config.model_copy(update={"seed": seed}))


def draw_truths(problem: Problem, kind: Kind, seed: int) -> np.ndarray:
    """Return parameters of each transition of a log, in coordinates, ``(T, d)``."""
    box, generator = SearchBox.of(problem.space), np.random.default_rng([seed, 23])
    d, count = len(problem.space), len(problem.trajectories)
    share = generator.uniform(size=d) - 0.5
    if kind == "fixed":
        return np.tile(box.middle + share * box.width, (count, 1))
    center = box.middle + _INNER * share * box.width
    draws = generator.standard_normal((count, d)).clip(-2, 2)
    return center + SPREAD * box.width * draws


def interval(found: Fit, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return each parameter's central interval, in units, ``(d,)`` each.

    Of a mixture it is the mixture's own, of a Laplace posterior the normal's, of all others that of the law which draws
    follow.
    """
    distribution = found.distribution
    if "mixture" in found.extras:
        draws = Mixture.of(found.extras["mixture"]).sample(_DRAWS, seed=0)
        low, high = np.quantile(draws, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        return to_values(low, distribution.is_log), to_values(high, distribution.is_log)
    if found.method == "laplace":
        reach = float(scipy.special.ndtri(0.5 + level / 2)) * distribution.std
        ends = (distribution.mean - reach, distribution.mean + reach)
        return to_values(ends[0], distribution.is_log), to_values(ends[1], distribution.is_log)
    tails = torch.tensor([0.5 - level / 2, 0.5 + level / 2], dtype=torch.float64)
    alone = replace(distribution, correlation=None)
    low, high = alone.rsample(tails[:, None].expand(2, len(distribution))).numpy()
    return low, high


def try_method(problem: Problem, truths: np.ndarray, *, kind: Kind, name: str, log: int) -> Trial:
    """Fit a simulated log by the problem's method and compare with the truth.

    Args:
        problem: with the simulated log.
        truths: in coordinates, ``(T, d)``.
        kind: of the log.
        name: what the method is called in the result.
        log: number of the log.
    """
    fitted = fit_problem(problem)
    found = fitted.distribution
    values = to_values(truths, problem.space.is_log)
    box = SearchBox.of(problem.space)
    names = problem.space.names
    inside, width = {}, {}
    for level in LEVELS:
        low, high = interval(fitted, level)
        held = ((values >= low) & (values <= high)).mean(0)
        share = (high - low) / (problem.space.high - problem.space.low)
        inside[f"{level:g}"] = dict(zip(names, map(float, held), strict=True))
        width[f"{level:g}"] = dict(zip(names, map(float, share), strict=True))
    error = np.abs(found.mean - truths.mean(0)) / box.width
    return Trial(kind, name, log, inside, width, dict(zip(names, map(float, error), strict=True)))


def calibrate(
    problems: Callable[[str], Problem],
    methods: Sequence[str],
    *,
    logs: Iterable[int],
    noise: np.ndarray,
    done: Iterable[Trial] = (),
) -> list[Trial]:
    """Fit every simulated log by every method.

    Args:
        problems: name of a method → the problem that fits by it; their logs give starts and actions.
        methods: names.
        logs: numbers of the logs of each kind; the number seeds a log.
        noise: deviation on each observed column of the ends of transitions, ``(n,)``.
        done: trials of an interrupted run, which are not repeated.
    """
    trials = list(done)
    known = {(t.kind, t.method, t.log) for t in trials}
    given = {method: problems(method) for method in methods}
    for log in logs:
        for kind in KINDS:
            for method in methods:
                if (kind, method, log) in known:
                    continue
                truths = draw_truths(given[method], kind, log)
                values = to_values(truths, given[method].space.is_log)
                made = with_seed(synthesise(given[method], values, noise, seed=log), log)
                trials.append(try_method(made, truths, kind=kind, name=method, log=log))
    return trials


def coverages(trials: Sequence[Trial]) -> list[Coverage]:
    """Return how much each method covered, by kind of log, parameter and level."""
    rows = []
    for kind, method in dict.fromkeys((t.kind, t.method) for t in trials):
        own = [t for t in trials if (t.kind, t.method) == (kind, method)]
        for parameter in own[0].error:
            for level in (f"{level:g}" for level in LEVELS):
                share = float(np.mean([t.inside[level][parameter] for t in own]))
                width = float(np.mean([t.width[level][parameter] for t in own]))
                low, high = wilson(share, len(own))
                rows.append(Coverage(kind, method, parameter, float(level), share, low, high, width, len(own)))
    return rows


def wilson(share: float, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a probability, from the share of so many independent trials."""
    z = 1.96
    centre = (share + z * z / (2 * count)) / (1 + z * z / count)
    reach = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count**2))
    return max(0.0, centre - reach), min(1.0, centre + reach)


def plain(trial: Trial) -> dict[str, Any]:
    """Return a trial as plain data."""
    return asdict(trial)
