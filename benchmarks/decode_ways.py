"""Ways to write the same answers, ours and transformers' `generate`, and the time that each takes.

Shapes: `B` batch, `L` tokens of a prompt, `H` hidden size, `A` symbols of an answer, `N` numbers of it.
"""

import copy
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import torch
import xgrammar
from machine import Rows, wait_and_time
from torch import Tensor, nn
from transformers import LogitsProcessor
from xgrammar.contrib.hf import LogitsProcessor as GrammarProcessor

from lerobot_bomb.actions.text import END, SYMBOL_TEXTS
from lerobot_bomb.cuda_graphs import GraphedFunction
from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_bomb.vlm.backbone import Backbone
from lerobot_bomb.vlm.images import crop, resized_pixels
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy


@dataclass(frozen=True)
class Timed:
    """Answers of a batch, one per row, and how long they took."""

    numbers: Tensor  # (B, N)
    prefill_s: float
    decode_s: float
    num_passes: int  # the prompt's included


def compare(
    ways: dict[str, tuple[Callable[[Any], Timed], Sequence[Any]]], *, must_agree: bool = True
) -> Rows:
    """Time each way on its requests, in turn, and compare the numbers; gains are over the first way."""
    timed: dict[str, list[Timed]] = {name: [] for name in ways}
    for write, requests in ways.values():
        write(requests[0])
    for i in range(max(len(requests) for _, requests in ways.values())):
        for name, (write, requests) in ways.items():
            timed[name].append(write(requests[i]))
        expected, *others = (answers[-1].numbers for answers in timed.values())
        if must_agree and not all(
            torch.equal(numbers, expected[:, : numbers.shape[1]]) for numbers in others
        ):
            raise SystemExit(f"answer {i}: {', '.join(ways)} do not write the same numbers")
    figures = {
        name: {
            "prefill_ms": 1e3 * statistics.median(answer.prefill_s for answer in answers),
            "decode_ms": 1e3 * statistics.median(answer.decode_s for answer in answers),
            "passes": statistics.mean(answer.num_passes for answer in answers),
            "whole_ms": 1e3 * statistics.median(answer.prefill_s + answer.decode_s for answer in answers),
        }
        for name, answers in timed.items()
    }
    slowest, *_ = figures.values()
    for row in figures.values():
        row["decode_gain"] = slowest["decode_ms"] / row["decode_ms"]
        row["whole_gain"] = slowest["whole_ms"] / row["whole_ms"]
    return figures


@contextmanager
def ends_of_passes(on_cuda: bool) -> Iterator[list[Any]]:
    """Collect the moment at which each pass of our decoders ended."""
    owner, name = (GraphedFunction, "__call__") if on_cuda else (CachedText, "read")
    read: Callable[..., Any] = getattr(owner, name)
    ends: list[Any] = []

    def timed(*args: Any) -> Any:
        returned = read(*args)
        ends.append(moment(on_cuda))
        return returned

    with patch.object(owner, name, timed):
        yield ends


def moment(on_cuda: bool) -> Any:
    """Return the time in seconds; on CUDA an event, which the device records when it comes to it."""
    if not on_cuda:
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


class NumbersByUs:
    """Writer of the first numbers of an answer by our decoder, whose first pass reads the prompt."""

    def __init__(
        self, writer: NumberWriter, symbol_ids: Tensor, num_numbers: int, dtype: torch.dtype = torch.float32
    ):
        self._writer, self._answer = writer, (symbol_ids, num_numbers)
        self._autocast = torch.autocast(symbol_ids.device.type, dtype, enabled=dtype != torch.float32)

    def __call__(self, prompt: Prompt) -> Timed:
        on_cuda = prompt.embeds.is_cuda
        with self._autocast, ends_of_passes(on_cuda) as ends:
            if on_cuda:
                torch.cuda.synchronize()
            started = moment(on_cuda)
            decoded, whole_s = wait_and_time(lambda: self._writer(prompt, *self._answer))
        prefill_s = started.elapsed_time(ends[0]) / 1e3 if on_cuda else ends[0] - started
        return Timed(decoded.numbers, prefill_s, whole_s - prefill_s, decoded.num_passes)


class NumbersByGenerate:
    """Greedy search of `generate` with xgrammar's logits processor, after given prompt embeddings."""

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
        self._rules = xgrammar.GrammarCompiler(tokenizer).compile_grammar(rules)

    def __call__(self, prompt: Prompt) -> Timed:
        """Time the whole answer, and one symbol, which is the time to read the prompt."""
        max_symbols = self._grammar.max_symbols(self._grammar.num_numbers)
        self._write(prompt, max_symbols=1)
        _, prefill_s = wait_and_time(lambda: self._write(prompt, max_symbols=1))
        symbols_BA, whole_s = wait_and_time(lambda: self._write(prompt, max_symbols))
        numbers = read_answer(symbols_BA, self._grammar.num_numbers)
        return Timed(numbers, prefill_s, whole_s - prefill_s, symbols_BA.shape[1])

    def _write(self, prompt: Prompt, max_symbols: int) -> Tensor:
        """Return the symbols (B, A) of the answer."""
        mask_BL, order_BL = prompt.mask.to(torch.uint8).sort(dim=1, stable=True)  # padding first
        model: Any = self._backbone.vlm
        ids_BA = model.generate(
            inputs_embeds=prompt.embeds.gather(1, order_BL[..., None].expand_as(prompt.embeds)),
            attention_mask=mask_BL.long(),
            max_new_tokens=max_symbols,
            do_sample=False,
            logits_processor=[GrammarProcessor(self._rules)],
            eos_token_id=self._end_id,
            pad_token_id=self._end_id,
        )
        return (ids_BA[..., None] == self._symbol_ids).long().argmax(dim=-1)


