"""Policies of random weights for the speed benchmarks: their features, and random observations."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors

CAMERAS = "observation.images.workspace", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"
INSTRUCTIONS = "put the black stone on the center", "go", "push the white stone to the left edge"


def features(num_dims: int, image_size: int, *, has_state: bool = True) -> dict[str, Any]:
    """Return config fields of a policy with two cameras and `num_dims` state and action dimensions."""
    inputs = dict.fromkeys(CAMERAS, PolicyFeature(FeatureType.VISUAL, (3, image_size, image_size)))
    state = {STATE: PolicyFeature(FeatureType.STATE, (num_dims,))} if has_state else {}
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (num_dims,))}
    return {"input_features": inputs | state, "output_features": outputs}


def make_batches(policy: Any, batch_size: int, num_batches: int) -> list[dict[str, Any]]:
    """Return preprocessed random observations with instructions of different lengths."""
    num_dims = policy.config.output_features[ACTION].shape[0]
    ends = {"min": -1.0, "max": 1.0, "mean": 0.0, "std": 1.0}
    stats = {name: torch.full((num_dims,), value) for name, value in ends.items()}
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats={STATE: stats, ACTION: stats})
    generator = torch.Generator().manual_seed(0)
    shapes = {key: feature.shape for key, feature in policy.config.input_features.items()}
    return [
        preprocessor(
            {key: torch.rand(batch_size, *shape, generator=generator) for key, shape in shapes.items()}
            | {"task": [INSTRUCTIONS[(first + row) % len(INSTRUCTIONS)] for row in range(batch_size)]}
        )
        for first in range(num_batches)
    ]
