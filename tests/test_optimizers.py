from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import (
    SLIDE_XML,
    LinearSimulator,
    answered,
    compiled,
    drive,
    linear_objective,
    numerical_gradient,
    random_controls,
    random_states,
    space_of,
    windows,
)

from dropo_torch.data.observation import parse_observation
from dropo_torch.distribution import to_values, truncated_interval, truncated_moments
from dropo_torch.fit import fit
from dropo_torch.likelihood import LOST_TRANSITION
from dropo_torch.objective import Objective
from dropo_torch.optimizers import CMAOptimizer, FisherOptimizer, FitSettings, Optimizer
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.sampled import SampledStage
from dropo_torch.optimizers.sigma_points import SigmaPointStage
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators import MujocoSimulator
from dropo_torch.support.random import draw_uniforms

#: Variance of a standard normal truncated at two deviations.
VARIANCE = float(truncated_moments(*truncated_interval(*torch.tensor([0.0, 1.0, -torch.inf, torch.inf])))[1])
EPSILON = 1e-4
GAINS = np.array([2.0, -0.5])


def spread_data(number: int = 300, seed: int = 0) -> np.ndarray:
    """Next states of the linear simulator whose parameters differ from transition to transition."""
    rng = np.random.default_rng(seed)
    return rng.normal([1.2, 4.0], [0.15, 0.4], (number, 2)) * GAINS


