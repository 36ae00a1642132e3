"""Queries, keys and values of a layer, for the tokens of a pass.

Shapes: `N` tokens of a pass, `C` columns of a cache, `H` hidden size, `V` key-value heads, `G` query heads
for each, `E` size of a head, `A` = 3 axes that a position has in M-RoPE: time, line and column.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_bomb.decoding.linear import cast, is_plain, make_linears, multiply

# states (N, H) and rotary positions (N, 1, ...) -> rotated queries (N, V * G, E); rotated keys,
# then values (N, 2 * V, E)
Heads = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def rotary_tables(model: Any, position_C: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (C,), or (A, C) -> cosines and sines (C, E), as a text model turns its heads.

    Every number of a head turns with one axis (M-RoPE, arXiv 2409.12191, section 2.1); text has the
    same position on all three.
    """
    weight = model.embed_tokens.weight
    sections = model.config.rope_parameters.get("mrope_section")
    if sections is None:
        cos_1CE, sin_1CE = model.rotary_emb(weight, position_C[None])
        return cos_1CE[0], sin_1CE[0]
    position_A1C = position_C.expand(3, -1)[:, None]
    axis_E = torch.arange(3).repeat_interleave(torch.tensor(sections)).repeat(2).to(weight.device)
    index_1CE = axis_E.expand(1, position_A1C.shape[-1], -1)
    cos_CE, sin_CE = (table[:, 0].gather(0, index_1CE)[0] for table in model.rotary_emb(weight, position_A1C))
    return cos_CE, sin_CE


class RopeHalves:
    """Heads of any projections; rotary positions rotate the first half of a head against the second."""

    def __init__(self, attention: Any, *, is_copy: bool):
        self._linears = make_linears(_projections(attention), are_copies=is_copy)
        self._size = attention.head_dim
        self._num_keys = attention.config.num_key_value_heads

    def __call__(self, x_NH: Tensor, rope_N12E: Tensor) -> tuple[Tensor, Tensor]:
        """Compute as `Heads`; cosines stand before sines, which are negative in the first half."""
        parts = self._linears(x_NH)
        joined = parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
        heads = cast(joined, rope_N12E.dtype).view(len(x_NH), -1, self._size)
        cos_N1E, sin_N1E = rope_N12E.chunk(2, dim=-1)
        rotated = heads[:, : -self._num_keys]
        half_rotated = rotated.roll(self._size // 2, dims=-1)
        rotated.mul_(cos_N1E).addcmul_(half_rotated, sin_N1E)
        return heads[:, : -2 * self._num_keys], heads[:, -2 * self._num_keys :]

    @staticmethod
    def rope(cos_CE: Tensor, sin_CE: Tensor) -> Tensor:
        """(C, 1, 2 * E) rotary positions from the model's own."""
        first_half, second_half = sin_CE.chunk(2, dim=-1)
        return torch.cat([cos_CE, -first_half, second_half], dim=-1)[:, None]


class RopePairs:
    """Heads of plain projections on a CPU, where this is faster.

    Weights are copied. Their rows are ordered so that numbers which are rotated together, the parts of a
    complex one, are neighbours. Attention logits do not depend on their order.
    """

    def __init__(self, attention: Any):
        # small beside a model's other weights: copying them costs less than it saves
        self._size, self._num_keys = attention.head_dim, attention.config.num_key_value_heads
        queries, keys, values = ([*part.parameters()] for part in _projections(attention))
        self._query = multiply(*(self._beside(part) for part in queries))
        keys_values = zip(keys, values, strict=True)
        self._new = multiply(*(torch.cat([self._beside(key), value.detach()]) for key, value in keys_values))

    def _beside(self, part: Tensor) -> Tensor:
        """Interleave rows of weights or biases: those of a head's first half with those of the second."""
        return part.detach().unflatten(0, (-1, 2, self._size // 2)).transpose(1, 2).flatten(0, 2)

    def __call__(self, x_NH: Tensor, rope_N1E: Tensor) -> tuple[Tensor, Tensor]:
        """Compute as `Heads`, with complex rotary positions."""
        shape = len(x_NH), -1, self._size // 2, 2
        query = cast(self._query(x_NH), torch.float32).view(shape)
        new = cast(self._new(x_NH), torch.float32).view(shape)
        torch.view_as_complex(query).mul_(rope_N1E)
        torch.view_as_complex(new).narrow(1, 0, self._num_keys).mul_(rope_N1E)
        return query.flatten(2), new.flatten(2)

    @staticmethod
    def rope(cos_CE: Tensor, sin_CE: Tensor) -> Tensor:
        """(C, 1, E / 2) complex rotary positions, from the model's own, which repeat each half."""
        half = cos_CE.shape[-1] // 2
        return torch.complex(cos_CE[:, None, :half].float(), sin_CE[:, None, :half].float())

    @staticmethod
    def can(attention: Any) -> bool:
        """Return True if the projections are plain, in float32 or less on a CPU."""
        parts = _projections(attention)
        return all(
            is_plain(part) and part.weight.dtype.itemsize <= 4 and part.weight.device.type == "cpu"
            for part in parts
        )


def softcap_of(attention: Any) -> float | None:
    """Return the cap of the attention logits, in families that have one."""
    return getattr(attention, "attn_logit_softcapping", None)


def _projections(attention: Any) -> list[nn.Module]:
    return [attention.q_proj, attention.k_proj, attention.v_proj]
