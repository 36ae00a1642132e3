"""Vision-language model of an ``fdvla``, from its config or a checkpoint's, and its prompt."""

from collections.abc import Sequence

from lerobot_bomb.vlm.backbone import check_family, config_dict
from lerobot_bomb.vlm.layout import END, INSTRUCTION, START, STATE, Piece, PromptLayout
from lerobot_bomb.vlm.qwen import QwenBackbone, QwenPrompt, build_qwen, load_qwen
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.fdvla.configuration_fdvla import FdvlaConfig


def build_model(config: FdvlaConfig) -> tuple[QwenPrompt, QwenBackbone]:
    """Build the base model, or a checkpoint's architecture; fill in what a checkpoint's config must hold."""
    if config.vlm_config is None:
        name = config.vlm_model_name
        check_family(name, QwenBackbone.family)
        tokens = QwenPrompt.from_tokenizer(load_tokenizer(name), name)
        backbone = load_qwen(name, config.image_size, config.nano_config)
        config.vlm_config, config.prompt_tokens = config_dict(backbone.vlm), tokens.to_dict()
    else:
        assert config.prompt_tokens is not None
        tokens = QwenPrompt(**config.prompt_tokens)
        backbone = build_qwen(config.vlm_config, config.image_size, config.weights_type)
    _freeze(config, backbone)
    if config.gradient_checkpointing:
        backbone.checkpoint_gradients()
    return tokens, backbone


def make_layout(
    config: FdvlaConfig, tokens: QwenPrompt, cameras: Sequence[str], tokens_per_image: int
) -> PromptLayout:
    """Make the layout of prompts: images, instruction, a token that the state's embedding replaces."""
    image = [tokens.image_start, *tokens_per_image * [tokens.image], tokens.image_end]
    pieces = [
        Piece(START, tokens.start),
        *(Piece(camera, image) for camera in cameras),
        Piece(INSTRUCTION, None),
    ]
    state = [Piece(STATE, [tokens.image_end])] if config.use_state else []
    return PromptLayout([*pieces, *state, Piece(END, tokens.end)], tokens.image)


def _freeze(config: FdvlaConfig, backbone: QwenBackbone) -> None:
    vlm = backbone.vlm
    vlm.requires_grad_(config.train_vlm == "full")
    if config.freeze_vision_encoder:
        vlm.model.visual.requires_grad_(False)
    if vlm.lm_head.weight is not vlm.get_input_embeddings().weight:
        vlm.lm_head.requires_grad_(False)  # no word is written
