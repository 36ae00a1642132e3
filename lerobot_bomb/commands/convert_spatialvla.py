"""``lerobot-bomb convert-spatialvla``: a published SpatialVLA folder as a checkpoint of ``spatialvla_grid``.

What the folder's ZoeDepth holds is left out: it is the public one, and depth that is observed is better.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGES
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file
from torch import Tensor

from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.checkpoints.checks import check_finite
from lerobot_bomb.checkpoints.folder import write_checkpoint
from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.files import check_new_folder, read_json
from lerobot_bomb.vlm.paligemma import PaliGemmaPrompt
from lerobot_bomb.vlm.tokenizer import load_tokenizer

WORDS, WORD_HEAD = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"
CELLS = "spatial_embed_tokens.weight"
LEFT_OUT = "vision_zoe_model."
# beginnings of the original's names -> of ours
RENAMED = {
    "vision_tower.": "backbone.vlm.model.vision_tower.",
    "multi_modal_projector.": "backbone.vlm.model.multi_modal_projector.",
    "language_model.model.": "backbone.vlm.model.language_model.",
    "position_embedding_3d.position_embedding_head.": "ego3d.layers.",
    CELLS: "cell_embedding.weight",
}


def add_convert_spatialvla_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb convert-spatialvla``."""
    add = parser.add_argument
    add(
        "folder",
        type=path_flag,
        help="folder with config.json, processor_config.json, tokenizer.json, weights",
    )
    add("--output", type=path_flag, required=True, help="new folder for the checkpoint")
    add("--grid", type=path_flag, required=True, help="the grid's gs_*.json")
    min_sigma = "least sigma that the grid was made with (default: 0.5, as in the published pretraining)"
    add("--min_sigma", type=float, default=0.5, help=min_sigma)
    add("--statistics", required=True, help="which of the folder's data sets says how actions are scaled")
    add("--camera", default="image", help="name of the camera, observation.images.NAME (default: image)")
    point = "what cells decode to: mid, as in the original, or cond_mean (default)"
    add("--decode_point", default="cond_mean", choices=("mid", "cond_mean"), help=point)


def run_convert_spatialvla(args: argparse.Namespace) -> int:
    """Write the checkpoint."""
    check_new_folder("--output", args.output)
    original = read_json(args.folder / "config.json")
    if original.get("model_type") != "spatialvla":
        raise ValueError(
            f"{args.folder}: config.json is of a {original.get('model_type')!r}, not of a SpatialVLA"
        )
    processor = read_json(args.folder / "processor_config.json")
    scales = _action_scales(processor["statistics"], args.statistics)
    grids = ActionGrids.from_published(json.loads(args.grid.read_text()), args.min_sigma, args.decode_point)
    if grids.num_tokens != original["spatial_token_num"]:
        raise ValueError(
            f"{args.folder} has {original['spatial_token_num']} cells, the published grid {grids.num_tokens}"
        )
    register_third_party_plugins()
    config = _config(args, original, int(processor["action_chunk_size"]), grids)
    policy = get_policy_class(config.type)(config)
    policy.load_state_dict(_weights(args.folder, original, policy.state_dict()), strict=True)
    pipelines = make_pre_post_processors(config, dataset_stats={ACTION: scales})
    config.vlm_model_name = args.folder.resolve().name  # nothing is read there any more
    write_checkpoint(args.output, policy, pipelines)
    print(f"written to {args.output}: --policy.path={args.output}")
    return 0


def _action_scales(statistics: dict[str, Any], name: str) -> dict[str, Tensor]:
    """q01 and q99 of an action; of a gripper, 0 and 1, which the original does not scale."""
    if name not in statistics:
        raise ValueError(f"--statistics={name} is not in the folder; choose from {', '.join(statistics)}")
    action = statistics[name][ACTION]
    q01, q99 = (torch.tensor(action[key], dtype=torch.float32) for key in ("q01", "q99"))
    scaled = torch.tensor(action.get("mask", [True] * 6 + [False]))
    return {"q01": q01.where(scaled, 0.0), "q99": q99.where(scaled, 1.0)}


def _config(args: argparse.Namespace, original: dict[str, Any], chunk_size: int, grids: ActionGrids) -> Any:
    text_config = {
        **original["text_config"],
        "model_type": "gemma2",
        "vocab_size": original["action_token_begin_idx"],
        "tie_word_embeddings": False,
    }
    vision_config = {"model_type": "siglip_vision_model", **original["vision_config"]}
    side = vision_config["image_size"]
    return PreTrainedConfig.get_choice_class("spatialvla_grid")(
        vlm_model_name=str(args.folder),
        vlm_config={
            "model_type": "paligemma",
            "image_token_index": original["image_token_index"],
            "projection_dim": original["projection_dim"],
            "hidden_size": text_config["hidden_size"],
            "tie_word_embeddings": False,
            "text_config": text_config,
            "vision_config": vision_config,
        },
        prompt_tokens=PaliGemmaPrompt.from_tokenizer(
            load_tokenizer(str(args.folder)), str(args.folder)
        ).to_dict(),
        chunk_size=chunk_size,
        n_action_steps=chunk_size,
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.QUANTILES,
            "ACTION": NormalizationMode.QUANTILES,
        },
        **grids.settings.flags(),
        grid_params=grids.to_dict(),
        ego3d_patch_reso=original["ego3d_patch_reso"],
        ego3d_n_freqs=original["n_freqs"],
        input_features={f"{OBS_IMAGES}.{args.camera}": PolicyFeature(FeatureType.VISUAL, (3, side, side))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (grids.num_dims,))},
        device="cpu",
    )


def _weights(folder: Path, original: dict[str, Any], ours: dict[str, Tensor]) -> dict[str, Tensor]:
    """The folder's tensors under our names, float32; what only we have stays as it is.

    Raises:
        ValueError: there are none, or one is missing or not finite.
    """
    files = sorted(folder.glob("*.safetensors"))
    for path in files:
        check_finite(path)
    tensors = {name: tensor for path in files for name, tensor in load_file(path).items()}
    if missing := [name for name in (WORDS, WORD_HEAD, CELLS) if name not in tensors]:
        raise ValueError(f"{folder}: its {len(files)} *.safetensors have no {', '.join(missing)}")
    first, end = original["action_token_begin_idx"], original["action_token_begin_idx"] + len(tensors[CELLS])
    head = tensors.pop(WORD_HEAD)
    converted = {"backbone.vlm.lm_head.weight": head[:first], "cell_head.weight": head[first:end]}
    tensors[WORDS] = tensors[WORDS][:first]
    for name, tensor in tensors.items():
        if not name.startswith(LEFT_OUT):
            converted[_renamed(name)] = tensor
    own = {name: ours[name] for name in ours if name.startswith("grids.") or name == "ego3d.no_depth"}
    return own | {name: tensor.float().contiguous() for name, tensor in converted.items()}


def _renamed(name: str) -> str:
    for begins, ours in RENAMED.items():
        if name.startswith(begins):
            return ours + name.removeprefix(begins)
    return name  # loading strictly names it
