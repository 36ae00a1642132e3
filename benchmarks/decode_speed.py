"""Writing an answer: ours against transformers' `generate` with xgrammar's logits processor.

    python benchmarks/decode_speed.py --policy.path=CHECKPOINT \
        --dataset.repo_id=USER/pusht --dataset.root=pusht --json decode_speed.json

Both have the same weights, read the same prompt embeddings and must write the same numbers. The prompts are
what a trained nano `vla0_smol` meets on frames of held-out episodes. A second model has the shape of
SmolVLM2-256M's text model, random weights and random prompts; nothing it writes can be guessed. Reading the
prompt (prefill) is reported apart; bars are on the rest (decode).
"""

import argparse
import logging
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
from decode_speed_compare import Timed, compare, finish, print_rows
from decode_speed_peer import OneTokenText
from decode_speed_works import (
    DecodeRequest,
    Episodes,
    add_episode_arguments,
    margin_at_difference,
    num_symbols,
    ours,
    peer,
)
from lerobot.utils.import_utils import register_third_party_plugins
from machine import add_machine_arguments, positive, require_idle_machine
from torch import Tensor

from lerobot_bomb.actions.text import NUM_SYMBOLS
from lerobot_bomb.decoding.decoder import MAX_GUESSES, Continuation, Guess, Prompt, decode_numbers
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, build_backbone
from lerobot_bomb.vlm.presets import nano_config
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer

MIN_NANO_RATIO, MIN_256M_RATIO = 4.0, 1.3
MIN_PASS_RATIOS = {"every step": 4.0, "queue": 2.0}
MAX_GRAMMAR_SHARE = 0.02
DRAFTS = ("none", "linear")
# the text model of SmolVLM2-256M-Video-Instruct
SHAPE_256M = {
    "vocab_size": 49280,
    "hidden_size": 576,
    "intermediate_size": 1536,
    "num_hidden_layers": 30,
    "num_attention_heads": 9,
    "num_key_value_heads": 3,
    "head_dim": 64,
    "max_position_embeddings": 8192,
}


