"""Layers of text models of the Llama and Gemma 2 families, for passes of a few tokens.

The layers' own modules are called in transformers' order, without what surrounds them there (building masks,
growing caches, recording outputs), which takes most of the time of a small model's pass.

Shapes: `B` batch, `K` tokens of a row in a pass, `N` of all rows, `C` columns of the cache, `H` hidden size,
`V` key-value heads, `Z` of all rows, `G` query heads for each, `X` queries of one, `E` size of a head.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeGuard

import torch
from torch import Tensor, nn
from torch.nn.functional import rms_norm, scaled_dot_product_attention
from transformers.models.gemma2.modeling_gemma2 import Gemma2DecoderLayer, Gemma2RMSNorm

# sizes of passes that may be compiled in a process; torch's own limit is 8
MAX_COMPILED = 64


@dataclass(frozen=True)
class Columns:
    """Where the tokens of a pass stand, as the layers need it."""

    shape: tuple[int, int, int, int, int]  # B, K, V, G, E
    slots: Tensor  # (N, 2 * V) int64 rows of a layer's flat cache, keys' before values'
    cos: Tensor  # (N, 1, E)
    sin: Tensor  # (N, 1, E), negative in the first half
    penalty: Tensor  # (B, 1, X, C): 0 for those that a query reads, else -inf


class TextLayers:
    """A text model's layers and its last norm, with its weights or with a copy of them."""

    def __init__(self, model: Any, *, copy_dtype: torch.dtype | None = None, compiled: bool = False):
        """``copy_dtype``: of a copy's products, which stays where it is, whatever becomes of the model.

        ``compiled``: by `torch.compile`, which fuses what is not a product.
        """
        self.model, self.config = model, model.config
        self.embedding: Tensor = model.embed_tokens.weight
        self.rotary_emb: Callable[..., tuple[Tensor, Tensor]] = model.rotary_emb
        modules = [*model.layers, model.norm]
        self._copied: list[tuple[Tensor, nn.Module, str]] = []
        if copy_dtype is not None:
            copies = [_copy(module, copy_dtype) for module in modules]
            for copied, source in zip(copies, modules, strict=True):
                self._copied += _same_parameters(copied, source)
            modules = copies
        *layers, norm = modules
        self._layers = [_Layer(layer, is_copy=copy_dtype is not None) for layer in layers]
        self._norm = _RMSNorm(norm)
        self._run = _compile_layer() if compiled else _Layer.__call__

    def __len__(self) -> int:
        return len(self._layers)

    def __call__(self, x_BKH: Tensor, columns: Columns, caches: Sequence[Tensor]) -> Tensor:
        """(B, K, H) embeddings -> (B, K, H) states after the last layer.

        ``caches``: of each layer (Z, 2, C, E), keys before values; what is new comes into them.
        """
        # one row a token: fewer dimensions to get ready for in each of many small operations
        x_NH = x_BKH.flatten(0, 1)
        for layer, cache_Z2CE in zip(self._layers, caches, strict=True):
            x_NH = self._run(layer, x_NH, columns, cache_Z2CE)
        return self._norm(x_NH).view(x_BKH.shape)

    @torch.no_grad()
    def refresh(self) -> None:
        """Give a copy the weights that the model has now."""
        copies = [copied for copied, _, _ in self._copied]
        weights = [getattr(module, name) for _, module, name in self._copied]
        torch._foreach_copy_(copies, weights)  # pyright: ignore[reportPrivateImportUsage]
        for norm in [*(norm for layer in self._layers for norm in layer.norms), self._norm]:
            norm.refresh()


def _copy(module: nn.Module, dtype: torch.dtype) -> nn.Module:
    copied = copy.deepcopy(module)
    for part in copied.modules():
        if isinstance(part, nn.Linear):
            part.to(dtype)
    return copied


def _same_parameters(copied: nn.Module, source: nn.Module) -> list[tuple[Tensor, nn.Module, str]]:
    """Parameters of a copy, and where each is a copy of."""
    return [
        (parameter, part, name)
        for copied_part, part in zip(copied.modules(), source.modules(), strict=True)
        for name, parameter in copied_part.named_parameters(recurse=False)
    ]


