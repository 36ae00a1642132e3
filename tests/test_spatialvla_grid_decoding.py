"""The decoder against transformers' own model, masks, cache and greedy search."""

from typing import Any

import pytest
import torch
from decode_ways import CellsByGenerate
from spatialvla_grid_cases import make_batch, make_policy, rows
from torch import Tensor

from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.decoding.slots import SlotHead


@torch.no_grad()
@pytest.mark.parametrize(("batch_size", "num_dims"), [(1, 7), (7, 7), (3, 4), (2, 2)])
def test_it_chooses_what_generate_chooses(batch_size: int, num_dims: int) -> None:
    for seed in range(3):
        policy = make_policy(seed, num_dims)
        batch = make_batch(policy, batch_size, seed)
        generate = CellsByGenerate(policy)
        cells = policy.choose(batch, policy.config.chunk_size)
        assert torch.equal(cells.flatten(1), generate(generate.inputs(batch)).numbers)


@torch.no_grad()
@pytest.mark.parametrize("prefix_attention", ["bidirectional", "causal"])
def test_training_and_decoding_agree(prefix_attention: str) -> None:
    """Check that the teacher-forced network finds likeliest what was chosen, given what was chosen."""
    policy = make_policy(1, 7, prefix_attention=prefix_attention, use_state=True)
    batch = make_batch(policy, 3)
    answer = policy.write(batch, policy.config.chunk_size)
    assert torch.equal(policy._losses(policy._hidden(batch, answer)[0], answer)[1], answer)


def test_a_rows_actions_do_not_depend_on_the_batch() -> None:
    policy = make_policy(2, 7)
    batch = make_batch(policy, 3)
    together = policy.predict_action_chunk(batch)
    for row in range(3):
        alone = policy.predict_action_chunk(rows(batch, slice(row, row + 1)))
        assert torch.equal(alone[0], together[row])


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Tokens of every pass, the prompt's first."""
    passes: list[int] = []

    class Counted(CachedText):
        def read(self, *args: Any) -> Tensor:
            passes.append(args[0].shape[1])
            return super().read(*args)

    monkeypatch.setattr("lerobot_bomb.decoding.slots.CachedText", Counted)
    return passes


def test_a_draft_saves_passes_and_changes_no_cell(passes: list[int]) -> None:
    policy = make_policy(2, 7, nano_config=None)
    batch = make_batch(policy, 1, 2)
    drafted = policy.choose(batch, 4)
    # cells of the same group follow each other here, but not always
    assert 0.5 < (drafted[:, 1:] == drafted[:, :-1]).float().mean() < 1
    assert policy.last_passes == len(passes) < 12
    passes.clear()
    policy._decoder.drafted = False
    assert torch.equal(policy.choose(batch, 4), drafted)
    assert passes[1:] == [1] * 11


def test_only_what_is_executed_is_decoded_with_one_pass_a_cell(passes: list[int]) -> None:
    policy = make_policy(0, 7, n_action_steps=2)
    batch = make_batch(policy, 2)
    chunk = policy.predict_action_chunk(batch)
    passes.clear()
    assert torch.equal(policy.select_action(batch), chunk[:, 0])
    assert torch.equal(policy.select_action(batch), chunk[:, 1])
    assert policy.last_passes == policy.last_tokens == len(passes) == 2 * 3 and passes[1:] == [1] * 5


@torch.no_grad()
def test_samples_are_as_frequent_as_the_capped_softmax_of_a_slot() -> None:
    groups = [
        {"dims": [0, 1], "transform": "identity", "bins": [4, 4]},
        {"dims": [2, 3], "transform": "identity", "bins": [4, 2]},
    ]
    policy = make_policy(0, 4, chunk_size=1, n_action_steps=1, temperature=0.8, action_groups=groups)
    policy.cell_head.weight *= 3  # into the cap
    policy.backbone.softcap = 1.5
    num_rows = 20_000
    batch = make_batch(policy, 1)
    noise = policy._choice_noise(num_rows, (1, policy.grids.num_tokens))
    assert noise is not None
    hidden_BH = policy._hidden(batch, policy.write(batch, 1))[0][:, 0].expand(num_rows, -1)
    slot = policy._group_rows[0]
    head = SlotHead(policy.cell_head.weight, noise, policy.backbone.cap)
    seen = torch.bincount(head.logits(hidden_BH, 0, slot).argmax(dim=1), minlength=slot.stop)
    logits = policy.backbone.cap(hidden_BH[0] @ policy.cell_head.weight[slot].T)
    expected = num_rows * (logits / 0.8).softmax(dim=0)
    assert expected.max() > 2 * expected.min() > 10
    assert ((seen - expected).square() / expected).sum() < 37.7  # 15 degrees of freedom: p = 0.001


def test_a_draft_changes_no_sample_and_an_episode_has_its_own() -> None:
    cells = []
    for draft, noise_seed in (("repeat", 0), ("none", 0), ("none", 1)):
        policy = make_policy(2, 7, nano_config=None, temperature=0.5, noise_seed=noise_seed, draft=draft)
        batch = make_batch(policy, 1, 2)
        cells.append(torch.stack([policy.choose(batch, 4) for _ in range(2)]))
    assert torch.equal(cells[0], cells[1])
    assert not torch.equal(cells[1], cells[2]) and not torch.equal(cells[1][0], cells[1][1])
