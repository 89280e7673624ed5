from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import hypothesis
import numpy as np
import pytest
import torch
from conftest import (
    SLIDE_XML,
    compiled,
    drive,
    numerical_gradient,
    random_controls,
    random_states,
    space_of,
    windows,
)
from hypothesis import given
from hypothesis import strategies as st

from dropo_torch.baselines.bayessim import BayesSimOptimizer
from dropo_torch.baselines.droid import DroidOptimizer
from dropo_torch.baselines.laplace import LaplaceOptimizer
from dropo_torch.baselines.settings import BayesSimSettings, DroidSettings, SimOptSettings, UdrSettings
from dropo_torch.baselines.simopt import SimOptOptimizer
from dropo_torch.baselines.udr import UdrOptimizer
from dropo_torch.data.observation import parse_observation
from dropo_torch.data.trajectory import Replay
from dropo_torch.distribution import to_values, truncated_interval, truncated_moments
from dropo_torch.fit import fit
from dropo_torch.objective import Objective
from dropo_torch.optimizers import AdamSettings, CMAOptimizer, FisherOptimizer, FitSettings, Optimizer, make_optimizer
from dropo_torch.optimizers.gauss_newton import MeansStage
from dropo_torch.optimizers.sampled import SampledStage
from dropo_torch.optimizers.sigma_points import SigmaPointStage
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators import MujocoSimulator
from dropo_torch.support.random import draw_uniforms
from dropo_torch.testing import KnownProblem, LinearSimulator, check_optimizer, linear_objective, linear_problem
from dropo_torch.testing.optimizers import MakeOptimizer

#: Variance of a standard normal truncated at 2σ.
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


def of_settings(**options: Any) -> MakeOptimizer:
    """A maker of the fit's own optimizers."""
    return lambda objective, seed: make_optimizer(objective, FitSettings(seed=seed, **options))


def simopt(objective: Objective, seed: int) -> SimOptOptimizer:
    log, settings = objective.transitions, SimOptSettings(samples=60, iterations=12)
    replay = Replay(log.states, log.controls, log.measured[:, None])
    return SimOptOptimizer(objective, replay, settings=settings, seed=seed)


def droid(objective: Objective, seed: int) -> DroidOptimizer:
    return DroidOptimizer(objective, settings=DroidSettings(budget=150), seed=seed)


def bayessim(objective: Objective, seed: int) -> BayesSimOptimizer:
    log = objective.transitions
    pairs = [x.reshape(-1, 2, x.shape[-1]) for x in (log.controls[:, 0], log.measured)]
    settings = BayesSimSettings(simulations=60, hidden=8, epochs=3)
    return BayesSimOptimizer(objective, Replay(log.states[::2], *pairs), settings=settings, seed=seed)


#: Every optimizer and baseline: how it is made, and how near the truth it comes; see ``check_optimizer``.
SEARCHES: dict[str, tuple[MakeOptimizer, dict[str, float | None]]] = {
    "fisher": (of_settings(samples=30), {"mean": 1e-4, "std": 0.01}),
    "fisher, entropy": (of_settings(samples=30, entropy=1.0), {"mean": 1e-3, "std": 0.1}),
    "correlated": (of_settings(samples=30, covariance="full"), {"mean": 1e-3, "std": 0.02}),
    "cma": (of_settings(optimizer="cma", samples=12, budget=200), {"mean": 0.1, "std": None}),
    "cma, common": (
        of_settings(optimizer="cma", samples=12, budget=200, common_random_numbers=True),
        {"mean": 0.1, "std": 0.8},
    ),
    "adam": (
        of_settings(optimizer="adam", adam=AdamSettings(steps=30, batch=20, samples=8)),
        {"mean": 0.02, "std": None},
    ),
    "laplace": (lambda o, seed: LaplaceOptimizer(o), {"mean": 1e-3, "std": None}),
    "droid": (droid, {"mean": 0.01, "std": None}),
    "simopt": (simopt, {"mean": 0.05, "std": None}),
    "bayessim": (bayessim, {"mean": None, "std": None}),
    "udr": (
        lambda o, seed: UdrOptimizer(o, settings=UdrSettings(), seed=seed),
        {"mean": None, "std": None},
    ),
}


