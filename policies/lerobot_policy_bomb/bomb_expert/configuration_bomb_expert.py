"""Config of ``bomb_expert``."""

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.bomb.scripted_policy import ScriptedConfig
from lerobot_bomb.libero.episode import ACTION_DIM


@PreTrainedConfig.register_subclass("bomb_expert")
@dataclass
class BombExpertConfig(ScriptedConfig):
    """The expert has no settings of its own."""

    env_types: ClassVar = ScriptedConfig.env_types | {"bomb_libero": {ACTION_DIM}}
