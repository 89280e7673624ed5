"""Adam, exact derivatives and certificates on the Warp backend."""

from typing import Any

import numpy as np
import pytest
import torch
from dropo_sims.hopper import SIM
from dropo_sims.hopper.record import record

import dropo_torch as dropo
from dropo_torch.certify import certify
from dropo_torch.errors import InputError
from dropo_torch.fit import answer
from dropo_torch.objective import Objective
from dropo_torch.optimizers import AdamOptimizer, AdamSettings, FisherOptimizer, FitSettings
from dropo_torch.optimizers.settings import adam_settings
from dropo_torch.support.checkpoint import dumps, loads
from dropo_torch.support.random import draw_uniforms

pytest.importorskip("warp")


def hopper(backend: str, variant: str = "point", steps: int = 40, epsilon: float = 1e-5) -> Objective:
    log = record(variant=variant, seed=3, steps=steps)
    space = dropo.ParameterSpace(SIM.model, SIM.parameters)
    simulator = dropo.make_simulator(backend, SIM.model, parameters=space, frame_skip=4)
    observation = dropo.parse_observation(space.model, SIM.observation)
    trajectories = dropo.Trajectories(log.observations, log.next_observations, log.actions, log.terminals)
    return Objective(simulator, dropo.make_transitions(trajectories, observation), observation, epsilon=epsilon)


@pytest.fixture(scope="module")
def objective() -> Objective:
    return hopper("warp")


def test_the_gradient_of_the_likelihood_is_that_of_its_differences(objective: Objective) -> None:
    space = objective.simulator.parameters
    uniforms = draw_uniforms(6, len(space), 1)
    mean, std = space.nominal * 1.05, np.full(len(space), 0.2)
    values = objective.values(mean[None], std[None], uniforms)[0].numpy()
    reduce = objective.likelihood()
    sums = objective.evaluator.gradient(values, objective.comparing(reduce))
    assert sums.gradient is not None
    gradient = sums.gradient
    assert float(sums.total[0]) == pytest.approx(float(objective.map(values, reduce).total[0]), rel=1e-12)
    assert sums.simulated_transitions == 6 * len(objective)
    for k, i in ((0, 0), (3, 2), (5, 3)):
        moved = [values.copy(), values.copy()]
        moved[0][k, i] += 1e-5
        moved[1][k, i] -= 1e-5
        plus, minus = (float(objective.map(v, reduce).total[0]) for v in moved)
        assert float(gradient[k, i]) == pytest.approx(
            (plus - minus) / 2e-5, rel=2e-3, abs=1e-3 * float(gradient.abs().max())
        )