def closed_form(measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The maximum of Σ log N(m; gμ, g²σ²v + ε): mean and variance of the data, column by column."""
    return measured.mean(0) / GAINS, np.sqrt((measured.var(0) - EPSILON) / VARIANCE) / np.abs(GAINS)


def linear_space(**more) -> ParameterSpace:
    return space_of(a=[0.0, 3.0], b=[1.0, 9.0], **more)


def spread_objective(**options) -> Objective:
    return linear_objective(LinearSimulator(linear_space(), np.diag(GAINS)), spread_data(), epsilon=EPSILON, **options)


def fisher(objective: Objective, **options) -> FisherOptimizer:
    return FisherOptimizer(objective, FitSettings(**options))


def small_cma(objective: Objective, **options) -> CMAOptimizer:
    return CMAOptimizer(objective, FitSettings(**{"samples": 12, "seed": 0, "budget": 48, "population": 8, **options}))


def test_fisher_reaches_the_closed_form_optimum_of_mean_and_deviation():
    objective = spread_objective()
    optimizer = fisher(objective)
    drive(optimizer, objective)
    mean, std = optimizer.candidates()[0]
    best_mean, best_std = closed_form(spread_data())
    error = best_std / np.sqrt(300)  # of the estimate of a mean
    np.testing.assert_allclose(mean, best_mean, atol=0.05 * error.min())
    np.testing.assert_allclose(std, best_std, rtol=0.01)
    value = sum(
        -0.5 * 300 * (np.log(2 * np.pi * v) + 1) for v in spread_data().var(0)
    )  # the log-likelihood at its maximum
    assert optimizer.progress.log_likelihood == pytest.approx(value, abs=0.02)
    assert optimizer.progress.log_likelihood <= value + 1e-9
    assert "nat" in optimizer.stop_reason


def test_fisher_puts_deviations_at_their_floor_where_one_value_explains_everything():
    simulator = LinearSimulator(linear_space(), np.diag(GAINS))
    objective = linear_objective(simulator, np.tile([1.2, 4.0] * GAINS, (50, 1)), epsilon=EPSILON)
    optimizer = fisher(objective)
    drive(optimizer, objective)
    mean, std = optimizer.candidates()[0]
    np.testing.assert_allclose(mean, [1.2, 4.0], atol=1e-6)
    assert (std * np.abs(GAINS) < 0.1 * np.sqrt(EPSILON)).all()


def test_cma_reaches_the_optimum_of_its_own_samples():
    objective = linear_objective(
        LinearSimulator(space_of(a=[0.0, 3.0]), [[2.0]]), spread_data(60)[:, :1], epsilon=EPSILON
    )
    optimizer = CMAOptimizer(objective, FitSettings(samples=25, seed=3, budget=600, common_random_numbers=True))
    drive(optimizer, objective)
    z = (objective.values(np.zeros((1, 1)), np.ones((1, 1)), draw_uniforms(25, 1, 3, 1, 0))[0]).numpy()
    best_std = np.sqrt((spread_data(60)[:, 0].var() - EPSILON) / z.var(ddof=1)) / 2
    best_mean = spread_data(60)[:, 0].mean() / 2 - best_std * z.mean()
    mean, std = optimizer.candidates()[0]
    assert mean == pytest.approx(best_mean, abs=0.1 * best_std / np.sqrt(60))
    assert std == pytest.approx(best_std, rel=0.01)


def test_cma_with_fresh_samples_comes_near_the_closed_form():
    objective = linear_objective(
        LinearSimulator(space_of(a=[0.0, 3.0]), [[2.0]]), spread_data(60)[:, :1], epsilon=EPSILON
    )
    optimizer = CMAOptimizer(objective, FitSettings(samples=50, seed=0, budget=300))
    drive(optimizer, objective)
    mean, std = optimizer.candidates()[0]
    assert mean == pytest.approx(closed_form(spread_data(60))[0][0], abs=0.1)
    assert std == pytest.approx(closed_form(spread_data(60))[1][0], rel=0.3)
    assert "budget of 300 evaluations" in optimizer.stop_reason


def log_objective(number: int = 300) -> Objective:
    rng = np.random.default_rng(4)
    space = space_of(gain={"bounds": [0.1, 10], "scale": "log"})
    simulator = LinearSimulator(space, [[1.0]], transform=torch.log)
    return linear_objective(simulator, rng.normal(np.log(3.0), 0.2, (number, 1)), epsilon=EPSILON)


def test_a_log_scaled_parameter_is_recovered_in_its_logarithm():
    objective = log_objective()
    optimizer = fisher(objective)
    drive(optimizer, objective)
    data = objective.transitions.measured[:, 0]
    mean, std = optimizer.candidates()[0]
    assert mean == pytest.approx(data.mean(), abs=1e-3)
    assert std == pytest.approx(np.sqrt((data.var() - EPSILON) / VARIANCE), rel=0.01)


def test_a_parameter_at_its_physical_limit_is_found_there():
    model = compiled(SLIDE_XML)
    space = ParameterSpace(
        model,
        {
            "friction": {"field": "dof_frictionloss", "name": "rail", "bounds": [0, 2]},
            "mass": {"field": "body_mass", "name": "block", "bounds": [1, 4]},
        },
    )
    simulator = MujocoSimulator(model, parameters=space, frame_skip=5)
    states, controls = random_states(model, 40), random_controls(model, 40, 1)
    truth = torch.tensor([[0.0, 2.3]], dtype=torch.float64)
    log = windows(states, controls, simulator.simulate(states, controls, truth)[:, 0])
    result = fit(Objective(simulator, log, parse_observation(model, None), epsilon=1e-8), FitSettings(samples=20))
    assert result.distribution.mean == pytest.approx([0, 2.3], abs=2e-3)
    assert result.distribution.mean[0] >= 0
    assert (result.distribution.sample(200, torch.Generator().manual_seed(0)) >= 0).all()


def asked_values(make: Callable[[Objective], Optimizer], objective: Objective) -> tuple[np.ndarray, Optimizer]:
    optimizer = make(objective)
    values = []
    while optimizer.stop_reason is None:
        request = optimizer.ask()
        values.append(request.values)
        optimizer.tell(answered(objective, request))
    return np.concatenate(values), optimizer


@pytest.mark.parametrize("make", [fisher, small_cma])
@pytest.mark.parametrize("target", [[-5.0, 4.0], [50.0, 4.0], [1.2, 0.0], [1.2, 90.0]])
def test_no_mean_leaves_the_box_and_no_sample_the_physical_limits(make, target):
    space = ParameterSpace(
        None, {"a": {"bounds": [0.0, 3.0], "limits": [0.0, 4.0]}, "b": {"bounds": [1.0, 9.0], "limits": [0.5, 10.0]}}
    )
    data = spread_data(50) + (np.array(target) - [1.2, 4.0]) * GAINS
    objective = linear_objective(LinearSimulator(space, np.diag(GAINS)), data, epsilon=EPSILON)
    values, optimizer = asked_values(make, objective)
    assert (values >= space.limits[:, 0] - 1e-9).all()
    assert (values <= space.limits[:, 1] + 1e-9).all()
    for mean, std in optimizer.candidates():
        assert (mean >= space.low).all()
        assert (mean <= space.high).all()
        assert (std >= 0.999 * objective.box.min_std).all()
        assert (std <= 1.001 * objective.box.max_std).all()
    if make is fisher:
        expected = np.clip(target, space.low, space.high)
        np.testing.assert_allclose(optimizer.candidates()[0][0], expected, atol=0.3)


def curved_objective(noise: float | None = None) -> Objective:
    """A simulator that bends within the distribution, so that Fisher scoring goes on over samples."""
    simulator = LinearSimulator(linear_space(), np.diag(GAINS), transform=lambda v: (v - 1).square())
    data = (np.random.default_rng(0).normal([1.2, 4.0], [0.3, 0.4], (40, 2)) - 1) ** 2 * GAINS
    return linear_objective(simulator, data, epsilon=EPSILON, noise=noise)


ROUTES: dict[str, tuple[Callable[[Objective], Optimizer], Callable[[], Objective]]] = {
    "fisher": (fisher, spread_objective),
    "fisher, noisy": (fisher, lambda: spread_objective(noise=0.05)),
    "fisher, sampled": (lambda o: fisher(o, samples=30), curved_objective),
    "cma": (small_cma, spread_objective),
    "cma, noisy": (small_cma, lambda: spread_objective(noise=0.05)),
    "cma, common": (lambda o: small_cma(o, common_random_numbers=True), spread_objective),
}


@pytest.fixture(params=ROUTES)
def route(request: pytest.FixtureRequest) -> tuple[Callable[[Objective], Optimizer], Objective]:
    make, objective = ROUTES[request.param]
    return make, objective()


def flat(candidates: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    return np.array([np.concatenate(c) for c in candidates])


def test_asking_twice_gives_the_same_request(route):
    make, objective = route
    optimizer = make(objective)
    while optimizer.stop_reason is None:
        first, second = optimizer.ask(), optimizer.ask()
        np.testing.assert_array_equal(first.values, second.values)
        assert first.evaluations == second.evaluations
        assert (first.linearise_at is None) == (objective.noise is None)
        np.testing.assert_array_equal(first.linearise_at, second.linearise_at)
        sums = answered(objective, first)
        np.testing.assert_array_equal(sums, answered(objective, second))
        optimizer.tell(sums)


def test_restored_at_any_step_it_goes_on_as_if_never_interrupted(route):
    make, objective = route
    whole = make(objective)
    states, requests, answers = [pickle.dumps(whole.state())], [], []
    while whole.stop_reason is None:
        request = whole.ask()
        requests.append(request.values)
        if len(requests) % 2:  # a checkpoint may also come between ask and tell
            states[-1] = pickle.dumps(whole.state())
        answers.append(answered(objective, request))
        whole.tell(answers[-1])
        states.append(pickle.dumps(whole.state()))
    assert len(requests) > 3
    used = make(objective)
    drive(used, objective)
    for step in range(len(states) - 1):
        other = used if step == 1 else make(objective)
        other.restore(pickle.loads(states[step]))
        for expected, answer in zip(requests[step:], answers[step:], strict=True):
            np.testing.assert_array_equal(other.ask().values, expected)
            other.tell(answer)
        assert other.stop_reason == whole.stop_reason
        np.testing.assert_array_equal(flat(other.candidates()), flat(whole.candidates()))


def test_the_curved_route_ends_in_sampling_and_the_straight_one_does_not():
    stages = []
    for make, build in (ROUTES["fisher"], ROUTES["fisher, sampled"]):
        objective = build()
        optimizer = make(objective)
        drive(optimizer, objective)
        stages.append(optimizer.progress.stage)
    assert stages == ["Fisher scoring on sigma points", "Fisher scoring on samples"]


def test_the_same_seed_gives_the_same_fit_and_another_seed_another():
    found = {seed: [] for seed in (0, 1)}
    for seed in (0, 0, 1):
        objective = spread_objective()
        optimizer = small_cma(objective, seed=seed)
        np.random.default_rng().normal()
        drive(optimizer, objective)
        found[seed].append(flat(optimizer.candidates()))
    np.testing.assert_array_equal(*found[0])
    assert (found[0][0] != found[1][0]).any()


def test_a_simulator_that_always_fails_stops_the_search_with_a_reason():
    objective = linear_objective(
        LinearSimulator(linear_space(), np.diag(GAINS), transform=lambda v: v * torch.nan), spread_data(5)
    )
    for optimizer in (fisher(objective), small_cma(objective)):
        drive(optimizer, objective)
        assert optimizer.stop_reason
        assert np.isfinite(flat(optimizer.candidates())).all()


def stage_gradient(make_stage: Callable[[np.ndarray, np.ndarray], object], objective: Objective, *phi: np.ndarray):
    """Scores of (μ, log σ) as a stage computes them, and by differences of its own log-likelihood."""
    is_log = objective.simulator.parameters.is_log
    d = len(phi[0])

    def sums(packed: np.ndarray) -> np.ndarray:
        stage = make_stage(packed[:d], np.exp(packed[d:]))
        return objective.map(to_values(stage.points(), is_log), stage.reduction()).total.numpy()

    at = np.concatenate([phi[0], np.log(phi[1])])
    return sums(at), numerical_gradient(lambda p: float(sums(p)[0]), at, 1e-5)


def mixed_objective(**options) -> Objective:
    """Two parameters that move all three columns."""
    effect = np.array([[1.0, 0.2], [-0.3, 2.0], [0.5, 0.5]])
    rng = np.random.default_rng(0)
    measured = rng.normal([1.2, 4.0], [0.2, 0.3], (25, 2)) @ effect.T + rng.normal(0, 0.05, (25, 3))
    return linear_objective(LinearSimulator(linear_space(), effect), measured, epsilon=1e-2, **options)


AWAY = (np.array([1.1, 4.2]), np.array([0.3, 0.2]))


def test_scores_are_the_gradient_of_the_sigma_point_likelihood():
    objective = mixed_objective()
    sums, expected = stage_gradient(lambda m, s: SigmaPointStage(objective.box, m, s), objective, *AWAY)
    np.testing.assert_allclose(sums[1:5], expected, rtol=1e-6)
    assert sums[-1] == pytest.approx(0, abs=1e-6)  # nothing bends


def test_at_a_physical_limit_the_mean_of_the_samples_moves_with_the_deviation():
    space = ParameterSpace(
        None, {"a": {"bounds": [0.0, 3.0], "limits": [0.0, 9.0]}, "b": {"bounds": [1.0, 9.0], "limits": [1.0, 20.0]}}
    )
    effect = np.array([[1.0, 0.2], [-0.3, 2.0], [0.5, 0.5]])
    objective = linear_objective(LinearSimulator(space, effect), np.full((5, 3), 1.5), epsilon=1e-2)
    sums, expected = stage_gradient(lambda m, s: SigmaPointStage(objective.box, m, s), objective, space.low, AWAY[1])
    np.testing.assert_allclose(sums[3:5], expected[2:], rtol=1e-6)


def test_sampled_scores_are_the_gradient_of_the_sampled_likelihood():
    objective = mixed_objective()
    for samples in (8, 40):  # without and with bends in the regression
        uniforms = draw_uniforms(samples, 2, 0)
        sums, expected = stage_gradient(
            lambda m, s, u=uniforms: SampledStage(objective.box, m, s, uniforms=u),
            objective,
            *AWAY,
        )
        np.testing.assert_allclose(sums[1:5], expected, rtol=1e-6)
        value = objective.evaluate(AWAY[0][None], AWAY[1][None], uniforms)[0].log_likelihood
        assert sums[0] == pytest.approx(value, rel=1e-12)


def test_sampled_scores_see_curvature():
    simulator = LinearSimulator(linear_space(), np.diag(GAINS), transform=lambda v: v + 0.1 * v.square())
    objective = linear_objective(simulator, spread_data(25) * 1.1, epsilon=1e-2)
    sums, expected = stage_gradient(
        lambda m, s: SampledStage(objective.box, m, s, uniforms=draw_uniforms(40, 2, 0)), objective, *AWAY
    )
    np.testing.assert_allclose(sums[1:5], expected, rtol=1e-6)


def test_fisher_information_is_that_of_the_gaussians():
    objective = mixed_objective()
    sums, _ = stage_gradient(lambda m, s: SigmaPointStage(objective.box, m, s), objective, *AWAY)
    effect = objective.simulator.effect.numpy()
    total = 1e-2 * np.eye(3) + effect @ np.diag(VARIANCE * AWAY[1] ** 2) @ effect.T
    inverse = np.linalg.inv(total)
    np.testing.assert_allclose(sums[5:9].reshape(2, 2), 25 * effect.T @ inverse @ effect, rtol=1e-8)
    change = [VARIANCE * 2 * s**2 * np.outer(c, c) for s, c in zip(AWAY[1], effect.T, strict=True)]
    expected = [[25 * 0.5 * np.trace(inverse @ a @ inverse @ b) for a in change] for b in change]
    np.testing.assert_allclose(sums[9:13].reshape(2, 2), expected, rtol=1e-8)


def test_the_gradient_of_the_means_is_that_of_their_cost():
    objective = mixed_objective()
    box = objective.box

    def sums(mean: np.ndarray) -> np.ndarray:
        stage = MeansStage(box.low, box.high, mean)
        return objective.map(stage.points(), stage.reduction()).total.numpy()

    expected = numerical_gradient(lambda p: float(sums(p)[0]), AWAY[0])
    np.testing.assert_allclose(sums(AWAY[0])[2:4], expected, rtol=1e-5)


def test_lost_transitions_weigh_the_same_in_every_likelihood():
    def fragile(v: torch.Tensor) -> torch.Tensor:
        return torch.where(v > -1, torch.nan, v)

    objective = linear_objective(LinearSimulator(linear_space(), np.diag(GAINS), transform=fragile), spread_data(5))
    box = objective.box
    for stage in (SigmaPointStage(box, *AWAY), SampledStage(box, *AWAY, uniforms=draw_uniforms(9, 2, 0))):
        assert float(objective.map(stage.points(), stage.reduction()).total[0]) == 5 * LOST_TRANSITION
    assert (
        objective.evaluate(AWAY[0][None], AWAY[1][None], draw_uniforms(9, 2, 0))[0].log_likelihood
        == 5 * LOST_TRANSITION
    )


def test_a_fit_with_noisy_starts_still_finds_the_parameter():
    model = compiled(SLIDE_XML)
    space = ParameterSpace(model, {"mass": {"field": "body_mass", "name": "block", "bounds": [1, 4]}})
    simulator = MujocoSimulator(model, parameters=space, frame_skip=5)
    states, controls = random_states(model, 400), 40 * random_controls(model, 400, 2)
    after = simulator.simulate(states, controls, torch.tensor([[2.3]], dtype=torch.float64))[:, 0].numpy()
    rng, noise = np.random.default_rng(0), np.array([0.002, 0.05])
    seen = states + torch.from_numpy(rng.normal(0, noise, (400, 2)))
    log = windows(seen, controls, after + rng.normal(0, noise, (400, 2)))
    result = fit(
        Objective(simulator, log, parse_observation(model, None), epsilon=1e-8, noise=noise), FitSettings(samples=20)
    )
    assert result.distribution.mean == pytest.approx([2.3], abs=0.05)
    assert result.distribution.std < 0.1


def test_a_fit_resumed_from_any_checkpoint_is_the_fit_never_interrupted(tmp_path):
    class Stop(Exception):
        pass

    def stop_after(steps: int):
        left = [steps]

        def callback(*_: object) -> None:
            left[0] -= 1
            if left[0] == 0:
                raise Stop

        return callback

    whole = fit(spread_objective(), FitSettings(samples=10))
    for steps in (1, len(whole.history) // 2):
        path = tmp_path / f"{steps}.pkl"
        with pytest.raises(Stop):
            fit(spread_objective(), FitSettings(samples=10), checkpoint=path, on_progress=stop_after(steps))
        again = fit(spread_objective(), FitSettings(samples=10), checkpoint=path, resume=True)
        assert len(again.history) == len(whole.history)
        for key in ("log_likelihood", "mse", "evaluations", "simulated_transitions", "stop_reason"):
            assert getattr(again, key) == getattr(whole, key), key
        np.testing.assert_array_equal(again.distribution.mean, whole.distribution.mean)
        np.testing.assert_array_equal(again.distribution.std, whole.distribution.std)
