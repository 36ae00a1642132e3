"""LeRobot's own policy types, as small as their flags allow, without a network.

Where a type reads a tokenizer or a configuration by name, the name is that of a folder written here. The pi0
family has its network's size and its tokenizer's name in code: `shrink_gemma` makes the first small, and
transformers reads a folder of the second's name, in the working directory, instead of the Hub's.
"""

import importlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from transformers import PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor
from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

from lerobot_bomb.vlm.presets import nano_config
from lerobot_bomb.vlm.tokenizer import GLOBAL_IMAGE_TOKEN, IMAGE_EDGE_TOKEN, IMAGE_TOKEN, nano_tokenizer

TOKENIZER = "google/paligemma-3b-pt-224"  # of the pi0 family
BACKBONE = "backbone"  # any other tokenizer or vision-language model
BASE = "base"  # the policy that a preset fine-tunes
BASE_CAMERAS = [f"observation.images.{name}" for name in ("image", "image2", "image3")]
CHUNK = {"chunk_size": 4, "n_action_steps": 4}
FLORENCE: dict[str, Any] = {
    "vision_config": {
        "model_type": "davit",
        "embed_dim": [8, 8, 16, 16],
        "depths": [1, 1, 1, 1],
        "num_heads": [1, 1, 2, 2],
        "num_groups": [1, 1, 2, 2],
        "window_size": 2,
        "projection_dim": 16,
    },
    "text_config": {
        "vocab_size": nano_tokenizer().get_vocab_size(),
        "d_model": 16,
        "encoder_layers": 1,
        "decoder_layers": 1,
        "encoder_attention_heads": 2,
        "decoder_attention_heads": 2,
        "encoder_ffn_dim": 32,
        "decoder_ffn_dim": 32,
    },
}
FLAGS: dict[str, dict[str, Any]] = {
    "act": {
        **CHUNK,
        "pretrained_backbone_weights": None,
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 32,
        "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1,
        "latent_dim": 4,
    },
    "diffusion": {
        "horizon": 8,
        "n_action_steps": 4,
        "pretrained_backbone_weights": None,
        "use_group_norm": True,
        "down_dims": [16, 32],
        "num_inference_steps": 2,
    },
    "smolvla": {
        **CHUNK,
        "vlm_model_name": BACKBONE,
        "num_vlm_layers": 2,
        "num_steps": 2,
        "resize_imgs_with_padding": [128, 128],
    },
    "pi0": {**CHUNK, "num_inference_steps": 2, "image_resolution": [56, 56]},
    "pi05": {**CHUNK, "num_inference_steps": 2, "image_resolution": [56, 56]},
    "pi0_fast": {
        **CHUNK,
        "image_resolution": [56, 56],
        "action_tokenizer_name": "fast",
        "max_decoding_steps": 4,
        "max_action_tokens": 32,
        # random weights do not write what a trained one begins its answers with
        "validate_action_token_prefix": False,
    },
    "xvla": {
        **CHUNK,
        "florence_config": FLORENCE,
        "tokenizer_name": BACKBONE,
        "action_mode": "auto",
        "hidden_size": 32,
        "depth": 1,
        "num_heads": 2,
        "num_denoising_steps": 2,
        "resize_imgs_with_padding": [64, 64],
    },
}
# the one class that is read from the folder of FAST's tokenizer: a character for each rounded coefficient
FAST_CODE = """
from scipy.fft import dct
from transformers.processing_utils import ProcessorMixin


class Coefficients:
    def decode(self, tokens):
        return "".join(chr(int(token)) for token in tokens)


class SmallFast(ProcessorMixin):
    attributes = []
    scale, min_token, bpe_tokenizer = 10, -50, Coefficients()

    def __call__(self, chunks):
        rounded = (dct(chunks, axis=1, norm="ortho") * self.scale).round().clip(-50, 49)
        return [(row.flatten() - self.min_token).astype(int).tolist() for row in rounded]
"""


def flags_of(stock_type: str, **more: Any) -> list[str]:
    """`--policy.*` for a stock command, after those of a preset."""
    values = {"device": "cpu", **FLAGS[stock_type], **more}
    return [
        f"--policy.{name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in values.items()
    ]


def write_base(stock_type: str, folder: Path) -> None:
    """Write a policy of random weights for another robot: cameras, state and actions are not BOMB's."""
    inputs = {name: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for name in BASE_CAMERAS}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (6,))
    actions = {"action": PolicyFeature(FeatureType.ACTION, (6,))}
    own = {
        name: tuple(value) if isinstance(value, list) else value for name, value in FLAGS[stock_type].items()
    }
    features = {"input_features": inputs, "output_features": actions}
    config = make_policy_config(stock_type, device="cpu", push_to_hub=False, **features, **own)
    torch.manual_seed(0)
    get_policy_class(stock_type)(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config):
        pipeline.save_pretrained(folder)


def write_folders(folder: Path) -> None:
    """Write the folders that the flags name, relative to the working directory, and the pi0 tokenizer."""
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=nano_tokenizer(),
        bos_token="<|im_start|>",
        eos_token="<end_of_utterance>",
        pad_token="<|im_end|>",
        extra_special_tokens={
            "image_token": IMAGE_TOKEN,
            "fake_image_token": IMAGE_EDGE_TOKEN,
            "global_image_token": GLOBAL_IMAGE_TOKEN,
        },
    )
    tokenizer.save_pretrained(folder / TOKENIZER)
    processor = SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor())
    processor.save_pretrained(folder / BACKBONE)
    SmolVLMConfig(**nano_config(nano_tokenizer())).save_pretrained(folder / BACKBONE)
    fast = folder / "fast"
    fast.mkdir()
    (fast / "small_fast.py").write_text(FAST_CODE)
    described = {"processor_class": "SmallFast", "auto_map": {"AutoProcessor": "small_fast.SmallFast"}}
    (fast / "processor_config.json").write_text(json.dumps(described))


def shrink_gemma(patch: pytest.MonkeyPatch, policy_type: str) -> None:
    """Build the type's networks small: no flag of the pi0 family says how large they are."""
    module = importlib.import_module(f"lerobot.policies.{policy_type}.modeling_{policy_type}")
    size = {"width": 64, "depth": 2, "mlp_dim": 64, "num_heads": 8, "num_kv_heads": 1, "head_dim": 16}
    patch.setattr(module, "get_gemma_config", lambda _: module.GemmaConfig(**size))
    for name in ("PaliGemmaForConditionalGenerationWithPiGemma", "PiGemmaForCausalLM"):
        if hasattr(module, name):
            patch.setattr(module, name, _small(getattr(module, name)))


def _small(network: type) -> Any:
    def build(config: Any) -> Any:
        vocab_size = nano_tokenizer().get_vocab_size()
        for part in (config, config.get_text_config()):
            part.vocab_size = vocab_size
        if hasattr(config, "vision_config"):
            config.image_token_index = 0
            small = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "projection_dim": 64}
            for name, value in {**small, "num_attention_heads": 2, "image_size": 56}.items():
                setattr(config.vision_config, name, value)
        return network(config)

    return build
