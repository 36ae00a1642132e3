"""Small SpatialVLA folders, as the original's ``save_pretrained`` writes them under transformers 4.47."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import interpolate
from transformers import ZoeDepthConfig
from zoedepth_cases import CONFIG

from lerobot_bomb.actions.grid_settings import ActionGroup
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.commands.main import main
from lerobot_bomb.vlm.tokenizer import nano_tokenizer
from lerobot_policy_bomb.spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

CAMERA = "observation.images.image"
TASK = "What action should the robot take to pick the cup?"  # the original's prompt has it in lower case
SIDE = 224  # pixels: a default, so config.json does not say it
VISION = {
    "hidden_size": 48,
    "intermediate_size": 96,
    "num_hidden_layers": 2,
    "image_size": SIDE,
    "patch_size": 14,
}
NAMES = {
    "backbone.vlm.model.vision_tower.": "vision_tower.",
    "backbone.vlm.model.multi_modal_projector.": "multi_modal_projector.",
    "backbone.vlm.model.language_model.": "language_model.model.",
    "backbone.vlm.lm_head.": "language_model.lm_head.",
    "ego3d.layers.": "position_embedding_3d.position_embedding_head.",
    "zoedepth.model.": "vision_zoe_model.",
    "cell_embedding.": "spatial_embed_tokens.",
}
BINS = (("theta", "phi", "r"), ("roll", "pitch", "yaw"))
DATA_SET = "bridge_orig/1.0.0"
ASSUMED = {
    "intrinsic": [[623.588, 0, 319.501], [0, 623.588, 239.545], [0, 0, 1]],
    "height": 480,
    "width": 640,
}
ACTION = {
    "q01": [-0.02, -0.04, -0.05, -0.1, -0.1, -0.2, 0.0],
    "q99": [0.03, 0.05, 0.06, 0.1, 0.2, 0.2, 1.0],
    "mask": [True] * 6 + [False],
}
TEXT_KEYS = """head_dim hidden_size intermediate_size model_type num_attention_heads num_hidden_layers
num_key_value_heads query_pre_attn_scalar"""
VISION_KEYS = """hidden_size intermediate_size model_type num_attention_heads num_hidden_layers patch_size
vision_use_head"""
# what every config of transformers 4.47 has; of ZoeDepth and its backbone all of it is written
NULL = """architectures bad_words_ids begin_suppress_tokens bos_token_id cross_attention_hidden_size
decoder_start_token_id eos_token_id exponential_decay_length_penalty finetuning_task forced_bos_token_id
forced_eos_token_id pad_token_id prefix problem_type sep_token_id suppress_tokens task_specific_params
tokenizer_class torch_dtype"""
FALSE = """_attn_implementation_autoset add_cross_attention do_sample early_stopping is_decoder
is_encoder_decoder output_attentions output_hidden_states output_scores remove_invalid_values
return_dict_in_generate tf_legacy_loss tie_encoder_decoder torchscript use_bfloat16"""
ZERO = "chunk_size_feed_forward encoder_no_repeat_ngram_size min_length no_repeat_ngram_size"
ONE = "num_beam_groups num_beams num_return_sequences"
FLOAT_ONE = "length_penalty repetition_penalty temperature top_p typical_p"
EVERY_CONFIG: dict[str, Any] = {
    **dict.fromkeys(NULL.split()),
    **dict.fromkeys(FALSE.split(), False),
    **dict.fromkeys(ZERO.split(), 0),
    **dict.fromkeys(ONE.split(), 1),
    **dict.fromkeys(FLOAT_ONE.split(), 1.0),
    "_name_or_path": "",
    "diversity_penalty": 0.0,
    "id2label": {"0": "LABEL_0", "1": "LABEL_1"},
    "label2id": {"LABEL_0": 0, "LABEL_1": 1},
    "max_length": 20,
    "pruned_heads": {},
    "return_dict": True,
    "tie_word_embeddings": True,
    "top_k": 50,
}
OF_ZOEDEPTH = {
    "backbone": None,
    "backbone_hidden_size": CONFIG["backbone_config"]["hidden_size"],
    "use_pretrained_backbone": False,
}


def gaussians(seed: int) -> dict[str, dict[str, float]]:
    """Draw Gaussians as a gs_*.json has them."""
    spread = torch.rand(6, 2, generator=torch.Generator().manual_seed(seed)).tolist()
    centers = {"theta": 1.8, "phi": 0.1, "r": 0.6}
    return {
        name: {"mu": centers.get(name, 0.0) + 0.2 * mu, "sigma": 0.3 + 0.4 * sigma}
        for name, (mu, sigma) in zip(sum(BINS, ()), spread, strict=True)
    }


def make_original(
    seed: int, min_sigma: float = 0.0, groups: tuple[ActionGroup, ...] | None = None, **options: Any
) -> SpatialvlaGridPolicy:
    """A policy that acts as the original does with the weights that `write_published` writes of it."""
    grids = ActionGrids.from_published(gaussians(seed), min_sigma, "mid", groups)
    text = {"num_hidden_layers": 2}
    torch.manual_seed(seed)
    config = SpatialvlaGridConfig(
        vlm_model_name="nano",
        nano_config={"vision_config": VISION, "text_config": text},
        device="cpu",
        **{
            "depth_source": "zoedepth",
            "depth_config": json.loads(ZoeDepthConfig(**CONFIG).to_json_string(use_diff=False)),
            "ego3d_zero_init": False,
            "ego3d_no_depth_vector": False,
            "crop_fraction": 1.0,
            **grids.settings.flags(),
            "grid_params": grids.to_dict(),
            "input_features": {CAMERA: PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))},
            "output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))},
            **options,
        },
    )
    policy = SpatialvlaGridPolicy(config).eval()
    # positions, and the cells before, must change what is chosen
    parts: Any = (policy.ego3d.layers[0], policy.ego3d.layers[3], policy.cell_embedding, policy.cell_head)
    for part in parts:
        torch.nn.init.normal_(part.weight, std=0.3)
    return policy


def published_tensors(policy: SpatialvlaGridPolicy) -> dict[str, Tensor]:
    """Return the tensors by the original's names; its words' table has unused rows for the cells."""
    tensors = {}
    for name, tensor in policy.state_dict().items():
        ours = next((each for each in NAMES if name.startswith(each)), None)
        if ours is not None:
            tensors[NAMES[ours] + name.removeprefix(ours)] = tensor.clone()
    words, head = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"
    tensors[words] = torch.cat([tensors[words], torch.zeros_like(policy.cell_head.weight)])
    tensors[head] = torch.cat([tensors[head], policy.cell_head.weight.detach()])
    return tensors


def write_published(
    policy: SpatialvlaGridPolicy, folder: Path, statistics: Mapping[str, Any] | None = None, **processor: Any
) -> Path:
    """The folder; ``processor``: other values of its processor_config.json."""
    folder.mkdir()
    save_file(published_tensors(policy), folder / "model.safetensors")
    nano_tokenizer().save(str(folder / "tokenizer.json"))
    (folder / "config.json").write_text(json.dumps(published_config(policy)))
    edges = {
        kind: {
            f"{name}_bins": axis_edges.tolist()
            for name, axis_edges in zip(BINS[group], policy.grids.group_edges(group), strict=True)
        }
        for group, kind in enumerate(("translation", "rotation"))
    }
    counts = {
        kind: {name: len(axis_edges) - 1 for name, axis_edges in each.items()} for kind, each in edges.items()
    }
    content = {
        "action_chunk_size": policy.config.chunk_size,
        "action_config": {
            "num_bins": {**counts, "gripper": 2, "total": policy.grids.num_tokens},
            "distribution": "gaussian",
            "use_spherical": True,
        },
        "bin_policy": edges,
        "intrinsic_config": {DATA_SET: ASSUMED, "default": ASSUMED},
        "min_sigma": 0.0,
        "num_obs_steps": 1,
        "obs_delta": 1,
        "processor_class": "SpatialVLAProcessor",
        "statistics": statistics or {DATA_SET: {"action": ACTION}},
    }
    (folder / "processor_config.json").write_text(json.dumps(content | processor))
    return folder


def published_config(policy: SpatialvlaGridPolicy) -> dict[str, Any]:
    """Values of sub-configs that equal their classes' defaults are left out, but ZoeDepth's."""
    vlm, num_cells = policy.config.vlm_config, policy.grids.num_tokens
    assert vlm is not None
    text, vision = vlm["text_config"], vlm["vision_config"]
    num_words, num_image_tokens = text["vocab_size"], policy.backbone.tokens_per_image
    zoedepth = policy.config.depth_config
    return {
        "_vocab_size": num_words + num_cells,
        "action_token_begin_idx": num_words,
        "architectures": ["SpatialVLAForConditionalGeneration"],
        "ego3d_patch_reso": policy.config.ego3d_patch_reso,
        "hidden_size": vlm["hidden_size"],
        "image_token_index": vlm["image_token_index"],
        "model_type": "spatialvla",
        "n_freqs": policy.config.ego3d_n_freqs,
        "pad_token_id": 0,
        "projection_dim": vlm["projection_dim"],
        "spatial_token_num": num_cells,
        "text_config": {
            "_attn_implementation_autoset": True,
            **{key: text[key] for key in TEXT_KEYS.split()},
            "num_image_tokens": num_image_tokens,
            "tie_word_embeddings": False,
            "torch_dtype": "bfloat16",
            "vocab_size": num_words + num_cells,
        },
        "torch_dtype": "float32",
        "transformers_version": "4.47.0",
        "use_spatial_token": True,
        "use_vision_zoe": zoedepth is not None,
        "vision_config": {
            **{key: vision[key] for key in VISION_KEYS.split()},
            "num_image_tokens": num_image_tokens,
            "projection_dim": vlm["projection_dim"],
            "torch_dtype": "bfloat16",
        },
        **({} if zoedepth is None else {"vision_zoe_config": OF_ZOEDEPTH | _whole(zoedepth)}),
    }


def _whole(config: Mapping[str, Any]) -> dict[str, Any]:
    """Complete a config as transformers 4.47 writes it."""
    later = ("dtype", "transformers_version")
    values = {key: value for key, value in config.items() if key not in later}
    if "backbone_config" in values:
        values["backbone_config"] = _whole(values["backbone_config"])
    return EVERY_CONFIG | values


# Converting and loading


def convert(folder: Path, output: Path, **options: object) -> int:
    flags = [f"--{name}={value}" for name, value in options.items()]
    return main(["checkpoint", "convert-spatialvla", str(folder), f"--output={output}", *flags])


def converted(folder: Path, output: Path, **options: object) -> Path:
    assert convert(folder, output, **options) == 0
    return output


def load(checkpoint: Path, **flags: object) -> tuple[SpatialvlaGridPolicy, Any, Any]:
    """Policy and processors, as LeRobot's commands load them."""
    overrides = [f"--{name}={value}" for name, value in flags.items()]
    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=overrides)
    policy: Any = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    return policy, *make_pre_post_processors(config, str(checkpoint))


def observations(num: int, seed: int = 0) -> dict[str, Any]:
    blots = torch.rand(num, 3, 7, 7, generator=torch.Generator().manual_seed(seed))
    images = interpolate(blots, (224, 224), mode="bilinear")
    return {CAMERA: images, "task": [TASK] * num}


def cells_of(policy: SpatialvlaGridPolicy, batch: dict[str, Any]) -> Tensor:
    """(B, 12), as the original numbers them."""
    cells_BTG = policy.choose(batch, policy.config.chunk_size)
    return (cells_BTG + torch.tensor(policy.grids.offsets)).flatten(1)
