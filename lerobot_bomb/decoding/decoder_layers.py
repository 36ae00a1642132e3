"""Layers of text models of the Llama, Qwen 2 and Gemma 2 families, for passes of a few tokens.

The layers' own modules are called in transformers' order, without what surrounds them there (building masks,
growing caches, recording outputs), which takes most of the time of a small model's pass.

Shapes: `B` batch, `K` tokens of a row in a pass, `N` of all rows, `C` columns of the cache, `H` hidden size,
`V` key-value heads, `Z` of all rows, `G` query heads for each, `X` queries of one, `E` size of a head.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import rms_norm, scaled_dot_product_attention
from transformers.models.gemma2.modeling_gemma2 import Gemma2DecoderLayer, Gemma2RMSNorm

from lerobot_bomb.decoding.linear import cast, make_linear, make_linears
from lerobot_bomb.decoding.qkv import Heads, RopeHalves, RopePairs, rotary_tables, softcap_of

# sizes of passes that may be compiled in a process; torch's own limit is 8
MAX_COMPILED = 64


@dataclass(frozen=True)
class Columns:
    """Columns of the tokens of a pass, as the layers need them."""

    shape: tuple[int, int, int, int, int]  # B, K, V, G, E
    slots: Tensor  # (N, 2 * V) int64 rows of a layer's flat cache, keys' before values'
    rope: Tensor  # (N, 1, ...) rotary positions, as `TextLayers.rope`
    bias: Tensor  # (B, 1, X, C): 0 for those that a query reads, else -inf


class TextLayers:
    """A text model's layers and its last norm, with its weights or with a copy of them."""

    def __init__(self, model: Any, *, copy_dtype: torch.dtype | None = None, compiled: bool = False):
        """``copy_dtype``: copy the weights, for products in this type; the copy does not move with the model.

        ``compiled``: use `torch.compile`, which fuses what is not a product.
        """
        self.model, self.config = model, model.config
        self.embedding: Tensor = model.embed_tokens.weight
        modules = [*model.layers, model.norm]
        self._copied: list[tuple[Tensor, nn.Module, str]] = []
        if copy_dtype is not None:
            copies = [_copy(module, copy_dtype) for module in modules]
            for copied, source in zip(copies, modules, strict=True):
                self._copied += _same_parameters(copied, source)
            modules = copies
        *layers, norm = modules
        self._rope_scale = _rope_scale(layers[0].self_attn)
        is_copy = copy_dtype is not None
        # torch does not compile operations on complex numbers
        by_pairs = not (is_copy or compiled) and all(RopePairs.can(layer.self_attn) for layer in layers)
        self._rope = RopePairs.rope if by_pairs else RopeHalves.rope
        make_heads = RopePairs if by_pairs else partial(RopeHalves, is_copy=is_copy)
        self._layers = [_Layer(layer, make_heads, is_copy=is_copy) for layer in layers]
        self._norm = _RMSNorm(norm)
        self._run = _compile_layer() if compiled else _Layer.__call__

    def __len__(self) -> int:
        return len(self._layers)

    @property
    def head_size(self) -> int:
        config = self.config
        return getattr(config, "head_dim", None) or config.hidden_size // config.num_attention_heads

    def __call__(self, x_BKH: Tensor, columns: Columns, caches: Sequence[Tensor]) -> Tensor:
        """(B, K, H) embeddings -> (B, K, H) states after the last layer.

        ``caches``: of each layer (Z, 2, C, E), keys before values; new ones are written into it.
        """
        # one row per token: fewer dimensions to set up in each of many small operations
        x_NH = x_BKH.flatten(0, 1)
        for layer, cache_Z2CE in zip(self._layers, caches, strict=True):
            x_NH = self._run(layer, x_NH, columns, cache_Z2CE)
        return self._norm(x_NH).view(x_BKH.shape)

    def rope(self, position_C: Tensor) -> Tensor:
        """Positions as `rotary_tables` takes them -> (C, 1, ...) rotary positions for the layers."""
        return self._rope(*rotary_tables(self.model, position_C)) * self._rope_scale

    @torch.no_grad()
    def refresh(self) -> None:
        """Update the copy, if any, to the model's current weights, which may change between two answers.

        A CUDA graph reads fixed addresses, so they are copied for every answer: 2.5 ms for a 500M model.
        """
        copies = [copied for copied, _, _ in self._copied]
        weights = [getattr(module, name) for _, module, name in self._copied]
        torch._foreach_copy_(copies, weights)  # pyright: ignore[reportPrivateImportUsage]
        for norm in [*(norm for layer in self._layers for norm in layer.norms), self._norm]:
            norm.refresh()