def main() -> None:
    """Count passes, time answers, print the tables; exit code 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add_episode_arguments(parser, "vla0_smol")
    parser.add_argument("--repeats", type=positive, default=20, help="answers of each (default: 20)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    logging.disable(logging.WARNING)
    register_third_party_plugins()
    torch.manual_seed(0)
    episodes = Episodes(args)
    bars: dict[str, bool] = {}
    with torch.inference_mode():
        figures: dict[str, Any] = {
            "passes": count_passes(episodes, args.repeats, bars),
            "features": time_features(episodes, args.repeats),
            "nano": {size: time_nano(episodes, size, args.repeats, bars) for size in (1, 16)},
            "256M": time_256m(bars),
            "bfloat16": compare_bfloat16(episodes, args.repeats),
        }
    finish(args.json, figures, bars)


def count_passes(episodes: Episodes, repeats: int, bars: dict[str, bool]) -> dict[str, Any]:
    """Passes of answers against their tokens: whole chunks, and no more than is executed."""
    modes = {
        "every step": 1,
        "queue": episodes.config.n_action_steps,
        "whole chunk": episodes.config.chunk_size,
    }
    figures: dict[str, Any] = {}
    for mode, num_steps in modes.items():
        drafts = {
            draft: episodes.works(1, repeats, n_action_steps=num_steps, draft=draft) for draft in DRAFTS
        }
        if mode != "whole chunk":
            drafts["previous chunk"] = episodes.planned(repeats, num_steps)
        for draft, works in drafts.items():
            whole = [ours(replace(work, stop_after=work.grammar.num_numbers)) for work in works]
            num_tokens = sum(num_symbols(works[0].grammar, answer.numbers) for answer in whole)
            num_passes = sum(answer.num_passes for answer in whole)
            num_needed = sum(ours(work).num_passes for work in works)
            figures[f"{mode}, draft {draft}"] = {
                "tokens": num_tokens / repeats,
                "passes": num_passes / repeats,
                "tokens_a_pass": num_tokens / num_passes,
                "passes_as_executed": num_needed / repeats,
            }
    print_rows("passes a chunk, the prompt's included", figures)
    for mode, bar in MIN_PASS_RATIOS.items():
        gain = figures[f"{mode}, draft linear"]["tokens_a_pass"]
        bars[f"{mode}: {gain:.1f} times fewer passes than tokens (bar {bar})"] = gain >= bar
    return figures


def time_nano(
    episodes: Episodes, batch_size: int, repeats: int, bars: dict[str, bool]
) -> dict[str, dict[str, float]]:
    """The whole chunk by the peer and by us, without and with drafts; then only what is executed."""
    works = episodes.works(batch_size, repeats)
    whole = [replace(work, stop_after=work.grammar.num_numbers) for work in works]
    undrafted = [replace(work, guess=KnownSymbols(work.grammar)) for work in whole]
    figures = compare(
        {
            "generate, xgrammar": (peer, whole),
            "ours, no draft": (ours, undrafted),
            "ours, linear draft": (ours, whole),
            "ours, linear draft, early stop": (ours, works),
        }
    )
    print_rows(f"nano, batch of {batch_size}, medians of {repeats}", figures)
    gain = figures["ours, linear draft"]["decode_gain"]
    bars[f"nano, batch of {batch_size}: decode {gain:.1f} times faster (bar {MIN_NANO_RATIO})"] = (
        gain >= MIN_NANO_RATIO
    )
    return figures


def time_features(episodes: Episodes, repeats: int) -> dict[str, dict[str, float]]:
    """The decoder built up from one token a pass on transformers' layers, batch of 1."""
    works = episodes.works(1, repeats)
    whole = [replace(work, stop_after=work.grammar.num_numbers) for work in works]
    known = [replace(work, guess=KnownSymbols(work.grammar)) for work in whole]
    single = [replace(work, guess=no_guess) for work in whole]
    figures = compare(
        {
            "one token a pass, transformers' layers, all of the head": (plain, single),
            "+ the head's 12 rows": (plain_short_head, single),
            "+ own static cache and passes": (ours, single),
            "+ known symbols without a pass": (ours, known),
            "+ linear draft": (ours, whole),
            "+ early stop": (ours, works),
        }
    )
    print_rows(f"features, nano, batch of 1, medians of {repeats}", figures)
    return figures


def no_guess(_: Tensor, place: Place) -> Tensor:
    """(B, 0)."""
    return place.number.new_empty(len(place.number), 0)


def plain_short_head(work: DecodeRequest) -> Timed:
    """Ours on transformers' layers and growing cache."""
    with patch("lerobot_bomb.decoding.writer.CachedText", OneTokenText):
        return ours(work)


