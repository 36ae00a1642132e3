"""A chunk of one action is the frame's own, which LeRobot reads in a third of the time of a chunk's."""

import pytest
import torch
from lerobot.utils.constants import ACTION
from policy_cases import CASES


def test_one_action_is_the_frames_own(policy_type: str) -> None:
    make_config = CASES[policy_type].make_config
    assert make_config(chunk_size=1, n_action_steps=1).action_delta_indices is None
    assert make_config(chunk_size=2, n_action_steps=1).action_delta_indices == [0, 1]


def test_it_is_trained_on_as_a_chunk(policy_type: str) -> None:
    cases = CASES[policy_type]
    policy = cases.make_policy(chunk_size=1, n_action_steps=1).train()
    batch = cases.make_batch(policy, 3)
    key = f"{ACTION}_is_pad"
    chunks = {**batch, ACTION: batch[ACTION][:, :1], key: torch.zeros(3, 1, dtype=torch.bool)}
    frames = {name: value for name, value in chunks.items() if name != key} | {ACTION: batch[ACTION][:, 0]}
    losses = []
    for each in (chunks, frames):
        policy.config.trained_batches = 0  # what is drawn follows from it
        losses.append(policy(each))
    assert losses[0][0].equal(losses[1][0]) and losses[0][1] == losses[1][1]


def test_a_longer_chunk_must_be_one(policy_type: str) -> None:
    cases = CASES[policy_type]
    policy = cases.make_policy(chunk_size=2, n_action_steps=1)
    batch = cases.make_batch(policy, 2)
    with pytest.raises(ValueError, match=r"expected \(batch, 2, 4\)"):
        policy({**batch, ACTION: torch.zeros(2, 4)})