def _rope_scale(attention: Any) -> float:
    """Return the scale of rotary positions that makes products of queries and keys ``p`` of `_Layer._read`.

    Scaling the tables costs nothing; scaling the products costs an operation in every layer and pass.
    """
    softcap = softcap_of(attention)
    return 1.0 if softcap is None else (2 * attention.scaling / softcap) ** 0.5


def _copy(module: nn.Module, dtype: torch.dtype) -> nn.Module:
    copied = copy.deepcopy(module)
    for part in copied.modules():
        if isinstance(part, nn.Linear):
            part.to(dtype)
    return copied


def _same_parameters(copied: nn.Module, source: nn.Module) -> list[tuple[Tensor, nn.Module, str]]:
    """Return each parameter of a copy, with the module and the name of its source."""
    return [
        (parameter, part, name)
        for copied_part, part in zip(copied.modules(), source.modules(), strict=True)
        for name, parameter in copied_part.named_parameters(recurse=False)
    ]


class _Layer:
    """A layer, its modules looked up once."""

    def __init__(self, layer: Any, make_heads: Callable[[Any], Heads], *, is_copy: bool):
        attention, mlp = layer.self_attn, layer.mlp
        self._heads = make_heads(attention)
        self._gate_up = make_linears([mlp.gate_proj, mlp.up_proj], are_copies=is_copy)
        self._out, self._down = make_linear(attention.o_proj), make_linear(mlp.down_proj)
        self._scale, self._softcap = attention.scaling, softcap_of(attention)
        self._activate: Callable[[Tensor], Tensor] = mlp.act_fn.forward
        self._before_attention = _RMSNorm(layer.input_layernorm)
        is_gemma = isinstance(layer, Gemma2DecoderLayer)
        after = _RMSNorm(layer.post_attention_layernorm)
        self._before_mlp = _RMSNorm(layer.pre_feedforward_layernorm) if is_gemma else after
        self._after_attention = after if is_gemma else None
        self._after_mlp = _RMSNorm(layer.post_feedforward_layernorm) if is_gemma else None

    @property
    def norms(self) -> "list[_RMSNorm]":
        """Norms of the layer, each once."""
        norms = self._before_attention, self._after_attention, self._before_mlp, self._after_mlp
        return [norm for norm in norms if norm is not None]

    def __call__(self, x_NH: Tensor, columns: Columns, cache_Z2CE: Tensor) -> Tensor:
        """States (N, H) -> states (N, H) after the layer."""
        read_NH = self._attend(self._before_attention(x_NH), columns, cache_Z2CE)
        x_NH = _add(x_NH, read_NH, self._after_attention)
        return _add(x_NH, self._mix(self._before_mlp(x_NH)), self._after_mlp)

    def _attend(self, x_NH: Tensor, columns: Columns, cache_Z2CE: Tensor) -> Tensor:
        query, new = self._heads(x_NH, columns.rope)
        dtype = cache_Z2CE.dtype
        cache_Z2CE.view(-1, new.shape[-1]).index_put_((columns.slots,), cast(new, dtype))
        # queries that share a key are adjacent: one product per key-value head
        query_BVKGE = cast(query, dtype).view(columns.shape).transpose(1, 2)
        keys_ZCE, values_ZCE = cache_Z2CE.narrow(2, 0, columns.bias.shape[-1]).unbind(dim=1)
        read = self._read(query_BVKGE, keys_ZCE, values_ZCE, columns.bias)
        return self._out(read.view(query_BVKGE.shape).transpose(1, 2).reshape(len(x_NH), -1))

    def _read(self, query_BVKGE: Tensor, keys_ZCE: Tensor, values_ZCE: Tensor, bias_B1XC: Tensor) -> Tensor:
        """Return the values that queries read, as many numbers as the queries have."""
        batch_size, num_keys, *_, size = query_BVKGE.shape
        if self._softcap is None:
            keys_BVCE = keys_ZCE.view(batch_size, num_keys, -1, size)
            values_BVCE = values_ZCE.view(keys_BVCE.shape)
            return scaled_dot_product_attention(
                query_BVKGE.flatten(2, 3), keys_BVCE, values_BVCE, attn_mask=bias_B1XC, scale=self._scale
            )
        # for p = 2 * scale * product / softcap, softcap * tanh(p / 2) is 2 * softcap * sigmoid(p) but for a
        # constant, which softmax ignores; the sigmoid is faster
        products_ZXC = torch.bmm(query_BVKGE.reshape(len(keys_ZCE), -1, size), keys_ZCE.transpose(1, 2))
        capped_ZXC = cast(products_ZXC, torch.float32).sigmoid_()
        capped_BVXC = capped_ZXC.view(batch_size, num_keys, *capped_ZXC.shape[1:])
        scores_BVXC = torch.add(bias_B1XC, capped_BVXC, alpha=2 * self._softcap)
        weights_BVXC = cast(scores_BVXC.softmax(dim=-1), values_ZCE.dtype)
        return torch.bmm(weights_BVXC.flatten(0, 1), values_ZCE)

    def _mix(self, x_NH: Tensor) -> Tensor:
        parts = self._gate_up(x_NH)
        gate, up = parts if len(parts) == 2 else parts[0].chunk(2, dim=-1)
        return self._down(self._activate(gate).mul_(up))


