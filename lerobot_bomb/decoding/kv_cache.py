"""Text models on a static key-value cache.

Shapes: `B` batch, `K` tokens of a pass, `C` columns of the cache, `H` hidden size, `V` key-value heads, `E`
size of a head.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lerobot_bomb.decoding.decoder_layers import Columns, TextLayers

# (C,) columns, from 0 -> the positions that a model takes them for, as `rotary_tables` takes them
Positions = Callable[[Tensor], Tensor]


def same_positions(column_C: Tensor) -> Tensor:
    """Return positions equal to the columns' numbers."""
    return column_C


def check_positions(
    config: Any,
    num_tokens: int,
    way_out: str = "shorten the instruction or give a smaller --policy.chunk_size",
) -> None:
    """Check that a text model of this config can read this many tokens.

    Raises:
        ValueError: it has fewer positions.
    """
    # layers with a sliding window see all of a shorter sequence
    num_positions = min(config.max_position_embeddings, getattr(config, "sliding_window", None) or math.inf)
    if num_tokens > num_positions:
        raise ValueError(
            f"prompt and answer take {num_tokens} tokens, and the model has {num_positions} positions; "
            f"{way_out}"
        )


class CachedText:
    """Text model that returns hidden states of new tokens, which attend to cached ones.

    A token's column in the cache sets its position, the same in every row (``positions``). A token at a
    column that is already written replaces what is there. Gaps go to `unread_column`.

    Raises:
        ValueError: the model has fewer positions than ``num_columns``.
    """

    def __init__(
        self,
        layers: TextLayers,
        batch_size: int,
        num_columns: int,
        positions: Positions = same_positions,
    ):
        config, embedding = layers.config, layers.embedding
        check_positions(config, num_columns)
        self._num_heads = config.num_key_value_heads
        self._num_groups = config.num_attention_heads // self._num_heads
        self._layers = layers
        # a multiple of 8, which attention on CUDA requires of its masks
        self._columns_C = torch.arange(-(-(num_columns + 1) // 8) * 8, device=embedding.device)
        self.unread_column = len(self._columns_C) - 1
        self._rope = layers.rope(positions(self._columns_C))
        device = embedding.device.type
        cast = torch.is_autocast_enabled(device)
        dtype = torch.get_autocast_dtype(device) if cast else embedding.dtype
        self._hidden_BC = torch.zeros(
            batch_size, len(self._columns_C), dtype=torch.bool, device=embedding.device
        )
        self._hides = False  # any of these
        self._barred, self._open = torch.tensor([-torch.inf, 0.0], dtype=dtype, device=embedding.device)
        shape = batch_size, self._num_heads, 2, len(self._columns_C), layers.head_size
        self._take(torch.zeros(len(layers), *shape, dtype=dtype, device=embedding.device))
        blocks_BV2 = torch.arange(math.prod(shape[:3]), device=embedding.device).view(shape[:3])
        # (B, 1, 2 * V), of each row's keys and values
        self._first_slot = blocks_BV2.transpose(1, 2).reshape(batch_size, 1, -1) * len(self._columns_C)

    def __call__(self, embeds_BKH: Tensor, columns_BK: Tensor, reach_BK: Tensor | None = None) -> Tensor:
        """Embeddings of tokens at columns -> (B, K, H) states after the last layer.

        A token reads the columns up to ``reach_BK``; without it, up to its own.
        """
        num_read = max(self._counts_of_columns(columns_BK))
        columns = self._locate(columns_BK, columns_BK if reach_BK is None else reach_BK, num_read)
        return self.read(embeds_BKH, columns)

    def read(self, embeds_BKH: Tensor, columns: Columns) -> Tensor:
        """Compute as a call does, for tokens at columns that `singly` located."""
        return self._layers(embeds_BKH, columns, self._layer_caches)

    def singly(self, columns_BK: Tensor) -> list[Columns]:
        """Locate K passes of one token per row, each up to its own column; faster than one by one."""
        counts = self._counts_of_columns(columns_BK)
        together = self._locate(columns_BK, columns_BK, max(counts, default=0))
        parts = zip(
            together.slots.unflatten(0, columns_BK.shape).unbind(dim=1),
            together.rope.unflatten(0, columns_BK.shape).unbind(dim=1),
            together.bias.unflatten(2, (columns_BK.shape[1], self._num_groups)).unbind(dim=2),
            counts,
            strict=True,
        )
        shape = len(columns_BK), 1, *together.shape[2:]
        return [Columns(shape, slots, rope, bias[..., :count]) for slots, rope, bias, count in parts]

    def columns_of(self, mask_BL: Tensor) -> Tensor:
        """Return the cache column (B, L) of each token in the mask; padding goes to `unread_column`."""
        return (mask_BL.cumsum(dim=1) - 1).masked_fill(~mask_BL, self.unread_column)

    def hide(self, columns_BK: Tensor, hidden_BK: Tensor) -> None:
        """Let no other token read the hidden ones of these columns; gaps cannot be hidden."""
        self._hides = True
        self._hidden_BC.scatter_(1, columns_BK, hidden_BK & (columns_BK != self.unread_column))

    def keep(self, row_B: Tensor) -> None:
        """Go on with these rows only, in this order."""
        self._take(self._cache[:, row_B])
        self._hidden_BC = self._hidden_BC[row_B]
        self._first_slot = self._first_slot[: len(row_B)]

    def clear(self) -> None:
        """Forget what was cached, and what was hidden."""
        self._cache.zero_()
        self._hidden_BC.zero_()

    def _take(self, cache: Tensor) -> None:
        self._cache = cache
        self._layer_caches = cache.flatten(1, 2).unbind()

    def _locate(self, columns_BK: Tensor, reach_BK: Tensor, num_read: int) -> Columns:
        unread_BKC = self._columns_C[:num_read] > reach_BK[..., None]
        if self._hides:
            unread_BKC |= self._hidden_BC[:, None, :num_read]
        bias_BKC = torch.where(unread_BKC, self._barred, self._open)
        (batch_size, num_tokens), size = columns_BK.shape, self._cache.shape[-1]
        return Columns(
            shape=(batch_size, num_tokens, self._num_heads, self._num_groups, size),
            slots=(self._first_slot + columns_BK[..., None]).flatten(0, 1),
            rope=self._rope[columns_BK.flatten()],
            bias=bias_BKC[:, None, :, None].expand(-1, -1, -1, self._num_groups, -1).flatten(2, 3),
        )

    def _counts_of_columns(self, columns_BK: Tensor) -> list[int]:
        """Return how many columns attention reads for each token; all if the host would have to wait."""
        if columns_BK.is_cuda:
            return [len(self._columns_C)] * columns_BK.shape[1]
        return [last + 1 for last in (columns_BK % self.unread_column).amax(dim=0).tolist()]
