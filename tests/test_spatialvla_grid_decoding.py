"""The decoder against transformers' own model, masks, cache and greedy search."""

import copy
from typing import Any

import pytest
import torch
from spatialvla_grid_cases import make_batch, make_policy, rows
from torch import Tensor, nn
from transformers import LogitsProcessor

from lerobot_bomb.vlm.cached_text import CachedText
from lerobot_bomb.vlm.images import crop_and_resize
from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy


class Slots(LogitsProcessor):
    """Lets only a slot's cells through."""

    def __init__(self, policy: SpatialvlaGridPolicy, first_cell: int, prompt_length: int):
        self.grids, self.first_cell, self.prompt_length = policy.grids, first_cell, prompt_length

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        group = (input_ids.shape[1] - self.prompt_length) % len(self.grids.groups)
        first = self.first_cell + self.grids.offsets[group]
        allowed = slice(first, first + self.grids.num_cells[group])
        masked = torch.full_like(scores, -torch.inf)
        masked[:, allowed] = scores[:, allowed]
        return masked


def generated(policy: SpatialvlaGridPolicy, batch: dict[str, Any]) -> Tensor:
    """(B, T, G) cells: the stock model with the cells as words, its prompt padded on the left."""
    vlm: Any = copy.deepcopy(policy.backbone.vlm)
    words = vlm.get_input_embeddings()
    first_cell = len(words.weight)
    words.weight = nn.Parameter(torch.cat([words.weight, policy.cell_embedding.weight]))
    vlm.lm_head.weight = nn.Parameter(torch.cat([vlm.lm_head.weight, policy.cell_head.weight]))
    vlm.config.text_config.vocab_size = vlm.model.vocab_size = len(words.weight)
    prompt = policy._prompt(batch)
    ids, written = (torch.zeros_like(column) for column in (prompt.ids, prompt.written))
    for row, kept in enumerate(prompt.written):
        ids[row, -int(kept.sum()) :], written[row, -int(kept.sum()) :] = prompt.ids[row, kept], True
    pixels = torch.stack(
        [crop_and_resize(batch[key], 0.9, policy.backbone.image_size, None) for key in policy._cameras], 1
    )
    num_slots = policy.config.chunk_size * len(policy.grids.groups)
    tokens = vlm.generate(
        input_ids=ids,
        attention_mask=written.long(),
        token_type_ids=torch.zeros_like(ids),
        pixel_values=pixels.flatten(0, 1),
        max_new_tokens=num_slots,
        min_new_tokens=num_slots,
        do_sample=False,
        logits_processor=[Slots(policy, first_cell, ids.shape[1])],
    )
    cells = tokens[:, ids.shape[1] :].unflatten(1, (policy.config.chunk_size, -1)) - first_cell
    return cells - torch.tensor(policy.grids.offsets)


@torch.no_grad()
@pytest.mark.parametrize(("batch_size", "num_dims"), [(1, 7), (7, 7), (3, 4), (2, 2)])
def test_it_chooses_what_generate_chooses(batch_size: int, num_dims: int) -> None:
    for seed in range(3):
        policy = make_policy(seed, num_dims)
        batch = make_batch(policy, batch_size, seed)
        assert torch.equal(policy._choose(batch, policy.config.chunk_size), generated(policy, batch))


@torch.no_grad()
@pytest.mark.parametrize("prefix_attention", ["bidirectional", "causal"])
def test_training_and_decoding_agree(prefix_attention: str) -> None:
    """What the teacher-forced network finds likeliest, given what was chosen, is what was chosen."""
    policy = make_policy(1, 7, prefix_attention=prefix_attention, use_state=True)
    batch = make_batch(policy, 3)
    cells = policy._choose(batch, policy.config.chunk_size)
    assert torch.equal(policy._losses(policy._hidden(batch, cells), cells)[1], cells)


def test_a_rows_actions_do_not_depend_on_the_batch() -> None:
    policy = make_policy(2, 7)
    batch = make_batch(policy, 3)
    together = policy.predict_action_chunk(batch)
    for row in range(3):
        alone = policy.predict_action_chunk(rows(batch, slice(row, row + 1)))
        assert torch.equal(alone[0], together[row])


def test_only_what_is_executed_is_decoded_with_one_pass_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy(0, 7, n_action_steps=2)
    batch = make_batch(policy, 2)
    chunk = policy.predict_action_chunk(batch)
    passes: list[int] = []

    class Counted(CachedText):
        def __call__(self, *args: Any) -> Tensor:
            passes.append(args[0].shape[1])
            return super().__call__(*args)

    monkeypatch.setattr("lerobot_policy_spatialvla_grid.modeling_spatialvla_grid.CachedText", Counted)
    assert torch.equal(policy.select_action(batch), chunk[:, 0])
    assert torch.equal(policy.select_action(batch), chunk[:, 1])
    assert len(passes) == 2 * 3 and passes[1:] == [1] * 5
