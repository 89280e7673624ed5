"""The damped least-squares step: against the system that it solves, in any units, and within bounds."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from dropo_torch.optimizers.least_squares import bounded_step, damped_step

ALL = np.ones(3, dtype=bool)


def problem(seed: int = 0, size: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A positive definite matrix and a force."""
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((20, size))
    return jacobian.T @ jacobian, rng.standard_normal(size)


@pytest.mark.parametrize(("damping", "ridge"), [(0.0, 0.0), (0.3, 0.0), (1e-3, 1e-2)])
def test_step_solves_its_system(damping: float, ridge: float) -> None:
    normal, force = problem()
    diagonal = np.diag(normal)
    expected = np.linalg.solve(normal + np.diag(damping * diagonal + ridge * diagonal.max()), force)
    np.testing.assert_allclose(damped_step(normal, force, ALL, damping, ridge), expected, rtol=1e-12)


def test_units_do_not_matter() -> None:
    normal, force = problem()
    unit = np.array([1e-3, 1.0, 1e3])
    other = damped_step(normal * np.outer(unit, unit), force * unit, ALL, 0.1) * unit
    np.testing.assert_allclose(other, damped_step(normal, force, ALL, 0.1), rtol=1e-9)


def test_what_is_not_free_stays_and_what_has_no_influence_too() -> None:
    normal, force = problem()
    step = damped_step(normal, force, np.array([True, False, True]), 0.0)
    assert step[1] == 0
    np.testing.assert_allclose((normal @ step - force)[[0, 2]], 0, atol=1e-12)
    silent = np.diag([1.0, 0.0, 1.0])
    assert damped_step(normal * np.outer(np.diag(silent), np.diag(silent)), force * np.diag(silent), ALL, 1e-3)[1] == 0
    assert not damped_step(normal, force, ~ALL, 0.0).any()
    assert damped_step(np.zeros((0, 0)), np.zeros(0), np.zeros(0, bool), 0.1).shape == (0,)


@pytest.mark.parametrize("seed", range(20))
def test_iterated_and_clipped_steps_end_at_the_bounded_minimum(seed: int) -> None:
    """There the gradient of what is inside vanishes, and that of what is at a bound points out."""
    normal, force = problem(seed)
    low, high, at = np.full(3, -0.01), np.full(3, 0.02), np.zeros(3)
    for _ in range(100):
        step = bounded_step(normal, force - normal @ at, low - at, high - at, 1e-9)
        at = np.clip(at + step, low, high)
    left = force - normal @ at
    inside = (low < at) & (at < high)
    np.testing.assert_allclose(left[inside], 0, atol=1e-9)
    assert (left[at == low] <= 0).all()
    assert (left[at == high] >= 0).all()


def test_an_entry_at_its_bound_does_not_lead_the_others_astray() -> None:
    """Its force points inwards, and the joint step would cross the bound."""
    normal, force = np.array([[1.0, 0.9], [0.9, 1.0]]), np.array([0.1, 1.0])
    assert damped_step(normal, force, np.ones(2, bool), 0.0)[0] < 0
    step = bounded_step(normal, force, np.array([0.0, -9.0]), np.array([9.0, 9.0]), 0.0)
    np.testing.assert_allclose(step, [0.0, 1.0])


@pytest.mark.parametrize("seed", range(20))
def test_step_from_bounds_is_the_best_that_leaves_none(seed: int) -> None:
    """With every entry at its lower bound, that is non-negative least squares."""
    normal, force = problem(seed, size=5)
    step = bounded_step(normal, force, np.zeros(5), np.full(5, np.inf), 0.1)
    factor = np.linalg.cholesky(normal + 0.1 * np.diag(np.diag(normal)))
    expected, _ = scipy.optimize.nnls(factor.T, np.linalg.solve(factor, force))
    np.testing.assert_allclose(step, expected, atol=1e-10)
