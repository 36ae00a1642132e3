"""Exact statistics in place of LeRobot's histograms, which take half of a recording's time."""

from typing import Any

import numpy as np
from lerobot.datasets.compute_stats import RunningQuantileStats

from lerobot_bomb.data.statistics import QUANTILES, Statistics, exact_statistics


class ExactStats(RunningQuantileStats):
    """LeRobot's statistics of an episode, computed from all values: bytes are counted, numbers kept."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._counts_CV: np.ndarray | None = None  # how often each channel has each value
        self._batches: list[np.ndarray] = []

    def update(self, batch: np.ndarray) -> None:
        """Add a batch of vectors, (..., D)."""
        batch_ND = batch.reshape(-1, batch.shape[-1])
        if batch.dtype == np.uint8:
            counts_CV = np.stack([np.bincount(values_N, minlength=256) for values_N in batch_ND.T])
            self._counts_CV = counts_CV if self._counts_CV is None else self._counts_CV + counts_CV
        else:
            self._batches.append(batch_ND)

    def get_statistics(self) -> Statistics:
        """Return (D,) min, max, mean, std and quantiles, and (1,) count."""
        if self._counts_CV is not None:
            return counted_statistics(self._counts_CV)
        return exact_statistics(np.concatenate(self._batches))


def counted_statistics(counts_CV: np.ndarray) -> Statistics:
    """(C, 256) numbers of pixels by channel and value -> (C,) min, max, mean, std and quantiles, (1,) count.

    A quantile is the smallest value that this share of the pixels does not exceed.
    """
    values_V, count = np.arange(256.0), counts_CV[0].sum()
    shares_CV, up_to_CV = counts_CV / count, counts_CV.cumsum(axis=1)

    def smallest(num_pixels: float) -> np.ndarray:
        return (up_to_CV < num_pixels).sum(axis=1).astype(np.float64)

    mean_C = shares_CV @ values_V
    return {
        "min": smallest(1),
        "max": smallest(count),
        "mean": mean_C,
        "std": np.sqrt((shares_CV * (values_V - mean_C[:, None]) ** 2).sum(axis=1)),
        "count": np.array([count]),
        **{name: smallest(share * count) for name, share in QUANTILES.items()},
    }
