"""Vision-language model of a ``vla0_smol``, from its config or a checkpoint's, and its prompt."""

from collections.abc import Sequence
from typing import Any

from lerobot_bomb.actions.text import digits_needed
from lerobot_bomb.vlm.backbone import (
    SmolVLMBackbone,
    build_backbone,
    check_family,
    config_dict,
    load_backbone,
)
from lerobot_bomb.vlm.layout import END, INSTRUCTION, START, STATE, Piece, PromptLayout
from lerobot_bomb.vlm.prompt import QWEN_CHAT, SMOLVLM_CHAT, PromptTokens
from lerobot_bomb.vlm.qwen import QwenBackbone, build_qwen, load_qwen
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol.configuration_vla0_smol import Vla0SmolConfig

# default for Qwen2.5-VL, which reads any size; VLA-0's
QWEN_IMAGE_SIZE = 224

type TextBackbone = SmolVLMBackbone | QwenBackbone


def build_model(config: Vla0SmolConfig) -> tuple[PromptTokens, TextBackbone]:
    """Build the base model, or a checkpoint's architecture; fill in what a checkpoint's config must hold."""
    if config.vlm_config is None:
        tokens, backbone = _load(config)
        config.vlm_config, config.prompt_tokens = config_dict(backbone.vlm), tokens.to_dict()
    else:
        assert config.prompt_tokens is not None
        tokens, backbone = PromptTokens(**config.prompt_tokens), _build(config, config.vlm_config)
        if tokens.system_prompt != config.system_prompt:
            raise ValueError(
                f"--policy.system_prompt={config.system_prompt!r}: this checkpoint was trained with "
                f"{tokens.system_prompt!r}, which cannot be changed"
            )
    if config.freeze_vision_encoder:
        backbone.freeze_vision()
    if config.gradient_checkpointing:
        backbone.checkpoint_gradients()
    return tokens, backbone


def make_layout(
    config: Vla0SmolConfig, tokens: PromptTokens, cameras: Sequence[str], tokens_per_image: int
) -> PromptLayout:
    """Make the layout of prompts: images, instruction, the state's numbers."""
    image = [*tokens.image_start, *tokens_per_image * [tokens.image], *tokens.image_end]
    pieces = [
        Piece(START, tokens.start),
        *(Piece(camera, image) for camera in cameras),
        Piece(INSTRUCTION, None),
    ]
    if config.use_state:
        assert config.robot_state_feature is not None
        width = 1 + (config.number_width or digits_needed(config.n_state_bins))
        numbers = Piece(STATE, None, width=config.robot_state_feature.shape[0] * width)
        pieces += [Piece(STATE, tokens.state_start), numbers, Piece(STATE, tokens.state_end)]
    return PromptLayout([*pieces, Piece(END, tokens.answer_start)], tokens.image)


def _load(config: Vla0SmolConfig) -> tuple[PromptTokens, TextBackbone]:
    name = config.vlm_model_name
    is_qwen = check_family(name, *SmolVLMBackbone.classes, QwenBackbone.family) == QwenBackbone.family
    chat = QWEN_CHAT if is_qwen else SMOLVLM_CHAT
    tokens = PromptTokens.from_tokenizer(load_tokenizer(name), name, config.system_prompt, chat)
    if is_qwen:
        return tokens, load_qwen(name, config.image_size or QWEN_IMAGE_SIZE)
    return tokens, load_backbone(name, config.nano_config, config.image_size)


def _build(config: Vla0SmolConfig, vlm_config: dict[str, Any]) -> TextBackbone:
    if vlm_config.get("model_type") == QwenBackbone.family:
        return build_qwen(vlm_config, config.image_size or QWEN_IMAGE_SIZE, config.weights_type)
    return build_backbone(vlm_config, config.image_size, config.weights_type)
