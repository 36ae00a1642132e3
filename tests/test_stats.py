import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import binom
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint

from lerobot_bomb.stats import (
    PairedCounts,
    Rate,
    clustered_difference_interval,
    clustered_interval,
    episodes_to_tell_apart,
    format_p,
    format_rate,
    holm,
    mcnemar_p_value,
    paired_difference_interval,
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


# Clusters


def test_records_of_one_seed_count_as_one_where_they_agree() -> None:
    # ten seeds of eleven conditions: five always succeed, five never do, so they tell as much as ten records;
    # 2.262 is Student's t for 9 degrees of freedom
    low, high = clustered_interval(np.array([11] * 5 + [0] * 5), np.full(10, 11)) or (0, 0)
    half = 2.2622 / (1 + 2.2622**2 / 10) * np.sqrt(0.25 / 10 + 2.2622**2 / 400)
    assert (low, high) == pytest.approx((0.5 - half, 0.5 + half), abs=1e-4)
    assert half == pytest.approx(0.2909, abs=1e-4)
    pooled = wilson_interval(55, 110)
    assert high - low > 3 * (pooled[1] - pooled[0])


@pytest.mark.parametrize(
    ("successes", "counts", "expected"),
    [
        ([1, 0, 1, 1], [1, 1, 1, 1], wilson_interval(3, 4)),  # a record each: independent
        ([7], [11], None),  # one seed alone tells nothing of others
        # always: at worst two records, and no variance that would be estimated
        ([3, 3], [3, 3], wilson_interval(2, 2)),
        ([0, 0], [3, 3], wilson_interval(0, 2)),
        # as independent as can be: no more than there are, with t of three degrees of freedom
        ([1, 1, 1, 1], [2, 2, 2, 2], (0.5 - 0.3737, 0.5 + 0.3737)),
    ],
)
def test_a_clustered_interval(
    successes: list[int], counts: list[int], expected: tuple[float, float] | None
) -> None:
    found = clustered_interval(np.array(successes), np.array(counts))
    assert found is expected is None or found == pytest.approx(expected, abs=1e-4)


def test_a_rate_of_clusters_says_so() -> None:
    alone = Rate.of([True, False], [1, 2])
    assert (str(alone), alone.method) == (format_rate(1, 2), "95 % Wilson interval")
    pooled = Rate.of([True, True, False, True], ["a", "a", "b", "b"])
    assert (pooled.successes, pooled.n, pooled.num_clusters) == (3, 4, 2)
    assert pooled.method == "95 % Wilson interval, 2 clusters by seed"
    one = Rate.of([True, False], ["a", "a"])
    assert (str(one), one.method) == ("1/2 = 50.0 %", "no interval: all are of one seed")


def test_the_interval_of_clusters_holds_the_truth_in_95_of_100() -> None:
    rng = np.random.default_rng(0)
    covered = []
    for _ in range(2000):
        of_seed = rng.beta(2, 2, 20)  # seeds differ in how hard they are, the same under 11 conditions
        low, high = clustered_interval(rng.binomial(11, of_seed), np.full(20, 11)) or (0, 0)
        covered.append(low <= 0.5 <= high)
    assert 0.93 < np.mean(covered) < 0.98


@pytest.mark.parametrize(
    ("only_first", "only_second", "p_value"),
    # 2 * (1 + 6) / 64; 2 / 1024; no more than 1
    [(0, 0, 1.0), (5, 1, 14 / 64), (1, 5, 14 / 64), (10, 0, 2 / 1024), (3, 3, 1.0), (60, 0, 2.0**-59)],
)
def test_mcnemar_counts_the_tails_of_a_fair_coin(only_first: int, only_second: int, p_value: float) -> None:
    assert mcnemar_p_value(only_first, only_second) == pytest.approx(p_value)


@pytest.mark.parametrize(
    ("p_value", "text"), [(0.0314, "p = 0.031"), (1.0, "p = 1"), (2.0**-400, "p < 1e-99"), (0.0, "p < 1e-99")]
)
def test_no_p_value_is_zero(p_value: float, text: str) -> None:
    assert format_p(p_value) == text


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


@example(PairedCounts(0, 0, 55, 0))
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


@pytest.mark.parametrize("num_seeds", [5, 20])
def test_clustered_pairs_hold_the_truth_in_95(num_seeds: int) -> None:
    rng = np.random.default_rng(0)
    seeds = np.repeat(np.arange(num_seeds), 11).tolist()
    covered = []
    for _ in range(1000):
        first, second = (rng.beta(0.5, 0.5, num_seeds) for _ in range(2))  # policies find other seeds hard
        first_N, second_N = (rng.random((num_seeds, 11)) < rate[:, None] for rate in (first, second))
        counts = PairedCounts.of(first_N.ravel().tolist(), second_N.ravel().tolist())
        differences = second_N.ravel().astype(int) - first_N.ravel()
        low, high = clustered_difference_interval(counts, differences.tolist(), seeds) or (0, 0)
        covered.append(low <= 0 <= high)
    assert 0.94 < np.mean(covered) < 0.99


def test_a_pair_for_each_cluster_is_independent() -> None:
    counts = PairedCounts(5, 2, 7, 1)
    differences = [0] * 6 + [-1] * 2 + [1] * 7
    expected = paired_difference_interval(counts)
    assert clustered_difference_interval(counts, differences, range(15)) == expected
    assert clustered_difference_interval(counts, differences, [0] * 15) is None


@pytest.mark.parametrize(("n", "rate"), [(40, 0.5), (100, 0.9), (300, 0.97)])
def test_wilsons_interval_holds_the_truth_in_95_of_100_on_average(n: int, rate: float) -> None:
    # counts are whole numbers, so the coverage swings around 95 % with the rate: an average over rates nearby
    rng = np.random.default_rng(0)
    rates = rng.uniform(rate - 0.02, rate + 0.02, 4000)
    intervals = [wilson_interval(int(successes), n) for successes in rng.binomial(n, rates)]
    covered = [low <= truth <= high for (low, high), truth in zip(intervals, rates, strict=True)]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.01)


