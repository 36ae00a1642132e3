"""Small models of every family that ``vla0_smol`` starts from, in folders as published ones are."""

from pathlib import Path
from typing import Any

import torch
from tokenizers import AddedToken, Tokenizer
from torch import Tensor
from transformers import (
    Idefics3Config,
    Idefics3ForConditionalGeneration,
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen2VLImageProcessor,
    SmolVLMConfig,
    SmolVLMForConditionalGeneration,
)

from lerobot_bomb.vlm.presets import nano_config, nano_qwen_config
from lerobot_bomb.vlm.prompt import normalize_task
from lerobot_bomb.vlm.tokenizer import nano_tokenizer
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

QWEN_TOKENS = ("<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>", "<|fim_pad|>")
# images are not whole patches, as those of the first 2.2B: 6 x 6 patches of 14 pixels and 2 left over
IDEFICS3_VISION = {"image_size": 86, "patch_size": 14, "num_hidden_layers": 2}
QWEN_IMAGE_SIZE = 56  # 2 x 2 tokens


def small_tokenizer(family: str) -> Tokenizer:
    """The nano one, with the special tokens of the family."""
    tokenizer = nano_tokenizer()
    if family == "qwen2_5_vl":
        tokenizer.add_special_tokens([AddedToken(text, special=True) for text in QWEN_TOKENS])
    return tokenizer


def small_model(family: str, tokenizer: Tokenizer) -> Any:
    """Build a small model of transformers' own class: random weights, two layers each of text and vision."""
    token_id = tokenizer.token_to_id
    if family == "qwen2_5_vl":
        config = nano_qwen_config(tokenizer)
        config |= {"image_token_id": token_id("<|image_pad|>"), "video_token_id": token_id("<|video_pad|>")}
        config |= {f"vision_{side}_token_id": token_id(f"<|vision_{side}|>") for side in ("start", "end")}
        config["vision_config"] |= {"depth": 2, "fullatt_block_indexes": [1]}
        config["text_config"] |= {"num_hidden_layers": 2, "eos_token_id": token_id("<|im_end|>")}
        return Qwen2_5_VLForConditionalGeneration(Qwen2_5_VLConfig(**config))
    config = nano_config(tokenizer)
    config["text_config"]["num_hidden_layers"] = 2
    if family == "smolvlm":
        config["vision_config"]["num_hidden_layers"] = 2
        return SmolVLMForConditionalGeneration(SmolVLMConfig(**config))
    config["vision_config"] |= IDEFICS3_VISION
    config |= {"model_type": family, "scale_factor": 3}
    return Idefics3ForConditionalGeneration(Idefics3Config(**config))


def write_folder(family: str, folder: Path) -> Path:
    """Config, weights and tokenizer."""
    tokenizer = small_tokenizer(family)
    torch.manual_seed(0)
    model = small_model(family, tokenizer)
    with torch.no_grad():  # biases and norms that are not zeros and ones
        for parameter in model.parameters():
            parameter += 0.02 * torch.randn(parameter.shape)
    model.save_pretrained(folder)
    tokenizer.save(str(folder / "tokenizer.json"))
    return folder


def options_of(family: str) -> dict[str, Any]:
    """Flags for such a model."""
    return {"image_size": QWEN_IMAGE_SIZE} if family == "qwen2_5_vl" else {}


def is_qwen(policy: Vla0SmolPolicy) -> bool:
    return policy.backbone.vlm.config.model_type == "qwen2_5_vl"


def prompt_text(policy: Vla0SmolPolicy, task: str, state: list[int] | None) -> str:
    """Write a question about the images of two cameras as the family's chat template does."""
    num_tokens, system = policy.backbone.tokens_per_image, policy.config.system_prompt
    state_text = "" if state is None else f"State: {' '.join(map(str, state))}, "
    question = f"Task: {normalize_task(task)}, {state_text}Actions: "
    if is_qwen(policy):
        system = "You are a helpful assistant." if system is None else system
        image = f"<|vision_start|>{'<|image_pad|>' * num_tokens}<|vision_end|>"
        opening = f"<|im_start|>system\n{system}<|im_end|>\n<|im_start|>user\n"
        return f"{opening}{image}{image}{question}<|im_end|>\n<|im_start|>assistant\n"
    system = "" if system is None else f"System: {system}<end_of_utterance>\n"
    image = f"<fake_token_around_image><global-img>{'<image>' * num_tokens}<fake_token_around_image>"
    return f"<|im_start|>{system}User:{image}{image}{question}<end_of_utterance>\nAssistant:"


def answer_text(policy: Vla0SmolPolicy, numbers: list[int]) -> str:
    end = "<|im_end|>" if is_qwen(policy) else "<end_of_utterance>"
    return "".join(f" {number}" for number in numbers) + end


def stock_inputs(policy: Vla0SmolPolicy, ids_L: Tensor, images_N3SS: Tensor) -> dict[str, Tensor]:
    """Return the stock model's inputs: a sequence and its images (N, 3, S, S) in [0, 1], of its own size."""
    if not is_qwen(policy):
        return {"input_ids": ids_L[None], "pixel_values": images_N3SS[None] * 2 - 1}
    images = [image.permute(1, 2, 0).mul(255).round().byte().numpy() for image in images_N3SS]
    processed = Qwen2VLImageProcessor(min_pixels=28 * 28)(images=images, return_tensors="pt")
    is_image = ids_L == policy.backbone.vlm.config.image_token_id
    return {"input_ids": ids_L[None], "mm_token_type_ids": is_image[None].int(), **processed}