def moving_objective() -> Objective:
    """Two parameters whose replays differ in how they move."""
    simulator = LinearSimulator(linear_space(), np.diag(GAINS), transition=0.5 * np.eye(2))
    return linear_objective(simulator, spread_data(40), epsilon=EPSILON)


PROBLEMS = {
    "moving": KnownProblem("moving", moving_objective, np.full(2, np.nan), np.full(2, np.nan)),
    "linear": linear_problem(),
    "noisy": linear_problem(40, noise=0.05),
    "curved": linear_problem(40, transform=lambda v: (v - 1).square()),
    "truth below the box": linear_problem(40, box=((0.0, 3.0), (4.5, 9.0))),
    "truth above the box": linear_problem(40, box=((0.0, 1.0), (1.0, 9.0))),
}
BEYOND = [(s, p) for s in ("fisher", "correlated", "cma", "adam") for p in PROBLEMS if p not in ("linear", "moving")]
LAWS = [("bayessim", "moving"), ("laplace", "noisy"), *((s, "linear") for s in SEARCHES if s != "bayessim"), *BEYOND]


@pytest.mark.parametrize(("search", "problem"), LAWS)
def test_optimizers_keep_their_laws(search: str, problem: str) -> None:
    make, accuracy = SEARCHES[search]
    if "truth" in problem and accuracy["mean"] is not None:
        accuracy = {"mean": max(accuracy["mean"], 0.02), "std": None}
    check_optimizer(make, problem=PROBLEMS[problem], **accuracy)


def test_the_curved_route_ends_in_sampling_and_the_straight_one_does_not():
    stages = []
    for name in ("linear", "curved"):
        objective = PROBLEMS[name].objective()
        optimizer = fisher(objective)
        drive(optimizer, objective)
        stages.append(optimizer.progress.stage)
    assert stages == ["Fisher scoring on sigma points", "Fisher scoring on samples"]


def test_another_seed_gives_another_search():
    objectives = [spread_objective() for _ in range(2)]
    found = [small_cma(o, seed=seed).ask().values for seed, o in enumerate(objectives)]
    assert (found[0] != found[1]).any()


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
    np.testing.assert_allclose(sums[2:6], expected, rtol=1e-6)
    assert sums[-1] == pytest.approx(0, abs=1e-6)  # nothing bends


def test_at_a_physical_limit_the_mean_of_the_samples_moves_with_the_deviation():
    space = ParameterSpace(
        None, {"a": {"bounds": [0.0, 3.0], "limits": [0.0, 9.0]}, "b": {"bounds": [1.0, 9.0], "limits": [1.0, 20.0]}}
    )
    effect = np.array([[1.0, 0.2], [-0.3, 2.0], [0.5, 0.5]])
    objective = linear_objective(LinearSimulator(space, effect), np.full((5, 3), 1.5), epsilon=1e-2)
    sums, expected = stage_gradient(lambda m, s: SigmaPointStage(objective.box, m, s), objective, space.low, AWAY[1])
    np.testing.assert_allclose(sums[4:6], expected[2:], rtol=1e-6)


def test_sampled_scores_are_the_gradient_of_the_sampled_likelihood():
    objective = mixed_objective()
    for samples in (8, 40):  # without and with bends in the regression
        uniforms = draw_uniforms(samples, 2, 0)
        sums, expected = stage_gradient(
            lambda m, s, u=uniforms: SampledStage(objective.box, m, s, uniforms=u),
            objective,
            *AWAY,
        )
        np.testing.assert_allclose(sums[2:6], expected, rtol=1e-6)
        value = objective.evaluate(AWAY[0][None], AWAY[1][None], uniforms)[0].log_likelihood
        assert sums[0] == pytest.approx(value, rel=1e-12)


def test_sampled_scores_see_curvature():
    simulator = LinearSimulator(linear_space(), np.diag(GAINS), transform=lambda v: v + 0.1 * v.square())
    objective = linear_objective(simulator, spread_data(25) * 1.1, epsilon=1e-2)
    sums, expected = stage_gradient(
        lambda m, s: SampledStage(objective.box, m, s, uniforms=draw_uniforms(40, 2, 0)), objective, *AWAY
    )
    np.testing.assert_allclose(sums[2:6], expected, rtol=1e-6)


