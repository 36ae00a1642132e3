from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs import NormalizationMode

from lerobot_bomb.actions.bins import Bins
from lerobot_bomb.actions.relative import RelativeActions, _residuals, bounds, named_dims


def fitted(chunk_size: int = 2, **changes: Any) -> RelativeActions:
    """Fit two dims whose states are swapped; the data's residuals are 10 (dim 0), and 30 and 20 (dim 1)."""
    data = {
        # dim 0: 100 + 10 from the state; dim 1 alternates
        "actions_ND": np.array([[110.0, 230.0], [310.0, 430.0], [110.0, 230.0], [310.0, 430.0]]),
        "states_NS": np.array([[200.0, 100.0], [400.0, 300.0], [200.0, 100.0], [400.0, 300.0]]),
        "episode_ends_N": np.array([1, 2, 3, 4]),  # every frame is an episode
        "action_bounds": (np.array([110.0, 230.0]), np.array([310.0, 430.0])),
        "state_bounds": (np.array([200.0, 100.0]), np.array([400.0, 300.0])),
        **changes,
    }
    relative = RelativeActions(2, {0: 1, 1: 0})
    relative.fit(chunk_size=chunk_size, **data)
    return relative


def test_residuals_by_hand() -> None:
    relative = fitted()
    # units of the normalised action: 100. Residuals: 10 -> 0.1 and 30 -> 0.3, the same in all chunks
    torch.testing.assert_close(relative.scale, torch.tensor([0.1, 0.3]))
    state = torch.tensor([[-1.0, 1.0]])  # state 200 and 300 as LeRobot normalises them
    action = torch.tensor([[[-1.0, -1.0], [0.9, -1.0]]])  # 110, 230; 300, 230
    # (110 - 300) / 10, (230 - 200) / 30; (300 - 300) / 10
    expected = torch.tensor([[[-19.0, 1.0], [0.0, 1.0]]])
    torch.testing.assert_close(relative.encode(action, state), expected, atol=1e-5, rtol=0)


def test_staying_is_zero() -> None:
    relative = fitted()
    state = torch.tensor([[0.5, -0.25]])  # 350 and 175
    stay = torch.tensor([[[(175 - 210) / 100, (350 - 330) / 100]]])
    torch.testing.assert_close(relative.encode(stay, state), torch.zeros(1, 1, 2), atol=1e-5, rtol=0)
    assert Bins(999, "levels").encode(relative.encode(stay, state)).tolist() == [[[499, 499]]]


def test_chunks_end_with_their_episode() -> None:
    """Residuals of a chunk's later actions count, but not those of the next episode."""
    actions = np.array([[0.0], [10.0], [20.0], [1000.0], [1010.0], [1020.0]])
    states = actions.copy()
    relative = RelativeActions(1, {0: 0})
    span = (np.array([0.0]), np.array([200.0]))
    relative.fit(actions, states, np.array([3, 3, 3, 6, 6, 6]), 3, span, span)
    # the largest residual is 20, of 100 a unit; beyond the episode it would be 1000
    assert relative.scale.item() == pytest.approx(0.2)


def test_of_many_residuals_those_of_evenly_spaced_frames_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_bomb.actions.relative.MAX_RESIDUALS", 4)
    actions, ends = np.arange(6.0) ** 2, np.array([6] * 6)
    # every fourth frame, 1 + 6 * 2 // 4: 0 and 4, and the actions after them
    assert _residuals(actions, np.zeros(6), ends, 2).tolist() == [0, 16, 1, 25]


def test_one_residual_in_a_thousand_saturates() -> None:
    residuals = np.arange(1001.0)  # their 0.999 quantile is 999
    states = 10_000 * residuals[:, None]
    span = (np.array([-1000.0]), np.array([1000.0]))
    relative = RelativeActions(1, {0: 0})
    relative.fit(states + residuals[:, None], states, np.arange(1, 1002), 1, span, span)
    assert relative.scale.item() == pytest.approx(0.999)


