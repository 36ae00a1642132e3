"""Ways to write the same answers, ours and the public one, and the requests on which they are timed.

The public way is transformers' `generate` with xgrammar's logits processor.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import torch
import xgrammar
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from machine import Rows, wait_and_time
from torch import Tensor
from torch.utils.data import default_collate
from xgrammar.contrib.hf import LogitsProcessor

from lerobot_bomb.actions.text import END, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.decoder import Continuation, Decoded, Guess, Prompt, decode_numbers
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.writer import NumberWriter, continue_prompt
from lerobot_bomb.vlm.backbone import Backbone


@dataclass(frozen=True)
class Timed:
    """Answers of a batch, one per row, and how long they took."""

    numbers: Tensor  # (B, N)
    prefill_s: float
    decode_s: float
    num_passes: int  # the prompt's included


def compare(
    runs: dict[str, tuple[Callable[[Any], Timed], Sequence[Any]]], *, must_agree: bool = True
) -> Rows:
    """Time each way on each request, in turn, and compare the numbers. Gains are over the first way."""
    timed: dict[str, list[Timed]] = {name: [] for name in runs}
    for run, works in runs.values():
        run(works[0])
    for i in range(max(len(works) for _, works in runs.values())):
        for name, (run, works) in runs.items():
            timed[name].append(run(works[i]))
        expected, *others = (answers[-1].numbers for answers in timed.values())
        if must_agree and not all(
            torch.equal(numbers, expected[:, : numbers.shape[1]]) for numbers in others
        ):
            raise SystemExit(f"answer {i}: {', '.join(runs)} do not write the same numbers")
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


@dataclass(frozen=True)
class DecodeRequest:
    """Batch of prompts, and the numbers to be written after each."""

    backbone: Backbone
    prompt: Prompt
    symbol_ids: Tensor
    grammar: NumberGrammar
    stop_after: int
    guess: Guess


def add_episode_arguments(parser: argparse.ArgumentParser, policy_type: str) -> None:
    """Add the arguments that `Episodes` needs."""
    parser.add_argument("--policy.path", dest="policy_path", required=True, help=f"trained {policy_type}")
    parser.add_argument("--dataset.repo_id", dest="repo_id", required=True)
    parser.add_argument("--dataset.root", dest="root")
    parser.add_argument("--episode", type=int, default=180, help="first episode to read (default: 180)")


class Episodes:
    """Loads a trained policy with given flags, and the frames that it meets."""

    def __init__(self, args: argparse.Namespace):
        self._path, self._first = args.policy_path, args.episode
        self.config: Any = PreTrainedConfig.from_pretrained(self._path)
        self._dataset = LeRobotDataset(args.repo_id, root=args.root)

    def works(self, batch_size: int, num_predictions: int, **options: Any) -> list[DecodeRequest]:
        """Return the policy's requests to the decoder, a row per episode, every `n_action_steps`."""
        policy, batches = self.batches(batch_size, num_predictions, **options)
        works: list[DecodeRequest] = []
        for batch in batches:
            policy.reset()
            with _captured(works):
                policy.select_action(batch)
        return works

    def batches(self, batch_size: int, num_predictions: int, **options: Any) -> tuple[Any, list[Any]]:
        """Return the policy with these options, and its inputs: a row per episode, every `n_action_steps`."""
        policy, preprocessor = self._load(**options)
        frames = [
            [self._frame(row, prediction * policy.config.n_action_steps) for row in range(batch_size)]
            for prediction in range(num_predictions)
        ]
        return policy, [preprocessor(default_collate(rows)) for rows in frames]

    def _load(self, **options: Any) -> tuple[Any, Any]:
        config: Any = PreTrainedConfig.from_pretrained(self._path)
        config.pretrained_path = self._path
        for name, value in options.items():
            setattr(config, name, value)
        policy = make_policy(config, ds_meta=self._dataset.meta).eval()
        return policy, make_pre_post_processors(config, self._path)[0]

    def _frame(self, row: int, step: int) -> dict[str, Any]:
        episodes: Any = self._dataset.meta.episodes
        episode = episodes[self._first + row]
        first, end = episode["dataset_from_index"], episode["dataset_to_index"]
        item: Any = self._dataset[first + step % (end - first)]
        return item


@contextmanager
def _captured(works: list[DecodeRequest]) -> Iterator[None]:
    write = NumberWriter.__call__

    def captured(
        writer: NumberWriter, prompt: Prompt, symbol_ids: Tensor, stop_after: int, noise: None
    ) -> Decoded:
        works.append(
            DecodeRequest(writer._backbone, prompt, symbol_ids, writer._grammar, stop_after, writer._guess)
        )
        return write(writer, prompt, symbol_ids, stop_after, noise)

    with patch.object(NumberWriter, "__call__", captured):
        yield


class Timer(Continuation):
    """Continuation that records when the prompt has been read."""

    prompt_read_s = 0.0

    def __init__(self, model: Continuation):
        self._model, self.keep = model, model.keep

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        logits = self._model(symbol_BK, first_B)
        self.prompt_read_s = self.prompt_read_s or time.perf_counter()
        return logits


def ours(work: DecodeRequest) -> Timed:
    """Time our decoder, whose first pass reads the prompt."""
    started = time.perf_counter()
    max_symbols = work.grammar.max_symbols(work.stop_after)
    model = Timer(continue_prompt(work.backbone, work.prompt, work.symbol_ids, max_symbols))
    decoded = decode_numbers(
        model, work.grammar, work.guess, batch_size=len(work.prompt.embeds), stop_after=work.stop_after
    )
    return Timed(
        decoded.numbers,
        model.prompt_read_s - started,
        time.perf_counter() - model.prompt_read_s,
        decoded.num_passes,
    )


def peer(work: DecodeRequest) -> Timed:
    """Time the public way."""
    return XgrammarGenerate(work.backbone, work.symbol_ids, work.grammar).timed(work.prompt)


class XgrammarGenerate:
    """Greedy search after given prompt embeddings, with our grammar translated for xgrammar."""

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
        """Return the (B, N) numbers and how many passes they took."""
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

    def timed(self, prompt: Prompt) -> Timed:
        """Time the whole answer, and one symbol, which is the time to read the prompt."""
        self(prompt.embeds, prompt.mask, max_symbols=1)
        _, prefill_s = wait_and_time(lambda: self(prompt.embeds, prompt.mask, max_symbols=1))
        (numbers, num_passes), whole_s = wait_and_time(lambda: self(prompt.embeds, prompt.mask))
        return Timed(numbers, prefill_s, whole_s - prefill_s, num_passes)


def read_answer(symbol_BA: Tensor, num_numbers: int) -> Tensor:
    """Return the first numbers (B, num_numbers) that rows of symbols spell after their leading space."""
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