def _compile_layer() -> Callable[[_Layer, Tensor, Columns, Tensor], Tensor]:
    """Compile one function for all layers, which differ only in tensors; again for each size of pass."""
    torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, MAX_COMPILED)
    return torch.compile(_Layer.__call__, dynamic=False)


class _RMSNorm:
    """RMSNorm of a model; what depends on its weight alone is computed once.

    On a CPU torch's own norm takes three times as long as the same in four operations.
    """

    def __init__(self, norm: Any):
        self._is_gemma = isinstance(norm, Gemma2RMSNorm)
        self._eps = norm.eps if self._is_gemma else norm.variance_epsilon
        self._source: Tensor = norm.weight
        self.is_on_host = norm.weight.device.type == "cpu"
        self._weight = 1 + norm.weight.float() if self._is_gemma else norm.weight
        width = len(norm.weight)
        self.scale, self._least_length = self._weight * width**0.5, torch.tensor((width * self._eps) ** 0.5)

    def refresh(self) -> None:
        """Take the module's current weight; only off the CPU, where the scale is not read."""
        if self._is_gemma:
            torch.add(self._source, 1, out=self._weight)

    def __call__(self, x: Tensor) -> Tensor:
        """States (..., H) -> normalised states (..., H)."""
        if self.is_on_host and x.dtype == torch.float32:
            return self.unscaled(x).mul_(self.scale)
        if self._is_gemma:
            return rms_norm(x.float(), x.shape[-1:], self._weight, self._eps).type_as(x)
        return rms_norm(x, x.shape[-1:], self._weight, self._eps)

    def unscaled(self, x: Tensor) -> Tensor:
        """(..., H) of length 1, or less where eps counts."""
        return x / torch.hypot(torch.linalg.vector_norm(x, dim=-1, keepdim=True), self._least_length)


def _add(x: Tensor, new: Tensor, norm: _RMSNorm | None) -> Tensor:
    """Add the output of a layer's part, of the same shape, to x; normalise it first if there is a norm."""
    if norm is None:
        return x + new
    if norm.is_on_host and x.dtype == new.dtype == torch.float32:
        return torch.addcmul(x, norm.unscaled(new), norm.scale)
    return x + norm(new)
