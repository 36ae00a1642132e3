"""Config of ``bomb_expert``."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.bomb.scripted_policy import ScriptedConfig


@PreTrainedConfig.register_subclass("bomb_expert")
@dataclass
class BombExpertConfig(ScriptedConfig):
    """The expert has no settings of its own."""
