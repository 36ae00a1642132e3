import math

import pytest
import torch
from vla0_smol_cases import make_batch, make_policy

from lerobot_bomb.actions.ensemble import TemporalEnsemble, age_weights

# what three chunks foresaw for one step, newest first
FORESEEN = (0.2, 0.1, 0.6)


@pytest.mark.parametrize(
    ("weighting", "coefficient", "mean"),
    [
        ("uniform", 0.0, 0.3),
        ("nvlabs", 0.0, 0.275),
        ("exponential", -math.log(2), 0.2285714),
        ("exponential", 0.01, 0.3013366),  # ACT's, whose oldest chunk has the weight 1
    ],
)
def test_mean_of_three_chunks(weighting: str, coefficient: float, mean: float) -> None:
    ensemble = TemporalEnsemble(3, weighting, coefficient)
    newest, middle, oldest = FORESEEN
    # each chunk is (1, 3, 1) and starts a step later than the one before
    ensemble(torch.tensor([9.0, 9.0, oldest]).view(1, 3, 1))
    ensemble(torch.tensor([9.0, middle, 9.0]).view(1, 3, 1))
    action = ensemble(torch.tensor([newest, 9.0, 9.0]).view(1, 3, 1))
    torch.testing.assert_close(action, torch.tensor([[mean]]))


def test_only_as_many_chunks_as_there_are_and_as_the_size_allows() -> None:
    ensemble = TemporalEnsemble(2, "uniform", 0.0)
    chunks = [torch.full((1, 3, 1), value) for value in (1.0, 2.0, 4.0)]
    assert [ensemble(chunk).item() for chunk in chunks] == [1.0, 1.5, 3.0]
    ensemble.reset()
    assert ensemble(chunks[2]).item() == 4.0


def test_dimensions_that_are_not_averaged_come_from_the_newest_chunk() -> None:
    ensemble = TemporalEnsemble(2, "uniform", 0.0, newest_only=[1])
    ensemble(torch.tensor([[[0.0, 0.0], [1.0, -1.0]]]))
    assert ensemble(torch.tensor([[[0.0, 1.0], [0.0, 0.0]]])).tolist() == [[0.5, 1.0]]


def test_weights_by_age() -> None:
    assert age_weights("uniform", 3, 5.0).tolist() == [1, 1, 1]
    assert age_weights("nvlabs", 3, 5.0).tolist() == [1, 0.5, 0.5]
    weights = age_weights("exponential", 3, -math.log(2))
    torch.testing.assert_close(weights / weights[0], torch.tensor([1, 0.5, 0.25]))


def test_a_chunk_of_another_mind_counts_less() -> None:
    ensemble = TemporalEnsemble(2, "adaptive", 1.0)
    ensemble(torch.tensor([[[9.0, 9.0], [0.0, 2.0]]]))
    action = ensemble(torch.tensor([[[1.0, 0.0], [9.0, 9.0]]]))  # cosines 1 and 0
    total = math.e + 1
    torch.testing.assert_close(action, torch.tensor([[math.e / total, 2 / total]]))


def test_no_coefficient_overflows() -> None:
    ensemble = TemporalEnsemble(3, "exponential", 500.0)
    for value in (1.0, 2.0, 4.0):
        action = ensemble(torch.full((1, 3, 1), value))
    assert action.item() == 1.0  # the oldest


def test_a_policy_averages_what_it_foresaw_and_forgets_it_on_reset() -> None:
    names = ["x", "y", "z", "gripper"]
    options = {"temporal_ensemble_size": 2, "n_action_steps": 1, "action_feature_names": names}
    policy = make_policy(**options, temporal_ensemble_exclude_joints=["gripper"])
    batches = [make_batch(policy, 2, seed=seed) for seed in range(3)]
    chunks = [policy.predict_action_chunk(batch) for batch in batches]
    assert not torch.equal(chunks[0], chunks[1])
    policy.reset()
    actions = [policy.select_action(batch) for batch in batches]
    assert torch.equal(actions[0], chunks[0][:, 0])
    for step in (1, 2):  # of three chunks, the two newest count
        mean = (chunks[step][:, 0] + chunks[step - 1][:, 1]) / 2
        torch.testing.assert_close(actions[step][:, :3], mean[:, :3])
        assert torch.equal(actions[step][:, 3], chunks[step][:, 0, 3])
    policy.reset()
    assert torch.equal(policy.select_action(batches[2]), chunks[2][:, 0])
