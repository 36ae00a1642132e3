"""Greedy decoding of answers with one choice a slot, one pass of the model each.

What may stand in a slot does not depend on what stands before it, so the language needs no automaton: the
output head has only the slot's rows.

Shapes: `B` batch, `L` tokens of a prompt, `H` hidden size, `S` slots, `C` choices of all kinds of slots.
"""

from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding, linear

from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.vlm.cached_text import CachedText
from lerobot_bomb.vlm.graphs import Recorded
from lerobot_bomb.vlm.recordings import Recordings
from lerobot_bomb.vlm.text_layers import TextLayers


class SlotWriter:
    """Choices after prompts; on CUDA recorded whole for every shape of prompts that it has met.

    The prompt may have gaps, but its last column is written. ``prompt_reads_all``: every token of the prompt
    reads all of it, not only what stands before.
    """

    def __init__(
        self, text_model: Any, first_position: int, *, prompt_reads_all: bool, compiled: bool = False
    ):
        self._text_model, self._first_position = text_model, first_position
        self._reads_all = prompt_reads_all
        self._recordings = Recordings[RecordedChoices](text_model, first_position, compiled=compiled)

    @torch.no_grad()
    def __call__(self, prompt: Prompt, slots: list[slice], embeds_CH: Tensor, head_CH: Tensor) -> Tensor:
        """(B, S) the likeliest choice in every slot, given those before it.

        ``slots``: which of the choices come into question, counted from the first of them; ``embeds_CH`` and
        ``head_CH``: the choices' rows of the embedding and of the output head.
        """
        if prompt.embeds.is_cuda:
            with torch.inference_mode(False), torch.no_grad():
                make = partial(RecordedChoices, slots, self._reads_all, embeds_CH, head_CH)
                recorded = self._recordings.find(prompt.embeds, len(slots), make)
                return recorded(prompt, embeds_CH, head_CH)
        batch_size, num_columns, _ = prompt.embeds.shape
        layers = TextLayers(self._text_model)
        text = CachedText(layers, batch_size, num_columns + len(slots), self._first_position)
        return choose(text, prompt, slots, embeds_CH, head_CH, prompt_reads_all=self._reads_all)


class RecordedChoices:
    """Choices after prompts of one shape."""

    def __init__(
        self, slots: list[slice], reads_all: bool, embeds_CH: Tensor, head_CH: Tensor, text: CachedText
    ):
        self._text, self._slots, self._reads_all = text, slots, reads_all
        self._embeds_CH, self._head_CH = embeds_CH.clone(), head_CH.clone()
        self._choose = Recorded(self._choose_all)

    def __call__(self, prompt: Prompt, embeds_CH: Tensor, head_CH: Tensor) -> Tensor:
        """As `choose`."""
        self._embeds_CH.copy_(embeds_CH)
        self._head_CH.copy_(head_CH)
        return self._choose(*prompt)[0].clone()

    def _choose_all(self, embeds_BLH: Tensor, written_BL: Tensor) -> tuple[Tensor]:
        self._text.clear()
        prompt = Prompt(embeds_BLH, written_BL)
        tables = self._embeds_CH, self._head_CH
        return (choose(self._text, prompt, self._slots, *tables, prompt_reads_all=self._reads_all),)


def choose(
    text: CachedText,
    prompt: Prompt,
    slots: list[slice],
    embeds_CH: Tensor,
    head_CH: Tensor,
    *,
    prompt_reads_all: bool,
) -> Tensor:
    """As `SlotWriter`, on an empty cache."""
    last_B1 = prompt.written.sum(dim=1, keepdim=True) - 1
    columns_BL = text.columns_of(prompt.written)
    reach_BL = last_B1.expand_as(columns_BL) if prompt_reads_all else columns_BL
    hidden_BKH = text(prompt.embeds, columns_BL, reach_BL)
    choices = []
    for column, slot in enumerate(slots, 1):
        choices.append(linear(hidden_BKH[:, -1], head_CH[slot]).argmax(dim=-1))
        if column < len(slots):
            embeds_BH = embedding(choices[-1] + slot.start, embeds_CH)
            hidden_BKH = text(embeds_BH[:, None], last_B1 + column)
    return torch.stack(choices, dim=1)
