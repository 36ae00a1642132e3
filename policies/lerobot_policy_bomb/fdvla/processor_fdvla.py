"""Processors of ``fdvla``: LeRobot's default pipelines plus the tokenizer of the task."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from torch import Tensor

from lerobot_bomb.vlm.task_tokenizer import TaskTokenizerStep, make_task_processors
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.fdvla.configuration_fdvla import FdvlaConfig


def make_fdvla_pre_post_processors(
    config: FdvlaConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the processors: rename, batch, tokenize, device, normalise; and unnormalise, to CPU."""
    tokenizer_step = TaskTokenizerStep(load_tokenizer(config.vlm_model_name))
    return make_task_processors(config, dataset_stats, tokenizer_step)
