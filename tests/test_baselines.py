"""The methods beside DROPO: known truths at small size, their laws, and what they refuse."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from conftest import LinearSimulator, generic_observation, linear_objective, space_of
from dropo_sims.hopper.study import REDUCED, Plan, all_cells, run_study

from benchmarks.intervals import (
    KINDS,
    CalibrationCell,
    CalibrationRun,
    calibrate,
    coverages,
    draw_truths,
    interval,
    synthesize,
    wilson,
)
from dropo_torch.baselines import Mixture, fit_problem, make_search
from dropo_torch.baselines.bayessim import summaries, summary_sums
from dropo_torch.baselines.laplace import LaplaceOptimizer
from dropo_torch.baselines.mixture import fit_mixture, unlikeness
from dropo_torch.baselines.settings import BayesSimSettings, method_settings
from dropo_torch.baselines.simopt import reps_weights
from dropo_torch.commands.cli import main
from dropo_torch.config import make_config
from dropo_torch.data.trajectory import Trajectories, make_replay
from dropo_torch.diagnostics import diagnose, estimates
from dropo_torch.distribution import DRAWN_STD, Distribution, truncated_moments
from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, fit
from dropo_torch.optimizers import FitSettings
from dropo_torch.optimizers.correlated import random_effects
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.problem import Problem, make_problem
from dropo_torch.report import write_fit_report
from dropo_torch.report.words import findings
from dropo_torch.support.random import draw_uniforms

#: A driven pendulum; the rod has no mass, the bob's is to be found.
PENDULUM_XML = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="bob" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.05"/>
      <inertial pos="0 0 -.5" mass="1" diaginertia=".002 .002 .002"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>"""
MASS, DAMPING = 1.4, 0.12
STEPS = 80


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pendulum's model, and a log of another mass and damping; without noise and with."""
    path = tmp_path_factory.mktemp("pendulum")
    (path / "pendulum.xml").write_text(PENDULUM_XML)
    model = mujoco.MjModel.from_xml_string(PENDULUM_XML)
    model.body("bob").mass[0], model.dof_damping[0] = MASS, DAMPING
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    torque = 3 * np.sin(0.31 * np.arange(STEPS)) + np.sin(1.1 * np.arange(STEPS))
    states = [np.array([0.0, 0.0])]
    for u in torque:
        data.ctrl[0] = u
        mujoco.mj_step(model, data, nstep=4)
        states.append(np.array([data.qpos[0], data.qvel[0]]))
    exact = np.array(states)
    noisy_ends = exact[1:] + np.array([1e-3, 1e-2]) * np.random.default_rng(3).standard_normal((STEPS, 2))
    for name, ends in (("exact", exact[1:]), ("noisy", noisy_ends)):
        np.savez(
            path / f"{name}.npz",
            observations=exact[:-1],
            next_observations=ends,
            actions=torque[:, None],
            terminals=np.arange(STEPS) == STEPS - 1,
        )
    return path


def config(folder: Path, method: str, data: str = "exact", **keys: Any) -> dict[str, Any]:
    return {
        "model": str(folder / "pendulum.xml"),
        "data": str(folder / f"{data}.npz"),
        "frame_skip": 4,
        "parameters": {
            "mass": {"field": "body_mass", "name": "bob", "bounds": [0.5, 3.0], "unit": "kg"},
            "damping": {"field": "dof_damping", "name": "pivot", "bounds": [0.01, 0.5], "limits": [0, 1]},
        },
        "method": method,
        "threads": 1,
        "samples": 20,
        "epsilon": [1e-6, 1e-4],
        **keys,
    }


def problem(folder: Path, method: str, data: str = "exact", **keys: Any) -> Problem:
    return make_problem(make_config(config(folder, method, data, **keys)))


TRUTH = np.array([MASS, DAMPING])


def test_droid_finds_the_parameters_and_its_deviations_collapse(folder: Path) -> None:
    for data, tolerance in (("exact", [1e-5, 1e-5]), ("noisy", [0.05, 0.1])):
        found = fit_problem(problem(folder, "droid", data)).distribution
        assert (np.abs(found.mean - TRUTH) < tolerance).all()
        assert (found.std < 1e-3 * (found.high - found.low)).all()  # whatever the noise


def test_laplace_is_the_normal_of_least_squares(folder: Path) -> None:
    """Where the simulation is linear, mean and covariance are those of weighted least squares, in closed form."""
    rng = np.random.default_rng(0)
    space = space_of(a=[-5, 5], b=[-5, 5])
    simulator = LinearSimulator(space, np.array([[1.0, 0.5], [0.0, 2.0], [1.0, -1.0]]))
    measured = np.array([1.0, -2.0]) @ simulator.effect.numpy().T + 0.1 * rng.standard_normal((40, 3))
    objective = linear_objective(simulator, measured, epsilon=[1e-2, 1e-2, 4e-2])
    found = fit(objective, FitSettings(samples=10), search=LaplaceOptimizer(objective)).distribution
    weight = np.diag(1 / np.array([1e-2, 1e-2, 4e-2]))
    design = simulator.effect.numpy()
    gram = 40 * design.T @ weight @ design
    mean = np.linalg.solve(gram, design.T @ weight @ measured.sum(0))
    residual = measured - mean @ design.T
    scale = np.einsum("ti,ij,tj->", residual, weight, residual) / (40 * 3 - 2)
    covariance = scale * np.linalg.inv(gram)
    assert found.mean == pytest.approx(mean, abs=1e-6)
    assert found.std == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
    assert found.correlation is not None
    assert found.correlation[0, 1] == pytest.approx(covariance[0, 1] / np.sqrt(np.prod(np.diag(covariance))), rel=1e-4)


