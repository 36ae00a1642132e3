"""Text models of the Llama and Gemma 2 families on a static key-value cache, for passes of a few tokens.

The layers' own modules are called in transformers' order, without what surrounds them there (building masks,
growing caches, recording outputs), which takes most of the time of a small model's pass.

Shapes: `B` batch, `K` tokens of a pass, `C` columns of the cache, `H` hidden size, `V` key-value heads, `G`
query heads for each, `E` size of a head.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, rms_norm, scaled_dot_product_attention
from transformers.activations import SiLUActivation
from transformers.models.gemma2.modeling_gemma2 import Gemma2DecoderLayer, Gemma2RMSNorm


@dataclass(frozen=True)
class _Columns:
    """Where the tokens of a pass stand, as the layers need it."""

    slots: Tensor  # (B * K * 2 * V,) int64 rows of the flat cache, keys' before values'
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
        num_heads = config.num_key_value_heads
        self._num_groups = config.num_attention_heads // num_heads
        embedding = model.embed_tokens.weight
        # a multiple of 8, which attention on CUDA wants of its masks
        self._columns_C = torch.arange(-(-(num_columns + 1) // 8) * 8, device=embedding.device)
        self.unread_column = len(self._columns_C) - 1
        cos_1CE, sin_1CE = model.rotary_emb(embedding, first_position + self._columns_C[None])
        first_half, second_half = sin_1CE[0].chunk(2, dim=-1)
        self._cos_CE, self._sin_CE = cos_1CE[0], torch.cat([-first_half, second_half], dim=-1)
        device = embedding.device.type
        cast = torch.is_autocast_enabled(device)
        self._dtype = torch.get_autocast_dtype(device) if cast else embedding.dtype
        # keys and values of a head, its columns beside each other, as attention reads them
        shape = batch_size, num_heads, 2, len(self._columns_C), config.head_dim
        self._layers = [
            _Layer(layer, torch.zeros(shape, dtype=self._dtype, device=embedding.device))
            for layer in model.layers
        ]
        self._norm = _RMSNorm(model.norm)
        blocks_BV2 = torch.arange(math.prod(shape[:3]), device=embedding.device).view(shape[:3])
        # (B, 1, 2 * V), of each row's keys and values
        self._first_slot = blocks_BV2.transpose(1, 2).reshape(batch_size, 1, -1) * len(self._columns_C)

    def __call__(self, embeds_BKH: Tensor, columns_BK: Tensor, reach_BK: Tensor | None = None) -> Tensor:
        """Embeddings of tokens at columns -> (B, K, H) states after the last layer.

        A token reads the columns up to ``reach_BK``; without it, up to its own.
        """
        columns = self._locate(columns_BK, columns_BK if reach_BK is None else reach_BK)
        x_BKH = embeds_BKH
        for layer in self._layers:
            x_BKH = layer(x_BKH, columns)
        return self._norm(x_BKH)

    def columns_of(self, written_BL: Tensor) -> Tensor:
        """Which columns of rows hold a token -> (B, L) its column in the cache, gaps out of the way."""
        return (written_BL.cumsum(dim=1) - 1).masked_fill(~written_BL, self.unread_column)

    def keep(self, row_B: Tensor) -> None:
        """Only these rows are gone on with, in this order."""
        for layer in self._layers:
            layer.keep(row_B)
        self._first_slot = self._first_slot[: len(row_B)]

    def _locate(self, columns_BK: Tensor, reach_BK: Tensor) -> _Columns:
        unread_BKC = self._columns_C[: self._count_columns(columns_BK)] > reach_BK[..., None]
        penalty_BKC = torch.where(unread_BKC, -torch.inf, 0.0).to(self._dtype)
        columns_BK1 = columns_BK[..., None]
        return _Columns(
            slots=(self._first_slot + columns_BK1).flatten(),
            cos=self._cos_CE[columns_BK1],
            sin=self._sin_CE[columns_BK1],
            penalty=penalty_BKC.repeat_interleave(self._num_groups, dim=1)[:, None],
        )

    def _count_columns(self, columns_BK: Tensor) -> int:
        """How many columns attention has to look at; all of them where the host would have to wait."""
        if not on_host(columns_BK):
            return len(self._columns_C)
        return int(torch.where(columns_BK == self.unread_column, 0, columns_BK).max()) + 1


class _Layer:
    """A layer, its modules looked up once, with the keys and values that it has computed."""

    def __init__(self, layer: Any, cache_BV2CE: Tensor):
        attention, mlp = layer.self_attn, layer.mlp
        self._qkv = [_product(part) for part in (attention.q_proj, attention.k_proj, attention.v_proj)]
        self._out, self._scale = _product(attention.o_proj), attention.scaling
        self._softcap: float | None = getattr(attention, "attn_logit_softcapping", None)
        self._gate, self._up, self._down = map(_product, (mlp.gate_proj, mlp.up_proj, mlp.down_proj))
        self._activate = mlp.act_fn
        self._is_silu = isinstance(mlp.act_fn, SiLUActivation | nn.SiLU)
        self._before_attention = _RMSNorm(layer.input_layernorm)
        is_gemma = isinstance(layer, Gemma2DecoderLayer)
        after = layer.post_attention_layernorm
        self._before_mlp = _RMSNorm(layer.pre_feedforward_layernorm if is_gemma else after)
        self._after_attention = _RMSNorm(after) if is_gemma else None
        self._after_mlp = _RMSNorm(layer.post_feedforward_layernorm) if is_gemma else None
        self._take(cache_BV2CE)

    def __call__(self, x_BKH: Tensor, columns: _Columns) -> Tensor:
        """(B, K, H) -> (B, K, H)."""
        read_BKH = self._attend(self._before_attention(x_BKH), columns)
        x_BKH = _add(x_BKH, read_BKH, self._after_attention)
        return _add(x_BKH, self._mix(self._before_mlp(x_BKH)), self._after_mlp)

    def keep(self, row_B: Tensor) -> None:
        """Only these rows are gone on with, in this order."""
        self._take(self._cache_BV2CE[row_B])

    def _take(self, cache_BV2CE: Tensor) -> None:
        self._cache_BV2CE, self._flat = cache_BV2CE, cache_BV2CE.flatten(0, 3)
        self._keys_BVCE, self._values_BVCE = cache_BV2CE.unbind(dim=2)

    def _attend(self, x_BKH: Tensor, columns: _Columns) -> Tensor:
        num_keys, size, dtype = self._keys_BVCE.shape[1], self._flat.shape[1], self._flat.dtype
        parts = torch.cat([project(x_BKH) for project in self._qkv], dim=-1).to(columns.cos.dtype)
        heads = parts.view(*x_BKH.shape[:2], -1, size)
        _rotate_(heads[:, :, :-num_keys], columns)
        new = heads[:, :, -2 * num_keys :].reshape(-1, size)
        self._flat.index_copy_(0, columns.slots, new.to(dtype))
        query = (heads[:, :, : -2 * num_keys] * self._scale).to(dtype)
        # the queries that share a key stand beside each other: one product a key-value head
        query_BVXE = query.view(*x_BKH.shape[:2], num_keys, -1, size).transpose(1, 2).flatten(2, 3)
        num_columns = columns.penalty.shape[-1]
        keys_BVCE = self._keys_BVCE.narrow(2, 0, num_columns)
        values_BVCE = self._values_BVCE.narrow(2, 0, num_columns)
        if self._softcap is None:
            read_BVXE = scaled_dot_product_attention(
                query_BVXE, keys_BVCE, values_BVCE, attn_mask=columns.penalty, scale=1.0
            )
        else:
            read_BVXE = _capped_attention(query_BVXE, keys_BVCE, values_BVCE, columns.penalty, self._softcap)
        read_BVKGE = read_BVXE.view(len(x_BKH), num_keys, x_BKH.shape[1], -1, size)
        return self._out(read_BVKGE.transpose(1, 2).flatten(2))

    def _mix(self, x_BKH: Tensor) -> Tensor:
        gate = self._gate(x_BKH)
        # torch's own silu takes 3.5 times as long there
        is_slow = self._is_silu and _in_float32_on_host(gate)
        activated = gate / (1 + torch.exp(-gate)) if is_slow else self._activate(gate)
        return self._down(activated * self._up(x_BKH))


def _product(module: nn.Module) -> Callable[[Tensor], Tensor]:
    """A projection; a plain one without `Module.__call__`, which is half of a small product's time."""
    if type(module) is nn.Linear and not (module._forward_hooks or module._forward_pre_hooks):
        return partial(linear, weight=module.weight, bias=module.bias)
    return module