def test_raw_residuals_of_state_and_action_normalised_alike() -> None:
    relative = RelativeActions(2, {0: 0, 1: 1})  # no data: the widest range
    action, state = torch.tensor([[[0.9, -0.9]]]), torch.tensor([[-0.4, 0.5]])
    torch.testing.assert_close(relative.encode(action, state) * 2, torch.tensor([[[1.3, -1.4]]]))


@given(
    st.lists(st.floats(-1, 1, width=32), min_size=6, max_size=6),
    st.lists(st.floats(-1, 1, width=32), min_size=2, max_size=2),
)
def test_round_trip(actions: list[float], state: list[float]) -> None:
    relative = fitted()
    action_1TD, state_1S = torch.tensor(actions).view(1, 3, 2), torch.tensor([state])
    there = relative.encode(action_1TD, state_1S)
    torch.testing.assert_close(relative.decode(there, state_1S), action_1TD, atol=1e-5, rtol=0)
    # through bins: half a step of the residuals' range, where they are within it
    bins = Bins(999, "levels")
    error = (relative.decode(bins.decode(bins.encode(there)), state_1S) - action_1TD).abs()
    inside = there.abs() <= 1
    assert (error <= relative.scale / 998 + 1e-5)[inside].all()


def test_absolute_dimensions_pass_through() -> None:
    relative = RelativeActions(3, {1: 0})
    action = torch.tensor([[[0.5, 0.5, -0.25]]])
    encoded = relative.encode(action, torch.tensor([[0.25]]))
    assert encoded.tolist() == [[[0.5, 0.125, -0.25]]]


def test_a_constant_action_stays_absolute() -> None:
    relative = RelativeActions(1, {0: 0})
    states = np.array([[1.0], [2.0]])
    constant = (np.array([5.0]), np.array([5.0]))
    relative.fit(np.full((2, 1), 5.0), states, np.array([2, 2]), 1, constant, (states[0], states[1]))
    assert relative.encode(torch.full((1, 1, 1), -1.0), torch.tensor([[0.3]])).item() == -1


def test_delta_control_is_refused() -> None:
    generator = np.random.default_rng(0)
    states = np.cumsum(generator.normal(size=(100, 1)), axis=0)
    steps = np.diff(states, axis=0, append=states[-1:])
    span = (np.array([-1.0]), np.array([1.0]))
    relative = RelativeActions(1, {0: 0})
    with pytest.raises(ValueError, match=r"action dimension 0 does not follow state dimension 0 .*delta"):
        relative.fit(steps, states, np.full(100, 100), 5, span, span)


def test_an_action_may_lead_its_state_by_a_whole_step() -> None:
    """Check a coarse rate: a position is reached one frame later, and jumps far in between."""
    actions = np.array([[0.0], [9.0], [1.0], [8.0], [0.0]])
    states = np.array([[5.0], [0.0], [9.0], [1.0], [8.0]])
    span = (np.array([0.0]), np.array([9.0]))
    relative = RelativeActions(1, {0: 0})
    relative.fit(actions, states, np.full(5, 5), 1, span, span)
    assert relative.scale.item() > 1.5


def test_bounds_are_those_of_the_normaliser() -> None:
    statistics = {name: np.array([value]) for name, value in (("min", 1), ("max", 5), ("q01", 2), ("q99", 4))}
    for mode, low, high in (
        (NormalizationMode.MIN_MAX, 1, 5),
        (NormalizationMode.QUANTILES, 2, 4),
        (NormalizationMode.IDENTITY, -1, 1),
    ):
        assert [bound.tolist() for bound in bounds(statistics, mode, 1)] == [[low], [high]]


def test_missing_statistics_are_named() -> None:
    with pytest.raises(ValueError, match=r"QUANTILES needs the statistics q01, q99, .* it has max, min"):
        bounds({"min": np.zeros(1), "max": np.ones(1)}, NormalizationMode.QUANTILES, 1)


def test_dimensions_by_name() -> None:
    names = ["shoulder.pos", "elbow.pos", "gripper.pos"]
    assert named_dims(names, ["Gripper", "elbow"], "--f") == [1, 2]
    assert named_dims(names, [], "--f") == []
    with pytest.raises(ValueError, match=r"--f: no action dimension is called 'hand'; there are shoulder"):
        named_dims(names, ["hand"], "--f")
