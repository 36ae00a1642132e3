"""Small `spatialvla_grid` policies and batches for them."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor
from variants import layers_of

from lerobot_policy_bomb.spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"
SIZE = 64
TASKS = ("put the black stone on the center", "go", "push the white stone to the left edge")


def make_config(num_dims: int = 4, *, has_depth: bool = True, **options: Any) -> SpatialvlaGridConfig:
    visual, state = PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)), PolicyFeature(FeatureType.STATE, (4,))
    shapes = {"depth": (SIZE, SIZE), "intrinsics": (3, 3)} if has_depth else {}
    geometry = {
        f"observation.{kind}.{camera}": PolicyFeature(FeatureType.STATE, shape)
        for kind, shape in shapes.items()
        for camera in ("workspace", "wrist")
    }
    layout: dict[str, Any] = {"action_layout": "pose"} if num_dims == 7 else {}
    return SpatialvlaGridConfig(
        vlm_model_name="nano",
        device="cpu",
        input_features={WORKSPACE: visual, WRIST: visual, "observation.state": state, **geometry},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (num_dims,))},
        **(layers_of(options) | layout | options),
    )


def make_policy(seed: int = 0, num_dims: int = 4, **options: Any) -> SpatialvlaGridPolicy:
    torch.manual_seed(seed)
    return SpatialvlaGridPolicy(make_config(num_dims, **options)).eval()


def stats(num_dims: int = 4) -> dict[str, dict[str, Tensor]]:
    return {
        key: {"min": -torch.ones(size), "max": torch.ones(size)}
        for key, size in (("observation.state", 4), ("action", num_dims))
    }


def make_batch(policy: SpatialvlaGridPolicy, batch_size: int, seed: int = 0) -> dict[str, Any]:
    """Preprocessed, the instructions of different lengths."""
    generator = torch.Generator().manual_seed(seed)
    num_dims = policy.grids.num_dims
    shape = batch_size, policy.config.chunk_size, num_dims
    raw = {
        WORKSPACE: torch.rand(batch_size, 3, SIZE, SIZE, generator=generator),
        WRIST: torch.rand(batch_size, 3, SIZE, SIZE, generator=generator),
        "observation.state": 2 * torch.rand(batch_size, 4, generator=generator) - 1,
        "action": 2 * torch.rand(shape, generator=generator) - 1,
        "task": [TASKS[row % len(TASKS)] for row in range(batch_size)],
    }
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=stats(num_dims))
    return preprocessor(raw)


def rows(batch: dict[str, Any], which: slice) -> dict[str, Any]:
    return {key: value[which] if isinstance(value, Tensor | list) else value for key, value in batch.items()}
