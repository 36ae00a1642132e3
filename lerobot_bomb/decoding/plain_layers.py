"""The layers of the Llama, Qwen 2 and Gemma 2 families as in their equations.

Nothing is cached, joined, copied or computed in place. Slow; tests compare the fast ones, `decoder_layers`,
with these, and these with transformers' own.

Shapes: `B` batch, `L` tokens, `H` hidden size, `V` key-value heads, `G` query heads for each, `E` size of a
head.
"""

from typing import Any

import torch
from torch import Tensor
from transformers.models.gemma2.modeling_gemma2 import Gemma2DecoderLayer, Gemma2RMSNorm

from lerobot_bomb.decoding.qkv import rotary_tables, softcap_of


def hidden_states(model: Any, x_BLH: Tensor, position_L: Tensor) -> Tensor:
    """(B, L, H) embeddings of a prompt -> (B, L, H) states after the last layer and its norm.

    Positions as `rotary_tables` takes them.
    """
    cos_LE, sin_LE = rotary_tables(model, position_L)
    for layer in model.layers:
        x_BLH = layer_states(layer, x_BLH, cos_LE, sin_LE)
    return rms_norm(model.norm, x_BLH)


def layer_states(layer: Any, x_BLH: Tensor, cos_LE: Tensor, sin_LE: Tensor) -> Tensor:
    """Compute one layer: attention, then the MLP, each on normalised states and added to them.

    Gemma 2 normalises what is added, too.
    """
    is_gemma = isinstance(layer, Gemma2DecoderLayer)
    read_BLH = attend(layer.self_attn, rms_norm(layer.input_layernorm, x_BLH), cos_LE, sin_LE)
    if is_gemma:
        read_BLH = rms_norm(layer.post_attention_layernorm, read_BLH)
    x_BLH = x_BLH + read_BLH
    before_mlp = layer.pre_feedforward_layernorm if is_gemma else layer.post_attention_layernorm
    mixed_BLH = mlp(layer.mlp, rms_norm(before_mlp, x_BLH))
    if is_gemma:
        mixed_BLH = rms_norm(layer.post_feedforward_layernorm, mixed_BLH)
    return x_BLH + mixed_BLH


def attend(attention: Any, x_BLH: Tensor, cos_LE: Tensor, sin_LE: Tensor) -> Tensor:
    """Grouped-query attention: each token reads itself and those before it."""
    num_tokens, size = x_BLH.shape[1], attention.head_dim
    query, key, value = (
        projection(x_BLH).unflatten(-1, (-1, size)).transpose(1, 2)  # (B, heads, L, E)
        for projection in (attention.q_proj, attention.k_proj, attention.v_proj)
    )
    query, key = rope(query, cos_LE, sin_LE), rope(key, cos_LE, sin_LE)
    num_groups = query.shape[1] // key.shape[1]
    key, value = (heads.repeat_interleave(num_groups, dim=1) for heads in (key, value))
    logits = softcap(attention, query @ key.transpose(-1, -2) * attention.scaling)
    future = torch.ones(num_tokens, num_tokens, dtype=torch.bool).triu(diagonal=1)
    weights = logits.masked_fill(future, -torch.inf).softmax(dim=-1)
    return attention.o_proj((weights @ value).transpose(1, 2).flatten(2))


def rope(x: Tensor, cos_LE: Tensor, sin_LE: Tensor) -> Tensor:
    """(B, heads, L, E) rotated by its position: number e of the first half against that of the second."""
    first, second = x.chunk(2, dim=-1)
    return x * cos_LE + torch.cat([-second, first], dim=-1) * sin_LE


def softcap(attention: Any, logits: Tensor) -> Tensor:
    """Limit attention logits, in Gemma 2 only (arXiv:2408.00118, section 2)."""
    limit = softcap_of(attention)
    return logits if limit is None else limit * torch.tanh(logits / limit)


def mlp(module: Any, x_BLH: Tensor) -> Tensor:
    """Compute a gated MLP."""
    return module.down_proj(module.act_fn(module.gate_proj(x_BLH)) * module.up_proj(x_BLH))


def rms_norm(norm: Any, x: Tensor) -> Tensor:
    """(..., H) of root mean square 1, times a weight; Gemma stores the weight minus 1."""
    is_gemma = isinstance(norm, Gemma2RMSNorm)
    weight = 1 + norm.weight if is_gemma else norm.weight
    eps = norm.eps if is_gemma else norm.variance_epsilon
    return x * torch.rsqrt(x.square().mean(dim=-1, keepdim=True) + eps) * weight
