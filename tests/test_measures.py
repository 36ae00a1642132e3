import numpy as np
import pytest

from lerobot_bomb.bootstrap import estimate_mean
from lerobot_bomb.evaluation.measures import measure_l1


def test_padded_steps_do_not_count() -> None:
    recorded = np.zeros((2, 3, 2))
    predicted = np.array([[[1, 3], [100, 100], [100, 100]], [[2, 2], [4, 0], [100, 100]]], dtype=float)
    is_pad = np.array([[False, True, True], [False, False, True]])
    l1 = measure_l1(predicted, recorded, is_pad, np.array([0, 1]), ["x", "y"])
    assert l1.all.mean == 12 / 6
    assert {name: estimate.mean for name, estimate in l1.dims.items()} == {"x": 7 / 3, "y": 5 / 3}
    assert [estimate.mean for estimate in l1.steps] == [2.0, 2.0]


def test_the_interval_draws_episodes_not_frames() -> None:
    values, episodes = np.array([0.0] * 50 + [1.0] * 50), np.array([0] * 50 + [1] * 50)
    found = estimate_mean(values, episodes)
    assert (found.mean, found.low, found.high) == (0.5, 0.0, 1.0)  # two episodes tell next to nothing
    alone = estimate_mean(values[:50], episodes[:50])
    assert (alone.mean, alone.low, alone.high) == (0.0, None, None)
    many = estimate_mean(values, np.arange(100))
    assert many.low == pytest.approx(0.4, abs=0.02)  # 0.5 - 1.96 * 0.05
    assert many.high == pytest.approx(0.6, abs=0.02)


def test_a_frame_counts_as_often_as_it_has_numbers() -> None:
    values = np.array([[1.0, 1.0], [4.0, np.nan], [np.nan, np.nan]])
    assert estimate_mean(values, np.array([0, 1, 2])).mean == 2.0
