"""Cache for CUDA graphs: weights and caches that stay where they are, so that graphs can be used again."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.kv_cache import CachedText, Positions, same_positions


class GraphCache[T]:
    """Cache of one object for each size of batch and prompt, on a copy of a text model's weights.

    There is one copy for each device and type of the computation. A copied or pickled cache is empty.
    """

    def __init__(self, text_model: Any, positions: Positions = same_positions, *, compiled: bool = False):
        """``compiled``: use `torch.compile` for layers, which fuses what is not a product."""
        self._text_model, self._positions, self._compiled = text_model, positions, compiled
        self._forget()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_modules": [], "_layers": {}, "_made": {}}

    def _forget(self) -> None:
        self._modules: list[nn.Module] = []
        self._layers: dict[Any, TextLayers] = {}
        self._made: dict[Any, T] = {}

    def find(self, prompt_BLH: Tensor, num_new: int, make: Callable[[CachedText], T]) -> T:
        """Return the object for such prompts and so many new tokens, with the model's current weights."""
        modules = list(self._text_model.modules())
        if modules != self._modules:  # such as an adapter that was added
            self._forget()
            self._modules = modules
        device = prompt_BLH.device
        cast = torch.is_autocast_enabled(device.type)
        dtype = torch.get_autocast_dtype(device.type) if cast else prompt_BLH.dtype
        place = device, dtype
        if place not in self._layers:
            self._layers[place] = TextLayers(self._text_model, copy_dtype=dtype, compiled=self._compiled)
        layers = self._layers[place]
        layers.refresh()
        batch_size, prompt_length, _ = prompt_BLH.shape
        shape = *place, batch_size, prompt_length, num_new
        if shape not in self._made:
            text = CachedText(layers, batch_size, prompt_length + num_new, self._positions)
            self._made[shape] = make(text)
        return self._made[shape]
