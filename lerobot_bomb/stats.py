"""Intervals and tests for success rates.

Shapes: `N` records, `C` clusters of records that are not independent, as those of one seed.
"""

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Z_95 = NormalDist().inv_cdf(0.975)
SIGNIFICANT = 0.05  # two-sided
SMALLEST_P = 1e-99  # that is shown
POWER = 0.8  # of the number of pairs that is advised
MAX_PAIRS = 2**20  # that are advised


def sums_by(values_N: ArrayLike, cluster_N: Sequence[Hashable]) -> tuple[np.ndarray, np.ndarray]:
    """Sum and count values by cluster: (sums_C, counts_C)."""
    places: dict[Hashable, int] = {}
    place_N = [places.setdefault(cluster, len(places)) for cluster in cluster_N]
    return np.bincount(place_N, weights=np.asarray(values_N)), np.bincount(place_N).astype(float)


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval (low, high) of a binomial proportion, in [0, 1].

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: unless 0 <= successes <= n and n >= 1.
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"need 0 <= successes <= n and n >= 1, got successes={successes}, n={n}")
    return _wilson(successes / n, n, Z_95)


def _wilson(rate: float, n: float, z: float) -> tuple[float, float]:
    center = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    # the rate lies in the interval, which rounding may forget where it is 0 or 1
    return min(rate, max(0.0, center - half)), max(rate, min(1.0, center + half))


def clustered_interval(successes_C: np.ndarray, counts_C: np.ndarray) -> tuple[float, float] | None:
    """Return the 95 % interval of a proportion over clustered records; None for one cluster of several.

    It is Wilson's interval of the effective number of independent records, which lies between the numbers of
    clusters and records, with Student's t for the number of clusters. For clusters of one record each, it is
    Wilson's interval itself; where all records count or none, that of the clusters.
    Source: Dean and Pagano (2015), "Evaluating confidence interval methods for binomial proportions in
    clustered surveys".
    """
    rate = float(successes_C.sum() / counts_C.sum())
    effective = _effective_number(successes_C, counts_C, rate * (1 - rate))
    return None if effective is None else _wilson(rate, *effective)


def _effective_number(
    sums_C: np.ndarray, counts_C: np.ndarray, variance: float
) -> tuple[float, float] | None:
    """Return the effective number of independent records, and the quantile for a 95 % interval.

    The values of a cluster's records have these sums, those of all records this variance. None for one
    cluster of several records.
    """
    num_clusters, n = len(counts_C), int(counts_C.sum())
    if num_clusters == n:
        return n, Z_95
    if num_clusters == 1:
        return None
    if variance == 0:  # nothing tells how alike the records of a cluster are: as if they were one
        return num_clusters, Z_95
    from scipy.special import stdtrit

    deviations_C = sums_C - sums_C.sum() / n * counts_C
    spread = (deviations_C**2).sum() * num_clusters / (num_clusters - 1)
    number = n**2 * variance / spread if spread > 0 else n
    return float(min(max(number, num_clusters), n)), float(stdtrit(num_clusters - 1, 0.975))


def format_bounds(interval: tuple[float, float] | None, form: str, unit: float = 1) -> str:
    """Format an interval as ' [low, high]', times a unit; '' without one."""
    return "" if interval is None else f" [{unit * interval[0]:{form}}, {unit * interval[1]:{form}}]"


@dataclass(frozen=True)
class Rate:
    """Share of n records that count, such as successes, with its 95 % interval."""

    successes: int
    n: int
    num_clusters: int  # of records that are not independent; n: all are
    interval: tuple[float, float] | None

    @classmethod
    def of(cls, is_counted_N: Sequence[bool], cluster_N: Sequence[Hashable]) -> "Rate":
        """Compute the rate of one or more records; those of one cluster are not independent."""
        successes_C, counts_C = sums_by(is_counted_N, cluster_N)
        interval = clustered_interval(successes_C, counts_C)
        return cls(int(successes_C.sum()), len(is_counted_N), len(counts_C), interval)

    @property
    def share(self) -> float:
        return self.successes / self.n

    @property
    def method(self) -> str:
        """Name of the interval, or why there is none."""
        if self.interval is None:
            return "no interval: all are of one seed"
        clusters = f", {self.num_clusters} clusters by seed" if self.num_clusters < self.n else ""
        return f"95 % Wilson interval{clusters}"

    @property
    def percent(self) -> str:
        """Text '96.0 % [86.5, 98.9]'."""
        return self._percent(".1f")

    @property
    def whole_percent(self) -> str:
        """Text '96 % [86, 99]'."""
        return self._percent(".0f")

    def _percent(self, form: str) -> str:
        return f"{100 * self.share:{form}} %{format_bounds(self.interval, form, 100)}"

    def __str__(self) -> str:
        """Format as '48/50 = 96.0 % [86.5, 98.9]'."""
        return f"{self.successes}/{self.n} = {self.percent}"


def format_rate(successes: int, n: int) -> str:
    """Format count, rate and 95 % Wilson interval of independent records: '48/50 = 96.0 % [86.5, 98.9]'."""
    return str(Rate(successes, n, n, wilson_interval(successes, n)))


def mcnemar_p_value(only_first: int, only_second: int) -> float:
    """Two-sided exact p-value of the hypothesis that both groups of paired episodes succeed equally often.

    In a pair with a single success, either group has it with probability 1/2 (McNemar, 1947).
    """
    from scipy.special import bdtr

    return min(1.0, 2 * float(bdtr(min(only_first, only_second), only_first + only_second, 0.5)))


