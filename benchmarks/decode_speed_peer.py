"""The public way to decode under a grammar: transformers' `generate` and xgrammar's logits processor.

Also the text model as transformers runs it, for the table of our decoder's features.
"""

from typing import Any

import torch
import xgrammar
from torch import Tensor
from transformers.cache_utils import DynamicCache
from xgrammar.contrib.hf import LogitsProcessor

from lerobot_bomb.actions.text import END, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.vlm.backbone import Backbone


class XgrammarGenerate:
    """Greedy search after given prompt embeddings; the language is ours, told to xgrammar."""

    def __init__(self, backbone: Backbone, symbol_ids: Tensor, grammar: NumberGrammar):
        self._backbone, self._symbol_ids, self._grammar = backbone, symbol_ids, grammar
        width = grammar.fixed_width
        values = " | ".join(f'"{str(value).zfill(width)}"' for value in range(grammar.num_values))
        rules = f'root ::= {" ".join(["value"] * grammar.num_numbers)}\nvalue ::= " " ({values})\n'
        vocabulary = [f"<{token}>" for token in range(backbone.vlm.lm_head.out_features)]
        for token, text in zip(symbol_ids[:END].tolist(), SYMBOL_TEXTS, strict=True):
            vocabulary[token] = text
        self._end_id = int(symbol_ids[END])
        tokenizer = xgrammar.TokenizerInfo(
            vocabulary, vocab_type=xgrammar.VocabType.RAW, stop_token_ids=[self._end_id]
        )
        self._grammar_of_peer = xgrammar.GrammarCompiler(tokenizer).compile_grammar(rules)

    def __call__(
        self, embeds_BLH: Tensor, mask_BL: Tensor, max_symbols: int | None = None
    ) -> tuple[Tensor, int]:
        """(B, N) numbers and the passes they took."""
        embeds_BLH, mask_BL = _padded_left(embeds_BLH, mask_BL)
        model: Any = self._backbone.vlm
        ids_BA = model.generate(
            inputs_embeds=embeds_BLH,
            attention_mask=mask_BL.long(),
            max_new_tokens=max_symbols or self._grammar.max_symbols(self._grammar.num_numbers),
            do_sample=False,
            logits_processor=[LogitsProcessor(self._grammar_of_peer)],
            eos_token_id=self._end_id,
            pad_token_id=self._end_id,
        )
        symbols_BA = (ids_BA[..., None] == self._symbol_ids).long().argmax(dim=-1)
        return read_answer(symbols_BA, self._grammar.num_numbers), symbols_BA.shape[1]


def read_answer(symbol_BA: Tensor, num_numbers: int) -> Tensor:
    """(B, num_numbers) the first numbers that rows of symbols spell, the first symbol being a space."""
    is_digit_BA = symbol_BA < SPACE
    column_A = torch.arange(symbol_BA.shape[1], device=symbol_BA.device)
    end_BA = torch.where(is_digit_BA, len(column_A), column_A).flip(1).cummin(dim=1).values.flip(1)
    value_BA = torch.where(is_digit_BA, symbol_BA * 10 ** (end_BA - 1 - column_A).clamp(min=0), 0)
    number_BA = ((~is_digit_BA).cumsum(dim=1) - 1).clamp(max=num_numbers)
    sums_BN = symbol_BA.new_zeros(len(symbol_BA), num_numbers + 1).scatter_add(1, number_BA, value_BA)
    return sums_BN[:, :num_numbers]


def _padded_left(embeds_BLH: Tensor, mask_BL: Tensor) -> tuple[Tensor, Tensor]:
    order_BL = mask_BL.to(torch.uint8).argsort(dim=1, stable=True)
    return (
        embeds_BLH.gather(1, order_BL[..., None].expand_as(embeds_BLH)),
        mask_BL.gather(1, order_BL),
    )


class OneTokenText:
    """Stands in for `CachedText` of a SmolVLM: a row, one token a pass, on transformers' growing cache."""

    columns_of = CachedText.columns_of

    def __init__(self, layers: TextLayers, batch_size: int, num_columns: int, _: object):
        assert batch_size == 1
        self._model, self.unread_column = layers.model, num_columns
        self._cache = DynamicCache(config=layers.config)

    def __call__(self, embeds_BKH: Tensor, columns_BK: Tensor) -> Tensor:
        return self._model(
            inputs_embeds=embeds_BKH, position_ids=columns_BK, past_key_values=self._cache, use_cache=True
        ).last_hidden_state