class _RMSNorm:
    """A model's norm; what its weight alone decides is computed once.

    On a CPU torch's own takes three times as long as the same in four operations.
    """

    def __init__(self, norm: Any):
        self._is_gemma = isinstance(norm, Gemma2RMSNorm)
        self._eps = norm.eps if self._is_gemma else norm.variance_epsilon
        self._weight = 1 + norm.weight.float() if self._is_gemma else norm.weight
        width = len(norm.weight)
        self.scale, self._least_length = self._weight * width**0.5, torch.tensor((width * self._eps) ** 0.5)

    def __call__(self, x: Tensor) -> Tensor:
        """(..., H) -> (..., H)."""
        if _in_float32_on_host(x):
            return self.unscaled(x).mul_(self.scale)
        if self._is_gemma:
            return rms_norm(x.float(), x.shape[-1:], self._weight, self._eps).type_as(x)
        return rms_norm(x, x.shape[-1:], self._weight, self._eps)

    def unscaled(self, x: Tensor) -> Tensor:
        """(..., H) of length 1, or less where eps counts."""
        return x / torch.hypot(torch.linalg.vector_norm(x, dim=-1, keepdim=True), self._least_length)


def _add(x: Tensor, new: Tensor, norm: _RMSNorm | None) -> Tensor:
    """Of the same shape: x and what a part of a layer adds to it."""
    if norm is None:
        return x + new
    if _in_float32_on_host(x) and _in_float32_on_host(new):
        return torch.addcmul(x, norm.unscaled(new), norm.scale)
    return x + norm(new)