def test_exact_jacobians_stand_for_small_differences(objective: Objective) -> None:
    space = objective.simulator.parameters
    center = space.nominal
    values = np.concatenate([center[None], center + 1e-6 * np.eye(len(space))])

    def slopes(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        return ((features[:, 1:] - features[:, :1]) / 1e-6).abs().sum((0, 2))

    exact = objective.evaluator.map_linear(values, objective.comparing(slopes))
    np.testing.assert_allclose(exact.total, objective.map(values, slopes).total, rtol=1e-4)


def advance(search: AdamOptimizer, objective: Objective) -> None:
    """Answer one request."""
    request = search.ask()
    np.testing.assert_array_equal(request.values, search.ask().values)
    sums = answer(objective, request)
    search.tell(sums.total, sums.gradient)


@pytest.mark.parametrize("off", [torch.no_grad, torch.inference_mode])
def test_gradients_are_taken_where_the_caller_has_switched_them_off(objective: Objective, off: Any) -> None:
    settings = FitSettings(optimizer="adam", adam=AdamSettings(steps=2, batch=4, samples=2), samples=4, seed=1)
    with off():
        found = dropo.fit(objective, settings)
    assert found.distribution == dropo.fit(objective, settings).distribution


def test_adam_approaches_the_masses_and_continues_from_any_state(objective: Objective) -> None:
    settings = FitSettings(optimizer="adam", adam=AdamSettings(steps=60, batch=20, samples=8), seed=1)
    whole = AdamOptimizer(objective, settings)
    error = []
    while whole.stop_reason is None:
        if len(error) in (0, 1, 7, 63, 64, 80):  # before and after the basis is computed, in both stages
            state = loads(b"".join(dumps("fit", (), whole.state())))[2]
            whole = AdamOptimizer(objective, settings)
            whole.restore(state)
        advance(whole, objective)
        error.append(np.abs(whole.candidates()[0][0] / objective.simulator.parameters.nominal - 1).max())
    assert error[-1] < 0.02 < error[0]
    straight = AdamOptimizer(objective, settings)
    while straight.stop_reason is None:
        advance(straight, objective)
    for found, expected in zip(straight.candidates()[0], whole.candidates()[0], strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("variant", ["point", "distribution"])
def test_adam_finds_what_fisher_scoring_finds(variant: str) -> None:
    log = hopper("warp", variant, epsilon=1e-6)
    fits = [dropo.fit(log, FitSettings(optimizer=name, samples=50)) for name in ("fisher", "adam")]
    assert fits[1].log_likelihood > fits[0].log_likelihood - 2
    np.testing.assert_allclose(fits[1].distribution.mean, fits[0].distribution.mean, rtol=0.02)


def test_some_rows_are_simulated_as_a_log_of_their_own(objective: Objective) -> None:
    rows = np.array([3, 11, 40])
    values = np.tile(objective.simulator.parameters.nominal, (3, 1)) * np.array([[1.0], [1.01], [0.98]])
    reduce = objective.likelihood()
    part = objective.on(objective.transitions.select(rows))
    torch.testing.assert_close(
        objective.map(values, reduce, rows).total, part.map(values, reduce).total, rtol=0, atol=0
    )


def test_both_backends_find_the_same_distribution() -> None:
    fits = [
        dropo.fit(hopper(backend, "distribution", epsilon=1e-6), FitSettings(samples=30))
        for backend in ("mujoco", "warp")
    ]
    np.testing.assert_allclose(fits[0].distribution.mean, fits[1].distribution.mean, rtol=0.02)
    assert fits[1].log_likelihood > fits[0].log_likelihood - 1


def test_a_certificate_holds_on_the_hopper_and_fails_for_a_wrong_gradient(
    objective: Objective, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = certify(objective, max_transitions=20, points=1)
    found.check()
    assert found.state_error < 1e-10
    assert all(p.median_error < 1e-6 for p in found.parameters)
    simulator, exact = objective.simulator, objective.simulator.jacobian  # type: ignore[attr-defined]

    def spoilt(*arguments: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        after, by_values, by_states = exact(*arguments)
        by_values = by_values.clone()
        by_values[..., 1] *= 1.1
        by_values[..., 2] = 0.0
        return after, by_values, by_states

    monkeypatch.setattr(simulator, "jacobian", spoilt)
    verdicts = {p.name: p.verdict for p in certify(objective, max_transitions=20, points=1).parameters}
    assert verdicts == {"torso_mass": "exact", "thigh_mass": "wrong", "leg_mass": "dead", "foot_mass": "exact"}
    with pytest.raises(InputError, match=r"thigh_mass is wrong .*leg_mass is dead"):
        certify(objective, max_transitions=20, points=1).check()
    with pytest.raises(InputError, match=r"thigh_mass is wrong"):
        dropo.fit(objective, FitSettings(optimizer="adam", samples=4))


def test_gradients_are_asked_of_simulators_that_have_them() -> None:
    plain = hopper("mujoco", steps=5)
    with pytest.raises(InputError, match="use backend: warp"):
        AdamOptimizer(plain, FitSettings(optimizer="adam"))
    with pytest.raises(InputError, match="use backend: warp"):
        certify(plain)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"step": 5}, "unknown key 'step'; did you mean 'steps'"),
        ({"steps": 0}, "expected a positive number"),
        ({"learning_rate": "fast"}, "expected a number"),
        ({"samples": 1}, "needs 2 or more"),
    ],
)
def test_settings_that_cannot_be_are_refused(given: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        adam_settings(given)


def test_fisher_asks_for_gradients_only_of_samples(objective: Objective) -> None:
    search = FisherOptimizer(objective, FitSettings())
    request = search.ask()
    assert request.is_stencil
    assert not request.gradient
