"""Small backbones that are built in code: no network, trained on a laptop's CPU."""

from collections.abc import Mapping
from typing import Any

from tokenizers import Tokenizer

# 1 / sqrt(width): SmolVLM's 0.02 suits its own width; at this one it starts all layers near zero
INITIALIZER_RANGE = 0.08

NANO_VISION = {
    "hidden_size": 96,
    "intermediate_size": 256,
    "num_hidden_layers": 3,
    "num_attention_heads": 3,
    "image_size": 128,
    "patch_size": 16,
    "initializer_range": INITIALIZER_RANGE,
}
NANO_TEXT = {
    "hidden_size": 128,
    "intermediate_size": 320,
    "num_hidden_layers": 4,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 32,
    "max_position_embeddings": 4096,
    "initializer_range": INITIALIZER_RANGE,
}


# the numbering of tokens belongs to the tokenizer, and the family to the policy
FIXED = ("model_type", "vocab_size")


def changed(
    config: dict[str, Any], changes: Mapping[str, Any] | None, flag: str = "--policy.nano_config"
) -> dict[str, Any]:
    """Return a preset with the values of ``changes``, which is nested like the preset.

    Raises:
        ValueError: the preset has no such value to change.
    """
    changes = changes or {}
    free = [name for name in config if name not in FIXED and "token" not in name]
    for name, value in changes.items():
        if name not in free:
            raise ValueError(f"{flag}: {name!r} cannot be changed; choose {', '.join(free)}")
        if isinstance(value, Mapping) != isinstance(config[name], dict):
            raise ValueError(f"{flag}: {name}={value!r} must be as in the preset, {config[name]!r}")
    return {
        name: changed(value, changes.get(name), f"{flag}, {name}")
        if isinstance(value, dict)
        else changes.get(name, value)
        for name, value in config.items()
    }


def nano_config(tokenizer: Tokenizer) -> dict[str, Any]:
    """Config of a SmolVLM of about a million parameters for 128x128 images, 16 tokens each."""
    return {
        "model_type": "smolvlm",
        "image_token_id": tokenizer.token_to_id("<image>"),
        "pad_token_id": tokenizer.token_to_id("<|im_end|>"),
        "scale_factor": 2,
        "tie_word_embeddings": False,
        "vision_config": dict(NANO_VISION),
        "text_config": {
            **NANO_TEXT,
            "model_type": "llama",
            "vocab_size": tokenizer.get_vocab_size(),
            "rms_norm_eps": 1e-5,
            "pad_token_id": tokenizer.token_to_id("<|im_end|>"),
            "bos_token_id": tokenizer.token_to_id("<|im_start|>"),
            "eos_token_id": tokenizer.token_to_id("<end_of_utterance>"),
            "tie_word_embeddings": False,
        },
    }


def nano_paligemma_config(tokenizer: Tokenizer) -> dict[str, Any]:
    """Config of a PaliGemma 2 of about a million parameters for 128x128 images, 64 tokens each."""
    return {
        "model_type": "paligemma",
        "image_token_index": tokenizer.token_to_id("<image>"),
        "projection_dim": 128,
        "hidden_size": 128,
        "vision_config": {
            **NANO_VISION,
            "model_type": "siglip_vision_model",
            "vision_use_head": False,
        },
        "text_config": {
            **NANO_TEXT,
            "model_type": "gemma2",
            "vocab_size": tokenizer.get_vocab_size(),
            "query_pre_attn_scalar": 32,
            "pad_token_id": tokenizer.token_to_id("<|im_end|>"),
            "bos_token_id": tokenizer.token_to_id("<|im_start|>"),
            "eos_token_id": tokenizer.token_to_id("<end_of_utterance>"),
        },
    }


def nano_qwen_config(tokenizer: Tokenizer) -> dict[str, Any]:
    """Config of a Qwen2.5-VL of about a million parameters, a token for 28x28 pixels."""
    return {
        "model_type": "qwen2_5_vl",
        "image_token_id": tokenizer.token_to_id("<image>"),
        "video_token_id": tokenizer.get_vocab_size(),  # none
        "vision_start_token_id": tokenizer.token_to_id("<fake_token_around_image>"),
        "vision_end_token_id": tokenizer.token_to_id("<fake_token_around_image>"),
        "tie_word_embeddings": True,
        "vision_config": {
            "depth": 3,
            "hidden_size": 96,
            "intermediate_size": 256,
            "num_heads": 3,
            "out_hidden_size": 128,
            "window_size": 56,
            "fullatt_block_indexes": [0, 2],
            "initializer_range": INITIALIZER_RANGE,
        },
        "text_config": {
            **{key: value for key, value in NANO_TEXT.items() if key != "head_dim"},
            "model_type": "qwen2_5_vl_text",
            "vocab_size": tokenizer.get_vocab_size(),
            # over 4 x 4 image tokens the stock base, 10^6, hardly turns
            "rope_parameters": {"rope_type": "default", "rope_theta": 10.0, "mrope_section": [4, 6, 6]},
            "pad_token_id": tokenizer.token_to_id("<|im_end|>"),
            "bos_token_id": tokenizer.token_to_id("<|im_start|>"),
            "eos_token_id": tokenizer.token_to_id("<end_of_utterance>"),
            "tie_word_embeddings": True,
        },
    }
