"""Intervals and tests for success rates."""

from math import comb, sqrt
from statistics import NormalDist


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """(low, high) of a binomial proportion, each in [0, 1].

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: unless 0 <= successes <= n, n >= 1 and 0 < confidence < 1.
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"need 0 <= successes <= n and n >= 1, got successes={successes}, n={n}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence={confidence} must lie between 0 and 1")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / n
    center = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    return max(0.0, center - half), min(1.0, center + half)


def format_rate(successes: int, n: int) -> str:
    """'48/50 = 96.0 % [86.5, 98.9]': count, rate and its 95 % Wilson interval."""
    low, high = wilson_interval(successes, n)
    return f"{successes}/{n} = {100 * successes / n:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def mcnemar_p_value(only_first: int, only_second: int) -> float:
    """Two-sided exact p-value of the hypothesis that both arms of paired episodes succeed equally often.

    Given the pairs in which one arm alone succeeded, either is as likely as a coin's side (McNemar, 1947).
    """
    num_discordant = only_first + only_second
    tail = sum(comb(num_discordant, k) for k in range(min(only_first, only_second) + 1))
    return min(1.0, 2 * tail / 2**num_discordant)