class _Layer:
    """A layer, its modules looked up once."""

    def __init__(self, layer: Any, *, is_copy: bool):
        attention, mlp = layer.self_attn, layer.mlp
        qkv, gate_up = [attention.q_proj, attention.k_proj, attention.v_proj], [mlp.gate_proj, mlp.up_proj]
        # those of a model are small beside its others: joining them anew costs less than it brings
        self._qkv = _joined_products(qkv, are_copies=is_copy)
        self._gate_up = _joined_products(gate_up, are_copies=True) if is_copy else _products(gate_up)
        self._out, self._down = _product(attention.o_proj), _product(mlp.down_proj)
        self._softcap: float | None = getattr(attention, "attn_logit_softcapping", None)
        self._scale: float = attention.scaling * (1 if self._softcap is None else 2 / self._softcap)
        self._activate: Callable[[Tensor], Tensor] = mlp.act_fn.forward
        self._before_attention = _RMSNorm(layer.input_layernorm)
        is_gemma = isinstance(layer, Gemma2DecoderLayer)
        after = _RMSNorm(layer.post_attention_layernorm)
        self._before_mlp = _RMSNorm(layer.pre_feedforward_layernorm) if is_gemma else after
        self._after_attention = after if is_gemma else None
        self._after_mlp = _RMSNorm(layer.post_feedforward_layernorm) if is_gemma else None

    @property
    def norms(self) -> "list[_RMSNorm]":
        """All of them, none twice."""
        norms = self._before_attention, self._after_attention, self._before_mlp, self._after_mlp
        return [norm for norm in norms if norm is not None]

    def __call__(self, x_NH: Tensor, columns: Columns, cache_Z2CE: Tensor) -> Tensor:
        """(N, H) -> (N, H)."""
        read_NH = self._attend(self._before_attention(x_NH), columns, cache_Z2CE)
        x_NH = _add(x_NH, read_NH, self._after_attention)
        return _add(x_NH, self._mix(self._before_mlp(x_NH)), self._after_mlp)

    def _attend(self, x_NH: Tensor, columns: Columns, cache_Z2CE: Tensor) -> Tensor:
        batch_size, num_tokens, num_keys, _, size = columns.shape
        dtype = cache_Z2CE.dtype
        parts = self._qkv(x_NH)
        joined = parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
        heads = _cast(joined, columns.cos.dtype).view(batch_size * num_tokens, -1, size)
        _rotate_(heads[:, :-num_keys], columns)
        cache_Z2CE.view(-1, size).index_put_((columns.slots,), _cast(heads[:, -2 * num_keys :], dtype))
        query = _cast(heads[:, : -2 * num_keys] * self._scale, dtype)
        # the queries that share a key stand beside each other: one product a key-value head
        query_BVKGE = query.view(columns.shape).transpose(1, 2)
        query_BVXE = query_BVKGE.reshape(batch_size, num_keys, -1, size)
        keys_ZCE, values_ZCE = cache_Z2CE.narrow(2, 0, columns.penalty.shape[-1]).unbind(dim=1)
        read_BVXE = self._read(query_BVXE, keys_ZCE, values_ZCE, columns.penalty)
        read_BKVGE = read_BVXE.view(query_BVKGE.shape).transpose(1, 2)
        return self._out(read_BKVGE.reshape(batch_size * num_tokens, -1))

    def _read(self, query_BVXE: Tensor, keys_ZCE: Tensor, values_ZCE: Tensor, penalty_B1XC: Tensor) -> Tensor:
        """(B, V, X, E) what queries read."""
        if self._softcap is None:
            shape = *query_BVXE.shape[:2], -1, query_BVXE.shape[-1]
            keys_BVCE, values_BVCE = keys_ZCE.view(shape), values_ZCE.view(shape)
            return scaled_dot_product_attention(
                query_BVXE, keys_BVCE, values_BVCE, attn_mask=penalty_B1XC, scale=1.0
            )
        # of p = 2 * product / softcap, softcap * tanh(p / 2) is 2 * softcap * sigmoid(p) but for a constant,
        # which softmax does not see; the sigmoid is faster
        products_ZXC = torch.bmm(query_BVXE.flatten(0, 1), keys_ZCE.transpose(1, 2))
        likeness_BVXC = _cast(products_ZXC, torch.float32).sigmoid_().view(*query_BVXE.shape[:3], -1)
        scores_BVXC = torch.add(penalty_B1XC, likeness_BVXC, alpha=2 * self._softcap)
        weights_BVXC = _cast(scores_BVXC.softmax(dim=-1), query_BVXE.dtype)
        return torch.bmm(weights_BVXC.flatten(0, 1), values_ZCE).view(query_BVXE.shape)

    def _mix(self, x_NH: Tensor) -> Tensor:
        parts = self._gate_up(x_NH)
        gate, up = parts if len(parts) == 2 else parts[0].chunk(2, dim=-1)
        return self._down(self._activate(gate).mul_(up))