def test_influences_tell_what_the_likelihood_is_without_a_sample():
    simulator = LinearSimulator(linear_space(), np.diag(GAINS), transform=lambda v: v + 0.1 * v.square())
    objective = linear_objective(simulator, spread_data(25) * 1.1, epsilon=1e-2)
    uniforms = draw_uniforms(60, 2, 0)
    stage = SampledStage(objective.box, *AWAY, uniforms=uniforms)
    stage.tell(objective.map(stage.points(), stage.reduction()).total)
    influences = stage.sums[-60:] - stage.sums[-60:].mean()
    without = np.array([
        objective.evaluate(AWAY[0][None], AWAY[1][None], uniforms[np.arange(60) != k])[0].log_likelihood
        for k in range(60)
    ])  # fmt: skip
    jackknife = 59 * (without.mean() - without)
    assert np.corrcoef(influences, jackknife)[0, 1] > 0.98
    assert influences.std() == pytest.approx(jackknife.std(), rel=0.1)
    assert stage.small_gain == pytest.approx(max(0.1, 0.1 * influences.std() / 60**0.5))


def test_fisher_information_is_that_of_the_gaussians():
    objective = mixed_objective()
    sums, _ = stage_gradient(lambda m, s: SigmaPointStage(objective.box, m, s), objective, *AWAY)
    effect = objective.simulator.effect.numpy()
    total = 1e-2 * np.eye(3) + effect @ np.diag(VARIANCE * AWAY[1] ** 2) @ effect.T
    inverse = np.linalg.inv(total)
    np.testing.assert_allclose(sums[6:10].reshape(2, 2), 25 * effect.T @ inverse @ effect, rtol=1e-8)
    change = [VARIANCE * 2 * s**2 * np.outer(c, c) for s, c in zip(AWAY[1], effect.T, strict=True)]
    expected = [[25 * 0.5 * np.trace(inverse @ a @ inverse @ b) for a in change] for b in change]
    np.testing.assert_allclose(sums[10:14].reshape(2, 2), expected, rtol=1e-8)


@pytest.mark.parametrize("robust", [False, True])
def test_the_gradient_of_the_means_is_that_of_their_cost(robust):
    objective = mixed_objective()
    box = objective.box

    def sums(mean: np.ndarray) -> np.ndarray:
        stage = MeansStage(box.low, box.high, mean, robust=robust)
        return objective.map(stage.points(), stage.reduction()).total.numpy()

    expected = numerical_gradient(lambda p: float(sums(p)[0]), AWAY[0])
    np.testing.assert_allclose(sums(AWAY[0])[2:4], expected, rtol=1e-5)


def test_a_robust_stage_is_not_led_by_what_no_mean_explains():
    """A tenth of the transitions are off by a thousand standard deviations: an impact that came too early."""
    simulator = LinearSimulator(linear_space(), np.diag(GAINS))
    truth = np.array([1.2, 4.0])
    measured = np.tile(truth * GAINS, (40, 1))
    measured[::10] += 100.0
    objective = linear_objective(simulator, measured, epsilon=1e-2)
    found = {}
    for robust in (False, True):
        stage = MeansStage(objective.box.low, objective.box.high, objective.box.middle, robust=robust)
        while stage.reason is None:
            stage.tell(objective.map(objective.box.values(stage.points()), stage.reduction()).total)
        found[robust] = np.abs(stage.point - truth).max()
    assert found[True] < 1e-2 < 0.1 < found[False]


def test_lost_transitions_are_counted_and_left_out_by_every_likelihood():
    def fragile(v: torch.Tensor) -> torch.Tensor:
        return torch.where(v > -1, torch.nan, v)

    objective = linear_objective(LinearSimulator(linear_space(), np.diag(GAINS), transform=fragile), spread_data(5))
    box = objective.box
    for stage in (SigmaPointStage(box, *AWAY), SampledStage(box, *AWAY, uniforms=draw_uniforms(9, 2, 0))):
        assert objective.map(stage.points(), stage.reduction()).total[:2].tolist() == [0, 5]
    found = objective.evaluate(AWAY[0][None], AWAY[1][None], draw_uniforms(9, 2, 0))[0]
    assert (found.log_likelihood, found.diverged, found.order()) == (-np.inf, 45, (-45, 0.0))


