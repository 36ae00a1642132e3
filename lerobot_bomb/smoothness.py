"""Smoothness of executed actions, by their second and third differences.

FDVLA's "jerk" is an "average second-order difference", of unknown norm and units: compare variants of a
policy, not numbers with the paper's. Shapes: `R` executed actions of all episodes, `D` action dims.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bootstrap import Estimate, estimate_mean

MIN_ACTIONS = 4  # that a third difference takes


@dataclass(frozen=True)
class Smoothness:
    """Mean Euclidean norms of differences over consecutive actions."""

    j2: Estimate  # of a[t+1] - 2 a[t] + a[t-1]: acceleration, where actions are positions
    j3: Estimate  # of a[t+2] - 3 a[t+1] + 3 a[t] - a[t-1]: jerk


def smoothness(
    actions_RD: np.ndarray,
    episode_R: np.ndarray,
    *,
    start_R: np.ndarray | None = None,
    exclude: Collection[int] = (),
    std_D: np.ndarray | None = None,
    dt_s: float | None = None,
) -> Smoothness:
    """Measure how smooth the executed actions of whole episodes are, seams between chunks included.

    Args:
        actions_RD: in the data's units, in order of time.
        episode_R: the episode of each action; one episode's actions follow each other.
        start_R: the start of each action's episode; episodes with the same one are drawn together. By default
            each is alone.
        exclude: dims that do not count, such as a gripper.
        std_D: the data's standard deviation, for normalised units.
        dt_s: seconds between actions, for units per s^2 and per s^3; otherwise per step.

    Raises:
        ValueError: no dim is left or one is unknown, a standard deviation is not positive, an episode's
            actions do not follow each other, or no episode has the four that a third difference takes.
    """
    num_dims = actions_RD.shape[1]
    if unknown := sorted(set(exclude) - set(range(num_dims))):
        raise ValueError(f"exclude has {unknown}, but actions have the dims 0 to {num_dims - 1}")
    dims = [dim for dim in range(num_dims) if dim not in exclude]
    if not dims:
        raise ValueError(f"exclude leaves none of the {num_dims} action dims")
    if np.count_nonzero(np.diff(episode_R)) + 1 != len(np.unique(episode_R)):
        raise ValueError("the actions of an episode must follow each other")
    actions_RD = actions_RD[:, dims].astype(np.float64)
    if std_D is not None:
        if not (std_D[dims] > 0).all():
            raise ValueError(f"std_D={std_D.tolist()} must be positive in the dims {dims}")
        actions_RD = actions_RD / std_D[dims]
    step = 1.0 if dt_s is None else dt_s
    start_R = episode_R if start_R is None else start_R
    return Smoothness(*(_mean_difference(actions_RD, episode_R, start_R, order, step) for order in (2, 3)))


def _mean_difference(
    actions_RD: np.ndarray, episode_R: np.ndarray, start_R: np.ndarray, order: int, step: float
) -> Estimate:
    """Estimate the mean norm of the differences that lie within an episode."""
    within = episode_R[order:] == episode_R[:-order]
    if not within.any():
        raise ValueError(f"no episode has {order + 1} actions, as a difference of order {order} takes")
    norms = np.linalg.norm(np.diff(actions_RD, n=order, axis=0), axis=1) / step**order
    return estimate_mean(norms[within], start_R[order:][within])
