"""Words of an instruction, and which of its tokens they are."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import TokenizerProcessorStep
from torch import Tensor

from lerobot_bomb.vlm.prompt import normalize_task, task_text
from lerobot_bomb.vlm.task_tokenizer import TaskTokenizerStep

PLACE = ("row", "column")  # what names an intersection

TOKENIZERS = (TaskTokenizerStep, TokenizerProcessorStep)  # steps that turn an instruction into tokens

type Range = tuple[int, int]  # of characters: first, last + 1


@dataclass(frozen=True)
class Span:
    """Words of an instruction."""

    name: str
    ranges: tuple[Range, ...]  # of the instruction's characters

    def tokens(self, offsets: Sequence[Range]) -> Tensor:
        """(S,) bool: the token with these characters holds some of the words."""
        return torch.tensor(
            [any(first < end and start < last for start, end in self.ranges) for first, last in offsets],
            dtype=torch.bool,
        )


def span_of(words: str, instruction: str) -> Span:
    """Return the span of all occurrences of the words that are no part of another word or number.

    Raises:
        ValueError: they are not in the instruction.
    """
    before, after = (r"\b" if words[i : i + 1].isalnum() else "" for i in (0, len(words) - 1))
    pattern = before + re.escape(words.lower()) + after
    found = [match.span() for match in re.finditer(pattern, instruction.lower())] if words.strip() else []
    if not found:
        raise ValueError(f"the words {words!r} are not in the instruction {instruction!r}")
    return Span(words, tuple(found))


def whole(instruction: str) -> Span:
    """Return the span of the whole instruction."""
    return Span("instruction", ((0, len(instruction)),))


def spans_of_words(instruction: str) -> list[Span]:
    """Return a span for each word and number; repeated ones get a number: "0", "0 (2)"."""
    spans: list[Span] = []
    for match in re.finditer(r"[\w']+", instruction):
        times = 1 + sum(span.name.split(" (")[0] == match[0] for span in spans)
        spans.append(Span(match[0] if times == 1 else f"{match[0]} ({times})", (match.span(),)))
    return spans


def difference(name: str, instruction: str, other: str) -> Span | None:
    """Return the words that differ in another instruction; None if none do, or their number differs.

    "place it at row 1, column 2", "place it at row 3, column 2" -> "1".
    """
    mine, others = ([*re.finditer(r"[\w']+|[^\w\s]", text)] for text in (instruction, other))
    if len(mine) != len(others):
        return None
    ranges = [word.span() for word, its in zip(mine, others, strict=True) if word[0] != its[0]]
    return Span(name, tuple(ranges)) if ranges else None


def named_spans(instruction: str, others: Mapping[str, str]) -> list[Span]:
    """Return the spans that differ from other instructions (row, column, ...), and row and column as one."""
    found = [difference(name, instruction, other) for name, other in others.items()]
    spans = [span for span in found if span is not None]
    places = [span for span in spans if span.name in PLACE]
    if len(places) == len(PLACE):
        spans.append(Span(" and ".join(PLACE), tuple(each for span in places for each in span.ranges)))
    return spans


def token_offsets(steps: Iterable[Any], instruction: str) -> list[Range]:
    """Return each token's range of characters in the instruction, for a preprocessor's steps.

    Tokens of a template around it lie before its first or behind its last character.

    Raises:
        ValueError: no step makes tokens, or its tokenizer does not give their characters.
    """
    for step in steps:
        if isinstance(step, TaskTokenizerStep):
            assert step.tokenizer is not None
            text = task_text(instruction, step.template)
            offsets = step.tokenizer.encode(text, add_special_tokens=False).offsets
            start = step.template.index("{}") - (len(instruction) - len(instruction.lstrip()))
            assert text[step.template.index("{}") :].startswith(normalize_task(instruction))
            return [(first - start, last - start) for first, last in offsets]
        if isinstance(step, TokenizerProcessorStep):
            tokenizer = step.input_tokenizer
            if not tokenizer.is_fast:
                raise ValueError(f"{type(tokenizer).__name__} does not say which characters a token is")
            return tokenizer(instruction, return_offsets_mapping=True)["offset_mapping"]
    raise ValueError("this policy reads no instruction: no step of its preprocessor turns one into tokens")