def _capped_attention(
    query_BVXE: Tensor, keys_BVCE: Tensor, values_BVCE: Tensor, penalty_B1XC: Tensor, softcap: float
) -> Tensor:
    """(B, V, X, E) read by X queries a head, each product p limited to ``softcap * tanh(p / softcap)``."""
    # 2 * softcap * sigmoid(2 * p / softcap), which is larger by softcap: the same after softmax, and faster
    query = (query_BVXE * (2 / softcap)).flatten(0, 1)
    scores = torch.bmm(query, keys_BVCE.flatten(0, 1).transpose(1, 2)).float().sigmoid_()
    scores_BVXC = torch.add(penalty_B1XC, scores.view(*query_BVXE.shape[:3], -1), alpha=2 * softcap)
    weights = scores_BVXC.softmax(dim=-1).to(values_BVCE.dtype).flatten(0, 1)
    return torch.bmm(weights, values_BVCE.flatten(0, 1)).view(query_BVXE.shape)


def _in_float32_on_host(x: Tensor) -> bool:
    return x.dtype == torch.float32 and on_host(x)


def on_host(tensor: Tensor) -> bool:
    """Whether the host may look at it without waiting for a device that works ahead."""
    return tensor.device.type == "cpu"


def _rotate_(heads: Tensor, columns: _Columns) -> None:
    """(B, K, heads, E) get their rotary positions in place."""
    half_turned = heads.roll(heads.shape[-1] // 2, dims=-1)
    heads.mul_(columns.cos).addcmul_(half_turned, columns.sin)
