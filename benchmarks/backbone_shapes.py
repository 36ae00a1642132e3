"""A training step and a chunk of actions of ``vla0_smol`` in the shape of a published base model.

    python benchmarks/backbone_shapes.py --shape=smolvlm_256m

The published architecture with random weights in float32 (``--bfloat16``: those of products in bfloat16), one
sample of two cameras, 10 actions of 7 numbers: that the shape runs, how long that takes and in how much
memory, and nothing of what a trained model does. A training step is forward and backward pass; the optimiser,
whose two states are twice the weights, is left out. One shape a process, as the peak of memory is the
process's.
"""

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from machine import add_machine_arguments, require_idle_machine, write_figures

from lerobot_bomb.tables import print_table
from lerobot_bomb.vlm.memory import GIB
from lerobot_bomb.vlm.presets import nano_config, nano_qwen_config
from lerobot_bomb.vlm.prompt import QWEN_CHAT, SMOLVLM_CHAT, PromptTokens
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer
from lerobot_policy_vla0_smol import Vla0SmolConfig, make_vla0_smol_pre_post_processors
from lerobot_policy_vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

CAMERAS = "observation.images.workspace", "observation.images.wrist"
NUM_STEPS, NUM_DIMS = 10, 7
INITIALIZER_RANGE = 0.02  # of the published models'

SIGLIP_BASE = {
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_size": 512,
    "patch_size": 16,
}
SIGLIP_SO400M = {
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_hidden_layers": 27,
    "num_attention_heads": 16,
    "image_size": 384,
    "patch_size": 14,
}


def smollm2(hidden: int, layers: int, heads: int, kv_heads: int, mlp: int, words: int) -> dict[str, Any]:
    """A text model of the SmolLM2 family."""
    return {
        "hidden_size": hidden,
        "num_hidden_layers": layers,
        "num_attention_heads": heads,
        "num_key_value_heads": kv_heads,
        "intermediate_size": mlp,
        "head_dim": hidden // heads,
        "vocab_size": words,
        "max_position_embeddings": 8192,
    }


# of the first generation, whose class is Idefics 3's; the second has the same shapes
SMOLVLM: dict[str, dict[str, Any]] = {
    "smolvlm_256m": {
        "scale_factor": 4,
        "vision_config": SIGLIP_BASE,
        "text_config": smollm2(576, 30, 9, 3, 1536, 49_280),
    },
    "smolvlm_500m": {
        "scale_factor": 4,
        "vision_config": SIGLIP_BASE,
        "text_config": smollm2(960, 32, 15, 5, 2560, 49_280),
    },
    "smolvlm_2.2b": {
        "scale_factor": 3,
        "vision_config": SIGLIP_SO400M,
        "text_config": smollm2(2048, 24, 32, 32, 8192, 49_155),
    },
}
QWEN: dict[str, dict[str, Any]] = {
    "qwen2.5_vl_3b": {
        "vision_config": {
            "depth": 32,
            "hidden_size": 1280,
            "intermediate_size": 3420,
            "num_heads": 16,
            "out_hidden_size": 2048,
            "window_size": 112,
            "fullatt_block_indexes": [7, 15, 23, 31],
        },
        "text_config": {
            "hidden_size": 2048,
            "num_hidden_layers": 36,
            "num_attention_heads": 16,
            "num_key_value_heads": 2,
            "intermediate_size": 11_008,
            "vocab_size": 151_936,
            "rope_parameters": {
                "rope_type": "default",
                "rope_theta": 1_000_000.0,
                "mrope_section": [16, 24, 24],
            },
        },
    }
}


