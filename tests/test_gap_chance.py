"""Names by chance: how often what has nothing to do with a gap is named, and that what has is."""

import numpy as np
import pytest
from scipy import stats

from dropo_torch.gap.chance import least_surplus, p_of_gain, p_of_ranks, p_of_share, p_of_stretch
from dropo_torch.gap.evidence import Cost
from dropo_torch.gap.log import parts_of
from dropo_torch.gap.rules import Rules, as_good

CANDIDATES, ERROR = 100, Rules().chance.error


def best_of_many(rng: np.random.Generator, blocks: int, numbers: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """χ² of the blocks without and with the best of many candidates that have nothing to do with a misfit."""
    misfit = np.exp(spread * rng.standard_normal(blocks)) * rng.standard_normal(blocks)
    slopes = rng.standard_normal((CANDIDATES, numbers, blocks)) * np.exp(
        spread * rng.standard_normal((CANDIDATES, 1, blocks))
    )
    fits = np.linalg.solve(slopes @ slopes.swapaxes(1, 2), slopes @ misfit[:, None])[..., 0]
    left = (misfit - np.einsum("cn,cnb->cb", fits, slopes)) ** 2
    return misfit**2, left[np.argmin(left.sum(1))]


@pytest.mark.parametrize(
    ("blocks", "numbers", "spread"), [(20, 1, 0.0), (20, 1, 1.0), (20, 3, 1.0), (9, 1, 1.0), (9, 3, 1.0)]
)
def test_chance_names_no_more_often_than_stated(blocks: int, numbers: int, spread: float) -> None:
    rng = np.random.default_rng(0)
    logs = [best_of_many(rng, blocks, numbers, spread) for _ in range(300)]
    named = [p_of_gain(before, after, numbers) * CANDIDATES <= ERROR for before, after in logs]
    assert sum(named) <= stats.binom.ppf(0.99, len(named), ERROR)


def test_three_standard_errors_over_five_blocks_name_much_more_often() -> None:
    rng, named = np.random.default_rng(0), 0
    for _ in range(300):
        before, after = best_of_many(rng, 20, 1, 0.0)
        gains = (before - after).reshape(5, 4).sum(1)
        named += gains.sum() > 3 * gains.std(ddof=1) * np.sqrt(5) or after.sum() < 0.2 * before.sum()
    assert named > 3 * ERROR * 300


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_true_effects_have_their_name_although_gains_differ_by_decades(share: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(100):
        before = np.exp(2.0 * rng.standard_normal(20) + 6)
        after = before * (1 - share) * rng.uniform(0.5, 1, 20)
        assert p_of_gain(before, after, 1) * CANDIDATES <= ERROR


@pytest.mark.parametrize("numbers", [1, 2])
def test_what_shows_in_one_stretch_is_seldom_named_by_chance(numbers: int) -> None:
    """Misfits of three shapes in a stretch, and a direction drawn at random for each number of 100 candidates."""
    rng, named, noise = np.random.default_rng(3), 0, np.full(20, 20.0)
    for _ in range(300):
        before = np.append(np.full(19, 10.0), 1e8)
        shape, found = rng.standard_normal(3), []
        for _ in range(CANDIDATES):
            basis = np.linalg.qr(rng.standard_normal((3, numbers)))[0]
            left = 1 - np.sum((basis.T @ shape) ** 2) / (shape @ shape)
            found.append(p_of_stretch(before, np.append(before[:19], left * 1e8), noise, numbers))
        named += 3 * min(found) * CANDIDATES <= ERROR
    assert named <= stats.binom.ppf(0.99, 300, ERROR)


def test_what_shows_in_one_stretch_is_named_where_it_explains_all_of_it() -> None:
    quiet, noise = np.full(20, 10.0), np.full(20, 20.0)
    once = np.append(quiet[:19], 1e8)
    assert p_of_gain(once, quiet, 1) * CANDIDATES > ERROR
    assert 3 * p_of_stretch(once, quiet, noise, 1) * CANDIDATES <= ERROR
    assert 3 * p_of_stretch(once, 1e-3 * once, noise, 1) * CANDIDATES > ERROR
    assert 3 * p_of_stretch(np.append(quiet[:19], 1e4), quiet, noise, 1) * CANDIDATES > ERROR  # as far as noise shows
    assert p_of_stretch(once, quiet, noise, 3) == 1


def test_short_log_shows_what_removes_nearly_everything() -> None:
    before = np.exp(np.random.default_rng(2).standard_normal(9) + 8)
    assert p_of_ranks(before) == pytest.approx(2.0**-9)
    assert p_of_gain(before, 1e-4 * before, 1) * CANDIDATES <= ERROR
    assert p_of_gain(before, 0.3 * before, 1) * CANDIDATES > ERROR


def test_share_of_the_misfit_is_uniform_under_chance() -> None:
    rng, found = np.random.default_rng(3), []
    for _ in range(4000):
        misfit, slope = rng.standard_normal((2, 12))
        left = misfit - slope * (misfit @ slope) / (slope @ slope)
        share = 1 - left @ left / (misfit @ misfit)
        found.append(stats.beta.sf(share, 0.5, 5.5))
        flat = np.full(12, misfit @ misfit / 12)  # of equal sizes, for which n is 12
        assert p_of_share(flat, flat * (1 - share), 1) == pytest.approx(found[-1], rel=1e-6)
    assert stats.kstest(found, "uniform").pvalue > 0.01


def test_lower_limit_is_below_the_truth_as_often_as_stated() -> None:
    rng = np.random.default_rng(4)
    below = [least_surplus(1.0 + rng.standard_normal(6), 0.05) <= 6.0 for _ in range(4000)]
    assert np.mean(below) == pytest.approx(0.95, abs=0.012)


def cost(windows: np.ndarray, degrees: float = 4000.0) -> Cost:
    return Cost(windows, np.zeros(len(windows)), degrees)


def test_a_tie_is_what_is_not_surely_worse_by_more_than_matters() -> None:
    rng, rules, blocks = np.random.default_rng(5), Rules(), np.arange(40) // 2
    noise = cost(rng.chisquare(100, 40))
    assert as_good(cost(noise.windows + 0.05), noise, blocks, rules)  # surely worse, by what does not matter
    assert as_good(cost(noise.windows + 8 * rng.standard_normal(40)), noise, blocks, rules)  # not surely worse
    assert not as_good(cost(noise.windows + 2.0), noise, blocks, rules)
    unsure = np.zeros(40)
    unsure[0] = 1e4  # worse by far in one place, which no paired test calls significant
    assert not as_good(cost(noise.windows + unsure), noise, blocks, rules)
    wrong = cost(noise.windows + 1e5)
    assert as_good(cost(wrong.windows * 1.005), wrong, blocks, rules)  # beside the model's own error it does not matter
    assert not as_good(cost(wrong.windows * 1.1), wrong, blocks, rules)


@pytest.mark.parametrize("episodes", [1, 3, 6, 25])
def test_blocks_are_stretches_of_one_episode(episodes: int) -> None:
    owner = np.sort(np.random.default_rng(6).integers(0, episodes, 50))
    blocks = parts_of(owner, 20)
    count = len(np.unique(blocks))
    assert count >= 20
    for block in np.unique(blocks):
        (rows,) = np.nonzero(blocks == block)
        assert len(np.unique(owner[rows])) == 1
        assert np.all(np.diff(rows) == 1)
    assert len(np.unique(parts_of(owner[:9], 20))) == 9 or episodes >= 20