def _compile_layer() -> Callable[[_Layer, Tensor, Columns, Tensor], Tensor]:
    """One piece of code for all layers, which differ only in their tensors; another for each size of pass."""
    torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, MAX_COMPILED)
    return torch.compile(_Layer.__call__, dynamic=False)


_Products = Callable[[Tensor], list[Tensor]]


def _products(modules: list[nn.Module]) -> _Products:
    """Projections of the same input."""
    products = [_product(module) for module in modules]
    return lambda x: [product(x) for product in products]


def _joined_products(modules: list[nn.Module], *, are_copies: bool) -> _Products:
    """The same as a single one, where they are plain; the weights of copies move beside each other."""
    linears = [module for module in modules if _is_plain(module)]
    if len(linears) < len(modules):
        return _products(modules)
    joined = []
    for parts in zip(*(linear.parameters() for linear in linears), strict=True):
        joined.append(torch.cat([part.detach() for part in parts]))
        if are_copies:
            for part, own in zip(parts, joined[-1].split([len(part) for part in parts]), strict=True):
                part.data = own
    product = _multiply(*joined)
    return lambda x: [product(x)]


def _product(module: nn.Module) -> Callable[[Tensor], Tensor]:
    """A projection; a plain one without `Module.__call__`, which is half of a small product's time."""
    return _multiply(*module.parameters()) if _is_plain(module) else module


def _multiply(weight: Tensor, bias: Tensor | None = None) -> Callable[[Tensor], Tensor]:
    transposed = weight.detach().t()
    return partial(torch.mm, mat2=transposed) if bias is None else partial(torch.addmm, bias, mat2=transposed)


def _is_plain(module: nn.Module) -> TypeGuard[nn.Linear]:
    return type(module) is nn.Linear and not (module._forward_hooks or module._forward_pre_hooks)


class _RMSNorm:
    """A model's norm; what its weight alone decides is computed once.

    On a CPU torch's own takes three times as long as the same in four operations.
    """

    def __init__(self, norm: Any):
        self._is_gemma = isinstance(norm, Gemma2RMSNorm)
        self._eps = norm.eps if self._is_gemma else norm.variance_epsilon
        self._source: Tensor = norm.weight
        self._weight = 1 + norm.weight.float() if self._is_gemma else norm.weight
        width = len(norm.weight)
        self.scale, self._least_length = self._weight * width**0.5, torch.tensor((width * self._eps) ** 0.5)

    def refresh(self) -> None:
        """The module has another weight; off the CPU, where the scale is not used."""
        if self._is_gemma:
            torch.add(self._source, 1, out=self._weight)

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


def _cast(x: Tensor, dtype: torch.dtype) -> Tensor:
    # `Tensor.to` takes as long as a small product even where there is nothing to do
    return x if x.dtype == dtype else x.to(dtype)


def _in_float32_on_host(x: Tensor) -> bool:
    return x.dtype == torch.float32 and x.device.type == "cpu"


def _rotate_(heads: Tensor, columns: Columns) -> None:
    """(N, heads, E) get their rotary positions in place."""
    half_turned = heads.roll(heads.shape[-1] // 2, dims=-1)
    heads.mul_(columns.cos).addcmul_(half_turned, columns.sin)
