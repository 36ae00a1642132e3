"""Means over recorded frames with intervals over their episodes.

Shapes: `R` frames, `T` actions of a chunk, `D` action dims, `E` episodes.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_bomb.stats import bootstrap_interval


@dataclass(frozen=True)
class Measure:
    """A mean over frames and its 95 % bootstrap interval over episodes; no interval of one episode."""

    mean: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        interval = "" if self.low is None else f" [{self.low:.4g}, {self.high:.4g}]"
        return f"{self.mean:.4g}{interval}"


@dataclass(frozen=True)
class L1:
    """Mean absolute error of actions in the dataset's units: of all, by dimension, by step of the chunk."""

    all: Measure
    dims: dict[str, Measure]
    steps: list[Measure]


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


def measure_l1(
    chunks_RTD: np.ndarray,
    recorded_RTD: np.ndarray,
    is_pad_RT: np.ndarray,
    episode_R: np.ndarray,
    dim_names: list[str],
) -> L1:
    """L1 of predicted chunks; steps beyond an episode's end do not count.

    A step of the chunk that lies beyond the end for every frame is left out, and those after it.
    """
    errors_RTD = np.abs(chunks_RTD.astype(np.float64) - recorded_RTD)
    errors_RTD[is_pad_RT] = np.nan
    num_steps = int((~is_pad_RT).any(axis=0).sum())
    return L1(
        all=measure(errors_RTD, episode_R),
        dims={name: measure(errors_RTD[..., i], episode_R) for i, name in enumerate(dim_names)},
        steps=[measure(errors_RTD[:, step], episode_R) for step in range(num_steps)],
    )
