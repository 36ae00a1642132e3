"""Layout of a prompt: which parts follow each other, and the span of columns of each.

Shapes: `B` batch, `L` tokens of a prompt or of a sequence that starts with it, `P` image tokens of all
cameras, `H` hidden size.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_bomb.actions.text import TokenRows

# names of parts; an image's is its camera's key
START, INSTRUCTION, STATE, END = "start", "instruction", "state", "end"


class Piece(NamedTuple):
    """Tokens of a part: the same in every row, or each row's own."""

    part: str
    ids: Sequence[int] | None  # None: each row's own
    width: int = 0  # columns of a row's own; those of an instruction are what a prompt has left


@dataclass(frozen=True)
class PromptLayout:
    """Pieces of a prompt, in order.

    No row has tokens of its own before an image, so an image's columns are the same in every row.
    """

    pieces: Sequence[Piece]
    image: int  # token whose embedding an image feature replaces

    @property
    def num_tokens(self) -> int:
        """Number of tokens of the longest prompt, without its instruction."""
        return sum(piece.width if piece.ids is None else len(piece.ids) for piece in self.pieces)

    def spans(self, num_columns: int) -> dict[str, slice]:
        """Return the columns of each part of prompts of this width, padding included."""
        spans: dict[str, slice] = {}
        column = 0
        for part, ids, width in self.pieces:
            start = spans[part].start if part in spans else column
            column += width if ids is None else len(ids)
            if part == INSTRUCTION:
                column += num_columns - self.num_tokens
            spans[part] = slice(start, column)
        return spans

    def fill(self, rows: Mapping[str, TokenRows]) -> TokenRows:
        """Join the parts of a batch's prompts; ``rows``: each row's own tokens, by part."""
        like_BL = rows[INSTRUCTION].ids
        return TokenRows.join(
            [rows[part] if ids is None else TokenRows.constant(ids, like_BL) for part, ids, _ in self.pieces]
        )

    @cached_property
    def _image_columns(self) -> list[int]:
        first = takewhile(lambda piece: piece.ids is not None, self.pieces)
        ids = [token for piece in first for token in piece.ids or ()]
        return [column for column, token in enumerate(ids) if token == self.image]

    def image_columns(self, device: torch.device) -> Tensor:
        """(P,) int64 columns of all image tokens, camera after camera."""
        return torch.tensor(self._image_columns, device=device)

    def with_images(self, words_BLH: Tensor, features_BPH: Tensor) -> Tensor:
        """Put image features in place of the image tokens' embeddings: (B, L, H)."""
        columns = self.image_columns(words_BLH.device)
        return words_BLH.index_copy(1, columns, features_BPH.to(words_BLH.dtype))
