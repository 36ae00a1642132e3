"""Processors of ``every_tenth``: LeRobot's default pipelines."""

from typing import Any

from lerobot.processor import make_default_pre_post_processors

from every_tenth.configuration_every_tenth import EveryTenthConfig


def make_every_tenth_pre_post_processors(
    config: EveryTenthConfig, dataset_stats: dict[str, Any] | None = None
) -> Any:
    """(preprocessor, postprocessor)."""
    return make_default_pre_post_processors(config, dataset_stats)
