"""Config of ``every_tenth``."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.bomb.scripted_policy import ScriptedConfig


@PreTrainedConfig.register_subclass("every_tenth")
@dataclass
class EveryTenthConfig(ScriptedConfig):
    """The arm stays where it is."""
