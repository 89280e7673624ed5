from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import torch
from conftest import LinearSimulator, linear_objective, numerical_gradient, space_of
from hypothesis import given
from hypothesis import strategies as st

from dropo_torch.distribution import (
    Distribution,
    SearchBox,
    tensor_values,
    to_coordinates,
    to_values,
    truncated_interval,
    truncated_moments,
    truncated_normal_icdf,
)
from dropo_torch.errors import InputError
from dropo_torch.fit import fit
from dropo_torch.optimizers import FitSettings
from dropo_torch.support.random import base_uniforms

#: μ, σ and physical limits: none, one that cuts, both that cut, μ at a limit, μ outside of one.
LAWS = [
    (1.0, 0.5, -np.inf, np.inf),
    (0.3, 0.5, 0.0, np.inf),
    (0.0, 0.7, 0.0, np.inf),
    (2.0, 1.0, 1.5, 2.2),
    (-0.5, 0.6, 0.0, 5.0),
    (3.0, 1.0, -np.inf, 2.0),
]


def truncnorm(mean, std, low, high):
    """The distribution of a normal redrawn until it is within 2σ and within the limits."""
    a, b = max(-2.0, (low - mean) / std), min(2.0, (high - mean) / std)
    return scipy.stats.truncnorm(a, b, loc=mean, scale=std)


def distribution(mean, std, low, high, *, log: bool = False) -> Distribution:
    return Distribution(
        ("p",), np.array([mean]), np.array([std]), np.array([0.1]), np.array([4.0]), np.array([[low, high]]),
        np.array([log]), ("kg",),
    )  # fmt: skip


def tensors(*numbers):
    return [torch.tensor(x, dtype=torch.float64) for x in numbers]


