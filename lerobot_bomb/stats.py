"""Intervals and tests for success rates, and intervals for means over episodes.

Shapes: `R` frames, `E` episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, comb, sqrt
from statistics import NormalDist

import numpy as np

NUM_RESAMPLES = 2000
NUM_BCA_RESAMPLES = 9999
Z_95 = NormalDist().inv_cdf(0.975)
POWER = 0.8  # of the numbers of episodes that are asked for


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """(low, high) of a binomial proportion at 95 %, each in [0, 1].

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: unless 0 <= successes <= n and n >= 1.
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"need 0 <= successes <= n and n >= 1, got successes={successes}, n={n}")
    rate = successes / n
    center = (rate + Z_95**2 / (2 * n)) / (1 + Z_95**2 / n)
    half = Z_95 / (1 + Z_95**2 / n) * sqrt(rate * (1 - rate) / n + Z_95**2 / (4 * n**2))
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


@dataclass(frozen=True)
class PairedCounts:
    """How often which arm of paired episodes succeeded."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @classmethod
    def of(cls, first_E: Sequence[bool], second_E: Sequence[bool]) -> "PairedCounts":
        """From the successes of the same episodes."""
        pairs = list(zip(first_E, second_E, strict=True))
        return cls(
            *(pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False)))
        )

    @property
    def n(self) -> int:
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def first(self) -> int:
        """Successes of the first arm."""
        return self.both + self.only_first

    @property
    def second(self) -> int:
        """Successes of the second arm."""
        return self.both + self.only_second

    @property
    def difference(self) -> float:
        """The second arm's rate minus the first one's."""
        return (self.only_second - self.only_first) / self.n

    @property
    def p_value(self) -> float:
        """Of the exact McNemar test."""
        return mcnemar_p_value(self.only_first, self.only_second)


def paired_difference_interval(counts: PairedCounts) -> tuple[float, float]:
    """95 % interval of the second rate minus the first, in [-1, 1]; of one episode, too.

    Source: Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions
    based on paired data", method 10: Wilson's intervals of both rates, joined by their correlation.

    Raises:
        ValueError: there are no pairs.
    """
    n, first, second = counts.n, counts.first, counts.second
    (low_1, high_1), (low_2, high_2) = wilson_interval(first, n), wilson_interval(second, n)
    rate_1, rate_2 = first / n, second / n
    margins = first * second * (n - first) * (n - second)
    excess = counts.both * counts.neither - counts.only_first * counts.only_second
    if excess > 0:  # corrected for continuity, not beyond 0
        excess = max(0.0, excess - n / 2)
    correlation = excess / sqrt(margins) if margins else 0.0

    def half(a: float, b: float) -> float:
        return sqrt(max(0.0, a**2 - 2 * correlation * a * b + b**2))

    low = half(rate_2 - low_2, high_1 - rate_1)
    high = half(high_2 - rate_2, rate_1 - low_1)
    return counts.difference - low, counts.difference + high


def episodes_to_tell_apart(counts: PairedCounts) -> int | None:
    """Pairs of episodes in which a difference as large as the one that was seen is found significant.

    At a level of 5 %, two-sided, with a power of 80 %; None where no difference was seen.
    Source: Miettinen (1968), "The matched pairs design in the case of all-or-none responses", large samples.
    """
    if counts.difference == 0:
        return None
    discordant = (counts.only_first + counts.only_second) / counts.n
    z_power = NormalDist().inv_cdf(POWER)
    spread = Z_95 * sqrt(discordant) + z_power * sqrt(discordant - counts.difference**2)
    return ceil((spread / counts.difference) ** 2)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for as many tests (Holm, 1979): that of a family of which none may err at 5 %."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    adjusted, largest = [0.0] * len(p_values), 0.0
    for place, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - place) * p_values[i]))
        adjusted[i] = largest
    return adjusted


def bca_interval(values_E: np.ndarray) -> tuple[float, float] | None:
    """95 % bootstrap interval of a mean over E episodes, corrected for bias and skew (BCa, Efron 1987).

    None for fewer than two; the draws are always the same.
    """
    if len(values_E) < 2:
        return None
    if np.ptp(values_E) == 0:  # the correction for skew is not defined
        return float(values_E[0]), float(values_E[0])
    from scipy.stats import bootstrap  # half a second, which the simulators' workers do not need

    rng = np.random.default_rng(0)
    interval = bootstrap((values_E,), np.mean, n_resamples=NUM_BCA_RESAMPLES, method="BCa", rng=rng)
    return float(interval.confidence_interval.low), float(interval.confidence_interval.high)


def bootstrap_interval(sums_E: np.ndarray, counts_E: np.ndarray) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of sum / count over E episodes.

    None for fewer than two, and where all are equal: resampling tells nothing of them. Episodes are drawn,
    not frames: the frames of one resemble each other. The draws are always the same.
    """
    if len(sums_E) < 2 or np.ptp(sums_E / counts_E) == 0:
        return None
    return _percentiles(_resampled_means(sums_E, counts_E))


