"""Processors of ``bomb_expert``: LeRobot's default pipelines, which leave the values as they are."""

from typing import Any

from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig


def make_bomb_expert_pre_post_processors(
    config: BombExpertConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return (preprocessor, postprocessor); actions stay in the environment's units."""
    return make_default_pre_post_processors(config, dataset_stats)
