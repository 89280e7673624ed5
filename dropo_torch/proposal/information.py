"""What a log tells of candidates: its noise, the length of windows that suits it, and Fisher information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from dropo_torch.config import Config
from dropo_torch.data.features import Features
from dropo_torch.data.trajectory import Trajectories, make_transitions
from dropo_torch.distribution import to_coordinates
from dropo_torch.effects.base import Setting
from dropo_torch.effects.engine import Variant
from dropo_torch.gap.log import make_setting, start_values
from dropo_torch.gap.noise import free_forces, late_rows
from dropo_torch.gap.scene import short_windows
from dropo_torch.gap.twin import Twin
from dropo_torch.initial_noise import NOISE_DRAWS
from dropo_torch.objective import Objective
from dropo_torch.problem import Problem, make_problem
from dropo_torch.proposal.candidates import Candidate
from dropo_torch.proposal.draft import Filter
from dropo_torch.support.report import Report
from dropo_torch.support.rows import evenly

#: Noise, and ε beside it, relative to a column's standard deviation and to its noise.
FLOOR, BESIDE = 1e-6, 0.3
#: Windows that are looked at, in logged steps, and seconds that they may take.
LAGS, LONGEST = (1, 2, 4, 8, 16, 32), 1.0
#: Microseconds of simulation for one length of windows, about, and logged steps at least and at most.
BUDGET, FEWEST, MOST = 1e6, 150, 3000
#: Step of the differences, as a share of a candidate's bounds.
STEP = 1e-5
#: Lengths of windows, one after the other, that tell less than a shorter one: longer ones are not tried then.
ENOUGH = 2
#: Standard errors, in sizes of candidates, below which more does not count when the length of windows is chosen.
FINE = 0.005
#: Nats for each direction that a longer window must gain.
GAIN = 0.15


@dataclass(frozen=True)
class Noise:
    """The noise of a log.

    Attributes:
        columns: standard deviation of each observed column, ``(n,)``.
        setting: the model, and the sizes of the log.
        config: that of the log, with the noise of its states.
        log: its states, where the log itself shows sensors.
    """

    columns: np.ndarray
    setting: Setting
    config: Config
    log: Trajectories | None = None


@dataclass(frozen=True)
class Information:
    """What a log tells of candidates, to first order around the model's values.

    Attributes:
        gram: Fisher information in the candidates' sizes, ``(d, d)``.
        lag: logged steps of a window.
        windows: of the log.
    """

    gram: np.ndarray
    lag: int
    windows: int


def measure_noise(problem: Problem, smooth: Filter | None = None) -> Noise:
    """Return the noise of a log, by short windows in which forces are free: what no missing effect explains.

    Of velocities that were derived through a filter, they show next to nothing: what that leaves counts.

    Raises:
        InputError: a log too short for that.
    """
    log = replace(problem.trajectories, dt=problem.trajectories.dt or problem.simulator.timestep)
    setting = make_setting(problem, log)
    twin = Twin(setting, problem.space, num_threads=problem.config.threads)
    own, short = Variant(tuple(start_values(problem).tolist())), short_windows(setting, log)
    setting = replace(setting, signals=replace(setting.signals, late=late_rows(twin, short, own)))
    found = free_forces(Twin(setting, problem.space, num_threads=problem.config.threads), short, own)
    spread = problem.observation.observed(log.observations).std(0)
    columns = Features.of(problem.observation).column_noise(found.noise)
    if smooth is not None:
        columns = np.maximum(columns, [_left_of_rate(smooth, label) for label in problem.observation.labels])
    return Noise(np.maximum(columns, FLOOR * np.where(spread > 0, spread, 1.0)), setting, problem.config)


def _left_of_rate(smooth: Filter, label: str) -> float:
    """The noise that a filter leaves of a derived velocity; none of a position, which stays as it was measured."""
    if ".velocity" not in label:
        return 0.0
    if "[w" in label:
        return smooth.turning_noise(label.split(".")[0])
    return smooth.rate_noise(label.replace(".velocity[v", ".position[").replace(".velocity", ".position"))


def noise_keys(problem: Problem, noise: np.ndarray) -> dict[str, Any]:
    """Return the keys ``noise`` and ``epsilon`` of a config: ε is small beside the noise."""
    listed = [float(f"{x:.3g}") for x in noise]
    features = problem.objective.features.feature_noise(np.array(listed))
    epsilon = [float(f"{max((BESIDE * x) ** 2, 1e-18):.2g}") for x in features]
    return {"noise": listed, "epsilon": epsilon}


def information_of(
    config: Config,
    candidates: Sequence[Candidate],
    *,
    least: int = 1,
    report: Report | None = None,
    log: Trajectories | None = None,
) -> Information:
    """Return what a log tells of candidates, by windows of the length that tells most.

    Args:
        config: with the log, ``noise`` and ``epsilon``.
        candidates: the candidates.
        least: shortest length of windows, in logged steps.
        report: is told the stage and its share.
        log: the log, in place of the config's.
    """
    document = config.document() | {"parameters": {c.name: c.spec for c in candidates}, "lag": 1}
    problem = make_problem(Config(**document, base=config.base), log=log)
    simulations = len(candidates) + 2 + 2 * NOISE_DRAWS * problem.observation.size
    cost = _microseconds(problem) * problem.simulator.frame_skip * simulations
    steps = int(np.clip(BUDGET / cost, FEWEST, MOST))
    longest = int(np.bincount(problem.trajectories.episodes).max())
    step = problem.simulator.timestep or 1.0
    tried = [n for n in LAGS if n > least and n * 4 <= longest and n * step <= LONGEST]
    tried = [min(least, max(1, longest // 2)), *tried]
    best, fewer = None, 0
    for number, lag in enumerate(tried):
        if report is not None:
            report(f"Fisher information of windows of {lag} rows", number / len(tried))
        found = _at_lag(problem, candidates, lag, steps)
        worth = _worth(found.gram)
        fewer = fewer + 1 if best is not None and worth < _worth(best.gram) else 0
        if best is None or worth > _worth(best.gram) + GAIN * _rank(found.gram):
            best = found
        if fewer == ENOUGH:
            break
    assert best is not None
    return best


def _worth(gram: np.ndarray) -> float:
    """Nats that are learned beside a prior of the candidates' sizes, up to what is known finely enough."""
    values = np.maximum(np.linalg.eigvalsh(gram), 0.0)
    return float(-0.5 * np.log(1 / (1 + values) + FINE**2).sum())