def plain(work: DecodeRequest) -> Timed:
    """Write as `plain_short_head` does, but with logits of the whole vocabulary."""

    def whole_head(backbone: SmolVLMBackbone, token_ids: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda hidden: backbone.logits(hidden)[..., token_ids]

    with patch.object(SmolVLMBackbone, "head", whole_head):
        return plain_short_head(work)


def time_256m(bars: dict[str, bool]) -> dict[str, Any]:
    """A text model of SmolVLM2-256M's shape against the peer, and against reading its weights once a pass."""
    config = nano_config(load_tokenizer(NANO))
    config["text_config"] |= SHAPE_256M
    backbone = build_backbone(config).eval()
    grammar = NumberGrammar(512, 40)
    prompt = torch.randn(1, 190, SHAPE_256M["hidden_size"])
    mask = torch.ones(1, 190, dtype=torch.bool)
    works = [
        DecodeRequest(
            backbone, Prompt(prompt + i, mask), torch.arange(30, 42), grammar, 40, KnownSymbols(grammar)
        )
        for i in range(3)
    ]
    figures = compare(
        {
            "generate, xgrammar": (peer, works),
            "ours, one token a pass": (ours, [replace(work, guess=no_guess) for work in works]),
            "ours, no draft": (ours, works),
            "ours, linear draft": (ours, [replace(work, guess=LinearDraft(grammar, 4)) for work in works]),
        }
    )
    print_rows("SmolVLM2-256M's shape, batch of 1, 10 actions of 4 numbers, medians of 3", figures)
    gain = figures["ours, no draft"]["decode_gain"]
    bars[f"256M: decode {gain:.2f} times faster (bar {MIN_256M_RATIO})"] = gain >= MIN_256M_RATIO
    floor_ms = 1e3 * read_weights_s(backbone)
    single = figures["ours, one token a pass"]
    step_ms = single["decode_ms"] / (single["passes"] - 1)
    grammar_ms, draft_ms = (
        1e3 * time_grammar_s(grammar, guess) for guess in (KnownSymbols(grammar), LinearDraft(grammar, 4))
    )
    share = grammar_ms / step_ms
    print(
        f"a pass: {step_ms:.1f} ms; its weights read once: {floor_ms:.1f} ms; "
        f"all but the model: {grammar_ms:.2f} ms, with drafts {draft_ms:.2f} ms"
    )
    bars[f"256M: grammar {share:.1%} of a pass (bar {MAX_GRAMMAR_SHARE:.0%})"] = share < MAX_GRAMMAR_SHARE
    costs = {"pass_ms": step_ms, "floor_ms": floor_ms, "grammar_ms": grammar_ms, "draft_ms": draft_ms}
    return figures | {"a pass": costs}


def read_weights_s(backbone: SmolVLMBackbone) -> float:
    """Median seconds to read the layers' weights once: one product of each with one vector."""
    layers: Any = backbone.vlm.model.text_model.get_submodule("layers")
    products = [module for module in layers.modules() if isinstance(module, torch.nn.Linear)]
    vectors = {module.in_features: torch.randn(1, module.in_features) for module in products}
    runs = []
    for _ in range(7):
        started = time.perf_counter()
        for module in products:
            module(vectors[module.in_features])
        runs.append(time.perf_counter() - started)
    return statistics.median(runs)


class NoModel(Continuation):
    """Continuation with the same logits for every symbol."""

    def __init__(self) -> None:
        self.logits = torch.randn(1, MAX_GUESSES + 1, NUM_SYMBOLS)

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        return self.logits[:, : symbol_BK.shape[1]]

    def keep(self, row_B: Tensor) -> None:
        """A batch of 1 has no rows to lose."""


def time_grammar_s(grammar: NumberGrammar, guess: Guess) -> float:
    """Median seconds a pass of everything but the model."""
    model, runs = NoModel(), []
    for _ in range(7):
        started = time.perf_counter()
        decoded = decode_numbers(model, grammar, guess, batch_size=1, stop_after=grammar.num_numbers)
        runs.append((time.perf_counter() - started) / decoded.num_passes)
    return statistics.median(runs)


def compare_bfloat16(episodes: Episodes, repeats: int) -> dict[str, float]:
    """Count chunks that ours and the peer write differently in bfloat16, and how close the choices were."""
    works = episodes.works(1, repeats)
    num_different, margins = 0, []
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for work in works:
            work = replace(work, stop_after=work.grammar.num_numbers)
            written, theirs = ours(work).numbers, peer(work).numbers
            if not torch.equal(written, theirs):
                num_different += 1
                margins.append(margin_at_difference(work, written[0], theirs[0]))
    figures = {"chunks": repeats, "different": num_different, "largest_margin": max(margins, default=0.0)}
    print(
        f"bfloat16: {num_different} of {repeats} chunks differ from the peer's; where they part, the two "
        f"likeliest symbols are at most {figures['largest_margin']:.3f} apart"
    )
    return figures


if __name__ == "__main__":
    main()
