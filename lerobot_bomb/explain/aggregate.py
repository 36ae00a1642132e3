"""Explanations of many episodes: which objects and words matter in which phase, with intervals.

An episode counts once in each phase that it has, by the moment in the middle of that phase.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bootstrap import bootstrap_interval


@dataclass(frozen=True)
class Mean:
    """Mean over episodes, with its bootstrap interval; one episode alone has none."""

    value: float
    interval: tuple[float, float] | None
    num_episodes: int


def mean_of(values: Sequence[float]) -> Mean | None:
    """Average the values that are numbers; None if there are none."""
    sample = np.array([value for value in values if np.isfinite(value)])
    if not len(sample):
        return None
    return Mean(float(sample.mean()), bootstrap_interval(sample, np.ones(len(sample))), len(sample))


def means_of(effects: Sequence[Mapping[str, float]]) -> dict[str, Mean]:
    """Average each effect by name, over the episodes that have it."""
    names = list(dict.fromkeys(name for each in effects for name in each))
    found = {name: mean_of([each[name] for each in effects if name in each]) for name in names}
    return {name: mean for name, mean in found.items() if mean is not None}