@pytest.mark.parametrize("epsilon", [1e-12, 1e-5, 1.0])
def test_laplace_does_not_depend_on_the_size_of_epsilon(folder: Path, epsilon: float) -> None:
    """Errors of the log far below ε are errors all the same: the means are found as well as the log tells."""
    found = fit_problem(problem(folder, "laplace", "noisy", epsilon=[1e-2 * epsilon, epsilon]))
    matched = fit_problem(problem(folder, "laplace", "noisy"))
    assert found.distribution.mean == pytest.approx(
        matched.distribution.mean, abs=1e-2 * matched.distribution.std.min()
    )
    assert found.distribution.std == pytest.approx(matched.distribution.std, rel=1e-3)
    assert found.extras["reduced_chi2"] * epsilon == pytest.approx(matched.extras["reduced_chi2"] * 1e-4, rel=1e-3)
    exact = fit_problem(problem(folder, "laplace", "exact", epsilon=epsilon)).distribution
    assert exact.mean == pytest.approx(TRUTH, rel=1e-6)


def test_laplace_keeps_a_direction_that_the_log_knows_where_another_is_unknown() -> None:
    """Only a + b is seen: its σ is the log's, though a's and b's are their boxes'."""
    rng = np.random.default_rng(0)
    simulator = LinearSimulator(space_of(a=[0, 1], b=[0, 100]), np.array([[1.0, 1.0]]))
    objective = linear_objective(simulator, 30.0 + 0.01 * rng.standard_normal((40, 1)), epsilon=1e-4)
    found = fit(objective, FitSettings(samples=10), search=LaplaceOptimizer(objective)).distribution
    assert found.correlation is not None
    covariance = found.correlation * np.outer(found.std, found.std)
    assert np.sqrt(covariance.sum()) == pytest.approx(0.01 / np.sqrt(40), rel=0.3)
    assert found.mean.sum() == pytest.approx(30.0, abs=0.01)
    assert (found.std <= [1.0, 100.0]).all()


def test_a_lost_transition_does_not_widen_laplace() -> None:
    """The reduced χ² is that of the transitions that survived."""
    sums = np.zeros(2 + 2 * 1 + 2 * 1)
    sums[0] = 0.5 * 38
    sums[1], sums[4] = 1, 1.0  # one lost; a curvature
    stage = MeansStage(np.zeros(1), np.ones(1), np.full(1, 0.5), (20, 2))
    stage.tell(torch.from_numpy(sums))
    assert stage.reduced_chi2 == pytest.approx(38 / (19 * 2 - 1))


def test_laplace_covers_the_truth_of_a_noisy_log(folder: Path) -> None:
    found = fit_problem(problem(folder, "laplace", "noisy")).distribution
    z = (TRUTH - found.mean) / found.std
    assert (np.abs(z) < 3.5).all()
    assert (found.std < [0.03, 0.07]).all()


def test_simopt_moves_to_the_parameters_and_shrinks(folder: Path) -> None:
    options = {"samples": 60, "iterations": 15, "horizon": 20}
    found = fit_problem(problem(folder, "simopt", method_options=options))
    spread = found.distribution.std / (found.distribution.high - found.distribution.low)
    assert found.distribution.mean == pytest.approx(TRUTH, rel=0.05)
    assert (spread < 0.05).all()
    assert found.document()["method"] == "simopt"
    assert found.document()["horizon"] == 20


@pytest.mark.parametrize("features", ["mdnn", "mdrff"])
def test_bayessim_contains_the_truth_and_is_narrower_than_the_prior(folder: Path, features: str) -> None:
    options = {"features": features, "simulations": 300, "horizon": 20, "epochs": 250, "components": 3, "hidden": 32}
    given = config(folder, "bayessim", method_options=options)
    given["parameters"] = {"mass": given["parameters"]["mass"]}
    model = Path(given["model"])
    light = model.with_name("damped.xml")
    light.write_text(PENDULUM_XML.replace('damping="0.05"', f'damping="{DAMPING}"'))
    result = fit_problem(make_problem(make_config({**given, "model": str(light)})))
    mixture = Mixture.of(result.document()["mixture"])
    draws = mixture.sample(2000, seed=1)[:, 0]
    low, high = np.quantile(draws, [0.01, 0.99])
    assert low < MASS < high
    assert draws.std() < 0.5 * (3.0 - 0.5) / np.sqrt(12)
    assert result.distribution.mean[0] == pytest.approx(draws.mean(), abs=4 * draws.std() / np.sqrt(2000))


