"""Small backbones that are built in code: no network, trained on a laptop's CPU."""

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