@dataclass(frozen=True)
class Slope:
    """How much a value changes with a level, by least squares, with its 95 % interval."""

    per_level: float
    low: float
    high: float


def slope(levels_N: np.ndarray, values_N: np.ndarray, episode_N: np.ndarray) -> Slope | None:
    """Of N values over their levels; None where all levels are the same.

    `episode_N` says which values are of one episode under several conditions: the percentile bootstrap draws
    episodes, and the draws are always the same.
    """
    if np.ptp(levels_N) == 0:
        return None
    episodes, of_N = np.unique(episode_N, return_inverse=True)
    moments_NM = np.stack(
        [np.ones(len(levels_N)), levels_N, values_N, levels_N**2, levels_N * values_N], axis=1
    )
    sums_EM = np.zeros((len(episodes), moments_NM.shape[1]))
    np.add.at(sums_EM, of_N, moments_NM)
    draws = np.random.default_rng(0).integers(len(episodes), size=(NUM_RESAMPLES, len(episodes)))
    drawn = _least_squares(sums_EM[draws].sum(axis=1))
    low, high = _percentiles(drawn[np.isfinite(drawn)])
    return Slope(float(_least_squares(sums_EM.sum(axis=0))), low, high)


def _least_squares(moments: np.ndarray) -> np.ndarray:
    """Slopes from (..., 5) sums of 1, x, y, x^2, xy; not finite where all x are the same."""
    n, x, y, xx, xy = np.moveaxis(moments, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (n * xy - x * y) / (n * xx - x**2)


def variance_share(values_N: np.ndarray, levels_N: np.ndarray) -> float | None:
    """Share of the values' variance that the level alone explains: its first-order sensitivity index.

    Corrected for the number of levels, so that it is 0 on average where the level has no effect, and can be
    negative. None where it is not defined: all values or all levels are the same.
    Source: epsilon squared, Kelley (1935), "An unbiased correlation ratio measure".
    """
    total = float(((values_N - values_N.mean()) ** 2).sum())
    groups = [values_N[levels_N == level] for level in np.unique(levels_N)]
    num_within = len(values_N) - len(groups)
    if total == 0 or len(groups) < 2 or num_within == 0:
        return None
    within = float(sum(((of - of.mean()) ** 2).sum() for of in groups))
    return 1 - within / num_within / (total / (len(values_N) - 1))


def format_bounds(interval: tuple[float, float] | None, form: str) -> str:
    """' [low, high]', each in this form; nothing for a single episode."""
    return "" if interval is None else f" [{interval[0]:{form}}, {interval[1]:{form}}]"


def paired_bootstrap_interval(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float] | None:
    """The same of the second mean minus the first, (sums_E, counts_E) each, drawn together as pairs."""
    if len(first[0]) < 2:
        return None
    return _percentiles(_resampled_means(*second) - _resampled_means(*first))


@dataclass(frozen=True)
class Measure:
    """A mean over frames and its 95 % bootstrap interval over episodes; no interval of one episode."""

    mean: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        interval = "" if self.low is None else f" [{self.low:.4g}, {self.high:.4g}]"
        return f"{self.mean:.4g}{interval}"


def measure(values_RX: np.ndarray, episode_R: np.ndarray) -> Measure:
    """Mean of all finite numbers (R, ...); every one counts the same."""
    values_RX = values_RX.reshape(len(episode_R), -1)
    counts_RX = np.isfinite(values_RX)
    episodes_E, place_R = np.unique(episode_R, return_inverse=True)
    sums_E, counts_E = np.zeros(len(episodes_E)), np.zeros(len(episodes_E))
    np.add.at(sums_E, place_R, np.where(counts_RX, values_RX, 0.0).sum(axis=1))
    np.add.at(counts_E, place_R, counts_RX.sum(axis=1))
    counted = counts_E > 0
    low, high = bootstrap_interval(sums_E[counted], counts_E[counted]) or (None, None)
    return Measure(float(sums_E.sum() / counts_E.sum()), low, high)


def _resampled_means(sums_E: np.ndarray, counts_E: np.ndarray) -> np.ndarray:
    """(NUM_RESAMPLES,), with the same draws for the same E."""
    num_episodes = len(sums_E)
    draws = np.random.default_rng(0).integers(num_episodes, size=(NUM_RESAMPLES, num_episodes))
    return sums_E[draws].sum(axis=1) / counts_E[draws].sum(axis=1)


def _percentiles(means: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