# How many


def test_as_many_pairs_as_are_asked_for_find_the_difference_in_80_of_100() -> None:
    shares = (0.6, 0.15, 0.05, 0.2)
    n = episodes_to_tell_apart(PairedCounts(600, 150, 50, 200))
    assert n is not None
    found = [table.p_value < 0.05 for table in drawn(n, shares, 4000)]
    assert np.mean(found) == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize(
    ("counts", "level", "n"),
    [
        (PairedCounts(0, 0, 1, 0), 0.05, 6),  # 2 / 2^6 is the first below 0.05
        (PairedCounts(0, 4, 0, 0), 0.05, 6),
        (PairedCounts(0, 0, 4, 0), 0.05 / 11, 9),  # 2 / 2^9 is the first below 0.05 / 11
        # every second pair differs, to one side: six or more do in 0.788 of 14 pairs, in 0.849 of 15
        (PairedCounts(1, 0, 1, 0), 0.05, 15),
        (PairedCounts(5, 3, 3, 1), 0.05, None),
        (PairedCounts(10**7, 1, 0, 0), 0.05, None),  # more than is asked of anybody
    ],
)
def test_the_number_of_pairs_is_that_of_the_exact_test(
    counts: PairedCounts, level: float, n: int | None
) -> None:
    assert episodes_to_tell_apart(counts, level) == n


@pytest.mark.parametrize(
    "counts", [PairedCounts(3, 3, 1, 3), PairedCounts(20, 9, 2, 9), PairedCounts(0, 7, 2, 1)]
)
def test_one_pair_less_is_too_few(counts: PairedCounts) -> None:
    def power(n: int) -> float:
        """Return the power over every outcome of n pairs."""
        share, second = 1 - (counts.both + counts.neither) / counts.n, counts.only_second
        second = second / (counts.only_first + counts.only_second)
        return sum(
            float(binom.pmf(m, n, share) * binom.pmf(k, m, second))
            for m in range(n + 1)
            for k in range(m + 1)
            if mcnemar_p_value(m - k, k) < 0.05
        )

    n = episodes_to_tell_apart(counts)
    assert n is not None and power(n) >= 0.8 > power(n - 1)
