"""A published SpatialVLA folder as a checkpoint of ``spatialvla_grid``.

The folder is what the original's ``save_pretrained`` writes; values that its config.json leaves out are the
defaults of transformers' classes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGES
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file
from torch import Tensor

from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.checkpoints.checks import check_finite
from lerobot_bomb.checkpoints.folder import write_checkpoint
from lerobot_bomb.files import read_json
from lerobot_bomb.vlm.backbone import config_dict
from lerobot_bomb.vlm.intrinsics import default_intrinsics, resize_intrinsics
from lerobot_bomb.vlm.paligemma import PaliGemmaPrompt
from lerobot_bomb.vlm.tokenizer import load_tokenizer

WORDS, WORD_HEAD = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"
CELLS = "spatial_embed_tokens.weight"
# nothing reads it: PaliGemma takes the patches' features
POOLING_HEAD = "vision_tower.vision_model.head."
# beginnings of the original's names -> of ours
RENAMED = {
    "vision_tower.": "backbone.vlm.model.vision_tower.",
    "multi_modal_projector.": "backbone.vlm.model.multi_modal_projector.",
    "language_model.model.": "backbone.vlm.model.language_model.",
    "position_embedding_3d.position_embedding_head.": "ego3d.layers.",
    "vision_zoe_model.": "zoedepth.model.",
    CELLS: "cell_embedding.weight",
}
TRANSLATION, ROTATION = ("theta_bins", "phi_bins", "r_bins"), ("roll_bins", "pitch_bins", "yaw_bins")
# keys that the folder's files must have; the rest has defaults
ORIGINAL_KEYS = (
    *("action_token_begin_idx", "image_token_index", "projection_dim", "hidden_size", "spatial_token_num"),
    *("text_config", "vision_config", "use_vision_zoe", "ego3d_patch_reso", "n_freqs"),
)
PROCESSOR_KEYS = ("statistics", "action_config", "action_chunk_size", "intrinsic_config")
BARE_TASK = "{}"
GRIPPER = 6  # of the action's dims
# least sigma of the published grid, which no file of its folder states
PUBLISHED_MIN_SIGMA = 0.5
EDGE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Published:
    """A published folder, with the settings that its files lack."""

    folder: Path
    statistics: str | None = None  # name of those that scale actions; None: it has one only
    camera: str = "image"
    grid: Path | None = None  # the authors' file of the Gaussians that its edges were made of
    min_sigma: float | None = None  # of that grid; None: the folder's, or the published one
    task_template: str = BARE_TASK  # around an instruction
    decode_point: str = "mid"


def convert(published: Published, output: Path) -> str:
    """Write the checkpoint to a new folder; return a sentence on its prompt.

    Raises:
        ValueError: the folder is incomplete, or does not match its options.
    """
    original = read_json(published.folder / "config.json")
    if original.get("model_type") != "spatialvla":
        raise ValueError(
            f"{published.folder}: config.json is of a {original.get('model_type')!r}, not of a SpatialVLA"
        )
    processor = read_json(published.folder / "processor_config.json")
    _check_keys(published.folder / "config.json", original, ORIGINAL_KEYS)
    _check_keys(published.folder / "processor_config.json", processor, PROCESSOR_KEYS)
    name = _chosen_statistics(processor["statistics"], published.statistics)
    grids = _grids(published, processor)
    if grids.num_tokens != original["spatial_token_num"]:
        raise ValueError(
            f"{published.folder} has {original['spatial_token_num']} cells, but processor_config.json "
            f"describes {grids.num_tokens}"
        )
    register_third_party_plugins()
    config = _config(published, original, processor, name, grids)
    policy: Any = get_policy_class(config.type)(config)
    policy.load_state_dict(_weights(published.folder, original, policy.state_dict()), strict=True)
    # whole, whatever the defaults of later transformers are
    config.vlm_config = config_dict(policy.backbone.vlm)
    if policy.zoedepth is not None:
        config.depth_config = config_dict(policy.zoedepth.model)
    scales = _action_scales(processor["statistics"][name][ACTION])
    pipelines = make_pre_post_processors(config, dataset_stats={ACTION: scales})
    config.vlm_model_name = published.folder.resolve().name  # nothing is read there any more
    write_checkpoint(output, policy, pipelines)
    return _prompt_text(published.task_template)


def _prompt_text(template: str) -> str:
    """Describe the prompt and its source; no file of the folder has it."""
    if template == BARE_TASK:
        return (
            "prompt: the instruction alone, as the original's processor adds nothing to what it is given; "
            "where the weights were trained on the slides' question: "
            "--task_template='What action should the robot take to {}?'"
        )
    return f"prompt: {template!r} around the instruction, as --task_template asks"


def _check_keys(path: Path, values: dict[str, Any], keys: tuple[str, ...]) -> None:
    if missing := [key for key in keys if key not in values]:
        raise ValueError(f"{path} has no {', '.join(missing)}, so it is not of a SpatialVLA's folder")


def _chosen_statistics(statistics: dict[str, Any], name: str | None) -> str:
    """Return the name of the statistics: the given one, or the only one."""
    if name is None and len(statistics) == 1:
        return next(iter(statistics))
    if name not in statistics:
        start = "--statistics is missing" if name is None else f"--statistics={name} is not in the folder"
        raise ValueError(f"{start}; choose from {', '.join(statistics)}")
    return name


def _action_scales(action: dict[str, Any]) -> dict[str, Tensor]:
    """Return the actions (D,) that -1 and 1 stand for, as LeRobot's statistics q01 and q99.

    The original scales only the dims in ``mask``. Its gripper is 0 or 1 before scaling, ours -1 or 1.
    """
    low, high = (torch.tensor(action[key], dtype=torch.float32) for key in ("q01", "q99"))
    scaled = torch.tensor(action.get("mask", [True] * len(low)))
    low, high = low.where(scaled, -1.0), high.where(scaled, 1.0)
    low[GRIPPER] = (low[GRIPPER] + high[GRIPPER]) / 2
    return {"q01": low, "q99": high}


def _grids(published: Published, processor: dict[str, Any]) -> ActionGrids:
    """Build grids from the folder's own edges and the Gaussians of --grid, which must give the same edges."""
    counts, policy = processor["action_config"]["num_bins"], processor.get("bin_policy")
    if policy is None:
        raise ValueError(
            f"{published.folder}: processor_config.json has no bin_policy, the edges of its cells"
        )
    edges, bins = [], []
    for kind, keys in (("translation", TRANSLATION), ("rotation", ROTATION)):
        bins.append(tuple(counts[kind][key] for key in keys))
        edges += [torch.tensor(policy[kind][key], dtype=torch.float64) for key in keys]
    transform = "polar" if processor["action_config"]["use_spherical"] else "identity"
    groups = (
        ActionGroup((0, 1, 2), transform, bins[0]),
        ActionGroup((3, 4, 5), "identity", bins[1]),
        ActionGroup((GRIPPER,), "binary", (counts["gripper"],)),
    )
    min_sigma = processor.get("min_sigma", 0.0)
    settings = GridSettings(
        groups, "gaussian", min_sigma, published.decode_point, zero_radius_bin=False, phi_fit="linear"
    )
    edges.append(torch.tensor([-1.0, 0.0, 1.0]))
    grids = ActionGrids.from_edges(edges, settings, GRIPPER + 1)
    if published.grid is None:
        if published.decode_point == "cond_mean":
            raise ValueError("--decode_point=cond_mean needs --grid: the folder says edges, not Gaussians")
        return grids
    least = (min_sigma, PUBLISHED_MIN_SIGMA) if published.min_sigma is None else (published.min_sigma,)
    for sigma in least:
        given = ActionGrids.from_published(read_json(published.grid), sigma, published.decode_point, groups)
        if torch.allclose(given.edges, grids.edges, rtol=0, atol=EDGE_TOLERANCE):
            given.settings = settings
            return given
    raise ValueError(
        f"--grid={published.grid} with a least sigma of {' or '.join(map(str, least))} (--min_sigma) has "
        "other edges than the folder's bin_policy, which its weights were trained with; leave --grid out"
    )


