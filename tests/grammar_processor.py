"""The grammar for transformers' `generate`."""

import torch
from torch import Tensor
from transformers import LogitsProcessor

from lerobot_bomb.actions.text import END, SPACE, SYMBOL_TEXTS


def spelled(symbols: list[int]) -> str:
    return "".join("#" if symbol == END else SYMBOL_TEXTS[symbol] for symbol in symbols)


class GrammarProcessor(LogitsProcessor):
    """Processor of logits by the grammar, as a regular expression's worth of Python tells it."""

    def __init__(self, num_values: int, num_numbers: int, prompt_length: int, symbol_ids: Tensor):
        self.num_values, self.num_numbers, self.prompt_length = num_values, num_numbers, prompt_length
        self.ids = symbol_ids.tolist()

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        masked = torch.full_like(scores, -torch.inf)
        for row, ids in enumerate(input_ids[:, self.prompt_length :].tolist()):
            text = spelled([self.ids.index(token) for token in ids])
            for symbol in self.choices(text):
                masked[row, self.ids[symbol]] = scores[row, self.ids[symbol]]
        return masked

    def choices(self, text: str) -> list[int]:
        if "#" in text or not text:
            return [END] if text else list(range(10))
        *_, number = text.split(" ")
        more = [digit for digit in range(10) if number != "0" and int(f"{number}{digit}") < self.num_values]
        if not number:
            return more
        return [*more, SPACE if text.count(" ") + 1 < self.num_numbers else END]

    def read(self, written: Tensor) -> list[list[int]]:
        """The numbers of what was generated, (B, all tokens)."""
        symbols_BA = (written[:, self.prompt_length :, None] == torch.tensor(self.ids)).long().argmax(dim=-1)
        texts = [spelled(symbols).rstrip("#") for symbols in symbols_BA.tolist()]
        return [[int(part) for part in text.split()] for text in texts]
