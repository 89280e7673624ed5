"""Verdicts on fits of good and of bad models, and what fits say about how well their numbers are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import arm
import numpy as np
import pytest
import torch
from conftest import LinearSimulator, linear_objective, space_of
from rich.console import Console

from dropo_torch.baselines import fit_problem
from dropo_torch.commands.cli import main
from dropo_torch.commands.fit import HOPELESS, run_fit
from dropo_torch.config import make_config
from dropo_torch.diagnostics import _given_the_log, _restricted, diagnose
from dropo_torch.distribution import DRAWN_STD, Distribution
from dropo_torch.fit import Fit, fit
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FitSettings
from dropo_torch.problem import Problem, make_problem
from dropo_torch.verdict import THRESHOLDS, Judgment, Thresholds, autocorrelation, judge, spread_note

#: σ of the noise on the ends of the arm's transitions, rad and rad/s.
NOISE = np.array([1e-4, 1e-4, 1e-3, 1e-3])
STEPS = 150


def arm_log(seed: int, friction: float = 0.0) -> dict[str, np.ndarray]:
    """A log of the arm with noise on the ends of its transitions; friction is in the log alone."""
    xml = arm.XML.replace('damping=".3"', f'damping=".3" frictionloss="{friction}"')
    log = arm.record(STEPS, seed, xml=xml)
    log["next_observations"] = log["next_observations"] + NOISE * np.random.default_rng(seed + 50).normal(
        size=(STEPS, 4)
    )
    return log


def in_degrees(log: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return log | {key: np.rad2deg(log[key]) for key in ("observations", "next_observations")}


def judged(folder: Path, log: dict[str, np.ndarray], **keys: Any) -> tuple[Problem, Fit, Judgment]:
    (folder / "arm.xml").write_text(arm.XML)
    np.savez(folder / "log.npz", **log)
    problem = make_problem(make_config({**arm.CONFIG, "epsilon": (NOISE**2).tolist(), **keys}, base=folder))
    found = fit_problem(problem)
    share = found.diverged / (len(problem.objective) * found.samples)
    return (
        problem,
        found,
        judge(found.distribution, found.method, diagnose(problem.objective, found.distribution), share),
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_right_model_explains_its_log(tmp_path: Path, seed: int) -> None:
    _, _, found = judged(tmp_path, arm_log(seed))
    assert found.verdict == "explained", found.reason


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_model_without_friction_does_not_whatever_sigma_covers(tmp_path: Path, seed: int) -> None:
    _, result, found = judged(tmp_path, arm_log(seed, friction=0.3))
    assert found.verdict == "not_explained", found.reason
    assert "hopeless" not in result.stop_reason


@pytest.mark.parametrize("optimizer", ["fisher", "cma"])
@pytest.mark.parametrize(
    ("make", "keys"),
    [(in_degrees, {}), (dict, {"frame_skip": 1}), (dict, {"frame_skip": 4})],
    ids=["degrees", "half the time", "twice the time"],
)
def test_a_log_in_other_units_or_of_another_time_step_is_hopeless_and_ends_early(
    tmp_path: Path, make: Callable[..., Any], keys: dict[str, Any], optimizer: str
) -> None:
    _, result, found = judged(tmp_path, make(arm_log(0)), **keys, optimizer=optimizer, budget=200)
    assert found.verdict == "hopeless", found.reason
    assert "units" in found.reason
    assert result.stop_reason.startswith("it is hopeless")
    assert len({entry.stage for entry in result.history}) <= 2
    assert result.history[-1].evaluations < 120


def test_a_search_that_spent_its_budget_may_not_have_converged(tmp_path: Path) -> None:
    """Not only the log is to blame then; a search that ends by itself blames the log alone."""
    for optimizer, keys in (("cma", {"budget": 20}), ("fisher", {})):
        problem, result, found = judged(tmp_path, in_degrees(arm_log(0)), optimizer=optimizer, **keys)
        assert found.verdict == "hopeless"
        diagnostics = diagnose(problem.objective, result.distribution, seed=0)
        for reason, told in (("the budget of 20 evaluations is spent", True), ("it is hopeless", False)):
            again = judge(result.distribution, result.method, diagnostics, 0.0, reason)
            assert ("the search has not converged, for the budget" in again.reason) == told


def test_a_hopeless_fit_writes_everything_and_exits_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    judged(tmp_path, in_degrees(arm_log(0)))
    (tmp_path / "config.json").write_text(json.dumps({**arm.CONFIG, "epsilon": (NOISE**2).tolist()}))
    out = tmp_path / "out"
    assert main(["fit", str(tmp_path / "config.json"), "--out", str(out), "--force"]) == HOPELESS == 3
    assert "verdict: hopeless: the simulator predicts" in capsys.readouterr().out
    document = json.loads((out / "fit.json").read_text())
    assert document["verdict"] == "hopeless"
    assert document["verdict_reason"] in capsys.readouterr().out or document["verdict_reason"]
    assert document["parameters"].keys() == arm.TRUTH.keys()
    assert "Hopeless" in (out / "report.html").read_text()
    assert (out / "distribution.yaml").is_file()


def test_where_everything_diverges_it_is_hopeless(tmp_path: Path) -> None:
    gear = {"gear": {"field": "actuator_gear", "name": "lift", "bounds": [1e16, 1e17]}}
    (tmp_path / "arm.xml").write_text(arm.XML)
    np.savez(tmp_path / "log.npz", **arm.record())
    config = make_config({**arm.CONFIG, "parameters": gear}, base=tmp_path)
    found = run_fit(config, tmp_path / "out", console=Console(quiet=True))
    assert found.judgment is not None
    assert found.judgment.verdict == "hopeless"
    assert "diverge" in found.judgment.reason
    document = json.loads((tmp_path / "out/fit.json").read_text())
    assert document["log_likelihood"] is None


def test_a_hopeless_fit_resumes_as_one(tmp_path: Path) -> None:
    problem, whole, _ = judged(tmp_path, in_degrees(arm_log(0)))
    again = [fit_problem(problem, checkpoint=tmp_path / "kept", resume=resume) for resume in (False, True)]
    for found in again:
        assert found.stop_reason == whole.stop_reason
        assert replace(found, seconds=0.0).document() == replace(whole, seconds=0.0).document()


def test_what_is_at_a_bound_and_what_training_gets_stands_in_the_reason(tmp_path: Path) -> None:
    bounds = {**arm.PARAMETERS["upper_mass"], "bounds": [0.5, 1.2]}
    _, result, found = judged(tmp_path, arm_log(0), parameters=arm.PARAMETERS | {"upper_mass": bounds})
    assert "the mean of upper_mass at its upper bound" in found.reason
    _, result, found = judged(tmp_path, arm.record(STEPS), epsilon=1e-4)
    note = spread_note(result.distribution)
    assert note in found.reason
    assert "entropy: 1" in note
    assert all(f"{name} from" in note for name in arm.TRUTH)
    draws = result.distribution.sample(1000, torch.Generator().manual_seed(0))
    for i, name in enumerate(result.distribution.names):
        low, high = (float(x) for x in note.split(f"{name} from ")[1].split(" kg")[0].split(" to "))
        assert low - 1e-8 <= draws[:, i].min() <= draws[:, i].max() <= high + 1e-8


def test_every_threshold_has_its_reason() -> None:
    assert Thresholds.__doc__ is not None
    for threshold in fields(THRESHOLDS):
        assert f"{threshold.name}:" in Thresholds.__doc__


# --- standard errors ---


def varying_objective(seed: int, sigma: float, number: int = 50) -> Objective:
    """Two parameters around 1.3 and 0.7 that differ from row to row, seen through two columns and noise."""
    rng = np.random.default_rng(seed)
    effect = np.array([[1.0, 0.4], [-0.3, 1.0]])
    drawn = rng.normal([1.3, 0.7], sigma, (number, 2)) if sigma else np.tile([1.3, 0.7], (number, 1))
    measured = drawn @ effect.T + rng.normal(0, 1e-3, (number, 2))
    simulator = LinearSimulator(space_of(a=[0, 3], b=[-1, 3]), effect)
    return linear_objective(simulator, measured, epsilon=1e-6)


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_standard_errors_are_the_scatter_of_the_estimates(sigma: float) -> None:
    """Over logs: 90 % of the means lie within 1.64 standard errors of the truth, whether parameters vary or not."""
    inside, scatter, told = [], [], []
    for seed in range(60):
        objective = varying_objective(seed, sigma)
        found = fit(objective, FitSettings(samples=10)).distribution
        error = diagnose(objective, found, samples=4).standard_error
        inside.append(np.abs(found.mean - [1.3, 0.7]) < 1.645 * error)
        scatter.append(found.mean)
        told.append(error)
    assert 0.82 <= np.mean(inside) <= 0.96
    assert np.mean(told, axis=0) == pytest.approx(np.std(scatter, axis=0), rel=0.25)


def test_the_likelihood_of_a_variance_is_that_of_the_whole_covariance() -> None:
    """At every variance: the density of the residuals, the means integrated out, and where these are then."""
    rng, prior = np.random.default_rng(0), torch.diag(torch.tensor([0.5, 2.0], dtype=torch.float64))
    jacobian, residual = (torch.from_numpy(rng.normal(size=s)) for s in ((12, 2, 3), (12, 3)))
    rest = torch.eye(3, dtype=torch.float64) + 0.2
    variances, whole, means = torch.tensor([0.0, 0.1, 1.0, 30.0], dtype=torch.float64), [], []
    for v in variances:
        total = torch.block_diag(*(rest + v * torch.outer(a[1], a[1]) for a in jacobian))
        slope, flat = jacobian.mT.reshape(-1, 2), residual.reshape(-1)
        marginal = total + slope @ torch.linalg.inv(prior) @ slope.T
        whole.append(-0.5 * (flat @ torch.linalg.solve(marginal, flat) + torch.logdet(marginal)))
        inverse = torch.linalg.inv(total)
        means.append(torch.linalg.solve(slope.T @ inverse @ slope + prior, slope.T @ inverse @ flat)[1])
    pull = torch.linalg.solve(rest, jacobian.mT)
    found, there = _restricted(jacobian @ pull, (pull.mT @ residual[..., None])[..., 0], 1, variances, prior)
    whole = torch.stack(whole)
    assert (found - found[0]).numpy() == pytest.approx((whole - whole[0]).numpy(), abs=1e-9)
    assert there.numpy() == pytest.approx(torch.stack(means).numpy(), abs=1e-9)


def test_means_are_no_surer_where_sigma_came_out_too_small() -> None:
    """A parameter that few windows show: its error with σ at the floor is near that with the true one, not a fifth."""
    shown = np.where(np.arange(60) % 12 == 0, 1.0, 1e-3)
    jacobian = torch.from_numpy(shown[:, None, None])
    true, told = 0.1, []
    objective = linear_objective(LinearSimulator(space_of(a=[0, 1]), np.eye(1)), np.zeros((60, 1)), epsilon=1e-4)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pulls = shown * rng.normal(0, true, 60) + rng.normal(0, 1e-2, 60)
        arguments = torch.from_numpy(pulls[:, None]), None, torch.ones(1, dtype=torch.float64)
        spread, noise = torch.full((1, 1), 1e-10).double(), torch.full((60, 1, 1), 1e-4).double()
        told.append(_given_the_log(objective, noise, jacobian, spread, *arguments).sqrt().item())
    assert 0.7 < np.median(told) / (true / np.sqrt(5)) < 1.4


def test_standard_errors_count_what_windows_of_a_trajectory_have_in_common() -> None:
    """Of twenty trajectories of ten windows with one error each: the scatter of the estimates, not a third of it."""
    episodes, scatter, told = np.repeat(np.arange(20), 10), [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        measured = 1.3 + np.repeat(rng.normal(0, 0.1, (20, 1)), 10, axis=0) + rng.normal(0, 1e-3, (200, 1))
        objective = linear_objective(LinearSimulator(space_of(a=[0, 3]), np.eye(1)), measured, epsilon=1e-6)
        objective = objective.on(replace(objective.transitions, episodes=episodes))
        point = Distribution.over(objective.simulator.parameters, measured.mean(0), objective.box.min_std)
        scatter.append(measured.mean())
        told.append(diagnose(objective, point, samples=4).standard_error[0])
    assert np.mean(told) == pytest.approx(np.std(scatter), rel=0.25)


def test_a_parameter_without_effect_within_its_bounds_leaves_the_errors_of_others_what_they_are() -> None:
    """Another that acts as the first does, a million times less, cannot stand for it."""
    measured, told = 1.3 + np.random.default_rng(0).normal(0, 0.1, (100, 1)), []
    for effect in ([[1.0, 0.0]], [[1.0, 1e-6]]):
        simulator = LinearSimulator(space_of(a=[0, 3], b=[0, 2]), np.array(effect))
        objective = linear_objective(simulator, measured, epsilon=0.01)
        point = Distribution.over(objective.simulator.parameters, [measured.mean(), 1.0], objective.box.min_std)
        told.append(diagnose(objective, point, samples=4).standard_error)
    assert told[1][0] == pytest.approx(told[0][0], rel=0.01)
    assert told[0][0] == pytest.approx(0.01, rel=0.2)
    assert (np.array(told)[:, 1] > 1.9).all()


def test_standard_errors_of_sigma_are_the_scatter_of_its_estimates() -> None:
    found = [(o, fit(o, FitSettings(samples=10)).distribution) for o in (varying_objective(s, 0.3) for s in range(40))]
    told = [diagnose(o, d, samples=4).std_error for o, d in found]
    scatter = np.std([d.std for _, d in found], axis=0)
    assert np.mean(told, axis=0) == pytest.approx(scatter, rel=0.3)
    assert np.mean([d.std for _, d in found], axis=0) * DRAWN_STD == pytest.approx(0.3, rel=0.05)


def test_a_sigma_at_its_floor_has_no_standard_error() -> None:
    objective = varying_objective(0, 0.0)
    box = objective.box
    fixed = Distribution.over(objective.simulator.parameters, np.array([1.3, 0.7]), box.min_std)
    assert np.isnan(diagnose(objective, fixed, samples=4).std_error).all()


def test_residuals_that_go_together_are_told_from_those_that_do_not() -> None:
    objective = varying_objective(0, 0.3, 400)
    found = fit(objective, FitSettings(samples=10)).distribution
    diagnostics = replace(diagnose(objective, found), follows=np.arange(400) < 399)
    together, least = autocorrelation(diagnostics)
    assert (together < least).all()
    order = np.argsort(diagnostics.residual[:, 0])
    together, least = autocorrelation(
        replace(diagnostics, measured=diagnostics.measured[order], mean=diagnostics.mean[order])
    )
    assert together[0] > least