def unstable_objective(cut: float, truth: float, epsilon: float, number: int = 8) -> Objective:
    """Two parameters in [0, 1]; all simulations diverge where one exceeds ``cut``, towards which the log pulls."""

    def unstable(values: torch.Tensor) -> torch.Tensor:
        return torch.where(values[..., :1] > cut, torch.nan, values)

    simulator = LinearSimulator(space_of(a=[0, 1], b=[0, 1]), np.array([[1.0, 0.2], [0.3, -1.0]]), transform=unstable)
    noise = np.random.default_rng(0).normal(0, 0.03, (number, 2))
    return linear_objective(simulator, np.array([truth, 0.4]) @ simulator.effect.numpy().T + noise, epsilon=epsilon)


CLIMBERS: dict[str, Callable[[Objective], tuple[FitSettings, Optimizer | None]]] = {
    "fisher": lambda o: (FitSettings(samples=10), None),
    "fisher, full covariance": lambda o: (FitSettings(samples=10, covariance="full"), None),
    "gauss-newton": lambda o: (FitSettings(samples=10), LaplaceOptimizer(o)),
    "adam": lambda o: (FitSettings("adam", samples=10, adam=AdamSettings(steps=40, samples=4)), None),
    "cma": lambda o: (FitSettings("cma", samples=10, budget=150), None),
    "droid": lambda o: (FitSettings(samples=10), DroidOptimizer(o, settings=DroidSettings(budget=150), seed=0)),
}


@pytest.mark.parametrize("name", CLIMBERS)
@given(cut=st.floats(0.55, 0.9), truth=st.floats(0.7, 3.0), exponent=st.floats(-12, 0))
@hypothesis.settings(max_examples=6, phases=[hypothesis.Phase.generate])
def test_nothing_outweighs_a_divergence_whatever_epsilon(name, cut, truth, exponent):
    """The log calls for values at which every simulation diverges: the fit stays where none does.

    σ of DROID and Laplace is no choice of theirs, so there it is the mean that must be finite.
    """
    objective = unstable_objective(cut, truth, 10**exponent)
    settings, search = CLIMBERS[name](objective)
    found = fit(objective, settings, search=search)
    assert found.distribution.mean[0] <= cut
    if search is None:
        assert found.diverged == 0
        assert np.isfinite(found.log_likelihood)


@given(cut=st.floats(0.1, 0.45), truth=st.floats(0.0, 1.0), exponent=st.floats(-12, 0))
@hypothesis.settings(max_examples=6, phases=[hypothesis.Phase.generate])
def test_a_search_that_begins_where_everything_diverges_looks_elsewhere(cut, truth, exponent):
    objective = unstable_objective(cut, truth, 10**exponent)
    found = fit(objective, FitSettings(samples=10))
    assert found.diverged == 0
    assert found.distribution.mean[0] <= cut


@given(
    costs=st.lists(st.floats(-1e300, 1e300), min_size=6, max_size=6),
    lost=st.lists(st.integers(0, 3), min_size=6, max_size=6),
)
def test_cma_is_told_of_divergence_before_all_costs(costs, lost):
    objective = unstable_objective(0.9, 0.5, 1e-2)
    search = DroidOptimizer(objective, settings=DroidSettings(population=6), seed=0)
    search.ask()
    told, tell = [], search._search.tell
    search._search.tell = lambda points, values: (told.extend(values), tell(points, values))
    search.tell(torch.tensor([*costs, *map(float, lost)], dtype=torch.float64))
    assert np.isfinite(told).all()
    for i, j in itertools.permutations(range(6), 2):
        if lost[i] < lost[j]:
            assert told[i] < told[j]


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
        path = tmp_path / f"{steps}.bin"
        with pytest.raises(Stop):
            fit(spread_objective(), FitSettings(samples=10), checkpoint=path, on_progress=stop_after(steps))
        again = fit(spread_objective(), FitSettings(samples=10), checkpoint=path, resume=True)
        assert len(again.history) == len(whole.history)
        for key in ("log_likelihood", "mse", "evaluations", "simulated_transitions", "stop_reason"):
            assert getattr(again, key) == getattr(whole, key), key
        np.testing.assert_array_equal(again.distribution.mean, whole.distribution.mean)
        np.testing.assert_array_equal(again.distribution.std, whole.distribution.std)
