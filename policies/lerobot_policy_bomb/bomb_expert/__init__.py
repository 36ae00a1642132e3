"""The scripted expert as a policy: the ceiling of the benchmark."""

from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig
from lerobot_policy_bomb.bomb_expert.processor_bomb_expert import make_bomb_expert_pre_post_processors

__all__ = ["BombExpertConfig", "make_bomb_expert_pre_post_processors"]
