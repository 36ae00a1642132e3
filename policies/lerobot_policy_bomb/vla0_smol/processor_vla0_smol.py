"""Processors of ``vla0_smol``: LeRobot's default pipelines plus the tokenizer of the task."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from torch import Tensor

from lerobot_bomb.vlm.prompt import TASK_TEMPLATE
from lerobot_bomb.vlm.task_tokenizer import TaskTokenizerStep, make_task_processors
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol.configuration_vla0_smol import Vla0SmolConfig


def make_vla0_smol_pre_post_processors(
    config: Vla0SmolConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the processors: rename, batch, tokenize, device, normalise; and unnormalise, to CPU."""
    tokenizer_step = TaskTokenizerStep(load_tokenizer(config.vlm_model_name), TASK_TEMPLATE)
    return make_task_processors(config, dataset_stats, tokenizer_step)
