"""Decoding on a device that the host runs ahead of: every pass has the same shapes, and is captured.

Shapes: `B` batch, `S` symbols, `L` tokens of a prompt, `H` hidden size.
"""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.nn.functional import embedding

from lerobot_bomb.cuda_graphs import GraphedFunction
from lerobot_bomb.decoding.decoder import (
    Answers,
    CachedContinuation,
    Decoded,
    Guess,
    Prompt,
    write,
)
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.finite import require_finite_answers
from lerobot_bomb.vlm.backbone import exact_linear

NUM_GUESSES = 16  # of every pass


class GraphDecoder:
    """Decoder of answers to prompts of one shape.

    Rows that are done go on until all are: a smaller batch would have to be captured, too.
    """

    def __init__(
        self, grammar: NumberGrammar, guess: Guess, embeds_SH: Tensor, head_SH: Tensor, text: CachedText
    ):
        """``embeds_SH``, ``head_SH``: the symbols' rows of the embedding and of the output head."""
        self._text, self._grammar, self._guess = text, grammar, guess
        self._embeds_SH, self._head_SH = embeds_SH.clone(), head_SH.clone()
        # a model that is moved replaces its tables; graphs read those of their time
        self._tables = list(grammar.buffers())
        self._first, self._next = GraphedFunction(self._write_first), GraphedFunction(self._write)

    def __call__(
        self,
        prompt: Prompt,
        embeds_SH: Tensor,
        head_SH: Tensor,
        stop_after: int,
        noise: Tensor | None = None,
    ) -> Decoded:
        """Decode as `decode_numbers`, with the current rows of embedding and head."""
        self._embeds_SH.copy_(embeds_SH)
        self._head_SH.copy_(head_SH)
        return decode_ahead(self._passes(prompt, noise), self._grammar, stop_after)

    def _passes(self, prompt: Prompt, noise: Tensor | None) -> Iterator[Answers]:
        length_B = prompt.mask.sum(dim=1)
        answers = self._first(*prompt.tensors, length_B, *Answers.start(self._grammar, len(length_B), noise))
        while True:
            yield Answers(*answers)
            answers = self._next(length_B, *answers)

    def _write_first(
        self, embeds_BLH: Tensor, mask_BL: Tensor, hidden_BL: Tensor, *state: Tensor
    ) -> tuple[Tensor, ...]:
        self._text.clear()
        return self._write(*state, prompt=Prompt(embeds_BLH, mask_BL, hidden_BL))

    def _write(self, length_B: Tensor, *answers: Tensor, prompt: Prompt | None = None) -> tuple[Tensor, ...]:
        model = CachedContinuation(self._text, self._embed, self._head, length_B, prompt)
        return tuple(write(model, self._grammar, self._guess, Answers(*answers), NUM_GUESSES)[0])

    def _embed(self, symbols: Tensor) -> Tensor:
        return embedding(symbols, self._embeds_SH)

    def _head(self, hidden: Tensor) -> Tensor:
        return exact_linear(hidden, self._head_SH)


def decode_ahead(passes: Iterator[Answers], grammar: NumberGrammar, stop_after: int) -> Decoded:
    """Decode as `decode_numbers`; in a pass the host learns if the last left all rows done, and finite."""
    hear = None
    for num_passes, answers in enumerate(passes, 1):
        if hear is not None:
            is_done, is_finite = hear()
            if not is_finite:
                require_finite_answers(answers.finite)
            if is_done:
                return Decoded(answers.answer(grammar)[:, :stop_after], num_passes)
        hear = _fetch(torch.stack([answers.is_done(grammar, stop_after).all(), answers.finite.all()]))
    raise AssertionError("an answer has an end")


def _fetch(flags: Tensor) -> Callable[[], list[bool]]:
    """Start to copy flags from a device; return a function that waits for them."""
    copied = flags.to("cpu", non_blocking=True)
    if not flags.is_cuda:
        return copied.tolist
    event = torch.cuda.Event()
    event.record()

    def wait() -> list[bool]:
        event.synchronize()
        return copied.tolist()

    return wait
