"""Greedy decoding of numbers, one symbol a step."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import pad

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.vlm.backbone import SmolVLMBackbone

# (B,) last symbols, or None for the prompt -> (B, NUM_SYMBOLS) logits of the next symbol
NextLogits = Callable[[Tensor | None], Tensor]


class CachedContinuation:
    """Next-symbol logits of a backbone: one pass over the prompt, then one token a call on its cache."""

    def __init__(self, backbone: SmolVLMBackbone, embeds_BLH: Tensor, written_BL: Tensor, symbol_ids: Tensor):
        self._backbone = backbone
        self._symbol_ids = symbol_ids
        self._prompt_BLH = embeds_BLH
        self._written_BL = written_BL
        self._length_B = written_BL.sum(dim=1)
        self._cache = backbone.new_cache()

    def __call__(self, symbol_B: Tensor | None) -> Tensor:
        """(B,) symbols just chosen, None at first -> (B, NUM_SYMBOLS) logits."""
        last_BH = self._read_prompt() if symbol_B is None else self._read_symbol(symbol_B)
        return self._backbone.logits(last_BH)[:, self._symbol_ids]

    def _read_prompt(self) -> Tensor:
        positions_BL = (self._written_BL.cumsum(dim=1) - 1).clamp(min=0)
        hidden_BLH = self._backbone.hidden_states(
            self._prompt_BLH, self._written_BL, positions_BL, self._cache
        )
        rows_B = torch.arange(len(hidden_BLH), device=hidden_BLH.device)
        return hidden_BLH[rows_B, self._length_B - 1]

    def _read_symbol(self, symbol_B: Tensor) -> Tensor:
        embeds_B1H = self._backbone.embed_tokens(self._symbol_ids[symbol_B])[:, None]
        self._written_BL = pad(self._written_BL, (0, 1), value=True)
        hidden_B1H = self._backbone.hidden_states(
            embeds_B1H, self._written_BL, self._length_B[:, None], self._cache
        )
        self._length_B = self._length_B + 1
        return hidden_B1H[:, 0]


def pick(logits_BS: Tensor, choices_BS: Tensor) -> Tensor:
    """(B,) the likeliest symbol among the choices; a choice is taken even where logits are -inf or NaN."""
    finite_BS = logits_BS.float().nan_to_num(neginf=torch.finfo(torch.float32).min)
    return finite_BS.masked_fill(~choices_BS, -torch.inf).argmax(dim=1)


def decode_numbers(
    next_logits: NextLogits,
    grammar: NumberGrammar,
    *,
    batch_size: int,
    num_numbers: int,
    stop_after: int,
) -> Tensor:
    """The first ``stop_after`` of ``num_numbers`` greedily written numbers: (B, stop_after) int64.

    Only what the grammar allows is ever chosen, so every row is well-formed by construction. Rows
    finish at different steps; one that is done is fed the end symbol and no longer read.
    """
    device = grammar.value.device
    state_B = torch.full((batch_size,), grammar.BOUNDARY, device=device)
    begun_B = torch.zeros(batch_size, dtype=torch.int64, device=device)
    done_B = torch.zeros(batch_size, dtype=torch.bool, device=device)
    numbers_BN = torch.zeros(batch_size, stop_after, dtype=torch.int64, device=device)
    symbol_B = None
    while True:
        choices_BS = grammar.choices(state_B, num_numbers - begun_B)
        symbol_B = pick(next_logits(symbol_B), choices_BS).masked_fill(done_B, END)
        closes_B = grammar.is_number[state_B] & (symbol_B >= SPACE) & ~done_B
        current_B1 = (begun_B - 1).clamp(min=0)[:, None]
        written_B1 = torch.where(
            closes_B[:, None], grammar.value[state_B][:, None], numbers_BN.gather(1, current_B1)
        )
        numbers_BN.scatter_(1, current_B1, written_B1)
        done_B = done_B | (closes_B & (begun_B == stop_after))
        if bool(done_B.all()):
            return numbers_BN
        begun_B = begun_B + ((symbol_B == SPACE) & ~done_B)
        state_B = grammar.advance(state_B, symbol_B)
