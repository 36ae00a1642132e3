"""Greedy decoding of numbers, several symbols a pass where they can be guessed.

A pass reads the symbol chosen last and some that are guessed to follow it, and gives the greedy choice after
each. As far as the guesses are these choices they are right, and so is the first choice that differs from its
guess: what is written is what one symbol a pass would write (speculative decoding, arXiv 2211.17192, for
greedy choices). Rows get on differently far in a pass, and leave the batch when they are done.

Shapes: `B` batch, `S` symbols, `A` columns of a row of symbols (the longest answer's and some to spare), `N`
numbers, `L` tokens of a prompt, `H` hidden size, `G` guesses, `K` = 1 + G.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.vlm.cached_text import CachedText

# (B, A) symbols written, END beyond, and where each row stands -> (B, G) guesses of what comes next, at most
# MAX_GUESSES
Guess = Callable[[Tensor, Place], Tensor]

MAX_GUESSES = 16
# where wrong ones cost time: how many are asked for in the first pass, which also reads the prompt
FIRST_GUESSES = 4


class Continuation(Protocol):
    """A model that goes on with rows of symbols."""

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        """(B, K) symbols, (B,) column of each row's first in its answer -> (B, K, S) logits after each."""
        ...

    def keep(self, row_B: Tensor) -> None:
        """Only these rows are gone on with, in this order."""
        ...


class Prompt(NamedTuple):
    """Rows of embeddings with gaps."""

    embeds: Tensor  # (B, L, H)
    written: Tensor  # (B, L) bool, which columns hold a token


class CachedContinuation(Continuation):
    """Symbol logits of a text model on its cache: the prompt is read in the first pass, then new symbols."""

    def __init__(
        self,
        text: CachedText,
        embed: Callable[[Tensor], Tensor],
        head: Callable[[Tensor], Tensor],
        length_B: Tensor,
        prompt: Prompt | None = None,
    ):
        """``embed``: symbols -> (..., H); ``head``: (..., H) -> (..., S); ``length_B``: of the prompts."""
        self._text, self._embed, self._head = text, embed, head
        self._length_B, self._prompt = length_B, prompt

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        num_symbols = symbol_BK.shape[1]
        embeds = self._embed(symbol_BK)
        columns = (self._length_B + first_B)[:, None] + torch.arange(num_symbols, device=first_B.device)
        columns = columns.clamp(max=self._text.unread_column)
        if self._prompt is not None:
            embeds = torch.cat([self._prompt.embeds, embeds], dim=1)
            columns = torch.cat([self._text.columns_of(self._prompt.written), columns], dim=1)
            self._prompt = None
        return self._head(self._text(embeds, columns)[:, -num_symbols:])

    def keep(self, row_B: Tensor) -> None:
        self._length_B = self._length_B[row_B]
        self._text.keep(row_B)


class Progress(NamedTuple):
    """How far rows of symbols are written."""

    symbols: Tensor  # (B, A) int64, END beyond what is written
    num_symbols: Tensor  # (B,) int64
    prefix: Tensor  # (B,) int64, of a `Place`
    number: Tensor  # (B,) int64, of a `Place`

    @classmethod
    def start(cls, grammar: NumberGrammar, batch_size: int) -> "Progress":
        """The space that every answer begins with is written."""
        place = grammar.start(batch_size)
        num_columns = grammar.max_symbols(grammar.num_numbers) + MAX_GUESSES + 1
        symbols_BA = place.prefix.new_full((batch_size, num_columns), END)
        symbols_BA[:, 0] = SPACE
        return cls(symbols_BA, torch.ones_like(place.prefix), place.prefix, place.number)

    @property
    def place(self) -> Place:
        return Place(self.prefix, self.number)

    def is_done(self, grammar: NumberGrammar, num_numbers: int) -> Tensor:
        """(B,) whether so many numbers are written."""
        complete_B = (self.number == num_numbers - 1) & grammar.must_end[self.prefix]
        return complete_B | (self.number >= num_numbers) | (self.prefix == grammar.DONE)

    def keep(self, row_B: Tensor) -> "Progress":
        """Those of these rows."""
        return Progress(*(tensor[row_B] for tensor in self))


