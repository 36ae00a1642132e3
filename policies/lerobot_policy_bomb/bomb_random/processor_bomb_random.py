"""Processors of ``bomb_random``: LeRobot's default pipelines, which leave the values as they are."""

from typing import Any

from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lerobot_policy_bomb.bomb_random.configuration_bomb_random import BombRandomConfig


def make_bomb_random_pre_post_processors(
    config: BombRandomConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return (preprocessor, postprocessor); actions stay in the environment's units."""
    return make_default_pre_post_processors(config, dataset_stats)