def fisher_p_value(first: int, of_first: int, second: int, of_second: int) -> float:
    """Two-sided exact p-value of the hypothesis that two unpaired groups succeed equally often."""
    from scipy.stats import fisher_exact

    found: Any = fisher_exact([[first, of_first - first], [second, of_second - second]])
    return float(found.pvalue)


def format_p(p_value: float) -> str:
    """Format as 'p = 0.031', never 'p = 0'."""
    return f"p = {p_value:.2g}" if p_value >= SMALLEST_P else f"p < {SMALLEST_P:g}"


def points_format(difference: float) -> str:
    """Return the format of a difference of rates in percentage points: a decimal for less than one point."""
    return ".1f" if 0 < abs(difference) < 0.01 else ".0f"


@dataclass(frozen=True)
class PairedCounts:
    """Counts of paired episodes by which of the two groups succeeded."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @classmethod
    def of(cls, first_E: Sequence[bool], second_E: Sequence[bool]) -> "PairedCounts":
        """Count the outcomes of the same episodes in two groups."""
        pairs = Counter(zip(first_E, second_E, strict=True))
        return cls(*(pairs[pair] for pair in ((True, True), (True, False), (False, True), (False, False))))

    @property
    def n(self) -> int:
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def first(self) -> int:
        """Successes of the first group."""
        return self.both + self.only_first

    @property
    def second(self) -> int:
        """Successes of the second group."""
        return self.both + self.only_second

    @property
    def difference(self) -> float:
        """Second group's rate minus the first one's."""
        return (self.only_second - self.only_first) / self.n

    @property
    def p_value(self) -> float:
        """P-value of the exact McNemar test, not adjusted."""
        return mcnemar_p_value(self.only_first, self.only_second)


def paired_difference_interval(
    counts: PairedCounts, number: float | None = None, z: float = Z_95
) -> tuple[float, float]:
    """Return the 95 % interval of the second rate minus the first, in [-1, 1]; also for one pair.

    `number`: the effective number of independent pairs, with its quantile `z`; by default, all are.
    Source: Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions
    based on paired data", method 10: Wilson's intervals of both rates, joined by their correlation.
    """
    n, first, second = counts.n, counts.first, counts.second
    number = n if number is None else number
    rate_1, rate_2 = first / n, second / n
    (low_1, high_1), (low_2, high_2) = _wilson(rate_1, number, z), _wilson(rate_2, number, z)
    margins = first * second * (n - first) * (n - second)
    excess = counts.both * counts.neither - counts.only_first * counts.only_second
    if excess > 0:  # corrected for continuity, not beyond 0
        excess = max(0.0, excess - n**2 / number / 2)
    correlation = excess / sqrt(margins) if margins else 0.0

    def half(a: float, b: float) -> float:
        return sqrt(max(0.0, a**2 - 2 * correlation * a * b + b**2))

    low = half(rate_2 - low_2, high_1 - rate_1)
    high = half(high_2 - rate_2, rate_1 - low_1)
    return counts.difference - low, counts.difference + high


def clustered_difference_interval(
    counts: PairedCounts, differences_N: Sequence[int], cluster_N: Sequence[Hashable]
) -> tuple[float, float] | None:
    """Return the 95 % interval of the second rate minus the first; None for one cluster of several pairs.

    `differences_N` is 1 for a pair in which only the second succeeded, -1 for only the first, else 0. The
    interval is that of the effective number of independent pairs, as in `clustered_interval`. Unlike the
    bootstrap over clusters, it holds the truth in 95 of 100 cases for few clusters, too.
    """
    sums_C, counts_C = sums_by(differences_N, cluster_N)
    discordant = (counts.only_first + counts.only_second) / counts.n
    effective = _effective_number(sums_C, counts_C, discordant - counts.difference**2)
    return None if effective is None else paired_difference_interval(counts, *effective)


def episodes_to_tell_apart(counts: PairedCounts, level: float = SIGNIFICANT) -> int | None:
    """Return how many pairs the exact McNemar test needs to find a difference as large as the observed one.

    It has this level and a power of 80 %. None if no difference was observed, or `MAX_PAIRS` are too few.
    """
    if counts.only_first == counts.only_second:
        return None
    enough = 1
    while _power(enough, counts, level) < POWER:
        enough *= 2
        if enough > MAX_PAIRS:
            return None
    too_few = enough // 2
    while enough - too_few > 1:
        middle = (too_few + enough) // 2
        if _power(middle, counts, level) < POWER:
            too_few = middle
        else:
            enough = middle
    return enough


def _power(n: int, counts: PairedCounts, level: float) -> float:
    """Probability that the exact McNemar test of n pairs, drawn with these shares, has p below `level`."""
    from scipy.stats import binom

    num_discordant = counts.only_first + counts.only_second
    discordant, second = num_discordant / counts.n, counts.only_second / num_discordant
    low, high = binom.ppf([1e-12, 1 - 1e-12], n, discordant)  # the other numbers hardly ever come
    drawn = np.arange(low, high + 1)
    # the most pairs for the rarer side with which the test rejects; -1: it cannot
    critical = binom.ppf(level / 2, drawn, 0.5) - 1
    rejects = binom.cdf(critical, drawn, second) + binom.cdf(critical, drawn, 1 - second)
    return float((binom.pmf(drawn, n, discordant) * rejects).sum())


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust the p-values of a family of tests, so that it errs in 5 % of cases at most (Holm, 1979)."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    adjusted, largest = [0.0] * len(p_values), 0.0
    for place, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - place) * p_values[i]))
        adjusted[i] = largest
    return adjusted