@dataclass(frozen=True)
class Decoded:
    """What was written, and in how many passes, the prompt's included."""

    numbers: Tensor  # (B, stop_after) int64
    num_passes: int


def pick(logits: Tensor, penalty: Tensor) -> Tensor:
    """(..., S) -> (...) the likeliest allowed symbol; one is taken even from logits of -inf or NaN."""
    finite = logits.float().nan_to_num(neginf=torch.finfo(torch.float32).min)
    return (finite + penalty).argmax(dim=-1)


def write(
    model: Continuation, grammar: NumberGrammar, guess: Guess, progress: Progress, num_guesses: int
) -> tuple[Progress, Tensor]:
    """One pass: further progress, and (B,) how many guesses were right."""
    symbols_BA, num_written_B, place = progress.symbols, progress.num_symbols, progress.place
    max_symbols = grammar.max_symbols(grammar.num_numbers)
    guess_BG = guess(symbols_BA, place)[:, :num_guesses]
    columns_A = torch.arange(symbols_BA.shape[1], device=symbols_BA.device)
    columns_BK = num_written_B[:, None] + columns_A[: guess_BG.shape[1] + 1]
    last_B1 = symbols_BA.gather(1, columns_BK[:, :1] - 1)
    logits_BKS = model(torch.cat([last_B1, guess_BG], dim=1), num_written_B - 1)
    places_BK = grammar.walk(place, guess_BG)
    picks_BK = pick(logits_BKS, grammar.penalties(places_BK))
    num_right_B = (picks_BK[:, :-1] == guess_BG).cumprod(dim=1).sum(dim=1)
    place = grammar.advance(places_BK.at(num_right_B), picks_BK.gather(1, num_right_B[:, None])[:, 0])
    num_written_B = (num_written_B + num_right_B + 1).clamp(max=max_symbols)
    symbols_BA = symbols_BA.scatter(1, columns_BK, picks_BK)
    # what follows a wrong guess is not written
    symbols_BA = symbols_BA.masked_fill(columns_A >= num_written_B[:, None], END)
    return Progress(symbols_BA, num_written_B, place.prefix, place.number), num_right_B


@torch.no_grad()
def decode_numbers(
    model: Continuation, grammar: NumberGrammar, guess: Guess, *, batch_size: int, stop_after: int
) -> Decoded:
    """The first ``stop_after`` greedily written numbers of each row.

    Only what the grammar allows is ever chosen, so every row is well-formed by construction. What a row
    writes after it is done is ignored.
    """
    progress = Progress.start(grammar, batch_size)
    row_B = torch.arange(batch_size, device=progress.number.device)
    numbers = progress.number.new_empty(batch_size, stop_after)
    num_passes, num_guesses = 0, FIRST_GUESSES
    while True:
        progress, num_right_B = write(model, grammar, guess, progress, num_guesses)
        num_passes += 1
        # twice as many as were right, and one
        num_guesses = min(MAX_GUESSES, 1 + round(2 * float(num_right_B.float().mean())))
        kept_B = (~progress.is_done(grammar, stop_after)).nonzero()[:, 0]
        if len(kept_B) == len(row_B):
            continue
        numbers[row_B] = read_answer(progress.symbols, stop_after)
        if not len(kept_B):
            return Decoded(numbers, num_passes)
        model.keep(kept_B)
        row_B, progress = row_B[kept_B], progress.keep(kept_B)


def read_answer(symbol_BA: Tensor, num_numbers: int) -> Tensor:
    """(B, num_numbers) the first numbers that rows of symbols spell, the first symbol being a space."""
    is_digit_BA = symbol_BA < SPACE
    column_A = torch.arange(symbol_BA.shape[1], device=symbol_BA.device)
    end_BA = torch.where(is_digit_BA, len(column_A), column_A).flip(1).cummin(dim=1).values.flip(1)
    value_BA = torch.where(is_digit_BA, symbol_BA * 10 ** (end_BA - 1 - column_A).clamp(min=0), 0)
    number_BA = ((~is_digit_BA).cumsum(dim=1) - 1).clamp(max=num_numbers)
    sums_BN = symbol_BA.new_zeros(len(symbol_BA), num_numbers + 1).scatter_add(1, number_BA, value_BA)
    return sums_BN[:, :num_numbers]
