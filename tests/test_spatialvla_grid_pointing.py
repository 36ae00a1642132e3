"""`spatialvla_grid` points, then acts: two tokens ahead of the cells, which are learned and obeyed."""

from typing import Any

import pytest
import torch
from spatialvla_grid_cases import make_batch, make_policy, rows
from spatialvla_grid_pointing_cases import NUM_STONES, PLACES, SINGLY, STONES, pointing_batch, pointing_policy
from torch.nn.functional import cross_entropy

from lerobot_bomb.policies.pointing import OTHER_ACTIONS, OTHER_PLACES, PLACE
from lerobot_policy_bomb.spatialvla_grid.pointing_spatialvla_grid import StoneCells


def test_stones_are_cells_along_y_then_x_and_what_is_beyond_is_in_the_outermost() -> None:
    assert STONES.counts == (9, 7)
    xy = torch.tensor([[-0.12, -0.12], [-0.12, 0.12], [0.055, -0.025], [-0.5, 0.5], [9.0, 9.0]])
    assert STONES.number_of(xy).tolist() == [0, 6, 4 * 7 + 2, 6, 62]
    assert StoneCells((-0.13, -0.13), (0.21, 0.13), 0.005).counts == (68, 52)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_an_answer_is_a_place_a_stone_and_then_cells(share: float) -> None:
    policy = pointing_policy(counterfactual_share=share, **SINGLY)
    batch = pointing_batch(policy, 2)
    batch["action"] = torch.tensor([[[-0.9, -0.6, -0.3, -0.1], [0.1, 0.3, 0.6, 0.9]]]).repeat(2, 1, 1)
    batch |= {OTHER_PLACES: torch.tensor(PLACES)[torch.tensor([[3, 3], [2, 2]])].flatten(1)}
    batch |= {OTHER_ACTIONS: torch.tensor(2 * [2 * [0.9, 0.9, 0.9, 0.9]])}
    cells, kept, pointed = policy.train()._targets(batch)
    meant, other = [[0, 30], [1, 6]], [[3, 30], [2, 6]]
    assert pointed.given.tolist() == (other if share else meant)
    assert pointed.meant.tolist() == meant
    first, second = [0, 1, 2, 3], [4, 5, 6, 7]
    assert cells.tolist() == 2 * [[[7, 7, 7, 7] if share else first, second]]
    # of another place only the next action is known
    assert kept.tolist() == 2 * [[True, not share]]


def test_the_loss_is_the_likelihood_among_a_slots_tokens_of_all_that_is_kept() -> None:
    for vocab in ("slot", "full"):
        policy = pointing_policy(counterfactual_share=0.5, loss_vocab=vocab).train()
        batch = pointing_batch(policy)
        policy._begin_batch()
        cells, loss_mask_BT, pointed = policy._targets(batch)
        is_other = pointed.given[:, 0] != pointed.meant[:, 0]
        assert 0 < is_other.sum() < 4
        hidden, _ = policy._hidden(batch, torch.cat([pointed.given, cells.flatten(1)], dim=1))
        logits = policy.backbone.cap(policy.cell_head(hidden))
        words = policy.backbone.cap(policy.backbone.vlm.lm_head(hidden))
        (first, num_polar, num_gripper) = 0, *policy.grids.num_cells
        assert logits.shape[-1] == num_polar + num_gripper + 4 + NUM_STONES
        starts = [num_polar + num_gripper, num_polar + num_gripper + 4] + 2 * [first, num_polar]
        counts = [4, NUM_STONES] + 2 * [num_polar, num_gripper]
        tokens = torch.cat([pointed.meant, cells.flatten(1)], dim=1)
        kept = torch.cat([torch.ones(4, 2) > 0, loss_mask_BT.repeat_interleave(2, dim=1)], dim=1)
        losses = []
        for row in range(4):
            for i in range(6):
                if kept[row, i]:
                    slot = slice(starts[i], starts[i] + counts[i])
                    if vocab == "slot":
                        losses.append(cross_entropy(logits[row, i, slot], tokens[row, i]))
                    else:
                        whole = torch.cat([logits[row, i], words[row, i]])
                        losses.append(cross_entropy(whole, tokens[row, i] + starts[i]))
        assert len(losses) == 4 * 6 - int(is_other.sum()) * 2
        policy.config.trained_batches = 0
        torch.testing.assert_close(policy(batch)[0], torch.stack(losses).mean())


def test_metrics_of_actions_skip_what_points() -> None:
    policy = pointing_policy(counterfactual_share=0.0, **SINGLY)
    batch = pointing_batch(policy)
    metrics = policy(batch)[1]
    assert set(metrics) == {"token_accuracy", "place_accuracy", "stone_accuracy"}
    cells, _, pointed = policy._targets(batch)
    answer = torch.cat([pointed.meant, cells.flatten(1)], dim=1)
    right = policy._losses(policy._hidden(batch, answer)[0], answer)[1] == answer
    assert metrics["token_accuracy"] == pytest.approx(float(right[:, 2:].float().mean()))
    assert metrics["place_accuracy"] == pytest.approx(float(right[:, 0].float().mean()))


