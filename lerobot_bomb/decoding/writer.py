"""Writer of numbers for a policy: the decoder that suits the device.

Shapes: `B` batch, `L` tokens of a prompt, `H` hidden size, `S` symbols.
"""

from functools import partial

import torch
from torch import Tensor, nn

from lerobot_bomb.decoding.decoder import CachedContinuation, Decoded, Guess, Prompt, decode_numbers
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.graph_cache import GraphCache
from lerobot_bomb.decoding.graph_decoder import GraphDecoder
from lerobot_bomb.decoding.kv_cache import CachedText, Positions, same_positions
from lerobot_bomb.vlm.backbone import Backbone


class NumberWriter:
    """Writer of numbers after prompts; on CUDA, passes are captured for every shape of prompts."""

    def __init__(
        self,
        backbone: Backbone,
        grammar: NumberGrammar,
        guess: Guess,
        positions: Positions = same_positions,
        *,
        compiled: bool = False,
    ):
        """``positions``: of a sequence's columns, the same in every row."""
        self._backbone, self._grammar, self._guess, self._positions = backbone, grammar, guess, positions
        self._graphs = GraphCache[GraphDecoder](backbone.text_model, positions, compiled=compiled)

    @torch.no_grad()
    def __call__(
        self, prompt: Prompt, symbol_ids: Tensor, stop_after: int, noise: Tensor | None = None
    ) -> Decoded:
        """Write the first ``stop_after`` numbers of each row; ``noise`` as in `decode_numbers`."""
        max_symbols = self._grammar.max_symbols(stop_after)
        head = self._backbone.vlm.lm_head
        if prompt.embeds.is_cuda and type(head) is nn.Linear:
            with torch.inference_mode(False), torch.no_grad():
                rows = self._backbone.embed_tokens(symbol_ids), head.weight[symbol_ids]
                make = partial(GraphDecoder, self._grammar, self._guess, *rows)
                captured = self._graphs.find(prompt.embeds, max_symbols, make)
                return captured(prompt, *rows, stop_after, noise)
        model = continue_prompt(self._backbone, prompt, symbol_ids, max_symbols, self._positions)
        return decode_numbers(
            model,
            self._grammar,
            self._guess,
            batch_size=len(prompt.embeds),
            stop_after=stop_after,
            noise=noise,
        )


def continue_prompt(
    backbone: Backbone,
    prompt: Prompt,
    symbol_ids: Tensor,
    max_symbols: int,
    positions: Positions = same_positions,
) -> CachedContinuation:
    """Continue a prompt by a backbone's current weights."""
    layers = TextLayers(backbone.text_model)
    return CachedContinuation(
        CachedText(layers, len(prompt.embeds), prompt.embeds.shape[1] + max_symbols, positions),
        lambda symbols: backbone.embed_tokens(symbol_ids[symbols]),
        backbone.head(symbol_ids),
        prompt.mask.sum(dim=1),
        prompt,
    )