def main() -> None:
    """Build, train a step, act; print times and the peak of memory."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", choices=[*SMOLVLM, *QWEN], required=True)
    parser.add_argument("--text_layers", type=int, help="of the text model, where not all fit")
    parser.add_argument("--forward_only", action="store_true", help="no gradients")
    parser.add_argument(
        "--bfloat16", action="store_true", help="--policy.dtype and --policy.weights_dtype; no gradients"
    )
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    policy, build_s = timed(lambda: make_policy(args.shape, args.text_layers, args.bfloat16))
    batch = make_batch(policy)
    figures = {"build_s": build_s}
    is_trained = not (args.forward_only or args.bfloat16)
    with torch.set_grad_enabled(is_trained):
        (loss, _), figures["forward_s"] = timed(lambda: policy.train()(batch))
        if is_trained:
            _, figures["backward_s"] = timed(loss.backward)
    policy.zero_grad(set_to_none=True)
    actions, figures["action_s"] = timed(lambda: policy.predict_action_chunk(batch))
    assert loss.isfinite() and actions.shape == (1, NUM_STEPS, NUM_DIMS)
    figures |= {
        "parameters_million": sum(parameter.numel() for parameter in policy.parameters()) / 1e6,
        "tokens_per_image": policy.backbone.tokens_per_image,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GIB,
        "threads": torch.get_num_threads(),
    }
    print_table(["figure", args.shape], [[name, f"{value:.4g}"] for name, value in figures.items()])
    asked = {"shape": args.shape, "text_layers": args.text_layers, "bfloat16": args.bfloat16}
    write_figures(args.json, {**asked, **figures})


def timed[T](call: Callable[[], T]) -> tuple[T, float]:
    """Return the call's result, and this process' CPU seconds, which other work does not stretch."""
    started = time.process_time()
    return call(), time.process_time() - started


def make_policy(shape: str, text_layers: int | None, in_bfloat16: bool) -> Vla0SmolPolicy:
    """Make a policy of random weights, with nano's tokenizer, whose numbers are among the published one's."""
    tokenizer = load_tokenizer(NANO)
    is_qwen = shape in QWEN
    vlm_config = nano_qwen_config(tokenizer) if is_qwen else nano_config(tokenizer)
    published = {**SMOLVLM, **QWEN}[shape]
    for name, value in published.items():
        vlm_config[name] = {**vlm_config[name], **value} if isinstance(value, dict) else value
    for part in ("vision_config", "text_config"):
        vlm_config[part]["initializer_range"] = INITIALIZER_RANGE
    if not is_qwen:
        vlm_config["model_type"] = "idefics3"
    if text_layers is not None:
        vlm_config["text_config"]["num_hidden_layers"] = text_layers
    tokens = PromptTokens.from_tokenizer(tokenizer, NANO, chat=QWEN_CHAT if is_qwen else SMOLVLM_CHAT)
    inputs = {key: PolicyFeature(FeatureType.VISUAL, (3, 256, 256)) for key in CAMERAS}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (NUM_DIMS,))
    torch.manual_seed(0)
    dtype = "bfloat16" if in_bfloat16 else "float32"
    return Vla0SmolPolicy(
        Vla0SmolConfig(
            dtype=dtype,
            weights_dtype=dtype,
            vlm_model_name=NANO,
            vlm_config=vlm_config,
            prompt_tokens=tokens.to_dict(),
            device="cpu",
            chunk_size=NUM_STEPS,
            input_features=inputs,
            output_features={"action": PolicyFeature(FeatureType.ACTION, (NUM_DIMS,))},
        )
    )


def make_batch(policy: Vla0SmolPolicy) -> dict[str, Any]:
    """One sample of noise."""
    stats = {
        key: {"min": torch.full((NUM_DIMS,), -1.0), "max": torch.full((NUM_DIMS,), 1.0)}
        for key in ("observation.state", "action")
    }
    preprocessor, _ = make_vla0_smol_pre_post_processors(policy.config, stats)
    return preprocessor(
        {
            **{key: torch.rand(1, 3, 256, 256) for key in CAMERAS},
            "observation.state": torch.rand(1, NUM_DIMS) * 2 - 1,
            "action": torch.rand(1, NUM_STEPS, NUM_DIMS) * 2 - 1,
            "action_is_pad": torch.zeros(1, NUM_STEPS, dtype=torch.bool),
            "task": ["put the black stone on the center"],
        }
    )


if __name__ == "__main__":
    main()