def test_the_place_that_is_meant_is_predicted_where_another_is_given() -> None:
    gradients = []
    for share in (0.0, 1.0):
        policy = pointing_policy(counterfactual_share=share).train()
        policy(pointing_batch(policy))[0].backward()
        place, stone = policy._pointing_rows
        grad = policy.cell_head.weight.grad
        assert grad is not None and (grad[stone] != 0).any()
        gradients.append(grad[place] / grad[place].norm())  # the mean is over fewer actions of another place
        grad = policy.cell_embedding.weight.grad
        assert grad is not None and (grad[place] != 0).any()
    torch.testing.assert_close(*gradients)


@torch.no_grad()
def test_a_weight_counts_the_loss_of_pointing_more_than_that_of_cells() -> None:
    policy = pointing_policy(counterfactual_share=0.0, pointing_loss_weight=3.0, **SINGLY)
    batch = pointing_batch(policy)
    cells, _, pointed = policy._targets(batch)
    answer = torch.cat([pointed.meant, cells.flatten(1)], dim=1)
    losses, _ = policy._losses(policy._hidden(batch, answer)[0], answer)
    expected = (3 * losses[:, :2].sum() + losses[:, 2:].sum()) / losses.numel()
    assert float(policy(batch)[0]) == pytest.approx(float(expected), rel=1e-5)


@torch.no_grad()
@pytest.mark.parametrize(("num_dims", "options"), [(4, SINGLY), (7, {})])
def test_at_each_position_all_of_its_tokens_and_no_others_can_win(
    num_dims: int, options: dict[str, Any]
) -> None:
    policy = pointing_policy(1, num_dims, **options)
    batch = make_batch(policy, 1)
    answer = policy.write(batch, 2)
    slots = [*policy._pointing_rows, *policy._group_rows, *policy._group_rows]
    assert [slot.stop - slot.start for slot in slots[:2]] == [4, NUM_STONES]
    assert [slot.start for slot in slots[:2]] == [policy.grids.num_tokens, policy.grids.num_tokens + 4]
    head = policy.cell_head.weight.clone()
    for position, slot in enumerate(slots):
        hidden, _ = policy._hidden(batch, answer)
        liked = hidden[0, position] / hidden[0, position].norm()
        for token in {0, 1, slot.stop - slot.start - 1}:
            policy.cell_head.weight.copy_(head)
            policy.cell_head.weight += 1e3 * liked  # all tokens of the other slots, too
            policy.cell_head.weight[slot] = head[slot]
            policy.cell_head.weight[slot.start + token] += 10 * liked
            assert policy.write(batch, 2)[0, position] == token
    policy.cell_head.weight.copy_(head)


@torch.no_grad()
@pytest.mark.parametrize(("num_dims", "options"), [(4, SINGLY), (7, {})])
def test_actions_alone_come_out_whatever_the_batch(num_dims: int, options: dict[str, Any]) -> None:
    policy = pointing_policy(2, num_dims, **options)
    batch = make_batch(policy, 3)
    answer = policy.write(batch, 2)
    _, cells = policy._split(answer)
    assert answer.shape[1] == 2 + 2 * len(policy.grids.groups) == policy.last_passes == 2 + policy.last_tokens
    # what the teacher-forced network finds likeliest, given what was written, is what was written
    assert torch.equal(policy._losses(policy._hidden(batch, answer)[0], answer)[1], answer)
    chunk = policy.predict_action_chunk(batch)
    assert chunk.shape == (3, 2, num_dims) and torch.equal(chunk, policy.grids.decode(cells))
    assert torch.equal(policy.select_action(batch), chunk[:, 0])
    for row in range(3):  # where steps are guessed
        assert torch.equal(policy.write(rows(batch, slice(row, row + 1)), 2)[0], answer[row])


def test_guesses_go_on_as_the_step_before_and_change_nothing() -> None:
    policy = pointing_policy(2, 7, nano_config=None, chunk_size=6, n_action_steps=6)
    batch = make_batch(policy, 1, 2)
    with torch.no_grad():  # one of three groups is always the same
        policy.cell_head.weight[policy._group_rows[0]] = 0
    drafted = policy.write(batch, 6)
    assert policy.last_passes is not None and 2 + 3 < policy.last_passes < 2 + 6 * 3
    policy._decoder.drafted = False
    assert torch.equal(policy.write(batch, 6), drafted)


