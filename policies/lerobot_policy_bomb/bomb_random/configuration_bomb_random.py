"""Config of ``bomb_random``."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.bomb.scripted_policy import ScriptedConfig


@PreTrainedConfig.register_subclass("bomb_random")
@dataclass
class BombRandomConfig(ScriptedConfig):
    """Uniformly random actions."""

    # the same seed gives the same actions, whatever the batch size
    seed: int = 0
