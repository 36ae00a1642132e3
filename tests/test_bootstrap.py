import tracemalloc

import numpy as np
import pytest
from scipy.stats import bootstrap, linregress

from lerobot_bomb.bootstrap import (
    Slope,
    bca_interval,
    bootstrap_interval,
    fit_slope,
    paired_bootstrap_interval,
    variance_share,
)
from lerobot_bomb.stats import sums_by


def ones(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(sums, counts) of episodes of one value each."""
    return values, np.ones(len(values))


def test_values_are_added_up_by_episode_in_the_order_of_the_first() -> None:
    sums, counts = sums_by(np.array([1.0, 10, 2, 20, 4]), ["b", "a", "b", "a", "b"])
    assert sums.tolist() == [7, 30] and counts.tolist() == [3, 2]


def test_a_paired_interval_is_that_of_the_differences() -> None:
    counts, first = np.array([2.0, 2, 2, 2]), np.array([1.0, 50, -30, 400])
    differences = np.array([1.0, 2, 3, 4])
    paired = paired_bootstrap_interval((first, counts), (first + differences, counts))
    assert paired == pytest.approx(bootstrap_interval(differences, counts))
    assert paired_bootstrap_interval((first[:1], counts[:1]), (first[:1], counts[:1])) is None


# Nothing to resample


@pytest.mark.parametrize("values", [[0.25] * 7, [1.0], [0.3 - 0.1, 0.4 - 0.2, 0.5 - 0.3]])
def test_equal_numbers_or_one_have_no_interval(values: list[float]) -> None:
    sample = ones(np.array(values))
    assert bca_interval(*sample) is None and bootstrap_interval(*sample) is None
    moved = np.arange(1.0, 1 + len(values)) / 10
    assert paired_bootstrap_interval(ones(moved), ones(moved + values)) is None


def test_a_slope_that_all_resamples_have_has_no_interval() -> None:
    levels, values = np.array([0.0, 1, 0, 1]), np.array([1.0, 0, 1, 0])
    assert fit_slope(levels, values, np.array([7, 7, 8, 8])) == Slope(-1.0, None, None)


# BCa


@pytest.mark.parametrize("num_values", [2, 9, 200])
def test_a_bca_interval_equals_scipys(num_values: int) -> None:
    values = np.random.default_rng(1).exponential(size=num_values)
    options = {"n_resamples": 9999, "method": "BCa", "rng": np.random.default_rng(0)}
    expected = bootstrap((values,), np.mean, **options).confidence_interval
    assert bca_interval(*ones(values)) == pytest.approx((expected.low, expected.high), rel=1e-9)


def test_a_bca_interval_draws_clusters() -> None:
    values = np.random.default_rng(1).exponential(size=30)
    doubled = sums_by(np.repeat(values, 5), list(np.repeat(np.arange(30), 5)))
    assert bca_interval(*doubled) == pytest.approx(bca_interval(*ones(values)))


def test_a_bca_interval_of_a_skewed_mean_holds_the_truth_nearly_as_often() -> None:
    samples = np.random.default_rng(0).exponential(size=(400, 60))
    intervals = [bca_interval(*ones(sample)) or (np.nan, np.nan) for sample in samples]
    assert np.mean([low <= 1.0 <= high for low, high in intervals]) > 0.92


def test_many_episodes_take_little_memory() -> None:
    values = np.random.default_rng(0).exponential(size=50_000)
    tracemalloc.start()
    found = bootstrap_interval(*ones(values))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6  # at once, the draws alone are 800 MB
    assert found == pytest.approx((values.mean() - 0.0088, values.mean() + 0.0088), abs=5e-4)


# Slopes and shares


def drawn_levels(rng: np.random.Generator, episodes: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(levels, episodes) of each episode under six conditions."""
    return np.tile(np.arange(6), episodes), np.repeat(np.arange(episodes), 6)


def test_a_slope_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    levels, episodes = drawn_levels(rng)
    values = (rng.random(len(levels)) > levels / 6).astype(float)
    found = fit_slope(levels, values, episodes)
    assert found is not None and found.per_level == pytest.approx(linregress(levels, values)[0])
    assert found.low is not None and found.high is not None
    assert found.low < found.per_level < found.high
    assert fit_slope(np.full(4, 3), np.ones(4), np.arange(4)) is None


def test_the_interval_of_a_slope_covers_it_with_episodes_that_differ() -> None:
    rng = np.random.default_rng(1)
    levels, episodes = drawn_levels(rng)
    truth, num_covered, n = -0.08, 0, 300
    for _ in range(n):
        of_episode = np.repeat(rng.uniform(-0.2, 0.2, 60), 6)
        values = (rng.random(len(levels)) < 0.7 + truth * levels + of_episode).astype(float)
        found = fit_slope(levels, values, episodes)
        assert found is not None and found.low is not None and found.high is not None
        num_covered += found.low <= truth <= found.high
    assert 0.91 <= num_covered / n <= 0.98


def test_a_level_without_effect_has_no_share_on_average_and_one_that_decides_has_all() -> None:
    rng = np.random.default_rng(2)
    shares = []
    for _ in range(400):
        levels, values = rng.integers(1, 6, 40), rng.integers(0, 2, 40)
        if (share := variance_share(values, levels)) is not None:
            shares.append(share)
    assert abs(np.mean(shares)) < 0.02
    levels = rng.integers(1, 6, 200)
    assert variance_share((levels > 2).astype(float), levels) == pytest.approx(1.0)
    # half of the variance: the level decides one of two summands that are alike
    other = rng.integers(1, 6, 20_000)
    levels = rng.integers(1, 6, 20_000)
    assert variance_share(levels + other.astype(float), levels) == pytest.approx(0.5, abs=0.02)
    assert variance_share(np.ones(5), np.arange(5)) is None
