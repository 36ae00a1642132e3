from typing import Any

import numpy as np
import pytest

from lerobot_bomb.smoothness import smoothness

PLANE = np.array([[0, 0], [1, 0], [2, 1], [3, 3], [3, 4]])  # second differences (0, 1), (0, 1), (-1, -1)
ONE = np.zeros(5, dtype=int)


def norms(actions: np.ndarray, episodes: np.ndarray = ONE, **options: Any) -> tuple[float, float]:
    found = smoothness(actions, episodes, **options)
    return found.j2.mean, found.j3.mean


def test_an_even_acceleration_has_no_jerk() -> None:
    assert norms(np.array([[0], [1], [3], [6], [10]])) == (1, 0)


def test_euclidean_norms_of_two_dims() -> None:
    # third differences (0, 0) and (-1, -2)
    assert norms(PLANE) == pytest.approx((1.138071, np.sqrt(5) / 2), abs=1e-6)


def test_a_seam_between_chunks_counts() -> None:
    smooth, seam = np.arange(8.0)[:, None], np.array([0, 1, 2, 3, 14, 15, 16, 17.0])[:, None]
    assert norms(smooth, np.zeros(8)) == (0, 0)
    assert norms(seam, np.zeros(8)) == pytest.approx(((10 + 10) / 6, (10 + 20 + 10) / 5))


def test_episodes_are_not_joined_and_every_difference_counts_alike() -> None:
    actions = np.array([[0], [1], [3], [6], [10], [-50], [-50], [-40]])
    found = smoothness(actions, np.array([7, 7, 7, 7, 7, 3, 3, 3]))
    assert (found.j2.mean, found.j3.mean) == ((3 * 1 + 10) / 4, 0)
    assert found.j2.low is not None and found.j3.low is None  # the short one has no third difference


def test_excluded_dims_do_not_count() -> None:
    gripper = np.array([[0], [1], [0], [1], [1]])
    with_gripper = np.hstack([PLANE[:, :1], gripper, PLANE[:, 1:]])
    assert norms(with_gripper, exclude=[1]) == norms(PLANE) != norms(with_gripper)


def test_normalised_units() -> None:
    std = np.array([2.0, 0.5])
    assert norms(PLANE * std, std_D=std) == norms(PLANE)
    stuck = np.hstack([PLANE * std, np.ones((5, 1))])
    assert norms(stuck, std_D=np.array([2, 0.5, 0]), exclude={2}) == norms(PLANE)


def test_units_of_time() -> None:
    j2, j3 = norms(PLANE)
    assert norms(PLANE, dt_s=0.1) == pytest.approx((100 * j2, 1000 * j3))


def test_integers_do_not_wrap() -> None:
    assert norms(np.array([[0], [255], [0], [255], [0]], dtype=np.uint8)) == (510, 1020)


@pytest.mark.parametrize(
    ("actions", "episodes", "options", "message"),
    [
        (PLANE, ONE, {"exclude": [2]}, r"exclude has \[2\], but actions have the dims 0 to 1"),
        (PLANE, ONE, {"exclude": [-1]}, r"exclude has \[-1\]"),
        (PLANE, ONE, {"exclude": [0, 1]}, "exclude leaves none of the 2 action dims"),
        (PLANE, ONE, {"std_D": np.array([1.0, 0])}, r"std_D=\[1.0, 0.0\] must be positive"),
        (PLANE, np.array([0, 0, 1, 1, 0]), {}, "must follow each other"),
        (PLANE[:3], ONE[:3], {}, "no episode has 4 actions"),
        (PLANE, np.array([0, 0, 1, 1, 2]), {}, "no episode has 3 actions"),
        (PLANE[:1], ONE[:1], {}, "no episode has 3 actions"),
    ],
)
def test_actions_that_cannot_be_measured(
    actions: np.ndarray, episodes: np.ndarray, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        smoothness(actions, episodes, **options)