@pytest.mark.parametrize("law", LAWS)
def test_the_inverse_cdf_is_that_of_the_truncated_normal(law):
    u = torch.linspace(1e-6, 1 - 1e-6, 501, dtype=torch.float64)
    ours = truncated_normal_icdf(u, *tensors(*law))
    np.testing.assert_allclose(ours, truncnorm(*law).ppf(u.numpy()), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_samples_follow_the_normal_redrawn_inside_its_limits(law):
    mean, std, low, high = law
    samples = distribution(*law).sample(20_000, torch.Generator().manual_seed(1))[:, 0].numpy()
    assert scipy.stats.kstest(samples, truncnorm(*law).cdf).pvalue > 1e-3
    draws = np.random.default_rng(2).normal(mean, std, 400_000)
    kept = draws[(np.abs(draws - mean) <= 2 * std) & (draws >= low) & (draws <= high)]
    assert scipy.stats.ks_2samp(samples, kept[:20_000]).pvalue > 1e-3


def test_samples_of_a_log_scaled_parameter_have_that_law_in_their_logarithm():
    law = (np.log(0.8), 0.5, 0.5, 3.0)
    samples = distribution(*law, log=True).sample(20_000, torch.Generator().manual_seed(1))[:, 0].numpy()
    expected = truncnorm(law[0], law[1], np.log(0.5), np.log(3.0))
    assert scipy.stats.kstest(np.log(samples), expected.cdf).pvalue > 1e-3


@given(
    st.floats(-3, 3), st.floats(1e-5, 2), st.floats(-2, 1), st.floats(0.01, 3),
    st.lists(st.floats(1e-12, 1 - 1e-12), min_size=1, max_size=5),
)  # fmt: skip
def test_no_sample_leaves_the_limits_or_two_deviations(mean, std, low, width, uniforms):
    if low > mean + 2 * std or low + width < mean - 2 * std:
        return  # then there is no such law
    x = truncated_normal_icdf(torch.tensor(uniforms, dtype=torch.float64), *tensors(mean, std, low, low + width))
    rounding = 1e-8 * max(1.0, std)
    assert (x >= max(low, mean - 2 * std) - rounding).all()
    assert (x <= min(low + width, mean + 2 * std) + rounding).all()
    assert torch.isfinite(x).all()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("log", [False, True])
def test_samples_are_differentiable_in_mean_and_deviation(law, log):
    mean, std, low, high = law
    ends = np.array([max(low, 0.05) if log else low, high])
    limits = torch.from_numpy(np.log(ends) if log else ends)
    u = torch.tensor([[0.03], [0.4], [0.77], [0.98]], dtype=torch.float64)
    at = np.array([np.log(abs(mean) + 0.5) if log else mean, std])

    def total(phi: np.ndarray | torch.Tensor) -> torch.Tensor:
        phi = torch.as_tensor(phi)
        weights = torch.tensor([[1.0], [-2.0], [0.5], [3.0]], dtype=torch.float64)
        return (weights * tensor_values(truncated_normal_icdf(u, *phi, *limits), np.array([log]))).sum()

    leaf = torch.tensor(at, requires_grad=True)
    total(leaf).backward()
    np.testing.assert_allclose(leaf.grad, numerical_gradient(lambda p: float(total(p)), at), rtol=1e-6, atol=1e-7)


def test_common_uniforms_move_with_the_distribution():
    u = base_uniforms(50, 1, torch.Generator().manual_seed(0))
    here, there = (distribution(m, s, -np.inf, np.inf).rsample(u) for m, s in ((0.0, 1.0), (3.0, 0.5)))
    torch.testing.assert_close((there - 3) / 0.5, here, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_moments_are_those_of_the_truncated_normal(law):
    a, b = truncated_interval(*tensors(*law))
    standard = scipy.stats.truncnorm(float(a), float(b))
    expected = [standard.moment(k) for k in (1, 2, 4)]
    np.testing.assert_allclose([float(x) for x in truncated_moments(a, b)], expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("log", [False, True])
def test_the_density_integrates_to_one_and_matches_the_law(law, log):
    mean, std, *limits = law
    p = distribution(mean, std, *(np.exp(limits) if log else limits), log=log)
    expected = truncnorm(*law)
    ends = expected.support()
    ends = np.exp(ends) if log else np.array(ends)
    density = lambda v: float(p.log_prob(torch.tensor([v], dtype=torch.float64)).exp())  # noqa: E731
    inside = np.nextafter(ends[0], ends[1]), np.nextafter(ends[1], ends[0])
    assert scipy.integrate.quad(density, *inside, epsabs=1e-8)[0] == pytest.approx(1, abs=1e-7)
    middle = 0.3 * ends[0] + 0.7 * ends[1]
    theirs = expected.pdf(np.log(middle)) / middle if log else expected.pdf(middle)
    assert density(middle) == pytest.approx(theirs, rel=1e-9)


def test_outside_the_support_the_density_is_zero():
    p = distribution(0.3, 0.5, 0.0, np.inf)
    values = torch.tensor([[-0.01], [1.31], [0.5]], dtype=torch.float64)
    assert torch.isinf(p.log_prob(values)).tolist() == [True, True, False]
    log = distribution(0.0, 0.5, 0.01, np.inf, log=True)
    assert (log.log_prob(torch.tensor([[0.0], [-1.0]], dtype=torch.float64)) == -torch.inf).all()


def test_parameters_are_independent():
    space = space_of(a=[0, 2], b={"bounds": [1, 10], "scale": "log"})
    p = Distribution.over(space, np.array([1.0, 1.0]), np.array([0.3, 0.2]))
    values = p.sample(100, torch.Generator().manual_seed(0))
    alone = [distribution(1.0, s, *space.limits[i], log=bool(i)) for i, s in enumerate((0.3, 0.2))]
    expected = alone[0].log_prob(values[:, :1]) + alone[1].log_prob(values[:, 1:])
    torch.testing.assert_close(p.log_prob(values), expected, rtol=1e-12, atol=1e-12)


CORRELATION = np.array([[1.0, 0.5], [0.5, 1.0]])


def correlated(*, is_uniform: bool = False, correlation: np.ndarray = CORRELATION) -> Distribution:
    space = space_of(a=[0, 2], b={"bounds": [1, 10], "scale": "log"})
    mean, std = np.array([1.0, 1.0]), np.array([0.3, 0.2])
    return Distribution.over(space, mean, std, correlation=correlation, is_uniform=is_uniform)


@pytest.mark.parametrize("is_uniform", [False, True])
def test_a_correlated_density_is_that_of_its_draws(is_uniform):
    """It integrates to one and gives the draws' moments, and is zero outside the support."""
    p = correlated(is_uniform=is_uniform)
    low, high = (np.where(p.is_log, np.exp(end), end) for end in p.ends)
    axes = [torch.linspace(*ends, 801, dtype=torch.float64)[1:] - (ends[1] - ends[0]) / 1600
            for ends in zip(low, high, strict=True)]  # fmt: skip
    grid = torch.cartesian_prod(*axes)
    density = p.log_prob(grid).exp() * np.prod(high - low) / len(grid)
    assert float(density.sum()) == pytest.approx(1, abs=2e-3)
    draws = p.sample(200_000, torch.Generator().manual_seed(0))
    product = (grid - draws.mean(0)).prod(-1)
    assert float((density * product).sum()) == pytest.approx(float((draws - draws.mean(0)).prod(-1).mean()), rel=0.05)
    outside = torch.tensor([[1.0, 0.0], [1.0, -1.0], [5.0, 3.0], [-9.0, -9.0], [1.0, 90.0]], dtype=torch.float64)
    assert (p.log_prob(outside) == -torch.inf).all()


def test_a_singular_correlation_can_be_drawn_from_and_has_no_density():
    p = correlated(correlation=np.ones((2, 2)))
    draws = p.sample(100, torch.Generator().manual_seed(0))
    assert np.corrcoef(draws[:, 0], draws[:, 1].log())[0, 1] == pytest.approx(1, abs=1e-6)
    with pytest.raises(InputError, match="correlation is singular, so that it has no density"):
        p.log_prob(draws)


def mixed() -> Distribution:
    space = space_of(
        friction={"bounds": [0, 2], "limits": [0, 5], "unit": "N m"},
        mass={"bounds": [1, 10], "scale": "log", "unit": "kg"},
        offset=[-1e-3, 2.0],
    )
    return Distribution.over(space, np.array([0.1 + 0.2, np.log(3.1), 0.0]), np.array([1e-5, 1e-7, 0.123456789012345]))


@pytest.mark.parametrize("suffix", [".json", ".yaml", ".yml"])
def test_a_saved_distribution_is_read_back_exactly(tmp_path, suffix):
    mixed().save(tmp_path / f"d{suffix}")
    back = Distribution.load(tmp_path / f"d{suffix}")
    for key, value in vars(mixed()).items():
        np.testing.assert_array_equal(getattr(back, key), value, err_msg=key)
    u = base_uniforms(20, 3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(back.rsample(u), mixed().rsample(u), rtol=0, atol=0)


def test_the_distribution_inside_a_fit_json_is_the_fitted_one(tmp_path):
    space = space_of(friction={"bounds": [0, 2], "limits": [0, 5]}, scale={"bounds": [1, 10], "scale": "log"})
    simulator = LinearSimulator(space, np.eye(2))
    result = fit(linear_objective(simulator, np.tile([0.0, 3.0], (20, 1))), FitSettings(samples=10))
    result.save(tmp_path / "fit.json")
    back = Distribution.load(tmp_path / "fit.json")
    for key, value in vars(result.distribution).items():
        np.testing.assert_array_equal(getattr(back, key), value, err_msg=key)
    entry = json.loads((tmp_path / "fit.json").read_text())["parameters"]["friction"]
    assert {"mean", "std", "low", "high", "unit"} <= set(entry)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no file"),
        ("{", "cannot be read"),
        ("[1]", "has no 'parameters'"),
        ('{"parameters": {}}', "has no 'parameters'"),
        ('{"parameters": {"a": {"mean": 1, "sd": 1}}}', r"parameters\.a has no number 'std'; did you mean 'sd'"),
        ('{"parameters": {"a": 3}}', r"parameters\.a has no number 'mean'"),
    ],
)
def test_a_file_that_holds_no_distribution_is_refused(tmp_path, text, message):
    path = tmp_path / "d.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        Distribution.load(path)


def test_center_and_spread_are_in_the_parameters_units():
    p = mixed()
    np.testing.assert_allclose(p.center, [0.3, 3.1, 0.0], rtol=1e-15)
    assert p.spread[1] == pytest.approx(3.1e-7)
    assert p.summary()["mass"]["unit"] == "kg"


boxes = st.builds(
    lambda a, w, scale: SearchBox.of(space_of(a=[a, a + w], b={"bounds": [scale, scale * (1 + w)], "scale": "log"})),
    st.floats(-100, 100), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3),
)  # fmt: skip


@given(boxes, st.lists(st.floats(0, 4), min_size=4, max_size=4))
def test_normalizing_undoes_denormalizing(box, phi):
    phi = np.array(phi)
    mean, std = box.denormalize(phi)
    np.testing.assert_allclose(box.normalize(mean, std), phi, atol=1e-9)
    assert (mean >= box.low - 1e-12).all()
    assert (mean <= box.high + 1e-9 * box.width).all()


@given(boxes)
def test_bounds_map_to_zero_and_four(box):
    np.testing.assert_allclose(box.normalize(box.low, box.min_std), 0, atol=1e-12)
    np.testing.assert_allclose(box.normalize(box.high, box.max_std), 4, rtol=1e-12)
    np.testing.assert_allclose(box.normalize(box.middle, np.sqrt(box.min_std * box.max_std)), 2, rtol=1e-9)
    np.testing.assert_allclose(box.max_std, box.width / 4)
    outside = box.denormalize(np.array([-1.0, 5.0, -1.0, 5.0]))
    np.testing.assert_allclose(outside[0], [box.low[0], box.high[1]])


def test_values_and_coordinates_convert_both_ways():
    is_log = np.array([False, True])
    values = np.array([[-2.0, 3.0], [0.0, 1e-4]])
    np.testing.assert_allclose(to_values(to_coordinates(values, is_log), is_log), values, rtol=1e-15)
    np.testing.assert_array_equal(to_coordinates(values, is_log)[:, 0], values[:, 0])
