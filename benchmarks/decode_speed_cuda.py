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
from typing import Any

import torch
from decode_ways import NumbersByGenerate, NumbersByUs, compare
from machine import (
    Rows,
    device_name,
    finish,
    make_parser,
    parse_on_idle_machine,
    positive,
    print_rows,
    wait_and_time,
)
from random_policies import features, make_batches

from lerobot_bomb.decoding.decoder import Guess, Prompt
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, build_backbone
from lerobot_bomb.vlm.presets import nano_config
from lerobot_bomb.vlm.prompt import PromptTokens
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer
from lerobot_policy_bomb.vla0_smol import Vla0SmolConfig
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

BAR_IS_ON, MIN_RATIO = "bfloat16, batch of 1", 8.0
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
    args = parse_on_idle_machine(parser)
    figures: dict[str, Any] = {"device": device_name("cuda")}
    bars: dict[str, bool] = {}
    logging.disable(logging.WARNING)
    torch.manual_seed(0)
    if "decode" in args.parts:
        backbone = build_backbone(config_500m()).cuda().eval()
        for dtype in (torch.float32, torch.bfloat16):
            repeats = args.repeats if dtype == torch.bfloat16 else min(args.repeats, 3)
            for batch_size in BATCH_SIZES:
                name = f"{str(dtype).removeprefix('torch.')}, batch of {batch_size}"
                figures[name] = time_decoding(backbone, dtype, batch_size, repeats)
                print_rows(f"{name}, medians of {repeats}", figures[name])
        gain = figures[BAR_IS_ON]["ours, no draft"]["decode_gain"]
        bars[f"{BAR_IS_ON}: decode {gain:.1f} times faster (bar {MIN_RATIO:g})"] = gain >= MIN_RATIO
    if "policy" in args.parts:
        figures["policy"] = time_policy(args.repeats)
        title = f"policy, chunks of {NUM_STEPS} actions of {NUM_DIMS}, all executed, no draft right"
        print_rows(title, figures["policy"])
    finish(args.json, figures, bars)


def config_500m() -> dict[str, Any]:
    """Return the config of a SmolVLM of the 500M shape, with our symbols' tokens."""
    config = nano_config(load_tokenizer(NANO))
    config["text_config"] |= TEXT_500M
    return config | {"scale_factor": 4, "vision_config": VISION_500M}


@torch.inference_mode()
def time_decoding(backbone: SmolVLMBackbone, dtype: torch.dtype, batch_size: int, repeats: int) -> Rows:
    """Time whole chunks by the peer and by us, without and with drafts."""
    grammar = NumberGrammar(512, NUM_STEPS * NUM_DIMS).cuda()
    written = torch.ones(batch_size, PROMPT_LENGTH, dtype=torch.bool, device="cuda")
    shape = batch_size, PROMPT_LENGTH, TEXT_500M["hidden_size"]
    prompts = [Prompt(torch.randn(shape, device="cuda"), written) for _ in range(repeats)]
    symbol_ids = torch.arange(30, 42, device="cuda")

    def ours(guess: Guess, *, compiled: bool) -> NumbersByUs:
        writer = NumberWriter(backbone, grammar, guess, compiled=compiled)
        return NumbersByUs(writer, symbol_ids, grammar.num_numbers, dtype)

    known, linear = KnownSymbols(grammar), LinearDraft(grammar, NUM_DIMS)
    peer = NumbersByGenerate(copy.deepcopy(backbone).to(dtype), symbol_ids, grammar)
    return compare(
        {
            "generate, xgrammar": (peer, [Prompt(embeds.to(dtype), mask) for embeds, mask, _ in prompts]),
            "ours, no draft": (ours(known, compiled=False), prompts),
            "ours, no draft, compiled": (ours(known, compiled=True), prompts),
            "ours, linear draft, compiled": (ours(linear, compiled=True), prompts),
        },
        must_agree=dtype == torch.float32,
    )


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
