"""Decoding of answers with one choice per slot, in one pass of the model each, or fewer.

An answer has steps of the same slots, and may have others ahead of them. Which choices a slot allows does not
depend on those before it, so no automaton is needed: the output head has only the slot's rows.

Shapes: `B` batch, `L` tokens of a prompt, `H` hidden size, `T` steps of an answer, `G` slots of a step, `S`
of an answer, `C` choices of all kinds of slots, `K` tokens of a pass.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from operator import and_, eq
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding

from lerobot_bomb.cuda_graphs import GraphedFunction
from lerobot_bomb.decoding.decoder import MAX_GUESSES, Prompt, likeliest
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.graph_cache import GraphCache
from lerobot_bomb.decoding.kv_cache import CachedText, Positions
from lerobot_bomb.finite import require_finite_answers
from lerobot_bomb.vlm.backbone import exact_linear, in_float32


class SlotDecoder:
    """Decoder of choices after prompts; on CUDA captured whole for every shape of prompts.

    The prompt may have padding, but not in its last column. ``bidirectional_prompt``: every token
    of the prompt attends to all of it, not only to the tokens before.
    """

    def __init__(
        self,
        text_model: Any,
        positions: Positions,
        *,
        bidirectional_prompt: bool,
        cap: Callable[[Tensor], Tensor],
        drafted: bool = False,
        compiled: bool = False,
    ):
        """``cap``: limits logits; ``drafted``: on a CPU, for one row, guess that a step repeats the last."""
        self._text_model, self._positions, self._cap = text_model, positions, cap
        self._bidirectional_prompt, self.drafted = bidirectional_prompt, drafted
        self.num_passes: int | None = None  # of the last answers, the prompt's included
        self._graphs = GraphCache[GraphSlots](text_model, positions, compiled=compiled)

    @torch.no_grad()
    def __call__(
        self,
        prompt: Prompt,
        slots: list[slice],
        num_steps: int,
        embeds_CH: Tensor,
        head_CH: Tensor,
        noise: Tensor | None = None,
        ahead: Sequence[slice] = (),
    ) -> Tensor:
        """(B, S) the likeliest choice in every slot, given those before it, or with ``noise`` a sampled one.

        ``slots``: the choices that each slot of a step allows; results count from the first of them;
        ``ahead``: the same for slots chosen once, before the steps, with the noise of the first step;
        ``embeds_CH`` and ``head_CH``: the choices' rows of the embedding and of the output head; ``noise``
        (B, T, C): added to the choices' logits.

        Raises:
            ValueError: a row's logits are not finite. On CUDA the host waits for the answers to learn of it.
        """
        places = _places(ahead, slots, num_steps)
        self.num_passes = num_slots = len(places)
        if noise is None:
            noise = prompt.embeds.new_empty(len(prompt.embeds), 0, len(head_CH))
        if prompt.embeds.is_cuda:
            with torch.inference_mode(False), torch.no_grad():
                settings = slots, num_steps, self._bidirectional_prompt, self._cap
                make = partial(GraphSlots, *settings, embeds_CH, head_CH, ahead=ahead)
                captured = self._graphs.find(prompt.embeds, num_slots, make)
                choices_BS, finite_B = captured(prompt, embeds_CH, head_CH, noise)
            require_finite_answers(finite_B)
            return choices_BS
        batch_size, num_columns, _ = prompt.embeds.shape
        layers = TextLayers(self._text_model)
        text = CachedText(layers, batch_size, num_columns + num_slots, self._positions)
        head = SlotHead(head_CH, noise, self._cap)
        # several rows seldom agree on how many guesses are right
        is_drafted = self.drafted and batch_size == 1
        singly = places[: len(ahead) + len(slots)] if is_drafted else places
        choices_BS, finite_B = choose(
            text, prompt, singly, embeds_CH, head, bidirectional_prompt=self._bidirectional_prompt
        )
        require_finite_answers(finite_B)
        if not is_drafted:
            return choices_BS
        length = int(prompt.mask.sum())
        answer_BS, num_more = repeat(text, length, places, len(slots), choices_BS, embeds_CH, head)
        self.num_passes = len(singly) + num_more
        return answer_BS


@dataclass(frozen=True)
class SlotHead:
    """Source of the logits of choices: rows of the output head and, for samples, noise."""

    rows: Tensor  # (C, H)
    noise: Tensor  # (B, T, C), added to the logits; T = 0: the likeliest is chosen
    cap: Callable[[Tensor], Tensor]  # of the logits, which keeps their order

    def logits(self, hidden_BH: Tensor, step: int, slot: slice) -> Tensor:
        """(B, H) -> (B, choices of the slot) float32."""
        return self._finish(exact_linear(hidden_BH, self.rows[slot]), step, slot)

    def logits_of_tokens(self, hidden_KH: Tensor, places: list[tuple[int, slice]]) -> list[Tensor]:
        """Return the float32 logits of the choices of one row's tokens, given each token's step and slot."""
        products = in_float32(partial(self._multiply, [slot for _, slot in places]), hidden_KH)
        return [
            self._finish(of_token, step, slot)
            for of_token, (step, slot) in zip(products, places, strict=True)
        ]

    def _multiply(self, slots: list[slice], hidden_KH: Tensor) -> list[Tensor]:
        rows_CH = self.rows.float()
        return [rows_CH[slot] @ hidden_H for slot, hidden_H in zip(slots, hidden_KH, strict=True)]

    def _finish(self, logits: Tensor, step: int, slot: slice) -> Tensor:
        if not self.noise.shape[1]:
            return logits
        return self.cap(logits) + self.noise[:, step, slot]


class GraphSlots:
    """Decoder of choices after prompts of one shape."""

    def __init__(
        self,
        slots: list[slice],
        num_steps: int,
        bidirectional_prompt: bool,
        cap: Callable[[Tensor], Tensor],
        embeds_CH: Tensor,
        head_CH: Tensor,
        text: CachedText,
        ahead: Sequence[slice] = (),
    ):
        self._text, self._places = text, _places(ahead, slots, num_steps)
        self._bidirectional_prompt, self._cap = bidirectional_prompt, cap
        self._embeds_CH, self._head_CH = embeds_CH.clone(), head_CH.clone()
        self._choose = GraphedFunction(self._choose_all)

    def __call__(
        self, prompt: Prompt, embeds_CH: Tensor, head_CH: Tensor, noise_BTC: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Choose as `choose`; the next call writes over the second result."""
        self._embeds_CH.copy_(embeds_CH)
        self._head_CH.copy_(head_CH)
        choices_BS, finite_B = self._choose(*prompt.tensors, noise_BTC)
        return choices_BS.clone(), finite_B

    def _choose_all(
        self, embeds_BLH: Tensor, mask_BL: Tensor, hidden_BL: Tensor, noise_BTC: Tensor
    ) -> tuple[Tensor, Tensor]:
        self._text.clear()
        prompt = Prompt(embeds_BLH, mask_BL, hidden_BL)
        head = SlotHead(self._head_CH, noise_BTC, self._cap)
        answer = self._places, self._embeds_CH, head
        return choose(self._text, prompt, *answer, bidirectional_prompt=self._bidirectional_prompt)


