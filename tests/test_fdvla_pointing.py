"""`fdvla` points, then acts: what it points at is learned, enters both heads, and is obeyed."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fdvla_cases import WORKSPACE, make_batch, make_config, make_policy
from lerobot.configs import NormalizationMode
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor, nn

from lerobot_bomb.bomb.pointing import SPOTS_XY_M
from lerobot_bomb.explain.activations import all_heads, all_layers, all_mlps
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.restoration import Corruption
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.policies.board_reader import NUM_SPOTS
from lerobot_bomb.policies.pointing import OTHER_ACTIONS, OTHER_PLACES, PLACE, STONE, number_of
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy
from lerobot_policy_bomb.fdvla.pointing_fdvla import Pointed, Pointer

PLACES = [[-0.09, 0.09], [0.0, 0.0], [0.09, -0.045], [0.17, 0.0]]
# without reading the board: that is in test_board_reader.py
POINTING: dict[str, Any] = {
    "pointing": True,
    "pointing_places": PLACES,
    "board_loss_weight": 0.0,
    "chunk_size": 1,
    "n_action_steps": 1,
}


def pointing_policy(**options: Any) -> FdvlaPolicy:
    return make_policy(**POINTING | options)


def pointing_batch(policy: FdvlaPolicy, batch_size: int = 4) -> dict[str, Any]:
    """Labels that are a function of the row: places in turn, the next ones as other places."""
    batch, places = make_batch(policy, batch_size), torch.tensor(PLACES)
    number_B = torch.arange(batch_size) % len(PLACES)
    others = torch.stack([places[(number_B + 1) % len(PLACES)], places[(number_B + 2) % len(PLACES)]], dim=1)
    stone_B2 = 0.05 * torch.randn(batch_size, 2, generator=torch.Generator().manual_seed(1))
    held_B1 = (number_B % 2).float()[:, None]
    return batch | {
        PLACE: places[number_B],
        STONE: torch.cat([stone_B2, held_B1], dim=1),
        OTHER_PLACES: others.flatten(1),
        # towards the place: what an action for it is
        OTHER_ACTIONS: torch.cat([10 * others, torch.zeros(batch_size, 2, 2)], dim=2).flatten(1),
    }


def wake_feedback(policy: FdvlaPolicy) -> FdvlaPolicy:
    """Wake the feedback as some training would: what is pointed at does change the actions."""
    assert policy.pointer is not None
    torch.manual_seed(1)
    torch.nn.init.normal_(policy.pointer.feedback[-1].get_parameter("weight"), std=0.5)
    return policy


def point_at(policy: FdvlaPolicy, place: int) -> None:
    """Let it point there, whatever it sees."""
    assert policy.pointer is not None
    with torch.no_grad():
        policy.pointer.place.weight.zero_()
        policy.pointer.place.bias.copy_(torch.nn.functional.one_hot(torch.tensor(place), len(PLACES)))


def test_it_acts_as_without_until_it_is_trained() -> None:
    policy, plain = pointing_policy(), make_policy(chunk_size=1, n_action_steps=1)
    shared = {name: tensor for name, tensor in policy.state_dict().items() if not name.startswith("pointer.")}
    plain.load_state_dict(shared)
    batch = make_batch(policy, 3)
    torch.testing.assert_close(
        policy.predict_action_chunk(batch), plain.predict_action_chunk(batch), rtol=0, atol=0
    )


def test_off_it_has_no_weights_and_reads_no_labels() -> None:
    policy = make_policy()
    assert policy.pointer is None and not any("point" in name for name in policy.state_dict())
    loss, metrics = policy(make_batch(policy, 2))
    assert torch.isfinite(loss) and "place_loss" not in metrics


def test_metrics_tell_which_places_and_stones_are_read() -> None:
    policy = pointing_policy()
    assert policy.pointer is not None
    batch = pointing_batch(policy)
    batch[STONE][:, :2] = torch.tensor(SPOTS_XY_M)[[30, 40, 50, 50]] + 0.002
    point_at(policy, 2)
    with torch.no_grad():
        policy.pointer.spot.weight.zero_()
        policy.pointer.spot.bias.copy_(torch.nn.functional.one_hot(torch.tensor(50), len(SPOTS_XY_M)))
    metrics = policy(batch)[1]
    assert metrics["place_accuracy"] == 0.25 and metrics["spot_accuracy"] == 0.5


def test_it_points_in_bfloat16() -> None:
    policy = pointing_policy(dtype="bfloat16")
    loss, metrics = policy(pointing_batch(policy))
    loss.backward()
    assert torch.isfinite(loss) and metrics["stone_loss"] > 0


def test_labels_are_of_training_only() -> None:
    policy = pointing_policy()
    policy.predict_action_chunk(make_batch(policy, 2))
    with pytest.raises(KeyError, match=r"fdvla needs 'observation\.pointing\.place'"):
        policy(make_batch(policy, 2))


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_heads_are_given_the_place_that_is_meant_or_another_with_its_action(share: float) -> None:
    policy = pointing_policy()
    assert policy.pointer is not None
    batch = pointing_batch(policy)
    labels = policy.pointer.labels(batch, share, "fdvla", torch.Generator().manual_seed(0))
    assert labels.place.tolist() == [0, 1, 2, 3]
    assert labels.is_other.tolist() == 4 * [share == 1]
    actions_BKD, loss_mask_BK = labels.given_actions(
        batch["action"], torch.ones(4, 1).bool(), labels.other_actions[:, None]
    )
    assert loss_mask_BK.all()
    if share == 0:
        assert labels.given.tolist() == [0, 1, 2, 3]
        torch.testing.assert_close(actions_BKD, batch["action"])
    else:
        assert not (labels.given == labels.place).any()
        xy_B2 = torch.tensor(PLACES)[labels.given]
        torch.testing.assert_close(actions_BKD[:, 0, :2], 10 * xy_B2)


def test_of_a_chunk_only_the_next_action_is_known_for_another_place() -> None:
    policy = pointing_policy(chunk_size=4)
    assert policy.pointer is not None
    batch = pointing_batch(policy)
    labels = policy.pointer.labels(batch, 1.0, "fdvla", torch.Generator().manual_seed(0))
    actions_BKD, loss_mask_BK = labels.given_actions(
        batch["action"], torch.ones(4, 4).bool(), labels.other_actions[:, None]
    )
    assert loss_mask_BK.tolist() == 4 * [[True, False, False, False]]
    torch.testing.assert_close(actions_BKD[:, 1:], batch["action"][:, 1:])


def gradients(policy: FdvlaPolicy, batch: dict[str, Any], **weights: float) -> dict[str, Tensor]:
    policy.zero_grad()
    policy.config.trained_batches = 0  # which all that is random in a batch follows from
    for name, value in weights.items():
        setattr(policy.config, name, value)
    policy.train()(batch)[0].backward()
    return {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def test_no_gradient_of_the_actions_reaches_what_is_pointed_at() -> None:
    policy = wake_feedback(pointing_policy())
    found = gradients(policy, pointing_batch(policy), pointing_loss_weight=0.0)
    for name in ("place", "spot", "stone.2", "held", "features.0"):
        assert (found[f"pointer.{name}.weight"] == 0).all(), name
    assert (found["pointer.feedback.0.weight"] != 0).any()


def test_gradients_of_pointing_reach_the_backbone_and_no_head() -> None:
    policy = pointing_policy()
    batch, both = pointing_batch(policy), {}
    for weight in (0.0, 1.0):
        both[weight] = {
            name: grad.clone() for name, grad in gradients(policy, batch, pointing_loss_weight=weight).items()
        }
    changed = {name for name, grad in both[1.0].items() if not torch.equal(grad, both[0.0][name])}
    assert {
        "pointer.place.weight",
        "pointer.spot.weight",
        "pointer.stone.2.weight",
        "pointer.held.weight",
    } <= changed
    assert any(name.startswith("backbone") for name in changed)
    assert not any(name.startswith(("flow_head", "denoise_head", "pointer.feedback")) for name in changed)


def test_the_loss_of_each_row_adds_up_to_the_mean() -> None:
    policy = pointing_policy()
    batch, losses = pointing_batch(policy), []
    for reduction in ("mean", "none"):
        policy.generator.manual_seed(0)
        losses.append(policy(batch, reduction=reduction)[0])
    torch.testing.assert_close(losses[0], losses[1].mean())


def test_numbers_are_ways_in_metres_at_three_scales() -> None:
    pointer = Pointer(8, 4, PLACES, NormalizationMode.MEAN_STD)
    pointed = Pointed(
        gripper=torch.tensor([[0.03, 0.0, 0.05]]),
        place_logits=torch.zeros(1, 4),
        spot_logits=torch.zeros(1, NUM_SPOTS),
        stone=torch.tensor([[0.006, 0.0]]),
        held_logit=torch.zeros(1),
        features=torch.zeros(1, 8),
    )
    (numbers,) = pointer._numbers(pointed, torch.tensor([[0.0, 0.04]])).tolist()
    way = [-0.3, 0.4, -0.75, 1.0, -0.99991, 1.0, 0.5, 1.0]
    stone = [0.06, 0.0, 0.15, 0.0, 0.76159, 0.0, 0.06, 0.76159]
    expected = [*way, *stone, -1.2, 1.33333, 0.5, 0.05]
    assert numbers == pytest.approx(expected, abs=1e-4)


def test_the_gripper_is_read_in_metres() -> None:
    pointer = Pointer(8, 4, PLACES, NormalizationMode.MEAN_STD)
    pointer.gripper_dims.copy_(torch.tensor([1, 2, 3]))
    pointer.state_bounds.copy_(torch.tensor([[0.0, -0.1, 0.0], [0.2, 0.1, 0.1]]))
    pointed = pointer(torch.zeros(1, 8), torch.tensor([[9.0, 0.0, 1.0, -1.0]]))
    torch.testing.assert_close(pointed.gripper, torch.tensor([[0.1, 0.1, 0.0]]))


def test_an_explanation_says_where_it_points() -> None:
    policy = pointing_policy()
    assert policy.pointer is not None and make_policy().scored().pointed(make_batch(policy, 1)) is None
    pointer = policy.pointer
    pointer.state_bounds.copy_(torch.tensor([[0.0, -0.1, 0.0], [0.2, 0.1, 0.1]]))
    point_at(policy, 2)
    with torch.no_grad():
        likeliest = [float(xy == (0.14, 0.045)) for xy in SPOTS_XY_M]
        beside = pointer.stone[2]
        assert isinstance(beside, nn.Linear)
        for layer, bias in ((pointer.spot, likeliest), (beside, [0.5, -1.0]), (pointer.held, [2.0])):
            layer.weight.zero_()
            layer.bias.copy_(torch.tensor(bias))
    batch = make_batch(policy, 1) | {"observation.state": torch.tensor([[0.0, 1.0, 0.0, 0.0]])}
    found = policy.scored().pointed(batch)
    assert found is not None and found.place_xy.tolist() == pytest.approx(PLACES[2])
    # half of 30 mm and minus a whole from the spot
    assert found.stone_xy.tolist() == pytest.approx([0.155, 0.015])
    assert found.held == pytest.approx(0.8808, abs=1e-4)
    share = 1 / (3 + np.e)
    assert [*found.probabilities.values()] == pytest.approx([share, share, np.e * share, share])
    assert [*map(list, found.probabilities)] == [pytest.approx(place) for place in PLACES]


def test_what_it_computes_while_it_points_can_be_put_back() -> None:
    policy = wake_feedback(pointing_policy())
    batch = make_batch(policy, 1)
    question = Question(policy.scored(), lambda observed: observed, batch)
    corruption = Corruption(question, question.encode({WORKSPACE: torch.zeros_like(batch[WORKSPACE])}, 1))
    num_layers, places = len(policy.scored().layers), question.policy.token_spans(question.rows)
    assert {len(passes) for passes in places.values()} == {3}
    assert places["pointing"] == (None, slice(None), None) and places["answer"] == (None, None, slice(None))
    whole = [*all_layers(num_layers), *all_heads(policy.scored().layers), *all_mlps(num_layers)]
    score = float(corruption.restore([whole]).scores)
    assert score == pytest.approx(question.clean_score, abs=1e-5) != pytest.approx(corruption.score, abs=1e-3)
    pointing = corruption.restore([all_layers(num_layers, places["pointing"])]).scores
    assert abs(float(pointing) - corruption.score) > 1e-6


def test_places_are_the_nearest() -> None:
    assert number_of(torch.tensor([[0.085, -0.05], [0.001, 0.0]]), torch.tensor(PLACES)).tolist() == [2, 1]


def test_it_learns_to_point_and_then_goes_where_it_points() -> None:
    policy = pointing_policy(draws_per_chunk=4, num_inference_steps=3)
    batch = pointing_batch(policy)
    # demonstrations, as the other actions, lead to the place: nothing but the pointer tells two of them apart
    batch["action"] = torch.cat([10 * batch[PLACE], torch.zeros(4, 2)], dim=1)[:, None]
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    for step in range(400):
        loss, metrics = policy.train()(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 49 and metrics["place_loss"] < 0.05 and error_of(policy, batch) < 0.25:
            break
    assert metrics["place_loss"] < 0.05 and error_of(policy, batch) < 0.25
    for place in range(len(PLACES)):
        point_at(policy, place)
        moved = batch | {
            "action": torch.tensor([[10 * x, 10 * y, 0.0, 0.0] for x, y in 4 * [PLACES[place]]])[:, None]
        }
        assert error_of(policy, moved) < 0.4, place


def error_of(policy: FdvlaPolicy, batch: dict[str, Any]) -> float:
    policy.reset()
    return float((policy.predict_action_chunk(batch) - batch["action"]).abs().mean())


def test_without_places_there_is_no_policy() -> None:
    with pytest.raises(ValueError, match=r"--policy\.pointing=true takes the places from a dataset"):
        FdvlaPolicy(make_config(pointing=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"counterfactual_share": 1.5}, r"--policy\.counterfactual_share=1\.5 must lie in 0\.\.1"),
        ({"pointing_loss_weight": -1.0}, r"--policy\.pointing_loss_weight=-1\.0 must not be negative"),
    ],
)
def test_wrong_flags_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**POINTING | options)


def test_it_needs_the_robots_state() -> None:
    with pytest.raises(ValueError, match=r"--policy\.pointing=true needs the feature 'observation\.state'"):
        make_policy(**POINTING, has_state=False, use_state=False)


def test_a_context_is_its_tensors() -> None:
    policy = wake_feedback(pointing_policy())
    batch = make_batch(policy, 2)
    context = policy._pointing(policy._read(batch), batch["observation.state"])
    again = type(context).of(context.tensors(), has_feedback=True)
    assert all(map(torch.equal, context.tensors(), again.tensors()))
    bare = replace(context, feedback=None)
    assert len(type(context).of(bare.tensors(), has_feedback=False).tensors()) == len(context.tensors()) - 1


def test_other_actions_are_normalised_as_the_datasets() -> None:
    policy = pointing_policy()
    assert policy.pointer is not None
    policy.pointer.action_bounds.copy_(torch.tensor([[0.0, 0.0, 0.0, -1.0], [2.0, 1.0, 1.0, 1.0]]))
    batch = pointing_batch(policy) | {OTHER_ACTIONS: torch.tensor(4 * [2 * [2.0, 0.5, 0.0, 1.0]])}
    labels = policy.pointer.labels(batch, 1.0, "fdvla", torch.Generator())
    torch.testing.assert_close(labels.other_actions, torch.tensor(4 * [[1.0, 0.0, -1.0, 1.0]]))


@pytest.mark.parametrize("mode", [NormalizationMode.MEAN_STD, NormalizationMode.MIN_MAX])
def test_an_action_that_never_changes_is_lerobots(mode: NormalizationMode) -> None:
    policy = pointing_policy(
        normalization_mapping=dict.fromkeys(("STATE", "ACTION"), mode)
        | {"VISUAL": NormalizationMode.IDENTITY}
    )
    low, high = torch.tensor([[-1.0, -2.0, 0.5, 1.0], [1.0, 2.0, 0.5, 1.0]])
    statistics = {"mean": (low + high) / 2, "std": (high - low) / 2, "min": low, "max": high}
    prepare, _ = make_pre_post_processors(policy.config, dataset_stats={"action": statistics})
    action = torch.tensor([[0.3, -1.0, 0.5, 1.0]])
    assert policy.pointer is not None
    policy.pointer.action_bounds.copy_(torch.stack([low, high]))
    expected = prepare({"observation.state": torch.zeros(1, 4), "action": action, "task": ["go"]})["action"]
    torch.testing.assert_close(policy.pointer.normalised(action), expected)
