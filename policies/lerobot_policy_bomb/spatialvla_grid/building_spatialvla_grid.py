"""Parts of a ``spatialvla_grid``, built from its config, a checkpoint or a dataset."""

import logging
from collections.abc import Sequence

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION

from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_report import clipping_text, rest_text
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.actions.relative import bounds
from lerobot_bomb.actions.text import digits_needed
from lerobot_bomb.data.columns import dim_names, present_episodes, read_columns
from lerobot_bomb.vlm.backbone import check_family, config_dict
from lerobot_bomb.vlm.depth import ZoeDepth, build_zoedepth, load_zoedepth, read_zoedepth_config
from lerobot_bomb.vlm.layout import END, INSTRUCTION, START, STATE, Piece, PromptLayout
from lerobot_bomb.vlm.paligemma import PaliGemmaBackbone, PaliGemmaPrompt, build_paligemma, load_paligemma
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import (
    NUM_STATE_BINS,
    SpatialvlaGridConfig,
)

logger = logging.getLogger(__name__)

# not of the base model: trained whole beside its adapters
CELL_TABLES = ("cell_embedding", "cell_head")
# patterns of modules that have adapters beside the text model's
VISION_LAYERS = r"backbone\.vlm\.model\.vision_tower\..*\.((q|k|v|out)_proj|fc[12])"
PROJECTOR = r"backbone\.vlm\.model\.multi_modal_projector\.linear"
EGO3D_LAYERS = r"ego3d\.layers\.[03]"


def adapted_layers(config: SpatialvlaGridConfig) -> list[str]:
    """Return name patterns of the layers with adapters, of the parts that the config trains."""
    others = [PROJECTOR]
    if not config.freeze_vision_encoder:
        others.append(VISION_LAYERS)
    if config.depth_source != "none":
        others.append(EGO3D_LAYERS)
    return others


def check_adapted_cells(
    config: SpatialvlaGridConfig,
    trained_whole: Sequence[str],
    num_cells: list[int],
    num_cells_of_base: list[int],
) -> None:
    """Raise a ValueError unless adapters can hold the cells of grids that were adapted to a dataset."""
    if not {*CELL_TABLES} <= {*trained_whole}:
        raise ValueError(
            f"--peft.full_training_modules={trained_whole} leaves out the cells, which were adapted to "
            f"this dataset; have {' and '.join(CELL_TABLES)} in it, or give "
            "--policy.adapt_embeddings=false"
        )
    if num_cells_of_base != num_cells:
        raise ValueError(
            f"--policy.action_groups: adapters cannot be trained on grids of {num_cells} cells, as those of "
            f"{config.pretrained_path} have {num_cells_of_base}; leave it as it is"
        )


def build_depth(config: SpatialvlaGridConfig) -> ZoeDepth | None:
    """Build ZoeDepth from a checkpoint's architecture, else from the weights of ``depth_model_name``."""
    if config.depth_source != "zoedepth":
        return None
    if config.depth_config is not None:
        return build_zoedepth(config.depth_config)
    zoedepth = load_zoedepth(config.depth_model_name)
    config.depth_config = config_dict(zoedepth.model)
    return zoedepth


def complete_depth(config: SpatialvlaGridConfig, meta: LeRobotDatasetMetadata | None) -> None:
    """Complete a checkpoint's config for its ``depth_source``, if it was trained with another.

    Features that the dataset ``meta`` lacks are reported later; without a dataset, by the first batch.
    """
    config.read_depth_of(None if meta is None else meta.features)
    if config.depth_source == "zoedepth" and config.depth_config is None:
        config.depth_config = read_zoedepth_config(config.depth_model_name)


def make_grids(config: SpatialvlaGridConfig, meta: LeRobotDatasetMetadata | None) -> ActionGrids:
    """Return a checkpoint's grids, else those fitted to the data, else uniform ones."""
    assert config.action_feature is not None
    num_dims = config.action_feature.shape[0]
    if config.grid_params is not None:
        grids = ActionGrids.from_dict(config.grid_params, num_dims)
        grids.decode_point = config.decode_point
        return grids
    grids = ActionGrids(config.grid_settings(), num_dims)
    if meta is not None:
        fit_to_data(grids, config, meta)
    config.grid_params = grids.to_dict()
    return grids


def fit_to_data(grids: ActionGrids, config: SpatialvlaGridConfig, meta: LeRobotDatasetMetadata) -> None:
    """Fit the cells to all actions of a dataset, normalised as LeRobot will."""
    assert meta.stats is not None
    actions_ND = read_columns(meta, (ACTION,), present_episodes(meta))[ACTION].astype(np.float64)
    low_D, high_D = bounds(meta.stats[ACTION], config.normalization_mapping["ACTION"], actions_ND.shape[1])
    actions_ND = normalised(actions_ND, low_D, high_D)
    grids.fit(actions_ND, normalised_rest(low_D, high_D))
    names = dim_names(meta.features[ACTION])
    for text, needs_remedy in (clipping_text(actions_ND, names), rest_text(grids, actions_ND, names)):
        if text:
            logger.log(logging.WARNING if needs_remedy else logging.INFO, "%s: %s", meta.repo_id, text)


def make_layout(
    config: SpatialvlaGridConfig, tokens: PaliGemmaPrompt, cameras: Sequence[str], tokens_per_image: int
) -> PromptLayout:
    """Make the layout of prompts: images, instruction, the state's numbers."""
    image = tokens_per_image * [tokens.image]
    pieces = [
        *(Piece(camera, image) for camera in cameras),
        Piece(START, tokens.start),
        Piece(INSTRUCTION, None),
    ]
    if config.use_state:
        assert config.robot_state_feature is not None
        width = 1 + digits_needed(NUM_STATE_BINS)
        numbers = Piece(STATE, None, width=width * config.robot_state_feature.shape[0])
        pieces += [Piece(STATE, tokens.state_start), numbers]
    return PromptLayout([*pieces, Piece(END, tokens.task_end)], tokens.image)


def build_model(config: SpatialvlaGridConfig) -> tuple[PaliGemmaPrompt, PaliGemmaBackbone]:
    """Build the base model, or a checkpoint's architecture; fill in what a checkpoint's config must hold."""
    if config.vlm_config is None:
        name = config.vlm_model_name
        check_family(name, PaliGemmaBackbone.family)
        tokens = PaliGemmaPrompt.from_tokenizer(load_tokenizer(name), name)
        backbone = load_paligemma(name, config.nano_config)
        config.vlm_config, config.prompt_tokens = config_dict(backbone.vlm), tokens.to_dict()
    else:
        assert config.prompt_tokens is not None
        tokens = PaliGemmaPrompt(**config.prompt_tokens)
        backbone = build_paligemma(config.vlm_config, config.weights_type)
    if config.freeze_vision_encoder:
        backbone.vlm.model.vision_tower.requires_grad_(False)
    if config.freeze_llm_embeddings:
        backbone.vlm.get_input_embeddings().requires_grad_(False)
    if config.loss_vocab == "slot" and not backbone.has_tied_head:
        backbone.vlm.lm_head.requires_grad_(False)  # no word is written
    if config.gradient_checkpointing:
        backbone.checkpoint_gradients()
    return tokens, backbone
