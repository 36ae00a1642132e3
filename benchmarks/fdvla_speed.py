"""Speed of a query of `fdvla`: the prompt read once, against reading it anew in every sampling step.

    OMP_NUM_THREADS=1 python benchmarks/fdvla_speed.py --json fdvla_speed.json
    python benchmarks/fdvla_speed.py --device=cuda --json fdvla_speed_cuda.json

All ways use the same policy and weights, see the same random images and start from the same noise, so their
actions must agree. The models have random weights: nano, and the shape of Qwen2.5-0.5B with a vision model of
3 layers. The bar compares with reading the whole prompt, images included, in every step. On CUDA a query's
sampling steps are one CUDA graph; one row runs without it.
"""

import logging
import statistics
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
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
from torch import Tensor

from lerobot_bomb.vlm.presets import nano_qwen_config
from lerobot_bomb.vlm.qwen import QwenPrompt
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer
from lerobot_policy_bomb.fdvla import FdvlaConfig
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

MIN_RATIO = 3.0
EVERY_STEP, ONCE = "prompt read in every step", "prompt read once"
TOLERANCES = {"float32": 1e-3, "bfloat16": 0.2}  # of actions of unit spread, after all steps
BATCH_SIZES = {"nano": (1, 8), "0.5B": (1,)}
IMAGE_SIZE, NUM_DIMS = 224, 7
# the text model of Qwen2.5-0.5B
TEXT_05B = {
    "hidden_size": 896,
    "intermediate_size": 4864,
    "num_hidden_layers": 24,
    "num_attention_heads": 14,
    "num_key_value_heads": 2,
    "initializer_range": 0.02,
    "rope_parameters": {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [8, 12, 12]},
}


def main() -> None:
    """Time all ways and print the tables; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--repeats", type=positive, default=10, help="queries of each (default: 10)")
    parts = tuple(BATCH_SIZES)
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts, help="models (default: all)")
    args = parse_on_idle_machine(parser)
    logging.disable(logging.WARNING)
    figures: dict[str, Any] = {"device": device_name(args.device)}
    bars: dict[str, bool] = {}
    for model in args.parts:
        for dtype in ("float32", "bfloat16") if args.device == "cuda" else ("float32",):
            policy = make_policy(model, args.device, dtype)
            for batch_size in BATCH_SIZES[model]:
                name = f"{model}, {dtype}, batch of {batch_size}"
                figures[name] = time_queries(policy, make_batches(policy, batch_size, args.repeats))
                title = (
                    f"{name}, {policy.config.num_inference_steps} steps, chunks of {policy.config.chunk_size}"
                )
                print_rows(title, figures[name])
                gain = figures[name][ONCE]["gain"]
                if batch_size == 1:
                    bars[f"{name}: {gain:.1f} times faster (bar {MIN_RATIO:g})"] = gain >= MIN_RATIO
            del policy
    finish(args.json, figures, bars)


def make_policy(model: str, device: str, dtype: str) -> FdvlaPolicy:
    """Return a policy with random weights and the default chunk, steps and sampler."""
    torch.manual_seed(0)
    tokenizer = load_tokenizer(NANO)
    vlm_config = nano_qwen_config(tokenizer)
    if model == "0.5B":
        vlm_config["text_config"] |= TEXT_05B
        vlm_config["vision_config"]["out_hidden_size"] = TEXT_05B["hidden_size"]
    config = FdvlaConfig(
        vlm_model_name=NANO,
        vlm_config=vlm_config,
        prompt_tokens=QwenPrompt.from_tokenizer(tokenizer, NANO).to_dict(),
        device=device,
        dtype=dtype,
        **features(NUM_DIMS, IMAGE_SIZE),
    )
    return FdvlaPolicy(config).to(device).eval()


def time_queries(policy: FdvlaPolicy, batches: list[dict[str, Any]]) -> Rows:
    """Time every way on every batch, in turn; all must give the same actions."""
    ways: dict[str, Callable[[dict[str, Any]], Tensor]] = {
        EVERY_STEP: partial(read_in_every_step, policy),
        ONCE: policy.predict_action_chunk,
    }
    if policy.config.device == "cuda":
        ways[f"{ONCE}, not captured"] = partial(uncaptured, policy)
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for i, batch in enumerate([batches[0], *batches]):
        answers = []
        for name, query in ways.items():
            policy.reset()
            with torch.inference_mode():
                actions, elapsed_s = wait_and_time(partial(query, batch))
            answers.append(actions)
            if i:  # the first is to get warm
                seconds[name].append(elapsed_s)
        expected, *others = answers
        if not all(torch.allclose(expected, other, atol=TOLERANCES[policy.config.dtype]) for other in others):
            raise SystemExit(f"query {i}: {', '.join(ways)} do not give the same actions")
    latencies = {name: statistics.median(runs) for name, runs in seconds.items()}
    num_actions = len(expected) * policy.config.chunk_size
    return {
        name: {
            "latency_ms": 1e3 * latency_s,
            "actions_a_second": num_actions / latency_s,
            "gain": latencies[EVERY_STEP] / latency_s,
        }
        for name, latency_s in latencies.items()
    }


def read_in_every_step(policy: FdvlaPolicy, batch: dict[str, Any]) -> Tensor:
    """Sample a chunk, reading the prompt and its images anew in every step."""

    def heads(actions: Tensor, tau: Tensor) -> tuple[Tensor | None, Tensor | None]:
        return policy._heads(policy._read(batch))(actions, tau)

    shape = len(batch["observation.state"]), policy.config.chunk_size, NUM_DIMS
    with policy.autocast(), torch.no_grad():
        return policy._denoise(heads, policy._noise(None, shape), policy._step_noise(shape))


def uncaptured(policy: FdvlaPolicy, batch: dict[str, Any]) -> Tensor:
    """Sample a chunk the policy's own way, but without a CUDA graph."""

    def sample(_: object, *tensors: Tensor) -> tuple[Tensor, ...]:
        return policy._sample(*tensors)

    with patch.object(policy, "_captured", sample):
        return policy.predict_action_chunk(batch)


if __name__ == "__main__":
    main()
