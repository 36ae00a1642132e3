"""L1 of predicted chunks on recorded frames, with intervals over their episodes.

Shapes: `R` frames, `T` actions of a chunk, `D` action dims, `E` episodes.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bootstrap import Estimate, estimate_mean


@dataclass(frozen=True)
class L1:
    """Mean absolute error of actions in the dataset's units: of all, by dimension, by step of the chunk."""

    all: Estimate
    dims: dict[str, Estimate]
    steps: list[Estimate]


def measure_l1(
    chunks_RTD: np.ndarray,
    recorded_RTD: np.ndarray,
    is_pad_RT: np.ndarray,
    episode_R: np.ndarray,
    dim_names: list[str],
) -> L1:
    """Measure the L1 of predicted chunks; steps beyond an episode's end do not count.

    A step of the chunk that lies beyond the end for every frame is left out, and those after it.
    """
    errors_RTD = np.abs(chunks_RTD.astype(np.float64) - recorded_RTD)
    errors_RTD[is_pad_RT] = np.nan
    num_steps = int((~is_pad_RT).any(axis=0).sum())
    return L1(
        all=estimate_mean(errors_RTD, episode_R),
        dims={name: estimate_mean(errors_RTD[..., i], episode_R) for i, name in enumerate(dim_names)},
        steps=[estimate_mean(errors_RTD[:, step], episode_R) for step in range(num_steps)],
    )
