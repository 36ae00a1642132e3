"""Figures of episodes beside their rate of success."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_bomb.bootstrap import Estimate
from lerobot_bomb.stats import sums_by


@dataclass(frozen=True)
class Measure:
    """A figure of episodes beside their rate of success."""

    name: str
    value: Callable[[Sequence[Any]], str | None]  # of records, with its unit; None: they do not have it
    note: str = ""  # what it is of


def mean_measure(field: str, name: str, note: str = "") -> Measure:
    """Measure the mean of a field: '0.440 [0.210, 0.670]', with a 95 % bootstrap interval over starts."""

    def value(records: Sequence[Any]) -> str | None:
        told = [each for each in records if getattr(each, field) is not None]
        if not told:
            return None
        values_N = np.array([getattr(each, field) for each in told])
        return Estimate.of(*sums_by(values_N, [each.start_key for each in told])).text(".3f")

    return Measure(name, value, note)
