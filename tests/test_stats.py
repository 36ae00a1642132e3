import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import linregress
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint

from lerobot_bomb.stats import (
    PairedCounts,
    bca_interval,
    bootstrap_interval,
    episodes_to_tell_apart,
    format_rate,
    holm,
    mcnemar_p_value,
    paired_bootstrap_interval,
    paired_difference_interval,
    slope,
    variance_share,
    wilson_interval,
)

COUNTS = st.integers(0, 60)
PAIRED = st.builds(PairedCounts, COUNTS, COUNTS, COUNTS, COUNTS).filter(lambda counts: counts.n > 0)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)],
)
def test_wilson_interval_matches_published_values(successes: int, n: int, low: float, high: float) -> None:
    # the last two: Newcombe (1998), table I, method 3
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (-1, 5), (6, 5)])
def test_impossible_counts_are_refused(successes: int, n: int) -> None:
    with pytest.raises(ValueError, match=f"successes={successes}, n={n}"):
        wilson_interval(successes, n)


def test_format_rate() -> None:
    assert format_rate(48, 50) == "48/50 = 96.0 % [86.5, 98.9]"


@pytest.mark.parametrize(
    ("only_first", "only_second", "p_value"),
    # 2 * (1 + 6) / 64; 2 / 1024; no more than 1
    [(0, 0, 1.0), (5, 1, 14 / 64), (1, 5, 14 / 64), (10, 0, 2 / 1024), (3, 3, 1.0)],
)
def test_mcnemar_counts_the_tails_of_a_fair_coin(only_first: int, only_second: int, p_value: float) -> None:
    assert mcnemar_p_value(only_first, only_second) == pytest.approx(p_value)


def test_a_paired_interval_is_that_of_the_differences() -> None:
    counts, first = np.array([2.0, 2, 2, 2]), np.array([1.0, 50, -30, 400])
    differences = np.array([1.0, 2, 3, 4])
    paired = paired_bootstrap_interval((first, counts), (first + differences, counts))
    assert paired == pytest.approx(bootstrap_interval(differences, counts))
    assert paired_bootstrap_interval((first[:1], counts[:1]), (first[:1], counts[:1])) is None


# Against statsmodels


@given(st.integers(1, 500), st.data())
def test_wilson_interval_equals_statsmodels(n: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, n))
    expected = proportion_confint(successes, n, method="wilson")
    assert wilson_interval(successes, n) == pytest.approx(expected, abs=1e-12)


@given(PAIRED)
def test_mcnemar_equals_statsmodels(counts: PairedCounts) -> None:
    table = [[counts.both, counts.only_first], [counts.only_second, counts.neither]]
    expected = vars(mcnemar(table, exact=True))["pvalue"]
    assert counts.p_value == pytest.approx(expected, abs=1e-12)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_equals_statsmodels(p_values: list[float]) -> None:
    assert holm(p_values) == pytest.approx(multipletests(p_values, method="holm")[1], abs=1e-12)


# Intervals of differences


@given(PAIRED)
def test_a_paired_difference_lies_in_its_interval_and_turns_around_with_its_arms(
    counts: PairedCounts,
) -> None:
    low, high = paired_difference_interval(counts)
    assert -1 <= low <= counts.difference <= high <= 1
    other = PairedCounts(counts.both, counts.only_second, counts.only_first, counts.neither)
    assert paired_difference_interval(other) == pytest.approx((-high, -low), abs=1e-12)


def drawn(n: int, shares: tuple[float, float, float, float], number: int) -> list[PairedCounts]:
    """Tables of n pairs."""
    draws = np.random.default_rng(0).multinomial(n, shares, size=number)
    return [PairedCounts(*map(int, draw)) for draw in draws]


@pytest.mark.parametrize(
    ("n", "shares"),
    [(50, (0.5, 0.2, 0.1, 0.2)), (200, (0.9, 0.06, 0.01, 0.03)), (400, (0.3, 0.1, 0.1, 0.5))],
)
def test_the_interval_of_a_paired_difference_holds_the_truth_in_95_of_100(
    n: int, shares: tuple[float, float, float, float]
) -> None:
    tables = drawn(n, shares, 4000)
    truth = shares[2] - shares[1]
    intervals = [paired_difference_interval(table) for table in tables]
    # a little wider than need be where few pairs have one of the outcomes
    assert 0.94 < np.mean([low <= truth <= high for low, high in intervals]) < 0.97


@pytest.mark.parametrize(("n", "rate"), [(40, 0.5), (100, 0.9), (300, 0.97)])
def test_wilsons_interval_holds_the_truth_in_95_of_100_on_average(n: int, rate: float) -> None:
    # counts are whole numbers, so the coverage swings around 95 % with the rate: an average over rates nearby
    rng = np.random.default_rng(0)
    rates = rng.uniform(rate - 0.02, rate + 0.02, 4000)
    intervals = [wilson_interval(int(successes), n) for successes in rng.binomial(n, rates)]
    covered = [low <= truth <= high for (low, high), truth in zip(intervals, rates, strict=True)]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.01)


def test_a_bca_interval_of_a_skewed_mean_holds_the_truth_nearly_as_often() -> None:
    samples = np.random.default_rng(0).exponential(size=(400, 60))
    intervals = [bca_interval(sample) or (np.nan, np.nan) for sample in samples]
    assert np.mean([low <= 1.0 <= high for low, high in intervals]) > 0.92


def test_a_bca_interval_of_equal_numbers_is_that_number_and_of_one_none() -> None:
    assert bca_interval(np.full(7, 0.25)) == (0.25, 0.25)
    assert bca_interval(np.ones(1)) is None


# How many


def test_as_many_pairs_as_are_asked_for_find_the_difference_in_80_of_100() -> None:
    shares = (0.6, 0.15, 0.05, 0.2)
    n = episodes_to_tell_apart(PairedCounts(600, 150, 50, 200))
    assert n is not None
    found = [table.p_value < 0.05 for table in drawn(n, shares, 2000)]
    assert 0.70 < np.mean(found) < 0.85  # the exact test is a little stricter than the formula's
    assert episodes_to_tell_apart(PairedCounts(5, 3, 3, 1)) is None


def drawn_levels(rng: np.random.Generator, episodes: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(levels, episodes) of each episode under six conditions."""
    return np.tile(np.arange(6), episodes), np.repeat(np.arange(episodes), 6)


def test_a_slope_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    levels, episodes = drawn_levels(rng)
    values = (rng.random(len(levels)) > levels / 6).astype(float)
    found = slope(levels, values, episodes)
    assert found is not None and found.per_level == pytest.approx(linregress(levels, values)[0])
    assert found.low < found.per_level < found.high
    assert slope(np.full(4, 3), np.ones(4), np.arange(4)) is None


def test_the_interval_of_a_slope_covers_it_with_episodes_that_differ() -> None:
    rng = np.random.default_rng(1)
    levels, episodes = drawn_levels(rng)
    truth, num_covered, n = -0.08, 0, 300
    for _ in range(n):
        of_episode = np.repeat(rng.uniform(-0.2, 0.2, 60), 6)
        values = (rng.random(len(levels)) < 0.7 + truth * levels + of_episode).astype(float)
        found = slope(levels, values, episodes)
        num_covered += found is not None and found.low <= truth <= found.high
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
