"""Small `fdvla` policies and batches for them."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor
from variants import layers_of

from lerobot_policy_bomb.fdvla import FdvlaConfig
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"
SIZE, STATE_DIMS = 64, 4
TASKS = ("put the black stone on the center", "go", "push the white stone to the left edge")
FLOW_ONLY: dict[str, Any] = {"use_denoise_head": False}
DENOISE_ONLY: dict[str, Any] = {"use_flow_head": False}
SMALL: dict[str, Any] = {
    "vlm_model_name": "nano",
    "device": "cpu",
    "dtype": "float32",
    "image_size": 56,
    "chunk_size": 4,
    "n_action_steps": 2,
    "num_inference_steps": 3,
    "draws_per_chunk": 4,
    "head_dim": 32,
    "dualmod_dim": 16,
}


def make_config(
    num_dims: int = 4, cameras: tuple[str, ...] = (WORKSPACE, WRIST), has_state: bool = True, **options: Any
) -> FdvlaConfig:
    inputs = {key: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)) for key in cameras}
    if has_state:
        inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (STATE_DIMS,))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (num_dims,))}
    chosen = SMALL | layers_of(options) | options
    return FdvlaConfig(input_features=inputs, output_features=outputs, **chosen)


def make_policy(seed: int = 0, num_dims: int = 4, **options: Any) -> FdvlaPolicy:
    torch.manual_seed(seed)
    return FdvlaPolicy(make_config(num_dims, **options)).eval()


def stats(num_dims: int = 4) -> dict[str, dict[str, Tensor]]:
    """Literal ones: state and action stay as they are."""
    sizes = (("observation.state", STATE_DIMS), ("action", num_dims))
    return {key: {"mean": torch.zeros(size), "std": torch.ones(size)} for key, size in sizes}


def make_batch(
    policy: FdvlaPolicy, batch_size: int, seed: int = 0, tasks: tuple[str, ...] = TASKS
) -> dict[str, Any]:
    """Preprocessed, the instructions of different lengths."""
    generator = torch.Generator().manual_seed(seed)
    num_dims = policy.action_dim
    shape = batch_size, policy.config.chunk_size, num_dims
    raw: dict[str, Any] = {
        "observation.state": torch.randn(batch_size, STATE_DIMS, generator=generator),
        "action": torch.randn(shape, generator=generator),
        "action_is_pad": torch.zeros(shape[:2], dtype=torch.bool),
        "task": [tasks[row % len(tasks)] for row in range(batch_size)],
    }
    for key in policy._cameras:
        raw[key] = torch.rand(batch_size, 3, SIZE, SIZE, generator=generator)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=stats(num_dims))
    return preprocessor(raw)


def rows(batch: dict[str, Any], which: slice | list[int]) -> dict[str, Any]:
    """Take some of a batch's rows."""
    index = list(range(len(batch["task"])))[which] if isinstance(which, slice) else which
    return {
        key: value[index] if isinstance(value, Tensor) else [value[i] for i in index]
        for key, value in batch.items()
        if isinstance(value, Tensor | list)
    }