def moments(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a mixture without its box."""
    mean = mixture.weights @ mixture.means
    centered = mixture.means - mean
    between = np.einsum("m,mi,mj->ij", mixture.weights, centered, centered)
    return mean, np.einsum("m,mij->ij", mixture.weights, mixture.covariances) + between


def test_a_mixtures_moments_match_its_draws() -> None:
    mixture = Mixture(
        weights=np.array([0.3, 0.7]),
        means=np.array([[0.0, 1.0], [2.0, -1.0]]),
        covariances=np.array([[[1.0, 0.3], [0.3, 0.5]], [[0.4, -0.2], [-0.2, 0.9]]]),
        low=np.full(2, -np.inf),
        high=np.full(2, np.inf),
    )
    mean, covariance = moments(mixture)
    draws = mixture.sample(60_000, seed=0)
    assert draws.mean(0) == pytest.approx(mean, abs=0.02)
    assert np.cov(draws.T) == pytest.approx(covariance, abs=0.04)
    inside = mixture.moments_inside
    assert inside[0] == pytest.approx(mean, abs=0.03)
    assert moments(Mixture.of(json.loads(json.dumps(mixture.document()))))[1] == pytest.approx(covariance)


def test_a_mixture_stays_in_its_box() -> None:
    outside = Mixture(np.ones(1), np.array([[50.0]]), np.array([[[1.0]]]), np.zeros(1), np.ones(1))
    assert outside.sample(100, seed=0) == pytest.approx(1.0)
    assert outside.share_inside == 0
    assert len(outside.peaks(0)) < 2
    two = Mixture(np.full(2, 0.5), np.array([[0.2], [0.7]]), np.full((2, 1, 1), 0.01), np.zeros(1), np.ones(1))
    assert two.peaks(0) == pytest.approx([0.2, 0.7], abs=0.01)
    near = Mixture(np.full(2, 0.5), np.array([[0.4], [0.6]]), np.full((2, 1, 1), 0.01), np.zeros(1), np.ones(1))
    assert len(near.peaks(0)) == 1
    wide = Mixture(np.ones(1), np.array([[0.9]]), np.array([[[0.2]]]), np.zeros(1), np.ones(1))
    assert wide.share_inside == pytest.approx(0.566, abs=0.02)
    assert wide.shares_inside == pytest.approx([0.566], abs=1e-3)
    points = np.linspace(-4, 6, 2001)
    density = wide.marginal_density(0, points)
    assert np.trapezoid(density, points) == pytest.approx(1, abs=1e-6)
    assert points[density.argmax()] == pytest.approx(0.9, abs=0.01)
    draws = wide.sample(5000, seed=0)
    assert draws.min() >= 0
    assert draws.max() <= 1
    assert wide.moments_inside[0][0] < 0.8


@pytest.mark.parametrize("features", ["mdnn", "mdrff"])
def test_a_mixture_density_network_learns_a_gaussian_posterior(features: str) -> None:
    """x = θ + noise with σ = 0.1: the posterior of θ in [0, 1] is normal around x with that σ."""
    rng = np.random.default_rng(0)
    shares = rng.uniform(size=(1500, 1))
    x = shares + 0.1 * rng.standard_normal((1500, 1))
    settings = BayesSimSettings(features=features, components=2, hidden=32, epochs=400)
    found = fit_mixture(x, shares, np.array([0.5]), settings=settings, seed=0, bounds=(np.zeros(1), np.ones(1)))
    mean, covariance = moments(found)
    assert mean[0] == pytest.approx(0.5, abs=0.04)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.1, rel=0.25)


def test_a_posterior_outside_the_box_ends_at_its_side_and_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log that is unlike every simulation: the network extrapolates."""

    def away(*_: object, bounds: tuple[np.ndarray, np.ndarray], **__: object) -> Mixture:
        low, width = bounds[0], bounds[1] - bounds[0]
        means, covariances = (low + np.array([0.5, 30.0]) * width)[None], np.diag(width**2)[None] * 1e-4
        return Mixture(np.ones(1), means, covariances, *bounds)

    monkeypatch.setattr("dropo_torch.baselines.bayessim.fit_mixture", away)
    found = fit_problem(problem(folder, "bayessim", method_options={"simulations": 20, "horizon": 10}))
    box = found.distribution
    assert box.mean[1] == pytest.approx(box.high[1], rel=1e-6)
    assert np.isfinite(box.std).all()
    assert "damping lies outside the search box" in found.document()["stop_reason"]
    assert found.document()["extrapolates"]
    assert found.document()["share_inside"] == 0


def test_training_the_network_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """No files in the working directory, nothing on the terminal, and the caller's random numbers as they were."""
    monkeypatch.chdir(tmp_path)
    x = np.random.default_rng(0).uniform(size=(60, 1))
    settings = BayesSimSettings(components=2, hidden=8, epochs=3)
    before = torch.random.get_rng_state()
    found = [
        fit_mixture(x, x, np.array([0.5]), settings=settings, seed=seed, bounds=(np.zeros(1), np.ones(1)))
        for seed in (0, 0, 1)
    ]
    assert torch.equal(torch.random.get_rng_state(), before)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")
    assert (found[0].means == found[1].means).all()
    assert (found[0].means != found[2].means).any()


def test_bayessim_without_sbi_says_how_to_get_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sbi", None)
    with pytest.raises(InputError, match=r"pip install 'dropo_torch\[baselines\]'"):
        make_search(problem(folder, "bayessim"))


def test_summaries_are_moments_of_changes() -> None:
    rng = np.random.default_rng(0)
    paths, logged = torch.from_numpy(rng.normal(size=(3, 2, 5, 4))), torch.from_numpy(rng.normal(size=(3, 5, 4)))
    controls = torch.from_numpy(rng.normal(size=(3, 5, 2)))
    sums = summary_sums(paths, logged, controls).numpy().reshape(3, -1)
    found = summaries(sums, 4, 3 * 4)
    change = np.diff(paths[:, 1].numpy(), axis=1).reshape(-1, 4)
    u = controls[:, 1:].numpy().reshape(-1, 2)
    expected = [change.mean(0), change.var(0), (change[:, :, None] * u[:, None]).mean(0).ravel()]
    assert found[1] == pytest.approx(np.concatenate(expected))
    assert found[2, :4] == pytest.approx(np.diff(logged.numpy(), axis=1).reshape(-1, 4).mean(0))


def test_bayessim_measures_its_replays_as_the_log_was(folder: Path) -> None:
    """Noise of variance ν adds 2ν to the mean square of a step's change."""
    options = {"simulations": 200, "horizon": 20}
    sums = []
    for noise in (None, [0.05, 0.3]):
        ours = problem(folder, "bayessim", method_options=options, noise=noise)
        search = make_search(ours)
        assert search is not None
        request = search.ask()
        assert request.replay is not None
        table = ours.objective.evaluator.map_replay(request.replay, request.values, request.reduce).total.reshape(
            101, -1
        )
        sums.append(table[:-1, 2:4].mean(0) / (4 * 19))
    assert (sums[1] - sums[0]).numpy() == pytest.approx([2 * 0.05**2, 2 * 0.3**2], rel=0.1)


def test_reps_weights_keep_within_the_bound_and_prefer_low_costs() -> None:
    costs = np.random.default_rng(0).uniform(size=500)
    for kl in (0.1, 0.5, 1.0):
        weights = reps_weights(costs, kl)
        entropy = np.sum(weights * np.log(np.maximum(weights * len(costs), 1e-300)))
        assert entropy == pytest.approx(kl, rel=0.02)
        assert weights[np.argmin(costs)] == weights.max()
    lost = reps_weights(np.array([1.0, np.nan, 2.0]), 0.5)
    assert lost[1] == 0
    assert lost.sum() == pytest.approx(1)
    assert reps_weights(np.full(4, np.nan), 0.5) == pytest.approx(0.25)


def test_replays_follow_the_log_where_the_parameters_are_right(folder: Path) -> None:
    ours = problem(folder, "simopt")
    replay = make_replay(ours.trajectories, ours.observation, 20)
    assert replay.measured.shape == (4, 20, 2)

    def worst(features: torch.Tensor, measured: torch.Tensor, controls: torch.Tensor) -> torch.Tensor:
        return (features - measured[:, None]).abs().amax((0, 2, 3))

    error = ours.objective.evaluator.map_replay(replay, np.array([[MASS, DAMPING], [1.0, 0.05]]), worst).total
    assert error[0] < 1e-9
    assert error[1] > 0.05
    assert make_replay(ours.trajectories, ours.observation, 10_000).horizon == STEPS


def test_uniform_boxes_lie_inside_the_search_box(folder: Path) -> None:
    first = fit_problem(problem(folder, "udr"))
    document = first.document()
    assert len(document["boxes"]) == 10
    for box in document["boxes"]:
        assert 0.5 <= box["mass"][0] < box["mass"][1] <= 3.0
        assert 0.01 <= box["damping"][0] < box["damping"][1] <= 0.5
    third = fit_problem(problem(folder, "udr", method_options={"box": 3}))
    draws = third.distribution.sample(20_000, torch.Generator().manual_seed(0)).numpy()
    low, high = np.array([document["boxes"][3][name] for name in ("mass", "damping")]).T
    assert (draws.min(0) >= low - 1e-12).all()
    assert (draws.max(0) <= high + 1e-12).all()
    assert draws.mean(0) == pytest.approx(third.distribution.mean, rel=0.02)
    assert draws.std(0) == pytest.approx(third.distribution.std, rel=0.03)


@pytest.mark.parametrize("uniform", [False, True])
def test_a_distribution_survives_its_file(tmp_path: Path, uniform: bool) -> None:
    space = space_of(a=[0.0, 10.0], b={"bounds": [0.1, 10.0], "scale": "log"})
    correlation = None if uniform else np.array([[1.0, 0.6], [0.6, 1.0]])
    made = Distribution.over(
        space, np.array([4.0, 0.3]), np.array([0.5, 0.2]), correlation=correlation, is_uniform=uniform
    )
    for name in ("d.json", "d.yaml"):
        made.save(tmp_path / name)
        back = Distribution.load(tmp_path / name)
        uniforms = draw_uniforms(500, 2, 0)
        assert back.rsample(uniforms).numpy() == pytest.approx(made.rsample(uniforms).numpy())
        values = made.rsample(uniforms)
        assert back.log_prob(values).numpy() == pytest.approx(made.log_prob(values).numpy())
        assert torch.isfinite(made.log_prob(values)).all()


@pytest.mark.parametrize("uniform", [False, True])
def test_a_density_integrates_to_one(uniform: bool) -> None:
    correlation = None if uniform else np.array([[1.0, -0.7], [-0.7, 1.0]])
    made = Distribution.over(
        space_of(a=[0.0, 10.0], b=[0.0, 10.0]), np.array([4.0, 5.0]), np.array([0.5, 1.0]), correlation=correlation,
        is_uniform=uniform,
    )  # fmt: skip
    a, b = (torch.linspace(float(lo), float(hi), 401, dtype=torch.float64) for lo, hi in zip(*made.ends, strict=True))
    a, b = (0.5 * (x[1:] + x[:-1]) for x in (a, b))
    grid = torch.stack(torch.meshgrid(a, b, indexing="ij"), -1)
    assert float(made.log_prob(grid).exp().sum() * (a[1] - a[0]) * (b[1] - b[0])) == pytest.approx(1, abs=5e-3)


def test_correlated_draws_have_their_correlation() -> None:
    correlation = np.array([[1.0, 0.8], [0.8, 1.0]])
    made = Distribution.over(space_of(a=[0, 1], b=[0, 1]), np.full(2, 0.5), np.full(2, 0.01), correlation=correlation)
    draws = made.sample(50_000, torch.Generator().manual_seed(0)).numpy()
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(0.8, abs=0.02)


def test_a_file_with_a_wrong_correlation_is_refused(tmp_path: Path) -> None:
    made = Distribution.over(space_of(a=[0, 1], b=[0, 1]), np.full(2, 0.5), np.full(2, 0.1), correlation=np.eye(2))
    made.save(tmp_path / "d.json")
    text = json.loads((tmp_path / "d.json").read_text())
    for wrong in ([[1.0]], [[1, 2], [2, 1]], "x", [[1, 0.5], [0.1, 1]]):
        (tmp_path / "d.json").write_text(json.dumps({**text, "correlation": wrong}))
        with pytest.raises(InputError, match="correlation"):
            Distribution.load(tmp_path / "d.json")


def test_random_effects_recovers_a_covariance() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([[1.0, 0.6], [0.6, 0.5]])
    design = rng.normal(size=(4000, 3, 2))
    drawn = rng.multivariate_normal([0.2, -0.1], truth, size=4000)
    residual = np.einsum("tij,tj->ti", design, drawn) + 0.1 * rng.standard_normal((4000, 3))
    gram = torch.from_numpy(np.einsum("tki,tkj->tij", design, design) / 0.01)
    force = torch.from_numpy(np.einsum("tki,tk->ti", design, residual) / 0.01)
    covariance, shift = random_effects(gram, force, 0.1 * torch.eye(2, dtype=torch.float64))
    assert covariance.numpy() == pytest.approx(truth, abs=0.06)
    assert shift.numpy() == pytest.approx([0.2, -0.1], abs=0.05)


def test_full_covariance_is_found_where_parameters_vary_together() -> None:
    rng = np.random.default_rng(1)
    space = space_of(a=[-4, 4], b=[-4, 4])
    simulator = LinearSimulator(space, np.eye(2))
    drawn = rng.multivariate_normal([0.5, -0.5], [[0.25, 0.2], [0.2, 0.25]], size=600)
    objective = linear_objective(simulator, drawn + 0.01 * rng.standard_normal(drawn.shape), epsilon=1e-4)
    plain = fit(objective, FitSettings(samples=200))
    full = fit(objective, FitSettings(samples=200, covariance="full"))
    assert full.distribution.correlation is not None
    assert full.distribution.correlation[0, 1] == pytest.approx(0.8, abs=0.08)
    assert full.distribution.mean == pytest.approx(drawn.mean(0), abs=0.02)
    assert full.log_likelihood > plain.log_likelihood + 50
    assert full.document()["correlation"][0][1] == pytest.approx(full.distribution.correlation[0, 1])


def test_entropy_keeps_deviations_open(folder: Path) -> None:
    closed = fit(problem(folder, "dropo", "exact").objective, FitSettings(samples=20))
    opened = fit(problem(folder, "dropo", "exact").objective, FitSettings(samples=20, entropy=2.0))
    assert (opened.distribution.std > 100 * closed.distribution.std).all()
    assert opened.log_likelihood < closed.log_likelihood
    assert opened.document()["entropy"] == 2.0
    assert opened.distribution.mean[0] == pytest.approx(MASS, rel=0.05)


def test_the_entropy_bonus_is_balanced_by_the_likelihood() -> None:
    """With one parameter and A = 1, Σ log N(0; 0, vσ² + ε) + β log σ is largest at vσ² = βε / (T − β)."""
    simulator = LinearSimulator(space_of(a=[-5, 5]), np.eye(1))
    found = fit(linear_objective(simulator, np.zeros((50, 1)), epsilon=1e-2), FitSettings(entropy=5.0, samples=50))
    variance = float(truncated_moments(torch.tensor(-2.0), torch.tensor(2.0))[1])
    assert variance * found.distribution.std[0] ** 2 == pytest.approx(5 * 1e-2 / (50 - 5), rel=0.02)


@pytest.mark.parametrize("method", ["droid", "simopt", "bayessim", "laplace"])
def test_an_interrupted_run_ends_as_one_never_interrupted(folder: Path, tmp_path: Path, method: str) -> None:
    options = {
        "droid": {"budget": 60},
        "simopt": {"samples": 12, "iterations": 5, "horizon": 10},
        "bayessim": {"simulations": 250, "horizon": 10, "epochs": 20, "hidden": 8, "components": 2},
        "laplace": {},
    }[method]
    ours = problem(folder, method, "noisy", method_options=options)
    whole = fit(ours.objective, FitSettings(samples=10), search=make_search(ours))

    class Stop(Exception):
        pass

    def stop(entry: object, progress: object) -> None:
        raise Stop

    again = problem(folder, method, "noisy", method_options=options)
    for _ in range(2):  # killed after the first batch, and again after the second
        with pytest.raises(Stop):
            fit(
                again.objective, FitSettings(samples=10), search=make_search(again), checkpoint=tmp_path / "c.bin",
                resume=True, on_progress=stop,
            )  # fmt: skip
    last = problem(folder, method, "noisy", method_options=options)
    resumed = fit(
        last.objective, FitSettings(samples=10), search=make_search(last), checkpoint=tmp_path / "c.bin", resume=True
    )  # fmt: skip
    assert {**resumed.document(), "seconds": 0} == {**whole.document(), "seconds": 0}


@pytest.mark.parametrize("method", ["droid", "simopt", "bayessim", "laplace", "udr"])
def test_dropo_fit_writes_what_training_reads(folder: Path, tmp_path: Path, method: str) -> None:
    options = {
        "droid": {"budget": 40},
        "simopt": {"samples": 10, "iterations": 3, "horizon": 10},
        "bayessim": {"simulations": 40, "horizon": 10, "epochs": 10, "hidden": 8, "components": 2},
    }.get(method, {})
    (tmp_path / "c.json").write_text(json.dumps(config(folder, method, "noisy", method_options=options)))
    assert main(["fit", str(tmp_path / "c.json"), "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert document["schema"] == "dropo-torch/fit/1"
    assert document["method"] == method
    assert set(document["parameters"]["mass"]) >= {"mean", "std", "low", "high", "unit"}
    loaded = Distribution.load(tmp_path / "out" / "fit.json")
    draws = loaded.sample(50, torch.Generator().manual_seed(0))
    assert torch.isfinite(draws).all()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What the standard deviations are" in page
    assert "Standard deviation at its floor" not in page
    assert ("<h2>The posterior</h2>" in page) == (method == "bayessim")


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("droid", {"budge": 3}, "did you mean 'budget'"),
        ("droid", {"budget": 0}, "1 or more"),
        ("droid", {"budget": 1.5}, "whole number"),
        ("simopt", {"kl": -1}, "more than 0"),
        ("simopt", {"samples": True}, "whole number"),
        ("bayessim", {"features": "mdn"}, "did you mean 'mdnn'"),
        ("bayessim", {"horizon": 1}, "2 or more"),
        ("udr", {"box": 10}, "one of the 10 boxes"),
        ("laplace", {"budget": 3}, "laplace: unknown key .budget."),
        ("dropo", {"budget": 3}, "dropo: unknown key .budget."),
        ("dropi", {}, "did you mean 'dropo'"),
    ],
)
def test_bad_options_are_told_in_one_line(method: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        method_settings(method, options)
    assert "\n" not in str(raised.value)


def test_a_bad_option_ends_the_command_before_an_earlier_run_is_moved(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.json").write_text(json.dumps(config(folder, "udr", method_options={"boxs": 3})))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fit.json").write_text("{}")
    assert main(["fit", str(tmp_path / "c.json"), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "method_options" in error
    assert error.count("\n") == 1
    assert (tmp_path / "out" / "fit.json").read_text() == "{}"


def test_options_of_the_fit_that_do_not_go_together_are_refused(folder: Path) -> None:
    objective = problem(folder, "dropo").objective
    with pytest.raises(InputError, match="needs optimizer: fisher"):
        fit(objective, FitSettings(optimizer="cma", covariance="full"))
    with pytest.raises(InputError, match="diagonal or full"):
        fit(objective, FitSettings(covariance="round"))
    with pytest.raises(InputError, match="no entropy bonus"):
        fit(objective, FitSettings(optimizer="adam", entropy=1.0))


def test_a_log_of_single_transitions_has_nothing_for_bayessim(folder: Path) -> None:
    ours = problem(folder, "bayessim")
    log = ours.trajectories
    single = Trajectories(log.observations, log.next_observations, log.actions, np.ones(len(log), dtype=bool))
    with pytest.raises(InputError, match="two transitions"):
        make_search(Problem(**{**vars(ours), "trajectories": single}))


TINY = Plan(
    seeds=1, steps=12, samples=8, droid_budget=40, simulations=20, horizon=6, epsilons=(1e-8, 1e-5, 1e-2),
    noise_variances=(1e-5,), sizes=(12,), resamples=2, cma_steps=8, cma_budget=24, cma_samples=4,
    noise_steps=12, backend="mujoco", paper=None,
)  # fmt: skip


def test_the_hopper_study_resumes_and_says_what_it_found(tmp_path: Path) -> None:
    out = tmp_path / "study"
    found = run_study(out, plan=TINY)
    assert len(found) == 8
    assert all(line.startswith(("holds", "DOES NOT HOLD")) for line in found)
    document = json.loads((out / "study.json").read_text())
    cases = {(r["case"], r["method"]) for r in document["tables"]["table"]}
    methods = ("dropo", "droid", "bayessim (mdnn)", "bayessim (mdrff)")
    assert ("noisy", "bayessim (mdnn) (noise given)") in cases
    assert cases >= {(c, m) for c in ("noiseless", "noisy", "unmodeled torso") for m in methods}
    assert ("noisy", "dropo (noise given)") in cases
    torso = {r["case"] for r in document["tables"]["table"] if r["parameter"] == "torso_mass"}
    assert torso == {"noiseless", "noisy"}
    point = [r for r in document["tables"]["table"] if (r["case"], r["method"]) == ("noiseless", "dropo")]
    assert max(r["largest_error_percent"] for r in point) < 0.1
    text = (out / "tables.md").read_text()
    assert "| noiseless | torso_mass |" in text
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 4
    assert "DROPO widens under the unmodeled torso" in page
    for figure in ("recovery.png", "sweep.png", "noise.png", "size.png"):
        assert (out / figure).stat().st_size > 5000
    cells = sorted((out / "cells").iterdir())
    assert len(cells) == len(all_cells(TINY))
    before = {p.name: p.stat().st_mtime_ns for p in cells}
    first = json.loads(cells[0].read_text())["fit"]["parameters"]
    cells[0].unlink()
    cells[1].unlink()
    with pytest.raises(InputError, match="add --resume"):
        run_study(out, plan=TINY)
    with pytest.raises(InputError, match="another size"):
        run_study(out, plan=replace(TINY, seeds=2), resume=True)
    again = run_study(out, plan=TINY, resume=True, workers=2)
    assert [line.split("(")[0] for line in again] == [f.split("(")[0] for f in found]
    after = {p.name: p.stat().st_mtime_ns for p in (out / "cells").iterdir()}
    assert {n for n in before if after[n] != before[n]} == {cells[0].name, cells[1].name}
    assert json.loads(cells[0].read_text())["fit"]["parameters"] == first  # to the bit, in a process of its own


@pytest.mark.slow
def test_the_reduced_study_finds_the_point_dynamics(tmp_path: Path) -> None:
    found = run_study(tmp_path / "study", reduced=True)
    assert found[0].startswith("holds: DROPO and DROID find the point dynamics")


def test_cells_of_a_study_have_names_of_their_own() -> None:
    for plan in (Plan(), REDUCED, TINY):
        names = [cell.name for cell in all_cells(plan)]
        assert len(set(names)) == len(names)


def test_an_unknown_study_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "hoper", "--out", str(tmp_path / "x")]) == 2
    assert "did you mean 'hopper'" in capsys.readouterr().err
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["reproduce", "hopper", "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err


def fit_of(distribution: Distribution, **about: Any) -> Fit:
    """A fit of which only the distribution matters."""
    rest = {f.name: None for f in fields(Fit) if f.name not in ("distribution", "method", "extras")}
    return Fit(**{**rest, "distribution": distribution, "method": "dropo", "extras": {}, **about})


def test_intervals_of_a_posterior_are_its_own() -> None:
    """Not those of draws, which end two σ from the mean; and of a mixture, not those of its normal."""
    space = space_of(a=[0, 10])
    made = Distribution.over(space, np.array([4.0]), np.array([0.5]))
    low, high = interval(fit_of(made, method="laplace"), 0.9)
    assert (low[0], high[0]) == pytest.approx((4 - 1.645 * 0.5, 4 + 1.645 * 0.5), rel=1e-3)
    two = Mixture(np.full(2, 0.5), np.array([[2.0], [6.0]]), np.full((2, 1, 1), 1e-4), np.zeros(1), np.full(1, 10.0))
    low, high = interval(fit_of(made, method="bayessim", extras={"mixture": two.document()}), 0.5)
    assert (low[0], high[0]) == pytest.approx((2, 6), abs=0.05)


def test_intervals_hold_their_share_of_draws() -> None:
    for uniform in (False, True):
        made = Distribution.over(space_of(a=[0, 10]), np.array([4.0]), np.array([0.5]), is_uniform=uniform)
        low, high = interval(fit_of(made), 0.9)
        draws = made.sample(20_000, torch.Generator().manual_seed(0)).numpy()
        assert np.mean((draws >= low) & (draws <= high)) == pytest.approx(0.9, abs=0.01)
    assert wilson(0.9, 100) == pytest.approx((0.826, 0.945), abs=2e-3)


def test_a_synthetic_log_is_explained_by_its_truth(folder: Path) -> None:
    ours = problem(folder, "laplace")
    truths, center = draw_truths(ours, "fixed", 3)
    assert (truths == center).all()
    made = synthesize(ours, truths, np.zeros(2), seed=0)
    found = fit_problem(made).distribution
    assert found.mean == pytest.approx(truths[0], rel=1e-6)
    varying, center = draw_truths(ours, "varying", 3)
    assert varying.std(0) == pytest.approx(0.1 * np.array([2.5, 0.49]), rel=0.25)
    assert (np.abs(varying.mean(0) - center) < 0.1 * np.array([2.5, 0.49])).all()


def test_laplace_is_calibrated_for_a_fixed_truth_and_dropo_for_a_varying_one(folder: Path) -> None:
    noise = np.array([1e-4, 5e-4])

    def ours(method: str) -> Problem:
        return problem(folder, method, epsilon=(noise**2).tolist())

    def runs(method: str, logs: int) -> list[CalibrationRun]:
        cells = [CalibrationCell(kind, method, log) for log in range(logs) for kind in KINDS]
        return [calibrate(cell, ours(method), noise=noise) for cell in cells]

    boxes = runs("udr", 3)
    assert len({run.width["0.9"]["mass"] for run in boxes}) == 3  # fits of several logs are independent
    covered = coverages(runs("laplace", 12) + runs("dropo", 12))
    found = {(c.kind, c.method, c.parameter): c.covered for c in covered if c.level == 0.9}
    assert found["fixed", "laplace", "mass"] > 0.7
    assert found["fixed", "laplace", "damping"] > 0.7
    assert found["varying", "dropo", "mass"] == pytest.approx(0.9, abs=0.08)  # damping hardly shows in one step
    assert found["varying", "laplace", "mass"] < 0.5


# --- what each method must not hide ---------------------------------------------------------------------------


def test_a_direction_that_the_log_does_not_see_is_uncertain() -> None:
    """Two parameters of which only the sum is seen: wide, with correlation −1; not narrow, with +1."""
    error, correlation = estimates(100 * np.ones((2, 2)))
    assert (error > 1e3).all()
    assert correlation[0, 1] == pytest.approx(-1, abs=1e-6)
    plain, _ = estimates(np.diag([4.0, 25.0]))
    assert plain == pytest.approx([0.5, 0.2])


@pytest.mark.parametrize("command", [["compare"], ["sweep-epsilon"]])
def test_commands_that_are_about_dropo_refuse_other_methods(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(yaml.safe_dump(config(folder, "droid")))
    assert main([*command, str(path), "--out", str(tmp_path / "out")]) == 2
    assert "method: droid given" in capsys.readouterr().err


@pytest.mark.parametrize(
    "extra", [{"budget": 300}, {"covariance": "full"}, {"entropy": 1.0}, {"optimizer": "cma"}, {"adam": {"steps": 3}}]
)
def test_a_method_refuses_what_it_would_ignore(folder: Path, extra: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=rf"^{next(iter(extra))}: .*method: laplace does not read"):
        make_search(problem(folder, "laplace", **extra))


def test_short_episodes_are_replayed_too() -> None:
    """Windows have the length that leaves the fewest transitions out, down to half of what was asked for."""
    count = np.array([16, 16, 16, 17, 15])
    ends = np.isin(np.arange(80), count.cumsum() - 1)
    states = np.arange(160.0).reshape(80, 2)
    log = Trajectories(states, states, np.zeros((80, 1)), ends)
    replay = make_replay(log, generic_observation(2), 50)
    assert (replay.horizon, len(replay.states)) == (15, 5)
    long = Trajectories(states, states, np.zeros((80, 1)), np.arange(80) == 79)
    assert make_replay(long, generic_observation(2), 50).horizon == 40
    assert make_replay(long, generic_observation(2), 80).horizon == 80
    assert make_replay(long, generic_observation(2), 20).horizon == 20


def test_bayessim_says_when_the_log_is_unlike_every_simulation(folder: Path) -> None:
    """A mass far outside the box: the network would answer all the same."""
    ours = problem(
        folder, "bayessim", method_options={"simulations": 60, "horizon": 20, "epochs": 3},
        parameters={"mass": {"field": "body_mass", "name": "bob", "bounds": [30.0, 31.0]}},
    )  # fmt: skip
    result = fit_problem(ours)
    found = result.document()
    assert found["summary_distance"] > 1.5
    assert "unlike every simulation" in found["stop_reason"]
    told = findings(result, diagnose(ours.objective, result.distribution))
    (about,) = [f for f in told if f.title == "What the standard deviations are"]
    assert about.level == "attention"
    assert "the posterior is a guess: the log is unlike every simulation" in about.text
    write_fit_report(
        folder / "guess.html",
        fit=result,
        diagnostics=diagnose(ours.objective, result.distribution),
        config=None,
        title="t",
    )
    page = (folder / "guess.html").read_text()
    assert page.split("<h2>The posterior</h2>")[1].split("<h2>")[0].count("<svg") == 1  # one parameter has no pairs


def test_a_log_off_the_surface_of_the_simulations_is_unlike_them() -> None:
    """Two columns move together; a log between the simulations' values of each, but off their line, is far."""
    rng = np.random.default_rng(0)
    along = rng.uniform(-1, 1, 500)
    x = np.stack([along, along + 0.03 * rng.standard_normal(500), np.ones(500)], 1)
    assert unlikeness(x, np.array([0.3, 0.3, 1.0])) < 1
    assert unlikeness(x, np.array([0.3, -0.3, 1.0])) > 5
    assert unlikeness(x, np.array([0.3, 0.3, 7.0])) < 1  # a column that nothing moves is not seen by the network
    assert unlikeness(np.ones((50, 1)), np.zeros(1)) == 0
    assert unlikeness(np.full((50, 1), np.nan), np.zeros(1)) == np.inf
    own = [unlikeness(np.delete(x, i, 0), x[i]) for i in range(100)]
    assert np.mean(np.array(own) > 1) < 0.05


def test_a_few_wild_simulations_do_not_blind_the_network() -> None:
    rng = np.random.default_rng(0)
    shares = rng.uniform(size=(1000, 1))
    x = shares + 0.05 * rng.standard_normal((1000, 1))
    x[:3] += 1e6
    assert unlikeness(x, np.array([0.5])) < 1
    assert unlikeness(x, np.array([9.0])) > 5
    settings = BayesSimSettings(components=2, hidden=16, epochs=60)
    found = fit_mixture(x, shares, np.array([0.5]), settings=settings, seed=0, bounds=(np.zeros(1), np.ones(1)))
    assert np.sqrt(found.moments_inside[1][0, 0]) < 0.12


def test_bayessim_takes_a_seed_of_any_size(folder: Path) -> None:
    options = {"simulations": 20, "horizon": 10, "epochs": 2}
    fit_problem(problem(folder, "bayessim", method_options=options, noise=[0.01, 0.01], seed=2**63 - 1))


def test_simopt_is_not_led_by_replays_that_explode(folder: Path) -> None:
    """Costs of which three are enormous give the weights that the others alone would give."""
    rng = np.random.default_rng(0)
    costs = rng.uniform(1, 2, 97)
    alone, together = reps_weights(costs, 0.5), reps_weights(np.concatenate([costs, np.full(3, 1e10)]), 0.5)
    assert together[97:].max() < 1e-12
    assert together[:97] == pytest.approx(alone, abs=0.01)
    search = make_search(problem(folder, "simopt", method_options={"samples": 20}))
    assert search is not None
    with pytest.raises(InputError, match="only 1 of 20 samples"):
        search.tell(torch.tensor([1.0] + [float("nan")] * 19, dtype=torch.float64))


def test_the_entropy_bonus_widens_a_full_covariance() -> None:
    """With β, C is larger by T / (T − β) where the data say it all."""
    rng = np.random.default_rng(0)
    draws = torch.from_numpy(0.1 * rng.standard_normal((60, 2)))
    gram = torch.eye(2, dtype=torch.float64).expand(60, 2, 2) * 1e8
    start = 0.01 * torch.eye(2, dtype=torch.float64)
    plain, _ = random_effects(gram, draws * 1e8, start)
    wide, _ = random_effects(gram, draws * 1e8, start, entropy=20.0)
    assert wide.numpy() == pytest.approx(plain.numpy() * 60 / 40, rel=1e-3)
    assert np.sqrt(np.diag(random_effects(gram, draws * 1e8, start, entropy=100.0)[0])).max() <= 1 + 1e-9


def test_bayessim_summarizes_orientations_of_log_and_replays_alike(tmp_path: Path) -> None:
    """A ball that spins: without noise, the log's own parameters give the log's own summary."""
    xml = """<mujoco><option timestep="0.01"/><worldbody><body><joint type="ball" damping="0.05"/>
    <geom name="top" type="box" size=".1 .2 .05" pos=".1 0 .1" mass="1"/></body></worldbody>
    </mujoco>"""
    (tmp_path / "ball.xml").write_text(xml)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[:] = [1.0, -2.0, 0.5]
    states = []
    for _ in range(41):
        states.append(np.concatenate([data.qpos, data.qvel]))
        mujoco.mj_step(model, data)
    np.savez(
        tmp_path / "log.npz", observations=states[:-1], next_observations=states[1:], actions=np.zeros((40, 0)),
        terminals=np.arange(40) == 39,
    )  # fmt: skip
    given = {
        "model": "ball.xml", "data": "log.npz", "frame_skip": 1, "method": "bayessim",
        "method_options": {"simulations": 20, "horizon": 20},
        "parameters": {"mass": {"field": "body_mass", "name": "body1", "bounds": [0.5, 2.0], "scale_inertia": True}},
    }  # fmt: skip
    ours = make_problem(make_config(given, base=tmp_path))
    search = make_search(ours)
    assert search is not None
    request = search.ask()
    assert request.replay is not None
    table = (
        ours.objective.evaluator.map_replay(request.replay, np.array([[1.0]]), request.reduce)
        .total.reshape(2, -1)
        .numpy()
    )
    assert table[0] == pytest.approx(table[1], abs=1e-9)
    assert (table[1, 6:9] > 1e-3).all()  # mean squares of the orientation's changes


def test_what_varies_is_no_outlier_where_the_starts_are_noisy(folder: Path) -> None:
    """σ is found as well with noise on every measurement as on the ends alone, where no window is widened."""
    noise = np.array([1e-4, 5e-4])
    found, true = [], []
    for seed in range(3):
        exact = problem(folder, "dropo", epsilon=(noise**2).tolist())
        truths, _ = draw_truths(exact, "varying", seed)
        made = synthesize(exact, truths, noise, seed=seed)
        log = made.trajectories
        starts = log.observations + noise * np.random.default_rng([seed, 1]).standard_normal(log.observations.shape)
        np.savez(
            folder / "varying.npz", observations=starts, next_observations=log.next_observations, actions=log.actions,
            terminals=log.terminals,
        )  # fmt: skip
        noisy = problem(folder, "dropo", "varying", noise=noise.tolist(), epsilon=1e-10)
        found.append([fit_problem(p).distribution.std[0] for p in (made, noisy)])
        true.append(truths[:, 0].std() / DRAWN_STD)
    assert np.mean(found, axis=0) == pytest.approx(np.full(2, np.mean(true)), rel=0.15)


def test_several_explanations_are_told(folder: Path) -> None:
    """A center of mass to one side or the other swings alike where nothing pulls it."""
    xml = PENDULUM_XML.replace('timestep="0.005"', 'timestep="0.005" gravity="0 0 0"').replace("0 0 -.5", "0 0 -.3")
    (folder / "turntable.xml").write_text(xml)
    given = config(folder, "bayessim", method_options={"simulations": 400, "horizon": 20}) | {
        "model": str(folder / "turntable.xml"),
        "parameters": {"offset": {"field": "body_ipos[2]", "name": "bob", "bounds": [-0.5, 0.5]}},
    }
    ours = synthesize(make_problem(make_config(given)), np.full((STEPS, 1), 0.3), np.full(2, 1e-4), seed=0)
    result = fit_problem(ours)
    told = {f.title: f.text for f in findings(result, diagnose(ours.objective, result.distribution))}
    assert "Several values explain the log" in told
    low, high = Mixture.of(result.extras["mixture"]).peaks(0)
    assert (low, high) == pytest.approx((-0.3, 0.3), abs=0.03)
    assert "Hardly narrower than the search box" not in told
