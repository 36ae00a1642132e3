"""Requests that `decode_speed.py` measures, from a trained policy, and two ways to write the answers."""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import torch
from decode_speed_compare import Timed
from decode_speed_peer import XgrammarGenerate
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_bomb.actions.text import END, number_symbols
from lerobot_bomb.decoding.decoder import (
    CachedContinuation,
    Continuation,
    Decoded,
    Guess,
    Prompt,
    decode_numbers,
)
from lerobot_bomb.decoding.draft import LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.writer import NumberWriter, continue_prompt
from lerobot_bomb.vlm.backbone import Backbone


@dataclass(frozen=True)
class DecodeRequest:
    """A batch of prompts, and what is to be written after each."""

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
    """A trained policy with other flags, and the frames that it meets."""

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
        """The policy with such flags, and what it sees: one row an episode, every `n_action_steps`."""
        policy, preprocessor = self._load(**options)
        frames = [
            [self._frame(row, prediction * policy.config.n_action_steps) for row in range(batch_size)]
            for prediction in range(num_predictions)
        ]
        return policy, [preprocessor(default_collate(rows)) for rows in frames]

    def planned(self, num_predictions: int, num_steps: int) -> list[DecodeRequest]:
        """Return requests of batch 1 that guess from the last chunk's unexecuted actions, its end held."""
        policy, preprocessor = self._load(n_action_steps=num_steps)
        works: list[DecodeRequest] = []
        plan_BTD = None
        for prediction in range(num_predictions + 1):
            batch = preprocessor(default_collate([self._frame(0, prediction * num_steps)]))
            with _captured(works):
                chunk_BTD = policy.predict_action_chunk(batch)
            if plan_BTD is not None:
                number_BN, _ = policy._targets({**batch, "action": plan_BTD})
                num_dims = chunk_BTD.shape[2]
                guess = PlanDraft(policy.grammar, num_dims, number_BN)
                works[-1] = replace(works[-1], guess=guess, stop_after=num_steps * num_dims)
            held_BTD = chunk_BTD[:, -1:].expand(-1, num_steps, -1)
            plan_BTD = torch.cat([chunk_BTD[:, num_steps:], held_BTD], dim=1)
        return works[1:]

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


class PlanDraft(LinearDraft):
    """Numbers that were foreseen; one that is being written becomes the nearest that begins as it does."""

    def __init__(self, grammar: NumberGrammar, num_dims: int, plan_BN: Tensor):
        super().__init__(grammar, num_dims)
        self._plan_BN = plan_BN

    def _expect(self, number_BN: Tensor, index_BX: Tensor, steps: Tensor | int) -> Tensor:
        index_BX = (index_BX + steps * self._num_dims).clamp(max=number_BN.shape[1] - 1)
        return self._plan_BN.gather(1, index_BX)


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
    """Knows when the prompt had been read."""

    prompt_read_s = 0.0

    def __init__(self, model: Continuation):
        self._model, self.keep = model, model.keep

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        logits = self._model(symbol_BK, first_B)
        self.prompt_read_s = self.prompt_read_s or time.perf_counter()
        return logits


def begin(work: DecodeRequest) -> CachedContinuation:
    """The model that goes on with the prompts."""
    max_symbols = work.grammar.max_symbols(work.stop_after)
    return continue_prompt(work.backbone, work.prompt, work.symbol_ids, max_symbols)


def ours(work: DecodeRequest) -> Timed:
    """The decoder; the first pass reads the prompt."""
    started = time.perf_counter()
    model = Timer(begin(work))
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
    """The whole answer by `generate`, and one symbol by it: what it takes to read the prompt."""
    generate = XgrammarGenerate(work.backbone, work.symbol_ids, work.grammar)
    embeds, mask = work.prompt.embeds, work.prompt.mask
    generate(embeds, mask, max_symbols=1)
    started = time.perf_counter()
    generate(embeds, mask, max_symbols=1)
    prompt_read = time.perf_counter()
    numbers, num_passes = generate(embeds, mask)
    whole_s, prefill_s = time.perf_counter() - prompt_read, prompt_read - started
    return Timed(numbers, prefill_s, whole_s - prefill_s, num_passes)


def num_symbols(grammar: NumberGrammar, number_BN: Tensor) -> int:
    """Tokens of the answers, spaces and ends included."""
    num_digits = grammar.fixed_width * number_BN.numel() or sum(
        len(str(number)) for number in number_BN.flatten().tolist()
    )
    return num_digits + number_BN.numel() + len(number_BN)


def margin_at_difference(work: DecodeRequest, written_N: Tensor, theirs_N: Tensor) -> float:
    """Difference of the two largest allowed logits at the first symbol that differs."""
    ours_A, theirs_A = (spell(work.grammar, numbers) for numbers in (written_N, theirs_N))
    at = int((ours_A[: len(theirs_A)] != theirs_A[: len(ours_A)]).nonzero()[0])
    model = begin(work)
    logits = model(ours_A[None, :at], torch.zeros(1, dtype=torch.int64))[0, -1].float()
    place = work.grammar.start(1)
    for symbol in ours_A[1:at]:
        place = work.grammar.advance(place, symbol[None])
    first, second = (logits + work.grammar.logit_bias(place)[0]).topk(2).values
    return float(first - second)


def spell(grammar: NumberGrammar, number_N: Tensor) -> Tensor:
    """(A,) symbols of an answer, its end included."""
    symbols_NC, written_NC = number_symbols(
        number_N[None], grammar.width, zero_padded=grammar.fixed_width > 0
    )
    return torch.cat([symbols_NC[written_NC], torch.tensor([END])])