def test_an_ensemble_is_of_actions_alone() -> None:
    policy = pointing_policy(
        n_action_steps=1, temporal_ensemble_size=2, temporal_ensemble_weighting="uniform", **SINGLY
    )
    first, second = (make_batch(policy, 2, seed) for seed in (1, 2))
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    policy.reset()
    policy.select_action(first)
    torch.testing.assert_close(policy.select_action(second), (chunks[0][:, 1] + chunks[1][:, 0]) / 2)


def test_an_explanation_scores_what_is_pointed_at_and_the_cells() -> None:
    policy = pointing_policy(**SINGLY)
    batch = make_batch(policy, 1)
    explained = policy.scored()
    answer = explained.answer(batch)
    assert torch.equal(answer, policy.write(batch, 2))
    with torch.no_grad():
        losses, _ = policy._losses(policy._hidden(batch, answer)[0], answer)
        torch.testing.assert_close(explained.score(explained.encode(batch), answer), -losses.sum(dim=1))


def test_an_explanation_says_where_it_points() -> None:
    policy = pointing_policy(**SINGLY)
    batch = make_batch(policy, 1)
    found = policy.scored().pointed(batch)
    answer = policy.write(batch, 2)
    place, stone = answer[0, :2].tolist()
    assert (
        found is not None and found.held is None and found.place_xy.tolist() == pytest.approx(PLACES[place])
    )
    x, y = divmod(stone, 7)
    assert found.stone_xy.tolist() == pytest.approx([-0.13 + 0.04 * (x + 0.5), -0.13 + 0.04 * (y + 0.5)])
    with torch.no_grad():
        states, _ = policy._hidden(batch, answer)
        others = (torch.cat([torch.tensor([[each]]), answer[:, 1:]], dim=1) for each in range(4))
        losses = [policy._losses(states, other)[0][0, 0] for other in others]
    shares = [float((-loss).exp()) for loss in losses]
    assert [*found.probabilities.values()] == pytest.approx(shares, abs=1e-5)
    assert [*map(list, found.probabilities)] == [pytest.approx(each) for each in PLACES]
    plain = make_policy()
    assert plain.scored().pointed(make_batch(plain, 1)) is None


def test_labels_are_of_training_only() -> None:
    policy = pointing_policy()
    policy.predict_action_chunk(make_batch(policy, 2))
    with pytest.raises(KeyError, match=r"spatialvla_grid needs 'observation\.pointing\.place'"):
        policy(make_batch(policy, 2))


def test_off_there_are_no_rows_and_no_labels() -> None:
    policy = make_policy()
    assert policy.cell_head.weight.shape[0] == policy.cell_embedding.num_embeddings == policy.grids.num_tokens
    assert {*policy.state_dict()} == {*pointing_policy().state_dict()}
    assert set(policy(make_batch(policy, 2))[1]) == {"token_accuracy"}
    method = "stone and destination predicted first"
    assert method not in policy.config.methods() and method in pointing_policy().config.methods()


def test_it_learns_to_point_and_then_goes_where_it_points(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {
        "text_config": {"num_hidden_layers": 2},
        "vision_config": {"image_size": 56, "num_hidden_layers": 1},
    }
    policy = pointing_policy(chunk_size=1, n_action_steps=1, nano_config=small, **SINGLY)
    batch, places = pointing_batch(policy, 8), torch.tensor(PLACES)
    # demonstrations, as the other actions, lead to the place: nothing but the token tells two of them apart
    batch["action"] = torch.cat([5 * batch[PLACE], torch.zeros(8, 2)], dim=1)[:, None]
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    generator, metrics = torch.Generator().manual_seed(0), {}
    for _ in range(50):
        others = places[torch.randint(len(PLACES), (8, 2), generator=generator)]
        batch[OTHER_PLACES] = others.flatten(1)
        batch[OTHER_ACTIONS] = torch.cat([5 * others, torch.zeros(8, 2, 2)], dim=2).flatten(1)
        loss, metrics = policy.train()(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert metrics["stone_accuracy"] == metrics["token_accuracy"] == 1
    pointed, cells = policy._split(policy.write(batch, 1))
    assert pointed.tolist() == 2 * [[0, 30], [1, 6], [2, 30], [3, 6]]
    assert torch.equal(cells, policy.grids.encode(batch["action"]))
    pointer, slots = policy.pointer, policy._pointing_rows
    assert pointer is not None
    for place, (x, y) in enumerate(PLACES):
        only = slice(slots[0].start + place, slots[0].start + place + 1)
        monkeypatch.setattr(pointer, "slots", lambda _, only=only: [only, slots[1]])
        expected = policy.grids.encode(torch.tensor([5 * x, 5 * y, 0.0, 0.0]))
        assert torch.equal(policy.choose(batch, 1), expected.expand(8, 1, -1)), place
