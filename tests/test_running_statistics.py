"""Statistics of episodes: exact, and those of LeRobot's own class within what its histograms lose."""

import numpy as np
import pytest
from lerobot.datasets.compute_stats import RunningQuantileStats

from lerobot_bomb.data.running_statistics import ExactStats
from lerobot_bomb.data.statistics import QUANTILES


def batches(dtype: str) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    values = rng.normal([90, 120, 200], [10, 40, 30], (3, 4, 500, 3)).clip(0, 255)
    return [*values.astype(dtype)]


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_statistics_of_several_batches(dtype: str) -> None:
    exact, stock = ExactStats(), RunningQuantileStats()
    for batch in batches(dtype):
        exact.update(batch)
        stock.update(batch)
    found, usual = exact.get_statistics(), stock.get_statistics()
    values = np.concatenate(batches(dtype)).reshape(-1, 3).astype(np.float64)
    method = "inverted_cdf" if dtype == "uint8" else "linear"
    expected = {
        **{name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")},
        **{name: np.quantile(values, share, axis=0, method=method) for name, share in QUANTILES.items()},
        "count": [6000],
    }
    assert found.keys() == usual.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-12, err_msg=name)
        # LeRobot's float32 sums, its 5000 bins, and the gaps between 6000 numbers
        np.testing.assert_allclose(value, usual[name], rtol=1e-2, atol=0.1, err_msg=name)
