"""Greedy decoding of numbers, several symbols a pass where they can be guessed.

A pass reads the symbol chosen last and some that are guessed to follow it, and gives the greedy choice after
each. As far as the guesses are these choices they are right, and so is the first choice that differs from its
guess: what is written is what one symbol a pass would write (speculative decoding, arXiv 2211.17192, for
greedy choices). Rows get on differently far in a pass, and leave the batch when they are done.

Shapes: `B` batch, `S` symbols, `A` columns of a row of symbols (the longest answer's and some to spare), `N`
numbers, `G` guesses, `K` = 1 + G.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.vlm.backbone import SmolVLMBackbone
from lerobot_bomb.vlm.cached_text import CachedText, on_host

# (B, A) symbols written, END beyond, and where each row stands -> (B, G) guesses of what comes next, at most
# MAX_GUESSES
Guess = Callable[[Tensor, Place], Tensor]

MAX_GUESSES = 16
# where the host looks at every pass: how many are asked for in the first, which also reads the prompt
FIRST_GUESSES = 4
# between two looks at which rows are done; a device works while the host runs ahead
PASSES_ON_DEVICE = 8


class Continuation(Protocol):
    """A model that goes on with rows of symbols."""

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        """(B, K) symbols, (B,) column of each row's first in its answer -> (B, K, S) logits after each."""
        ...

    def keep(self, row_B: Tensor) -> None:
        """Only these rows are gone on with, in this order."""
        ...


@dataclass(frozen=True)
class Decoded:
    """What was written, and in how many passes, the prompt's included."""

    numbers: Tensor  # (B, stop_after) int64
    num_passes: int


class CachedContinuation(Continuation):
    """Symbol logits of a backbone: the prompt is read in the first pass, then only new symbols."""

    def __init__(
        self,
        backbone: SmolVLMBackbone,
        prompt_BLH: Tensor,
        written_BL: Tensor,
        symbol_ids: Tensor,
        max_symbols: int,
    ):
        self._backbone = backbone
        self._symbol_ids = symbol_ids
        self._head = backbone.head(symbol_ids)
        self._length_B1 = written_BL.sum(dim=1, keepdim=True)
        self._text = CachedText(
            backbone.vlm.model.text_model, len(prompt_BLH), prompt_BLH.shape[1] + max_symbols
        )
        columns_BL = self._text.columns_of(written_BL)
        self._prompt: tuple[Tensor, Tensor] | None = prompt_BLH, columns_BL

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        num_symbols = symbol_BK.shape[1]
        embeds = self._backbone.embed_tokens(self._symbol_ids[symbol_BK])
        columns = self._length_B1 + first_B[:, None] + torch.arange(num_symbols, device=first_B.device)
        columns = columns.clamp(max=self._text.unread_column)
        if self._prompt is not None:
            prompt_BLH, columns_BL = self._prompt
            embeds, columns = torch.cat([prompt_BLH, embeds], 1), torch.cat([columns_BL, columns], 1)
            self._prompt = None
        return self._head(self._text(embeds, columns)[:, -num_symbols:])

    def keep(self, row_B: Tensor) -> None:
        self._length_B1 = self._length_B1[row_B]
        self._text.keep(row_B)


def pick(logits: Tensor, penalty: Tensor) -> Tensor:
    """(..., S) -> (...) the likeliest allowed symbol; one is taken even from logits of -inf or NaN."""
    finite = logits.float().nan_to_num(neginf=torch.finfo(torch.float32).min)
    return (finite + penalty).argmax(dim=-1)


@torch.no_grad()
def decode_numbers(
    model: Continuation, grammar: NumberGrammar, guess: Guess, *, batch_size: int, stop_after: int
) -> Decoded:
    """The first ``stop_after`` greedily written numbers of each row.

    Only what the grammar allows is ever chosen, so every row is well-formed by construction. What a row
    writes after it is done is ignored.
    """

    def is_done(place: Place) -> Tensor:
        complete_B = (place.number == stop_after - 1) & grammar.must_end[place.prefix]
        return complete_B | (place.number >= stop_after) | (place.prefix == grammar.DONE)

    place, max_symbols = grammar.start(batch_size), grammar.max_symbols(grammar.num_numbers)
    row_B = torch.arange(batch_size, device=place.prefix.device)
    numbers = place.prefix.new_empty(batch_size, stop_after)
    symbols_BA = place.prefix.new_full((batch_size, max_symbols + MAX_GUESSES + 1), END)
    symbols_BA[:, 0] = SPACE
    num_written_B = torch.ones_like(place.prefix)
    columns_A = torch.arange(symbols_BA.shape[1], device=symbols_BA.device)
    looks_at_every_pass = on_host(symbols_BA)
    num_passes, num_guesses = 0, FIRST_GUESSES if looks_at_every_pass else MAX_GUESSES
    while True:
        guess_BG = guess(symbols_BA, place)[:, :num_guesses]
        columns_BK = num_written_B[:, None] + columns_A[: guess_BG.shape[1] + 1]
        last_B1 = symbols_BA.gather(1, columns_BK[:, :1] - 1)
        logits_BKS = model(torch.cat([last_B1, guess_BG], dim=1), num_written_B - 1)
        num_passes += 1
        places_BK = grammar.walk(place, guess_BG)
        picks_BK = pick(logits_BKS, grammar.penalties(places_BK))
        num_right_B = (picks_BK[:, :-1] == guess_BG).cumprod(dim=1).sum(dim=1)
        place = grammar.advance(places_BK.at(num_right_B), picks_BK.gather(1, num_right_B[:, None])[:, 0])
        num_written_B = (num_written_B + num_right_B + 1).clamp(max=max_symbols)
        symbols_BA.scatter_(1, columns_BK, picks_BK)
        # what follows a wrong guess is not written
        symbols_BA.masked_fill_(columns_A >= num_written_B[:, None], END)
        if looks_at_every_pass:  # wrong guesses cost time there: twice as many as were right, and one
            num_guesses = min(MAX_GUESSES, 1 + round(2 * float(num_right_B.float().mean())))
        elif num_passes % PASSES_ON_DEVICE:
            continue
        kept_B = (~is_done(place)).nonzero()[:, 0]
        if len(kept_B) == len(row_B):
            continue
        numbers[row_B] = read_answer(symbols_BA, stop_after)
        if not len(kept_B):
            return Decoded(numbers, num_passes)
        model.keep(kept_B)
        row_B, place, num_written_B = row_B[kept_B], place.keep(kept_B), num_written_B[kept_B]
        symbols_BA = symbols_BA[kept_B]


def read_answer(symbol_BA: Tensor, num_numbers: int) -> Tensor:
    """(B, num_numbers) the first numbers that rows of symbols spell, the first symbol being a space."""
    is_digit_BA = symbol_BA < SPACE
    column_A = torch.arange(symbol_BA.shape[1], device=symbol_BA.device)
    end_BA = torch.where(is_digit_BA, len(column_A), column_A).flip(1).cummin(dim=1).values.flip(1)
    value_BA = torch.where(is_digit_BA, symbol_BA * 10 ** (end_BA - 1 - column_A).clamp(min=0), 0)
    number_BA = ((~is_digit_BA).cumsum(dim=1) - 1).clamp(max=num_numbers)
    sums_BN = symbol_BA.new_zeros(len(symbol_BA), num_numbers + 1).scatter_add(1, number_BA, value_BA)
    return sums_BN[:, :num_numbers]
