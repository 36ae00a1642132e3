"""Qwen2.5-VL's vision model on images of one size, computed at once instead of one by one.

Shapes: `B` images, `P` patches of an image, `N` patches of all images, `E` features, `H` hidden size.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import (
    Qwen2_5_VLVisionAttention,
    apply_rotary_pos_emb_vision,
)


class WindowAttention(Qwen2_5_VLVisionAttention):
    """Attention that reads a window of all images in one call; stock code makes a call per image."""

    def forward(
        self,
        hidden_states: Tensor,
        cu_seqlens: Tensor,
        rotary_pos_emb: Tensor | None = None,
        position_embeddings: tuple[Tensor, Tensor] | None = None,
        *,
        window_lengths: Sequence[int] | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """(N, E) -> (N, E); ``window_lengths``: patches of each window of an image, in order; None: stock."""
        if window_lengths is None:
            return super().forward(hidden_states, cu_seqlens, rotary_pos_emb, position_embeddings, **kwargs)
        assert position_embeddings is not None
        parts = self.qkv(hidden_states).unflatten(1, (3, self.num_heads, -1)).unbind(1)
        queries, keys = apply_rotary_pos_emb_vision(parts[0], parts[1], *position_embeddings)
        return self.proj(self._read_windows(window_lengths, queries, keys, parts[2]).flatten(1))

    def _read_windows(self, lengths: Sequence[int], *parts: Tensor) -> Tensor:
        """Queries, keys and values (N, heads, size of a head) -> attention outputs of the same shape."""
        if len(set(lengths)) == 1:
            return self._read(*(part.unflatten(0, (-1, lengths[0])) for part in parts)).flatten(0, 1)
        of_images = (part.unflatten(0, (-1, sum(lengths))).split(list(lengths), dim=1) for part in parts)
        windows = [self._read(*window) for window in zip(*of_images, strict=True)]
        return torch.cat(windows, dim=1).flatten(0, 1)

    def _read(self, *parts: Tensor) -> Tensor:
        """Queries, keys and values (windows, patches, heads, size of a head) -> attention outputs."""
        queries, keys, values = (part.transpose(1, 2) for part in parts)
        return scaled_dot_product_attention(queries, keys, values, scale=self.scaling).transpose(1, 2)


def read_windows_at_once(visual: nn.Module) -> None:
    """Let a vision model read each window of all images in one call."""
    for block in visual.blocks:  # pyright: ignore[reportGeneralTypeIssues]
        block.attn.__class__ = WindowAttention


def embed_patches(visual: Any, patches: Tensor, num_images: int, side: int) -> Tensor:
    """Patches of square images -> features (num_images, P / 4, H) of merged patches.

    All images share the windows and rotations of one.
    """
    grid_13 = torch.tensor([[1, side, side]])
    window_index, ends = visual.get_window_index(grid_13)
    lengths = [end - start for start, end in pairwise(dict.fromkeys(ends))]
    unit = visual.spatial_merge_unit
    order = (window_index[:, None] * unit + torch.arange(unit)).flatten().to(patches.device)
    angles_PE = visual.rot_pos_emb(grid_13)[order].repeat(num_images, 2)
    position_embeddings = angles_PE.cos(), angles_PE.sin()
    x_NE = visual.patch_embed(patches).unflatten(0, (num_images, -1))[:, order].flatten(0, 1)
    for number, block in enumerate(visual.blocks):
        windows = [side**2] if number in visual.fullatt_block_indexes else lengths
        x_NE = block(x_NE, cu_seqlens=None, position_embeddings=position_embeddings, window_lengths=windows)
    merged = visual.merger(x_NE).unflatten(0, (num_images, -1))
    return merged[:, window_index.argsort().to(patches.device)]
