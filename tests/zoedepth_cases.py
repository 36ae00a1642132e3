"""A tiny ZoeDepth with random weights, whose depth varies."""

from typing import Any

import torch
from transformers import ZoeDepthConfig, ZoeDepthForDepthEstimation

BACKBONE: dict[str, Any] = {
    "model_type": "beit",
    "hidden_size": 16,
    "num_hidden_layers": 4,
    "num_attention_heads": 2,
    "intermediate_size": 16,
    "image_size": 384,
    "patch_size": 32,
    "drop_path_rate": 0.9,
    "layer_scale_init_value": 1.0,
    "initializer_range": 0.3,
    "reshape_hidden_states": False,
    "use_relative_position_bias": True,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}
CONFIG: dict[str, Any] = {
    "initializer_range": 0.1,
    "backbone_config": BACKBONE,
    "neck_hidden_sizes": [8, 8, 8, 8],
    "fusion_hidden_size": 8,
    "bottleneck_features": 8,
    "num_relative_features": 8,
    "bin_embedding_dim": 8,
    "num_attractors": [4, 2, 1, 1],
    "bin_configurations": [{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0}],
}


def make_zoedepth(seed: int = 0) -> ZoeDepthForDepthEstimation:
    torch.manual_seed(seed)
    return ZoeDepthForDepthEstimation(ZoeDepthConfig(**CONFIG))
