"""Numbers as text symbols, and the hiding of numbers while training.

A symbol is one of the twelve tokens that an answer consists of: the digits 0-9, a space, the end.
Shapes: `B` batch, `N` numbers, `W` digits a number may have, `C` = W + 1 columns a number takes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

NUM_SYMBOLS = 12
SPACE, END = 10, 11
SYMBOL_TEXTS = (*"0123456789", " ")  # the chat format defines the end's
MAX_DIGITS = 4  # of any number that a policy reads or writes

IGNORED = -100  # label of a token that the loss does not count

MASK_LEVELS = ("value", "step", "char")


def digits_needed(num_values: int) -> int:
    """Number of digits that the numbers from 0 to ``num_values`` - 1 need."""
    return len(str(num_values - 1))


def number_symbols(numbers_BN: Tensor, width: int, *, zero_padded: bool) -> tuple[Tensor, Tensor]:
    """Numbers -> symbols (B, N, C) and which of the columns are written (B, N, C).

    A number is a space followed by its digits, right-aligned in its columns; without zero padding the
    columns of leading zeros are not written.
    """
    place_values_W = 10 ** torch.arange(width - 1, -1, -1, device=numbers_BN.device)
    digits_BNW = numbers_BN[..., None] // place_values_W % 10
    mask_BNW = (numbers_BN[..., None] >= place_values_W) | (place_values_W == 1) | zero_padded
    space_BN1 = torch.full_like(digits_BNW[..., :1], SPACE)
    symbols_BNC = torch.cat([space_BN1, digits_BNW], dim=-1)
    return symbols_BNC, torch.cat([torch.ones_like(space_BN1, dtype=torch.bool), mask_BNW], dim=-1)


@dataclass(frozen=True)
class NumberTokens:
    """Numbers as tokens; all (B, N, C)."""

    ids: Tensor  # int64
    mask: Tensor  # bool, whether the column holds a token
    loss_mask: Tensor  # bool

    def hide_numbers(self, hidden_BN: Tensor, hidden_id: int) -> "NumberTokens":
        """Put one ``hidden_id`` in place of a hidden number's digits; its space stays and is trained on."""
        ids_BNC, mask_BNC, loss_mask_BNC = self.ids.clone(), self.mask.clone(), self.loss_mask.clone()
        mask_BNC[..., 1:-1] &= ~hidden_BN[..., None]
        loss_mask_BNC[..., 1:] &= ~hidden_BN[..., None]
        ids_BNC[..., -1] = ids_BNC[..., -1].masked_fill(hidden_BN, hidden_id)
        return NumberTokens(ids_BNC, mask_BNC, loss_mask_BNC)

    def hide_characters(self, hidden_BNC: Tensor, hidden_id: int) -> "NumberTokens":
        """Put ``hidden_id`` in place of single digits and spaces."""
        ids_BNC = self.ids.masked_fill(hidden_BNC, hidden_id)
        return NumberTokens(ids_BNC, self.mask, self.loss_mask & ~hidden_BNC)


def draw_hidden(
    eligible_BN: Tensor, max_fraction: float, skip_prob: float, generator: torch.Generator
) -> Tensor:
    """Draw which of the eligible units to hide: (B, N) bool.

    A row hides nothing with probability ``skip_prob``; else floor(count * f) distinct units, f uniform
    in [0, max_fraction].
    """
    batch_size, num_units = eligible_BN.shape
    device = eligible_BN.device
    fraction_B = max_fraction * torch.rand(batch_size, generator=generator)
    fraction_B[torch.rand(batch_size, generator=generator) < skip_prob] = 0
    draw_BN = torch.rand(batch_size, num_units, generator=generator).to(device)
    rank_BN = draw_BN.masked_fill(~eligible_BN, 2.0).argsort(dim=1).argsort(dim=1)
    num_hidden_B = (eligible_BN.sum(dim=1) * fraction_B.to(device)).floor()
    return rank_BN < num_hidden_B[:, None]


