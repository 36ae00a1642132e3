"""Decoding of numbers, several symbols a pass where they can be guessed.

A pass reads the symbol chosen last and some that are guessed to follow it, and gives the likeliest choice
after each. Guesses are right up to the first that differs from its choice, and that choice is right, too. So
a row gets the symbols that one a pass would write (speculative decoding, arXiv 2211.17192, for greedy
choices). Rows advance by different numbers of symbols, and leave the batch when they are done.

A sample is the likeliest choice after Gumbel noise was added to the logits (arXiv 1611.01144, section 2.1).
The noise belongs to a symbol's place in the answer, so guesses change no sample either.

Shapes: `B` batch, `S` symbols, `N` numbers, `L` tokens of a prompt, `H` hidden size, `G` guesses,
`K` = 1 + G.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lerobot_bomb.actions.text import NUM_SYMBOLS, SPACE
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.finite import require_finite_answers

# (B, N) complete numbers and each row's place -> (B, G) guesses of the symbols that follow, at most
# MAX_GUESSES
Guess = Callable[[Tensor, Place], Tensor]

MAX_GUESSES = 24
# guesses in the first pass, which also reads the prompt, where wrong ones cost time
FIRST_GUESSES = 4


class Continuation(Protocol):
    """A model that continues rows of symbols."""

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        """(B, K) symbols, (B,) column of each row's first in the answer -> (B, K, S) logits after each."""
        ...

    def keep(self, row_B: Tensor) -> None:
        """Go on with these rows only, in this order."""
        ...


class Prompt(NamedTuple):
    """Rows of embeddings with padding."""

    embeds: Tensor  # (B, L, H)
    mask: Tensor  # (B, L) bool, which columns hold a token
    hidden: Tensor | None = None  # (B, L) bool, tokens that no other reads; None: there are none

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Prompt as tensors, with defaults in place of None."""
        return self.embeds, self.mask, torch.zeros_like(self.mask) if self.hidden is None else self.hidden


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
        """``embed``: symbols -> (..., H); ``head``: (..., H) -> (..., S); ``length_B``: prompts' lengths."""
        self._text, self._embed, self._head = text, embed, head
        self._length_B, self._prompt = length_B, prompt

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        num_symbols = symbol_BK.shape[1]
        embeds = self._embed(symbol_BK)
        columns = (self._length_B + first_B)[:, None] + torch.arange(num_symbols, device=first_B.device)
        columns = columns.clamp(max=self._text.unread_column)
        if self._prompt is not None:
            embeds = torch.cat([self._prompt.embeds, embeds], dim=1)
            of_prompt = self._text.columns_of(self._prompt.mask)
            if self._prompt.hidden is not None:
                self._text.hide(of_prompt, self._prompt.hidden)
            columns = torch.cat([of_prompt, columns], dim=1)
            self._prompt = None
        return self._head(self._text(embeds, columns)[:, -num_symbols:])

    def keep(self, row_B: Tensor) -> None:
        self._length_B = self._length_B[row_B]
        self._text.keep(row_B)


class Answers(NamedTuple):
    """Rows of symbols written so far."""

    numbers: Tensor  # (B, N) int64 those that are complete, else 0
    last: Tensor  # (B,) int64, the symbol written last
    num_symbols: Tensor  # (B,) int64
    prefix: Tensor  # (B,) int64, of a `Place`
    number: Tensor  # (B,) int64, of a `Place`
    finite: Tensor  # (B,) bool, whether all that is written is from finite logits
    noise: Tensor  # (B, A, S) of the A symbols of an answer, added to their logits; A = 0: none is

    @classmethod
    def start(cls, grammar: NumberGrammar, batch_size: int, noise: Tensor | None = None) -> "Answers":
        """Start answers after the space that each begins with."""
        place = grammar.start(batch_size)
        numbers_BN = place.prefix.new_zeros(batch_size, grammar.num_numbers)
        ones_B = torch.ones_like(place.prefix)
        if noise is None:
            noise = torch.empty(batch_size, 0, NUM_SYMBOLS, device=ones_B.device)
        return cls(numbers_BN, SPACE * ones_B, ones_B, place.prefix, place.number, ones_B.bool(), noise)

    def noise_of(self, num_choices: int) -> Tensor:
        """(B, K, S) noise of the next K choices."""
        column_K = torch.arange(num_choices, device=self.noise.device)
        index_BK = (self.num_symbols[:, None] + column_K).clamp(max=self.noise.shape[1] - 1)
        return self.noise.gather(1, index_BK[..., None].expand(-1, -1, self.noise.shape[2]))

    @property
    def place(self) -> Place:
        return Place(self.prefix, self.number)

    def is_done(self, grammar: NumberGrammar, num_numbers: int) -> Tensor:
        """(B,) bool: all numbers are written."""
        complete_B = (self.number == num_numbers - 1) & grammar.must_end[self.prefix]
        return complete_B | (self.number >= num_numbers) | (self.prefix == grammar.DONE)

    def answer(self, grammar: NumberGrammar) -> Tensor:
        """(B, N) numbers, with the one that is being written."""
        return self.numbers.scatter_add(1, self.number[:, None], grammar.value[self.prefix][:, None])

    def keep(self, row_B: Tensor) -> "Answers":
        """Keep these rows only."""
        return Answers(*(tensor[row_B] for tensor in self))


