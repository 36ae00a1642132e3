"""Speed of decoding on a GPU: ours against transformers' `generate` with xgrammar's logits processor.

    python benchmarks/decode_speed_cuda.py --json decode_speed_cuda.json

The model has SmolVLM2-500M's shape, random weights and random prompts, so nothing it writes can be guessed.
In bfloat16 the peer's weights are bfloat16 and ours are float32, cast once per answer; in float32 both must
write the same numbers. Reading the prompt (prefill) is reported separately; the bars are on the decoding. A
policy of this shape is then timed from images to actions.
"""

import copy
import logging
import statistics
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from decode_speed_works import Timed, XgrammarGenerate, compare
from machine import (
    Rows,
    add_machine_arguments,
    finish,
    make_parser,
    positive,
    print_rows,
    require_cuda,
    require_idle_machine,
    wait_and_time,
)
from random_policies import features, make_batches
from torch import Tensor

from lerobot_bomb.cuda_graphs import GraphedFunction
from lerobot_bomb.decoding.decoder import Guess, Prompt
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, build_backbone
from lerobot_bomb.vlm.presets import nano_config
from lerobot_bomb.vlm.prompt import PromptTokens
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer
from lerobot_policy_vla0_smol import Vla0SmolConfig
from lerobot_policy_vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

MIN_RATIO = 8.0  # in bfloat16, one prompt at a time
PARTS = "decode", "policy"
BATCH_SIZES = 1, 16
PROMPT_LENGTH, NUM_STEPS, NUM_DIMS = 190, 10, 7
INITIALIZER_RANGE = 0.02  # of the published models
# of SmolVLM2-500M-Video-Instruct
TEXT_500M = {
    "hidden_size": 960,
    "num_hidden_layers": 32,
    "num_attention_heads": 15,
    "num_key_value_heads": 5,
    "intermediate_size": 2560,
    "head_dim": 64,
    "vocab_size": 49_280,
    "max_position_embeddings": 8192,
    "initializer_range": INITIALIZER_RANGE,
}
VISION_500M = {
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_size": 512,
    "patch_size": 16,
    "initializer_range": INITIALIZER_RANGE,
}


def main() -> None:
    """Time decoding and a policy, print the tables; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=positive, default=10, help="answers of each (default: 10)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="default: all")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_cuda("benchmarks/decode_speed.py measures on a CPU.")
    require_idle_machine(args.force)
    print(torch.cuda.get_device_name(), f"torch {torch.__version__}")
    logging.disable(logging.WARNING)
    torch.manual_seed(0)
    figures: dict[str, Any] = {"device": torch.cuda.get_device_name()}
    bars: dict[str, bool] = {}
    if "decode" in args.parts:
        figures |= time_decoding_all(args.repeats, bars)
    if "policy" in args.parts:
        figures["policy"] = time_policy(args.repeats)
    finish(args.json, figures, bars)


def time_decoding_all(repeats: int, bars: dict[str, bool]) -> dict[str, Any]:
    """Time decoding in both precisions and both sizes of batch."""
    figures = {}
    backbone = build_backbone(config_500m()).cuda().eval()
    with torch.inference_mode():
        for dtype in (torch.float32, torch.bfloat16):
            for batch_size in BATCH_SIZES:
                name = f"{str(dtype).removeprefix('torch.')}, batch of {batch_size}"
                num_answers = repeats if dtype == torch.bfloat16 else min(repeats, 3)
                figures[name] = time_decoding(backbone, dtype, batch_size, num_answers, bars, name)
    return figures


def config_500m() -> dict[str, Any]:
    """Return the config of a SmolVLM of the 500M shape, with our symbols' tokens."""
    config = nano_config(load_tokenizer(NANO))
    config["text_config"] |= TEXT_500M
    return config | {"scale_factor": 4, "vision_config": VISION_500M}


