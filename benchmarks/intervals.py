"""Simulation-based calibration: how often the interval of a fitted distribution holds what it should.

Logs are simulated under known parameters, with the initial states and actions of a given log, and fitted. Two
questions:

``fixed``    one vector of parameters holds throughout, drawn from the search box: is it inside the interval?
``varying``  every transition has parameters of its own, drawn around such a vector: which share is inside?

In both, initial states are exact and the ends have noise. A method that says how uncertain a fixed value is should pass
the first, one that says how much a value varies the second.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.special
import torch

from dropo_torch.baselines import Mixture, fit_problem
from dropo_torch.data.trajectory import Trajectories, make_transitions
from dropo_torch.distribution import SearchBox, to_values
from dropo_torch.fit import Fit
from dropo_torch.problem import Problem
from dropo_torch.studies.study import grouped

Kind = Literal["fixed", "varying"]
KINDS: tuple[Kind, ...] = ("fixed", "varying")
LEVELS = (0.5, 0.9)
#: Truths of ``varying`` logs are drawn around this inner share of the search box; those of ``fixed`` ones, all over it.
_INNER = 0.6
#: Draws of a mixture of which its quantiles are taken.
_DRAWS = 20_000
#: Standard deviation of the parameters of ``varying`` logs, as a share of the search width.
SPREAD = 0.1


@dataclass(frozen=True)
class CalibrationCell:
    """One fit of one simulated log that is to be made.

    Attributes:
        kind: what the log is.
        method: name of the method that fits it.
        log: number of the log, which seeds it.
    """

    kind: Kind
    method: str
    log: int

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        return f"{self.log:04d}-{self.kind}-{re.sub('[^a-z0-9]+', '-', self.method)}"


@dataclass(frozen=True)
class CalibrationRun(CalibrationCell):
    """One fit of one simulated log.

    Attributes:
        kind, method, log: as of its cell.
        inside: level → share of each parameter's true values inside its central interval, name → share.
        width: level → width of the interval as a share of the search box, name → share.
        error: of the mean, as a share of the search box, name → share.
    """

    inside: dict[str, dict[str, float]]
    width: dict[str, dict[str, float]]
    error: dict[str, float]


@dataclass(frozen=True)
class Coverage:
    """All runs of a method on one kind of log, for one parameter.

    Attributes:
        kind, method: as of the runs.
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


def synthesize(problem: Problem, truths: np.ndarray, noise: np.ndarray, seed: int) -> Problem:
    """Return the problem with a log simulated under known parameters, from its episodes' initial states and actions.

    Args:
        problem: whose log gives initial states and actions; without effects that remember.
        truths: parameters of each transition, in units, ``(T, d)``.
        noise: standard deviation of the noise on each observed column of the ends of transitions, ``(n,)``.
        seed: of the noise.
    """
    log, observation, simulator = problem.trajectories, problem.observation, problem.simulator
    columns, index = list(observation.log_columns), observation.index
    starts = observation.states(log.observations)
    before, after = log.observations.copy(), log.next_observations.copy()
    for t in range(len(log)):
        if t == 0 or log.terminals[t - 1]:
            state = torch.from_numpy(starts[t : t + 1].copy())
        before[t, columns] = state[0].numpy()[index]
        control = torch.from_numpy(log.actions[t : t + 1, None].copy())
        state = simulator.simulate(state, control, torch.from_numpy(truths[t : t + 1].copy()))[:, 0]
        after[t, columns] = state[0].numpy()[index]
    after[:, columns] += noise * np.random.default_rng(seed).standard_normal((len(log), len(columns)))
    return with_log(problem, replace(log, observations=before, next_observations=after))


def with_log(problem: Problem, log: Trajectories) -> Problem:
    """Return the problem of another log with the same columns."""
    transitions = make_transitions(log, problem.observation, lag=problem.objective.transitions.lag)
    return replace(problem, trajectories=log, objective=problem.objective.on(transitions))


def draw_truths(problem: Problem, kind: Kind, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters of each transition of a log, in coordinates, ``(T, d)``, and the mean they are drawn around."""
    box, generator = SearchBox.of(problem.space), np.random.default_rng([seed, 23])
    d, count = len(problem.space), len(problem.trajectories)
    share = generator.uniform(size=d) - 0.5
    if kind == "fixed":
        center = box.middle + share * box.width
        return np.tile(center, (count, 1)), center
    center = box.middle + _INNER * share * box.width
    draws = generator.standard_normal((count, d)).clip(-2, 2)
    return center + SPREAD * box.width * draws, center


def interval(found: Fit, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return each parameter's central interval, in units, ``(d,)`` each.

    Of a mixture it is the mixture's own, of a Laplace posterior the normal's, of all others that of the
    distribution which draws follow.
    """
    distribution, tails = found.distribution, (0.5 - level / 2, 0.5 + level / 2)
    if "mixture" in found.extras:
        draws = Mixture.of(found.extras["mixture"]).sample(_DRAWS, seed=0)
        low, high = to_values(np.quantile(draws, tails, axis=0), distribution.is_log)
    elif found.method == "laplace":
        reach = float(scipy.special.ndtri(tails[1])) * distribution.std
        low, high = to_values(distribution.mean + np.array([-reach, reach]), distribution.is_log)
    else:
        uniforms = torch.tensor(tails, dtype=torch.float64)[:, None].expand(2, len(distribution))
        low, high = replace(distribution, correlation=None).rsample(uniforms).numpy()
    return low, high


def calibrate(cell: CalibrationCell, problem: Problem, *, noise: np.ndarray) -> CalibrationRun:
    """Simulate a log, fit it and compare with the truth.

    Args:
        cell: what is simulated and fitted.
        problem: fits by the cell's method; its log gives initial states and actions.
        noise: standard deviation on each observed column of the ends of transitions, ``(n,)``.
    """
    space, box = problem.space, SearchBox.of(problem.space)
    truths, _ = draw_truths(problem, cell.kind, cell.log)
    values = to_values(truths, space.is_log)
    config = problem.config.model_copy(update={"seed": cell.log})  # fits of several logs are independent
    fitted = fit_problem(replace(synthesize(problem, values, noise, seed=cell.log), config=config))
    inside, width = {}, {}
    for level in LEVELS:
        low, high = interval(fitted, level)
        inside[f"{level:g}"] = space.named(((values >= low) & (values <= high)).mean(0))
        width[f"{level:g}"] = space.named((high - low) / (space.high - space.low))
    error = np.abs(fitted.distribution.mean - truths.mean(0)) / box.width
    return CalibrationRun(**vars(cell), inside=inside, width=width, error=space.named(error))


def coverages(runs: Sequence[CalibrationRun]) -> list[Coverage]:
    """Return how much each method covered, by kind of log, parameter and level."""
    rows = []
    for (kind, method), own in grouped(runs, lambda run: (run.kind, run.method)).items():
        for parameter in own[0].error:
            for level in (f"{level:g}" for level in LEVELS):
                share = float(np.mean([t.inside[level][parameter] for t in own]))
                width = float(np.mean([t.width[level][parameter] for t in own]))
                low, high = wilson(share, len(own))
                rows.append(Coverage(kind, method, parameter, float(level), share, low, high, width, len(own)))
    return rows


def wilson(share: float, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a probability, from the share of so many independent runs."""
    z = 1.96
    center = (share + z * z / (2 * count)) / (1 + z * z / count)
    reach = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count**2))
    return max(0.0, center - reach), min(1.0, center + reach)