def _config(
    published: Published,
    original: dict[str, Any],
    processor: dict[str, Any],
    statistics: str,
    grids: ActionGrids,
) -> Any:
    from transformers import SiglipVisionConfig

    text_config = {
        **original["text_config"],
        "model_type": "gemma2",
        "vocab_size": original["action_token_begin_idx"],
        "tie_word_embeddings": False,
    }
    vision_config = {
        **original["vision_config"],
        "model_type": "siglip_vision_model",
        "vision_use_head": False,
    }
    side: Any = SiglipVisionConfig(**vision_config).image_size
    image = f"{OBS_IMAGES}.{published.camera}"
    tokenizer, chunk_size = load_tokenizer(str(published.folder)), processor["action_chunk_size"]
    return PreTrainedConfig.get_choice_class("spatialvla_grid")(
        vlm_model_name=str(published.folder),
        vlm_config={
            "model_type": "paligemma",
            "image_token_index": original["image_token_index"],
            "projection_dim": original["projection_dim"],
            "hidden_size": original["hidden_size"],
            "tie_word_embeddings": False,
            "text_config": text_config,
            "vision_config": vision_config,
        },
        prompt_tokens=PaliGemmaPrompt.from_tokenizer(tokenizer, str(published.folder)).to_dict(),
        task_template=published.task_template,
        chunk_size=chunk_size,
        n_action_steps=chunk_size,
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.QUANTILES,
            "ACTION": NormalizationMode.QUANTILES,
        },
        **grids.settings.flags(),
        grid_params=grids.to_dict(),
        depth_source="zoedepth" if original["use_vision_zoe"] else "none",
        depth_config=original["vision_zoe_config"] if original["use_vision_zoe"] else None,
        camera_intrinsics=_intrinsics(processor["intrinsic_config"], statistics, published.camera, side),
        ego3d_patch_reso=original["ego3d_patch_reso"],
        ego3d_n_freqs=original["n_freqs"],
        ego3d_no_depth_vector=False,
        crop_fraction=1.0,
        input_features={image: PolicyFeature(FeatureType.VISUAL, (3, side, side))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (grids.num_dims,))},
        device="cpu",
    )