def _places(ahead: Sequence[slice], slots: Sequence[slice], num_steps: int) -> list[tuple[int, slice]]:
    """Return the step and the slot of every choice of an answer."""
    return [(0, slot) for slot in ahead] + [(step, slot) for step in range(num_steps) for slot in slots]


def choose(
    text: CachedText,
    prompt: Prompt,
    places: list[tuple[int, slice]],
    embeds_CH: Tensor,
    head: SlotHead,
    *,
    bidirectional_prompt: bool,
) -> tuple[Tensor, Tensor]:
    """Choose as `SlotDecoder`, on an empty cache; also return (B,) bool, all logits were finite."""
    last_B1 = prompt.mask.sum(dim=1, keepdim=True) - 1
    columns_BL = text.columns_of(prompt.mask)
    if prompt.hidden is not None:
        text.hide(columns_BL, prompt.hidden)
    reach_BL = last_B1.expand_as(columns_BL) if bidirectional_prompt else columns_BL
    hidden_BH = text(prompt.embeds, columns_BL, reach_BL)[:, -1]
    chosen = [likeliest(head.logits(hidden_BH, *places[0]))]
    passes = text.singly(last_B1 + torch.arange(1, len(places), device=last_B1.device))
    for columns, (_, before), place in zip(passes, places[:-1], places[1:], strict=True):
        embeds_BH = embedding(chosen[-1][0], embeds_CH[before])
        hidden_BH = text.read(embeds_BH[:, None], columns)[:, 0]
        chosen.append(likeliest(head.logits(hidden_BH, *place)))
    choices_BS, logits_BS = (torch.stack(of_slots, dim=1) for of_slots in zip(*chosen, strict=True))
    return choices_BS, logits_BS.isfinite().all(dim=1)


def repeat(
    text: CachedText,
    length: int,
    places: list[tuple[int, slice]],
    num_kinds: int,
    first_1S: Tensor,
    embeds_CH: Tensor,
    head: SlotHead,
) -> tuple[Tensor, int]:
    """Choose several a pass, after a prompt of this length: (1, S), as one a pass would, and the passes.

    ``first_1S``: choices up to the end of the first step, which has ``num_kinds`` slots.

    A pass reads the last choice and guesses that repeat the step before. Guesses are right up to the first
    that differs from the likeliest choice, and that choice is right, too.
    """
    chosen: list[int] = first_1S[0].tolist()
    num_tokens, num_passes = 1, 0
    while len(chosen) < len(places):
        num_passes += 1
        asked = places[len(chosen) : len(chosen) + num_tokens]
        guesses = [chosen[ahead % num_kinds - num_kinds] for ahead in range(num_tokens)]
        read = [chosen[-1] + places[len(chosen) - 1][1].start]
        read += [guess + slot.start for guess, (_, slot) in zip(guesses[:-1], asked, strict=False)]
        column_K = torch.arange(num_tokens, device=first_1S.device) + length + len(chosen) - 1
        (hidden_KH,) = text(embeds_CH[read][None], column_K[None])
        logits = head.logits_of_tokens(hidden_KH, asked)
        require_finite_answers(torch.cat(logits, dim=-1).isfinite().all()[None])
        picks = [int(of_slot.argmax()) for of_slot in logits]
        # one that was not read may be right, too: it says how many to read in the next pass
        num_right = sum(accumulate(map(eq, picks, guesses), and_))
        chosen += picks[: num_right + 1]
        num_tokens = min(MAX_GUESSES, 1 + 2 * num_right, len(places) - len(chosen))
    return first_1S.new_tensor([chosen]), num_passes