def read_answer(symbol_BA: Tensor, num_numbers: int) -> Tensor:
    """Return the first numbers (B, N) that rows of symbols spell after their leading space."""
    spelled = ("".join(SYMBOL_TEXTS[symbol] for symbol in row if symbol != END) for row in symbol_BA.tolist())
    return symbol_BA.new_tensor([[int(number) for number in text.split()][:num_numbers] for text in spelled])


def cells_by_us(policy: SpatialvlaGridPolicy, draft: str, batch: dict[str, Any]) -> Timed:
    """Choose and time a chunk's cells with the policy's own decoder."""
    policy._decoder.drafted = draft != "none"
    started = time.perf_counter()
    with ends_of_passes(on_cuda=False) as ends:
        cells_BTG = policy.choose(batch, policy.config.chunk_size)
        ended = time.perf_counter()
    return Timed(cells_BTG.flatten(1), ends[0] - started, ended - ends[0], len(ends))


class CellsByGenerate:
    """Greedy search by transformers' own PaliGemma, masks and cache; its last words are the cells."""

    def __init__(self, policy: SpatialvlaGridPolicy):
        self._policy = policy
        self._vlm: Any = copy.deepcopy(policy.backbone.vlm)
        words = self._vlm.get_input_embeddings()
        self._first_cell = len(words.weight)
        words.weight = nn.Parameter(torch.cat([words.weight, policy.cell_embedding.weight]))
        head = self._vlm.lm_head
        head.weight = nn.Parameter(torch.cat([head.weight, policy.cell_head.weight]))
        # what a policy without depth learned to add to every patch
        size = policy.ego3d.lattice_size
        no_depth_E = policy.ego3d(torch.full((1, size, size, 3), torch.nan))[0, 0]
        norm = self._vlm.model.vision_tower.get_submodule("vision_model.post_layernorm")
        norm.bias = nn.Parameter(norm.bias + no_depth_E)
        self._vlm.config.text_config.vocab_size = self._vlm.model.vocab_size = len(words.weight)

    def inputs(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Return the policy's prompt, padded on the left, and its images, as the stock model reads them."""
        policy, prompt = self._policy, self._policy.prompt(batch)
        written_BL, order_BL = prompt.mask.long().sort(dim=1, stable=True)  # padding first
        size, fraction = policy.backbone.image_size, policy.config.crop_fraction
        pixels = [resized_pixels(crop(batch[key], fraction, None), size) for key in policy._cameras]
        return {
            "input_ids": prompt.ids.gather(1, order_BL) * written_BL,
            "attention_mask": written_BL,
            "token_type_ids": torch.zeros_like(prompt.ids),
            "pixel_values": torch.stack(pixels, dim=1).flatten(0, 1),
        }

    def __call__(self, inputs: dict[str, Tensor]) -> Timed:
        """Choose and time the cells of a chunk; a pass ends with its logits."""
        grids, num_steps = self._policy.grids, self._policy.config.chunk_size
        slots = _Slots(self._policy, self._first_cell)
        started = time.perf_counter()
        tokens = self._vlm.generate(
            **inputs,
            max_new_tokens=num_steps * len(grids.groups),
            do_sample=False,
            logits_processor=[slots],
        )
        ended, prompt_read = time.perf_counter(), slots.moments_s[0]
        offsets = torch.tensor(grids.offsets).repeat(num_steps)
        cells_BS = tokens[:, inputs["input_ids"].shape[1] :] - self._first_cell - offsets
        return Timed(cells_BS, prompt_read - started, ended - prompt_read, len(slots.moments_s))


class _Slots(LogitsProcessor):
    """Lets only the slot's cells through; records when each pass ended."""

    def __init__(self, policy: SpatialvlaGridPolicy, first_cell: int):
        self.moments_s: list[float] = []
        cells = zip(policy.grids.offsets, policy.grids.num_cells, strict=True)
        self._cells = [slice(first_cell + first, first_cell + first + count) for first, count in cells]

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        cells = self._cells[len(self.moments_s) % len(self._cells)]
        self.moments_s.append(time.perf_counter())
        masked = torch.full_like(scores, -torch.inf)
        masked[:, cells] = scores[:, cells]
        return masked