def compact(mask_BL: Tensor, *columns_BL: Tensor) -> tuple[Tensor, ...]:
    """Move the written columns of every row to the front, in order; drop columns that no row needs.

    Returns ``mask_BL`` and each of ``columns_BL`` rearranged, (B, longest row).
    """
    longest = int(mask_BL.sum(dim=1).max())
    order_BL = mask_BL.logical_not().to(torch.uint8).argsort(dim=1, stable=True)[:, :longest]
    return tuple(column.gather(1, order_BL) for column in (mask_BL, *columns_BL))


@dataclass(frozen=True)
class TokenRows:
    """Rows of tokens with padding: ids (B, L) int64 and which columns hold a token (B, L) bool.

    A hidden token keeps its position, but no other token attends to it.
    """

    ids: Tensor
    mask: Tensor
    hidden: Tensor | None = None  # (B, L) bool; None: no token is

    @classmethod
    def constant(cls, ids: Sequence[int], like_BL: Tensor) -> "TokenRows":
        """Put the same tokens in every row, with as many rows as ``like_BL`` and on its device."""
        ids_BL = torch.tensor(ids, dtype=torch.int64, device=like_BL.device).expand(len(like_BL), -1)
        return cls(ids_BL, torch.ones_like(ids_BL, dtype=torch.bool))

    @classmethod
    def join(cls, parts: "list[TokenRows]") -> "TokenRows":
        if any(part.hidden is not None for part in parts):
            parts = [cls(part.ids, part.mask, part.mask & ~part.attention_mask) for part in parts]
        return cls(
            *(torch.cat(columns, 1) for columns in zip(*(part._columns for part in parts), strict=True))
        )

    @property
    def attention_mask(self) -> Tensor:
        """(B, L) bool, which columns hold a token that others attend to."""
        return self.mask if self.hidden is None else self.mask & ~self.hidden

    def rounded(self, multiple: int) -> "TokenRows":
        """Pad the rows at their ends, to a multiple of `multiple` columns."""
        width = -self.ids.shape[1] % multiple
        return TokenRows(*(nn.functional.pad(columns, (0, width)) for columns in self._columns))

    def without_padding(self) -> "TokenRows":
        """Move the tokens of each row to its front."""
        mask_BL, ids_BL, *hidden = compact(self.mask, self.ids, *self._columns[2:])
        return TokenRows(ids_BL, mask_BL, *hidden)

    @property
    def _columns(self) -> list[Tensor]:
        return [self.ids, self.mask] if self.hidden is None else [self.ids, self.mask, self.hidden]


@dataclass(frozen=True)
class Answer:
    """Numbers and the end token as rows without padding; all (B, A), A the tokens of the longest."""

    rows: TokenRows
    labels: Tensor  # int64 token ids, IGNORED where the loss does not count them
    columns: Tensor  # int64, which of the M = N * C + 1 columns with padding a token comes from

    @classmethod
    def of(cls, numbers: NumberTokens, end_id: Tensor) -> "Answer":
        """Remove the padding, and label what the loss counts."""
        end_B1 = end_id.expand(len(numbers.ids), 1)
        true_B1 = torch.ones_like(end_B1, dtype=torch.bool)
        ids_BM, mask_BM, loss_mask_BM = (
            torch.cat([columns.flatten(1), last], dim=1)
            for columns, last in zip(
                (numbers.ids, numbers.mask, numbers.loss_mask), (end_B1, true_B1, true_B1), strict=True
            )
        )
        labels_BM = ids_BM.masked_fill(~(loss_mask_BM & mask_BM), IGNORED)
        columns_BM = torch.arange(ids_BM.shape[1], device=ids_BM.device).expand_as(ids_BM)
        mask_BA, ids_BA, labels_BA, columns_BA = compact(mask_BM, ids_BM, labels_BM, columns_BM)
        return cls(TokenRows(ids_BA, mask_BA), labels_BA, columns_BA)

    def with_padding(self, values_BA: Tensor, numbers: NumberTokens) -> Tensor:
        """Put the tokens' values (B, A) back at their columns (B, M); undefined in padding."""
        values_BM = values_BA.new_zeros(len(values_BA), numbers.mask[0].numel() + 1)
        return values_BM.scatter(1, self.columns, values_BA)
