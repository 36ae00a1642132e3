import numpy as np
import pytest

from lerobot_bomb.stats import (
    bootstrap_interval,
    format_rate,
    mcnemar_p_value,
    paired_bootstrap_interval,
    wilson_interval,
)


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