def _rank(gram: np.ndarray) -> int:
    return int((np.linalg.eigvalsh(gram) > 1).sum())


def _microseconds(problem: Problem) -> float:
    """Of a physics step, about."""
    model = problem.space.model
    assert model is not None
    return float((3 + 0.15 * model.nv**2) * (1.0 if model.ngeom < 2 else 2.0))


def _at_lag(problem: Problem, candidates: Sequence[Candidate], lag: int, steps: int) -> Information:
    """Fisher information by windows of one length."""
    every = make_transitions(
        problem.trajectories, problem.observation, lag=lag, history=problem.simulator.history,
        past=problem.simulator.past, since=problem.since,
    )  # fmt: skip
    wanted = max(8, steps // lag)
    rows = evenly(len(every), wanted)
    objective = problem.objective.on(every.select(rows))
    jacobian, covariance = sensitivities(objective)
    scaled = jacobian * torch.tensor([c.size for c in candidates], dtype=torch.float64)[None, :, None]
    pulled = torch.linalg.solve(covariance, scaled.mT)
    each = torch.nan_to_num(scaled @ pulled)
    usual = each.diagonal(dim1=1, dim2=2).sum(1)
    kept = usual <= 100 * usual[usual > 0].median() if bool((usual > 0).any()) else usual >= 0
    gram = each[kept].sum(0) * (len(every) / max(int(kept.sum()), 1))
    return Information(gram.numpy(), lag, len(every))


def sensitivities(objective: Objective) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the derivatives of the features in the parameters ``(T, d, m)``, and the features' covariance.

    They are taken at the model's values, by differences into the search box.
    """
    box, space = objective.box, objective.simulator.parameters
    start = nominal_point(objective)
    step = STEP * box.width * np.where(start + STEP * box.width > box.high, -1.0, 1.0)
    points = np.concatenate([start[None], start + np.diag(step)])
    run = objective.evaluator
    features = [run.after(block, torch.from_numpy(box.values(points))) for block in run.blocks(len(points))]
    simulated = torch.cat(features)
    jacobian = torch.nan_to_num((simulated[:, 1:] - simulated[:, :1]) / torch.from_numpy(step)[:, None])
    initial = objective.initial_noise(start, None, widen=False)
    assert len(space) == len(step)
    return jacobian, objective.base_covariance(slice(None), initial)


def nominal_point(objective: Objective) -> np.ndarray:
    """Return the model's own values in coordinates, within the search box, ``(d,)``."""
    space = objective.simulator.parameters
    return to_coordinates(np.clip(np.nan_to_num(space.nominal, nan=1.0), space.low, space.high), space.is_log)