@dataclass(frozen=True)
class Decoded:
    """Numbers that were written, and the passes it took, the prompt's included."""

    numbers: Tensor  # (B, stop_after) int64
    num_passes: int


def likeliest(logits: Tensor) -> tuple[Tensor, Tensor]:
    """(..., S) -> (...) index of the largest logit, and that logit: NaN if any is NaN, else inf if any is."""
    choice = logits.argmax(dim=-1)
    return choice, logits.gather(-1, choice[..., None])[..., 0]


def write(
    model: Continuation, grammar: NumberGrammar, guess: Guess, answers: Answers, num_guesses: int
) -> tuple[Answers, Tensor]:
    """Run a pass; return the longer answers, and (B,) how many guesses were right."""
    place = answers.place
    guess_BG = guess(answers.numbers, place)[:, :num_guesses]
    logits_BKS = model(torch.cat([answers.last[:, None], guess_BG], dim=1), answers.num_symbols - 1)
    places_BK = grammar.walk(place, guess_BG)
    logits_BKS = logits_BKS.float() + grammar.logit_bias(places_BK)
    if answers.noise.shape[1]:
        logits_BKS = logits_BKS + answers.noise_of(logits_BKS.shape[1])
    picks_BK, logits_BK = likeliest(logits_BKS)
    num_right_B = (picks_BK[:, :-1] == guess_BG).cumprod(dim=1).sum(dim=1)
    column_K = torch.arange(picks_BK.shape[1], device=picks_BK.device)
    # what follows a wrong guess is not written
    mask_BK = column_K <= num_right_B[:, None]
    completes_BK = (picks_BK >= SPACE) & mask_BK
    index_BK = places_BK.number.clamp(max=grammar.num_numbers - 1)
    numbers_BN = answers.numbers.scatter_add(1, index_BK, grammar.value[places_BK.prefix] * completes_BK)
    last_B = picks_BK.gather(1, num_right_B[:, None])[:, 0]
    place = grammar.advance(places_BK.at(num_right_B), last_B)
    max_symbols = grammar.max_symbols(grammar.num_numbers)
    num_symbols_B = (answers.num_symbols + num_right_B + 1).clamp(max=max_symbols)
    finite_B = answers.finite & (logits_BK.isfinite() | ~mask_BK).all(dim=1)
    state = last_B, num_symbols_B, place.prefix, place.number, finite_B
    return Answers(numbers_BN, *state, answers.noise), num_right_B


@torch.no_grad()
def decode_numbers(
    model: Continuation,
    grammar: NumberGrammar,
    guess: Guess,
    *,
    batch_size: int,
    stop_after: int,
    noise: Tensor | None = None,
) -> Decoded:
    """Decode the first ``stop_after`` numbers of each row: likeliest or, with ``noise`` (B, A, S), samples.

    Only what the grammar allows is ever chosen, so every row is well-formed by construction. What a row
    writes after it is done is ignored.

    Raises:
        ValueError: a row was written from logits that are not finite.
    """
    answers = Answers.start(grammar, batch_size, noise)
    row_B = torch.arange(batch_size, device=answers.number.device)
    numbers = answers.number.new_empty(batch_size, stop_after)
    max_symbols = grammar.max_symbols(stop_after)
    num_passes, num_guesses = 0, FIRST_GUESSES
    while True:
        num_left = max(1, max_symbols - int(answers.num_symbols.min()))
        answers, num_right_B = write(model, grammar, guess, answers, min(num_guesses, num_left - 1))
        num_passes += 1
        # twice as many as were right, and one
        num_guesses = min(MAX_GUESSES, 1 + round(2 * float(num_right_B.float().mean())))
        kept_B = (~answers.is_done(grammar, stop_after)).nonzero()[:, 0]
        if len(kept_B) == len(row_B):
            continue
        require_finite_answers(answers.finite, row_B)
        numbers[row_B] = answers.answer(grammar)[:, :stop_after]
        if not len(kept_B):
            return Decoded(numbers, num_passes)
        model.keep(kept_B)
        row_B, answers = row_B[kept_B], answers.keep(kept_B)
