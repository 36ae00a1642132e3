"""Greedy decoding of answers with one choice a slot, one pass of the model each.

What may stand in a slot does not depend on what stands before it, so the language needs no automaton: the
output head has only the slot's rows.

Shapes: `B` batch, `L` tokens of a prompt, `H` hidden size, `S` slots.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_bomb.vlm.cached_text import CachedText


class PromptContinuation:
    """Hidden states after a prompt, then after one more token at a time.

    The prompt may have gaps, but its last column is written. ``prompt_reads_all``: every token of the prompt
    reads all of it, not only what stands before.
    """

    def __init__(self, text: CachedText, prompt_BLH: Tensor, written_BL: Tensor, *, prompt_reads_all: bool):
        self._text = text
        self._column_B1 = written_BL.sum(dim=1, keepdim=True) - 1
        columns_BL = text.columns_of(written_BL)
        reach_BL = self._column_B1.expand_as(columns_BL) if prompt_reads_all else columns_BL
        hidden_BLH = text(prompt_BLH, columns_BL, reach_BL)
        self.hidden = hidden_BLH[:, -1]  # (B, H) after the newest token

    def append(self, embeds_BH: Tensor) -> None:
        """Read one more token in every row."""
        self._column_B1 = self._column_B1 + 1
        self.hidden = self._text(embeds_BH[:, None], self._column_B1)[:, 0]


@torch.no_grad()
def decode_slots(
    model: PromptContinuation,
    heads: list[Callable[[Tensor], Tensor]],
    embeds: list[Callable[[Tensor], Tensor]],
) -> Tensor:
    """(B, S) the likeliest choice in every slot, given those before it.

    ``heads``: (B, H) hidden states -> (B, choices) logits, for each slot; ``embeds``: (B,) choices -> (B, H).
    """
    choices = []
    for slot, (head, embed) in enumerate(zip(heads, embeds, strict=True)):
        choices.append(head(model.hidden).argmax(dim=-1))
        if slot < len(heads) - 1:
            model.append(embed(choices[-1]))
    return torch.stack(choices, dim=1)
