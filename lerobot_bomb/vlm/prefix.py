"""Prefix: keys and values of tokens that a language model has read, for later tokens to attend to.

Shapes: `B` batch, `L` tokens of a prefix, `T` of a segment, `H` hidden size, `V` key-value heads, `E` size of
a head.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

type KeysValues = tuple[Tensor, Tensor]  # (B, V, L, E) each


@dataclass(frozen=True)
class Prefix:
    """States that the model keeps of images and text that it has read."""

    hidden: Tensor  # (B, L, H) after the last layer
    attention_mask: Tensor  # (B, L) bool, False: padding, or a hidden token
    next_position: Tensor  # (B, 1) int64, of what follows
    layers: list[KeysValues]

    def tensors(self) -> list[Tensor]:
        """Return all tensors, as `of` takes them."""
        return [
            self.hidden,
            self.attention_mask,
            self.next_position,
            *(part for layer in self.layers for part in layer),
        ]

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> "Prefix":
        """Invert `tensors`."""
        hidden, attention_mask, next_position, *layers = tensors
        return cls(hidden, attention_mask, next_position, list(zip(layers[::2], layers[1::2], strict=True)))


class Reader:
    """Stands in for a layer's cache: the kept keys and values are read, not changed."""

    def __init__(self, kept: KeysValues | None):
        self._kept, self.new = kept, kept

    def update(self, keys_BVTE: Tensor, values_BVTE: Tensor, _: int) -> KeysValues:
        self.new = keys_BVTE, values_BVTE
        if self._kept is None:
            return self.new
        return torch.cat([self._kept[0], keys_BVTE], dim=2), torch.cat([self._kept[1], values_BVTE], dim=2)
