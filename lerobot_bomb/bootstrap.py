"""Bootstrap intervals over episodes, of means and of their slopes over levels.

The draws are always the same. Shapes: `R` frames, `E` episodes, `N` values, `M` sums of each episode.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from lerobot_bomb.stats import Z_95

NUM_RESAMPLES = 2000
NUM_BCA_RESAMPLES = 9999
MAX_DRAWS = 2**20  # that are in memory at once
ROUNDING = 1e-9  # that makes no two numbers different


def bootstrap_interval(sums_E: np.ndarray, counts_E: np.ndarray) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of sum / count over E episodes.

    None for fewer than two episodes, or if all means are equal: resampling tells nothing about them. Episodes
    are drawn, not frames, because an episode's frames resemble each other.
    """
    if _is_constant(sums_E, counts_E):
        return None
    return _percentiles(_resampled_means(sums_E, counts_E, NUM_RESAMPLES))


def paired_bootstrap_interval(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the second mean minus the first, drawn together as pairs.

    Each argument is (sums_E, counts_E). None for fewer than two pairs, or if all differences are equal.
    """
    if len(first[0]) < 2 or _are_equal(second[0] / second[1] - first[0] / first[1]):
        return None
    return _percentiles(_resampled_means(*second, NUM_RESAMPLES) - _resampled_means(*first, NUM_RESAMPLES))


def bca_interval(sums_E: np.ndarray, counts_E: np.ndarray) -> tuple[float, float] | None:
    """95 % bootstrap interval of sum / count over E episodes, corrected for bias and skew.

    None for fewer than two episodes, or if all means are equal.
    Source: Efron (1987), "Better bootstrap confidence intervals" (BCa).
    """
    if _is_constant(sums_E, counts_E):
        return None
    means = _resampled_means(sums_E, counts_E, NUM_BCA_RESAMPLES)
    mean = sums_E.sum() / counts_E.sum()
    without_E = (sums_E.sum() - sums_E) / (counts_E.sum() - counts_E)
    deviations_E = without_E.mean() - without_E
    skew = (deviations_E**3).sum() / (6 * (deviations_E**2).sum() ** 1.5)
    normal = NormalDist()
    bias = normal.inv_cdf(((means < mean).mean() + (means <= mean).mean()) / 2)
    shares = [normal.cdf(bias + (bias + z) / (1 - skew * (bias + z))) for z in (-Z_95, Z_95)]
    low, high = np.quantile(means, shares)
    return float(low), float(high)


@dataclass(frozen=True)
class Slope:
    """Least-squares slope of a value over levels, with its 95 % interval unless all resamples agree."""

    per_level: float
    low: float | None
    high: float | None


def fit_slope(levels_N: np.ndarray, values_N: np.ndarray, episode_N: np.ndarray) -> Slope | None:
    """Fit the slope of N values over their levels, by least squares; None where all levels are the same.

    `episode_N` names each value's episode, which may have several conditions: the percentile bootstrap draws
    episodes.
    """
    if np.ptp(levels_N) == 0:
        return None
    episodes, of_N = np.unique(episode_N, return_inverse=True)
    moments_NM = np.stack(
        [np.ones(len(levels_N)), levels_N, values_N, levels_N**2, levels_N * values_N], axis=1
    )
    sums_EM = np.zeros((len(episodes), moments_NM.shape[1]))
    np.add.at(sums_EM, of_N, moments_NM)
    drawn = _least_squares(_resampled_sums(sums_EM, NUM_RESAMPLES))
    low, high = _percentiles(drawn[np.isfinite(drawn)]) or (None, None)
    return Slope(float(_least_squares(sums_EM.sum(axis=0))), low, high)


def _least_squares(moments: np.ndarray) -> np.ndarray:
    """Slopes from (..., 5) sums of 1, x, y, x^2, xy; not finite where all x are the same."""
    n, x, y, xx, xy = np.moveaxis(moments, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (n * xy - x * y) / (n * xx - x**2)


def variance_share(values_N: np.ndarray, levels_N: np.ndarray) -> float | None:
    """Share of the values' variance that the level alone explains: its first-order sensitivity index.

    It is corrected for the number of levels, so it is 0 on average where the level has no effect, and can be
    negative. None if undefined: all values or all levels are the same.
    Source: epsilon squared, Kelley (1935), "An unbiased correlation ratio measure".
    """
    total = float(((values_N - values_N.mean()) ** 2).sum())
    groups = [values_N[levels_N == level] for level in np.unique(levels_N)]
    num_within = len(values_N) - len(groups)
    if total == 0 or len(groups) < 2 or num_within == 0:
        return None
    within = float(sum(((group - group.mean()) ** 2).sum() for group in groups))
    return 1 - within / num_within / (total / (len(values_N) - 1))


@dataclass(frozen=True)
class Estimate:
    """A mean over frames and its 95 % bootstrap interval over episodes; no interval for one episode."""

    mean: float
    low: float | None
    high: float | None

    @classmethod
    def of(cls, sums_E: np.ndarray, counts_E: np.ndarray) -> "Estimate":
        """Estimate sum / count over E episodes."""
        low, high = bootstrap_interval(sums_E, counts_E) or (None, None)
        return cls(float(sums_E.sum() / counts_E.sum()), low, high)

    def __str__(self) -> str:
        return self.text(".4g")

    def text(self, form: str) -> str:
        """Return '0.44 [0.21, 0.67]', or the mean alone, in a format."""
        interval = "" if self.low is None else f" [{self.low:{form}}, {self.high:{form}}]"
        return f"{self.mean:{form}}{interval}"


def estimate_mean(values_RX: np.ndarray, episode_R: np.ndarray) -> Estimate:
    """Estimate the mean of all finite numbers (R, ...), each with the same weight."""
    values_RX = values_RX.reshape(len(episode_R), -1)
    counts_RX = np.isfinite(values_RX)
    episodes_E, place_R = np.unique(episode_R, return_inverse=True)
    sums_E, counts_E = np.zeros(len(episodes_E)), np.zeros(len(episodes_E))
    np.add.at(sums_E, place_R, np.where(counts_RX, values_RX, 0.0).sum(axis=1))
    np.add.at(counts_E, place_R, counts_RX.sum(axis=1))
    counted = counts_E > 0
    return Estimate.of(sums_E[counted], counts_E[counted])


def _is_constant(sums_E: np.ndarray, counts_E: np.ndarray) -> bool:
    """Return True if there are fewer than two episodes, or all have one mean."""
    return len(sums_E) < 2 or _are_equal(sums_E / counts_E)


def _are_equal(values: np.ndarray) -> bool:
    """Return True if all are equal up to rounding: resampling them tells nothing."""
    return bool(np.ptp(values) <= ROUNDING * np.abs(values).max())


def _resampled_means(sums_E: np.ndarray, counts_E: np.ndarray, number: int) -> np.ndarray:
    """Return (number,) resampled means, with the same draws for the same E."""
    sums = _resampled_sums(np.stack([sums_E, counts_E], axis=1), number)
    return sums[:, 0] / sums[:, 1]


def _resampled_sums(values_EM: np.ndarray, number: int) -> np.ndarray:
    """(number, M) sums over E episodes drawn with replacement, few draws in memory at once."""
    num_episodes, num_sums = values_EM.shape
    rng = np.random.default_rng(0)
    sums = np.empty((number, num_sums))
    columns = [np.ascontiguousarray(column) for column in values_EM.T]
    at_once = max(1, MAX_DRAWS // num_episodes)
    for start in range(0, number, at_once):
        draws = rng.integers(num_episodes, size=(min(at_once, number - start), num_episodes))
        for place, column in enumerate(columns):
            is_constant = (column == column[0]).all()
            drawn = column[0] * num_episodes if is_constant else column[draws].sum(axis=1)
            sums[start : start + len(draws), place] = drawn
    return sums


def _percentiles(means: np.ndarray) -> tuple[float, float] | None:
    """Return the 2.5th and 97.5th percentile; None if all are the same, or there is none."""
    if not len(means) or _are_equal(means):
        return None
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
