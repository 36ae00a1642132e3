"""Means of a field over episodes, as text."""

from collections.abc import Sequence

import numpy as np

from lerobot_bomb.bootstrap import bootstrap_interval, format_bounds, sums_by
from lerobot_bomb.results.record import NO_VALUE, Measure, Record


def mean_measure(field: str, name: str, note: str = "") -> Measure:
    """Measure the mean of a field: '0.440 [0.210, 0.670]', with a 95 % bootstrap interval over starts."""

    def value(records: Sequence[Record]) -> str:
        told = [each for each in records if getattr(each, field) is not None]
        if not told:
            return NO_VALUE
        values_N = np.array([getattr(each, field) for each in told])
        sums_E, counts_E = sums_by(values_N, [each.start_key for each in told])
        interval = bootstrap_interval(sums_E, counts_E)
        return f"{sums_E.sum() / counts_E.sum():.3f}{format_bounds(interval, '.3f')}"

    return Measure(name, value, note)