def _intrinsics(
    cameras: dict[str, Any], statistics: str, camera: str, side: int
) -> dict[str, list[list[float]]]:
    """Return the camera's intrinsics from the folder, for images of ``side``; {} for the default ones."""
    calibration = cameras.get(statistics) or cameras["default"]
    # the original counts from the image's edge, the flag from the first pixel's centre
    K = torch.tensor([calibration["intrinsic"]], dtype=torch.float32)
    K = resize_intrinsics(K, (calibration["height"], calibration["width"]), (side, side))
    if torch.allclose(K, default_intrinsics(side, side)):
        return {}
    K[:, :2, 2] -= 0.5
    return {camera: K[0].tolist()}


def _weights(folder: Path, original: dict[str, Any], ours: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the folder's tensors under our names, in float32; Ego3D's are ours if the folder has none.

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
    tensors[WORDS] = tensors[WORDS][:first]
    converted = dict(_renamed(tensors))
    converted |= {"backbone.vlm.lm_head.weight": head[:first], "cell_head.weight": head[first:end]}
    own = {} if original["use_vision_zoe"] else {n: t for n, t in ours.items() if n.startswith("ego3d.")}
    return own | {name: tensor.float().contiguous() for name, tensor in converted.items()}


def _renamed(tensors: dict[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
    """Yield tensors under the policy's names; an unknown one keeps its name, which strict loading reports."""
    for name, tensor in tensors.items():
        if not name.startswith(POOLING_HEAD):
            begins = next((begins for begins in RENAMED if name.startswith(begins)), "")
            yield RENAMED.get(begins, "") + name.removeprefix(begins), tensor
