"""Intervals and tests for success rates, and intervals for means over episodes.

Shapes: `R` frames, `E` episodes.
"""

from dataclasses import dataclass
from math import comb, sqrt
from statistics import NormalDist

import numpy as np

NUM_RESAMPLES = 2000


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """(low, high) of a binomial proportion at 95 %, each in [0, 1].

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: unless 0 <= successes <= n and n >= 1.
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"need 0 <= successes <= n and n >= 1, got successes={successes}, n={n}")
    z = NormalDist().inv_cdf(0.975)
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


def bootstrap_interval(sums_E: np.ndarray, counts_E: np.ndarray) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of sum / count over E episodes; None for fewer than two.

    Episodes are drawn, not frames: the frames of one resemble each other. The draws are always the same.
    """
    return None if len(sums_E) < 2 else _percentiles(_resampled_means(sums_E, counts_E))


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
