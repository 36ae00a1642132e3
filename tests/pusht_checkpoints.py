"""Checkpoints of LeRobot's ACT, small and untrained, with what a training on PushT would leave in them."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_bomb.checkpoints.folder import write_checkpoint


def write_act(
    folder: Path,
    image_size: int = 96,
    num_states: int = 2,
    low: tuple[float, float] = (12.0, 25.0),
    high: tuple[float, float] = (511.0, 511.0),
) -> Path:
    """A checkpoint whose demonstrations had images of this size and actions from `low` to `high`."""
    config: Any = make_policy_config(
        "act", dim_model=8, n_heads=1, dim_feedforward=8, n_encoder_layers=1, use_vae=False,
        pretrained_backbone_weights=None, chunk_size=4, n_action_steps=2, device="cpu",
    )  # fmt: skip
    config.input_features = {
        OBS_IMAGE: PolicyFeature(FeatureType.VISUAL, (3, image_size, image_size)),
        OBS_STATE: PolicyFeature(FeatureType.STATE, (num_states,)),
    }
    config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (2,))}
    torch.manual_seed(0)
    policy: Any = get_policy_class("act")(config)
    lowest, highest = torch.tensor(low), torch.tensor(high)
    board = torch.full((num_states,), 512.0)
    stats = {
        ACTION: {
            "min": lowest,
            "max": highest,
            "mean": (lowest + highest) / 2,
            "std": (highest - lowest) / 4,
        },
        OBS_STATE: {"min": 0 * board, "max": board, "mean": board / 2, "std": board / 4},
        OBS_IMAGE: {name: torch.full((3, 1, 1), 0.5) for name in ("min", "max", "mean", "std")},
    }
    write_checkpoint(folder, policy, make_pre_post_processors(config, dataset_stats=stats))
    return folder
