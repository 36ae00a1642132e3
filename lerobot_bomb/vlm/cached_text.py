"""Text models of the Llama and Gemma 2 families on a static key-value cache, for passes of a few tokens.

The layers' own modules are called in transformers' order, without what surrounds them there (building masks,
growing caches, recording outputs), which takes most of the time of a small model's pass.

Shapes: `B` batch, `K` tokens of a pass, `C` columns of the cache, `H` hidden size, `V` key-value heads, `G`
query heads for each, `E` size of a head.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import rms_norm, scaled_dot_product_attention
from transformers.models.gemma2.modeling_gemma2 import Gemma2DecoderLayer, Gemma2RMSNorm


@dataclass(frozen=True)
class _Columns:
    """Where the tokens of a pass stand, as the layers need it."""

    slots: Tensor  # (B * K * V,) int64 rows of the flat cache
    cos: Tensor  # (B, K, 1, E)
    sin: Tensor  # (B, K, 1, E), negative in the first half
    penalty: Tensor  # (B, 1, K * G, columns in use): 0 for those that a query reads, else -inf


def check_positions(config: Any, num_tokens: int) -> None:
    """A text model of this config can read so many tokens.

    Raises:
        ValueError: it has fewer positions.
    """
    # layers with a sliding window see all of a shorter sequence
    num_positions = min(config.max_position_embeddings, getattr(config, "sliding_window", None) or math.inf)
    if num_tokens > num_positions:
        raise ValueError(
            f"prompt and answer take {num_tokens} tokens, and the model has {num_positions} positions; "
            f"give a smaller --policy.chunk_size"
        )


class CachedText:
    """Hidden states of new tokens, which read what was cached before them.

    A token's column in the cache is its position, counted from 0; the model counts from ``first_position``.
    One at a column that is written already takes its place, so what is no longer wanted is written over. Gaps
    go to `unread_column`.

    Raises:
        ValueError: the model has fewer positions than ``num_columns``.
    """

    def __init__(self, model: Any, batch_size: int, num_columns: int, first_position: int = 0):
        config = model.config
        check_positions(config, num_columns)
        self._model = model
        self._num_heads, self._num_groups = config.num_key_value_heads, config.num_attention_heads
        self._num_groups //= self._num_heads
        embedding = model.embed_tokens.weight
        # a multiple of 8, which attention on CUDA wants of its masks
        self._columns_C = torch.arange(-(-(num_columns + 1) // 8) * 8, device=embedding.device)
        self.unread_column = len(self._columns_C) - 1
        cos_1CE, sin_1CE = model.rotary_emb(embedding, first_position + self._columns_C[None])
        first_half, second_half = sin_1CE[0].chunk(2, dim=-1)
        self._cos_CE, self._sin_CE = cos_1CE[0], torch.cat([-first_half, second_half], dim=-1)
        device = embedding.device.type
        dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else embedding.dtype
        # keys and values; a head's columns beside each other, as attention reads them
        shape = (2, batch_size, self._num_heads, len(self._columns_C), config.head_dim)
        self._caches = [
            torch.zeros(shape, dtype=dtype, device=embedding.device) for _ in range(config.num_hidden_layers)
        ]
        heads_BV = torch.arange(batch_size * self._num_heads, device=embedding.device)
        self._first_slot_B1V = heads_BV.view(batch_size, 1, -1) * len(self._columns_C)

    def __call__(self, embeds_BKH: Tensor, columns_BK: Tensor, reach_BK: Tensor | None = None) -> Tensor:
        """Embeddings of tokens at columns -> (B, K, H) states after the last layer.

        A token reads the columns up to ``reach_BK``; without it, up to its own.
        """
        columns = self._locate(columns_BK, columns_BK if reach_BK is None else reach_BK)
        x_BKH = embeds_BKH
        for layer, cache in zip(self._model.layers, self._caches, strict=True):
            read_BKH = self._attend(layer.self_attn, _norm(layer.input_layernorm, x_BKH), cache, columns)
            if isinstance(layer, Gemma2DecoderLayer):
                x_BKH = x_BKH + _norm(layer.post_attention_layernorm, read_BKH)
                mixed_BKH = self._mix(layer.mlp, _norm(layer.pre_feedforward_layernorm, x_BKH))
                x_BKH = x_BKH + _norm(layer.post_feedforward_layernorm, mixed_BKH)
            else:
                x_BKH = x_BKH + read_BKH
                x_BKH = x_BKH + self._mix(layer.mlp, _norm(layer.post_attention_layernorm, x_BKH))
        return _norm(self._model.norm, x_BKH)

    def columns_of(self, written_BL: Tensor) -> Tensor:
        """Which columns of rows hold a token -> (B, L) its column in the cache, gaps out of the way."""
        return (written_BL.cumsum(dim=1) - 1).masked_fill(~written_BL, self.unread_column)

    def keep(self, row_B: Tensor) -> None:
        """Only these rows are gone on with, in this order."""
        self._caches = [cache[:, row_B] for cache in self._caches]
        self._first_slot_B1V = self._first_slot_B1V[: len(row_B)]

    def _locate(self, columns_BK: Tensor, reach_BK: Tensor) -> _Columns:
        unread_BKC = self._columns_C[: self._count_columns(columns_BK)] > reach_BK[..., None]
        penalty_BKC = torch.where(unread_BKC, -torch.inf, 0.0).to(self._caches[0].dtype)
        return _Columns(
            slots=(self._first_slot_B1V + columns_BK[..., None]).flatten(),
            cos=self._cos_CE[columns_BK][:, :, None],
            sin=self._sin_CE[columns_BK][:, :, None],
            penalty=penalty_BKC.repeat_interleave(self._num_groups, dim=1)[:, None],
        )

    def _count_columns(self, columns_BK: Tensor) -> int:
        """How many columns attention has to look at; all of them where the host would have to wait."""
        if not on_host(columns_BK):
            return len(self._columns_C)
        return int(torch.where(columns_BK == self.unread_column, 0, columns_BK).max()) + 1

    def _attend(self, attention: Any, x_BKH: Tensor, cache: Tensor, columns: _Columns) -> Tensor:
        heads = *x_BKH.shape[:2], -1, cache.shape[-1]
        query, key = (
            _rotate(projection(x_BKH).view(heads), columns)
            for projection in (attention.q_proj, attention.k_proj)
        )
        new = key, attention.v_proj(x_BKH).view(heads)
        for cached, part in zip(cache.flatten(1, 3), new, strict=True):
            cached.index_copy_(0, columns.slots, part.flatten(0, 2).to(cache.dtype))
        # the queries that share a key stand beside each other: one product a key-value head
        query_BVXE = query.to(cache.dtype).unflatten(2, (-1, self._num_groups)).transpose(1, 2).flatten(2, 3)
        keys_BVCE, values_BVCE = cache[..., : columns.penalty.shape[-1], :]
        softcap = getattr(attention, "attn_logit_softcapping", None)
        if softcap is None:
            read_BVXE = scaled_dot_product_attention(
                query_BVXE, keys_BVCE, values_BVCE, attn_mask=columns.penalty, scale=attention.scaling
            )
        else:
            scores_BVXC = query_BVXE @ keys_BVCE.transpose(2, 3) * (attention.scaling / softcap)
            scores_BVXC = softcap * torch.tanh(scores_BVXC) + columns.penalty
            read_BVXE = scores_BVXC.softmax(dim=-1, dtype=torch.float32).to(cache.dtype) @ values_BVCE
        read = read_BVXE.unflatten(2, (len(x_BKH[0]), -1)).transpose(1, 2).flatten(2)
        return attention.o_proj(read)

    def _mix(self, mlp: Any, x_BKH: Tensor) -> Tensor:
        gate = mlp.gate_proj(x_BKH)
        is_silu = getattr(self._model.config, "hidden_act", None) == "silu"
        is_slow = is_silu and on_host(gate) and gate.dtype == torch.float32
        # torch's own silu takes 3.5 times as long there
        activated = gate / (1 + torch.exp(-gate)) if is_slow else mlp.act_fn(gate)
        return mlp.down_proj(activated * mlp.up_proj(x_BKH))


def on_host(tensor: Tensor) -> bool:
    """Whether the host may look at it without waiting for a device that works ahead."""
    return tensor.device.type == "cpu"


def _rotate(heads: Tensor, columns: _Columns) -> Tensor:
    """(B, K, heads, E) with rotary positions."""
    return heads * columns.cos + heads.roll(heads.shape[-1] // 2, dims=-1) * columns.sin


def _norm(norm: Any, x_BKH: Tensor) -> Tensor:
    if isinstance(norm, Gemma2RMSNorm):
        weight = 1 + norm.weight.float()
        return rms_norm(x_BKH.float(), x_BKH.shape[-1:], weight, norm.eps).type_as(x_BKH)
    return rms_norm(x_BKH, x_BKH.shape[-1:], norm.weight, norm.variance_epsilon)