def time_decoding(
    backbone: SmolVLMBackbone,
    dtype: torch.dtype,
    batch_size: int,
    repeats: int,
    bars: dict[str, bool],
    name: str,
) -> Rows:
    """Time whole chunks by the peer and by us, without and with drafts."""
    grammar = NumberGrammar(512, NUM_STEPS * NUM_DIMS).cuda()
    written = torch.ones(batch_size, PROMPT_LENGTH, dtype=torch.bool, device="cuda")
    prompts = [
        Prompt(torch.randn(batch_size, PROMPT_LENGTH, TEXT_500M["hidden_size"], device="cuda"), written)
        for _ in range(repeats)
    ]
    symbol_ids = torch.arange(30, 42, device="cuda")
    stock = copy.deepcopy(backbone).to(dtype)
    cast = [Prompt(prompt.embeds.to(dtype), written) for prompt in prompts]
    known, linear = KnownSymbols(grammar), LinearDraft(grammar, NUM_DIMS)
    ways: dict[str, tuple[Guess, bool]] = {
        "ours, no draft": (known, False),
        "ours, no draft, compiled": (known, True),
        "ours, linear draft, compiled": (linear, True),
    }
    ours = {
        way: Ours(NumberWriter(backbone, grammar, guess, compiled=compiled), symbol_ids, dtype)
        for way, (guess, compiled) in ways.items()
    }
    figures = compare(
        {
            "generate, xgrammar": (XgrammarGenerate(stock, symbol_ids, grammar).timed, cast),
            **{way: (write, prompts) for way, write in ours.items()},
        },
        must_agree=dtype == torch.float32,
    )
    print_rows(f"{name}, medians of {repeats}", figures)
    gain = figures["ours, no draft"]["decode_gain"]
    if (dtype, batch_size) == (torch.bfloat16, 1):
        bars[f"{name}: decode {gain:.1f} times faster (bar {MIN_RATIO:g})"] = gain >= MIN_RATIO
    return figures


class Ours:
    """Writes an answer; times the whole, and the first pass, which reads the prompt."""

    def __init__(self, writer: NumberWriter, symbol_ids: Tensor, dtype: torch.dtype):
        self._writer, self._symbol_ids, self._dtype = writer, symbol_ids, dtype

    def __call__(self, prompt: Prompt) -> Timed:
        started = torch.cuda.Event(enable_timing=True)
        with (
            torch.autocast("cuda", dtype=torch.bfloat16, enabled=self._dtype == torch.bfloat16),
            ends_of_passes() as ends,
        ):
            torch.cuda.synchronize()
            started.record()
            decoded, whole_s = wait_and_time(
                lambda: self._writer(prompt, self._symbol_ids, NUM_STEPS * NUM_DIMS)
            )
        prefill_s = started.elapsed_time(ends[0]) / 1e3
        return Timed(decoded.numbers, prefill_s, whole_s - prefill_s, decoded.num_passes)


@contextmanager
def ends_of_passes() -> Iterator[list[torch.cuda.Event]]:
    """Collect the event at which the device was done with each captured pass."""
    ends: list[torch.cuda.Event] = []
    replay: Callable[..., Any] = GraphedFunction.__call__

    def timed(*args: Any) -> Any:
        returned = replay(*args)
        ends.append(torch.cuda.Event(enable_timing=True))
        ends[-1].record()
        return returned

    with patch.object(GraphedFunction, "__call__", timed):
        yield ends


def time_policy(repeats: int) -> Rows:
    """Time a policy from images, instruction and state to a chunk of actions, without the processors."""
    figures = {}
    for compiled in (False, True):
        policy = make_policy(compiled)
        for batch_size in BATCH_SIZES:
            (batch,) = make_batches(policy, batch_size, 1)
            with torch.inference_mode():
                runs = [
                    wait_and_time(lambda policy=policy, batch=batch: policy.predict_action_chunk(batch))[1]
                    for _ in range(repeats + 2)
                ][2:]
            latency_s = statistics.median(runs)
            figures[f"batch of {batch_size}{', compiled' if compiled else ''}"] = {
                "latency_ms": 1e3 * latency_s,
                "actions_a_second": batch_size * NUM_STEPS / latency_s,
            }
    print_rows(f"policy, chunks of {NUM_STEPS} actions of {NUM_DIMS}, all executed, no draft right", figures)
    return figures


def make_policy(compiled: bool) -> Vla0SmolPolicy:
    """Make a policy of the 500M shape, with random weights."""
    config = Vla0SmolConfig(
        vlm_config=config_500m(),
        prompt_tokens=PromptTokens.from_tokenizer(load_tokenizer(NANO), NANO).to_dict(),
        dtype="bfloat16",
        compile_model=compiled,
        device="cuda",
        chunk_size=NUM_STEPS,
        n_action_steps=NUM_STEPS,
        **features(NUM_DIMS, 256),
    )
    config.vlm_model_name = NANO  # its tokenizer
    return Vla0SmolPolicy(config).cuda().eval()


if __name__ == "__main__":
    main()
