from dataclasses import replace

import numpy as np

from lerobot_bomb.evaluation.trivial import Demonstrations

DEMONSTRATIONS = Demonstrations(
    actions=np.array([[0.0, 0.0], [1.0, 10.0], [3.0, 10.0], [8.0, 8.0], [9.0, 6.0]]),
    states=np.array([[5.0, 5.0], [0.5, 1.0], [1.5, 9.0], [7.0, 7.0], [8.5, 8.5]]),
    episode_index=np.array([4, 4, 4, 7, 7]),
    run_index=np.array([0, 0, 0, 1, 1]),
    is_train=np.array([True, True, True, False, False]),
)


def test_recorded_chunks_end_with_their_episode() -> None:
    chunks, is_pad = DEMONSTRATIONS.recorded(np.array([1, 4]), chunk_size=3)
    assert chunks.tolist() == [[[1, 10], [3, 10], [3, 10]], [[9, 6], [9, 6], [9, 6]]]
    assert is_pad.tolist() == [[False, False, True], [False, True, True]]


def test_trivial_predictors_by_hand() -> None:
    chunks = DEMONSTRATIONS.trivial(np.array([0, 1, 2, 3, 4]), chunk_size=2)
    assert chunks["hold"][2].tolist() == [[1.5, 9], [1.5, 9]]
    # an episode's first frame repeats the state, never another episode's last action
    assert chunks["repeat"][:, 0].tolist() == [[5, 5], [0, 0], [1, 10], [7, 7], [8, 8]]
    # one action before: no line through it; two: 1 + 1, 1 + 2, and 20, 30 stay within 0..10
    assert chunks["extrapolate"][1].tolist() == [[0, 0], [0, 0]]
    assert chunks["extrapolate"][2].tolist() == [[2, 10], [3, 10]]
    assert chunks["extrapolate"][4].tolist() == [[3, 8], [3, 8]]  # the training data end at 3
    np.testing.assert_allclose(chunks["mean"][4], [[4 / 3, 20 / 3]] * 2)


def test_nothing_precedes_or_follows_a_static_scene() -> None:
    scenes = replace(DEMONSTRATIONS, run_index=np.arange(5))
    chunks, is_pad = scenes.recorded(np.array([1]), chunk_size=2)
    assert chunks.tolist() == [[[1, 10], [1, 10]]] and is_pad.tolist() == [[False, True]]
    assert scenes.trivial(np.array([2]), chunk_size=1)["repeat"].tolist() == [[[1.5, 9]]]


def test_without_a_state_the_mean_stands_in_and_nothing_is_held() -> None:
    chunks = replace(DEMONSTRATIONS, states=None).trivial(np.array([3]), chunk_size=1)
    assert set(chunks) == {"repeat", "extrapolate", "mean"}
    np.testing.assert_allclose(chunks["repeat"][0], [[4 / 3, 20 / 3]])
