"""Uniformly random actions as a policy: the floor of the benchmark."""

from lerobot_policy_bomb.bomb_random.configuration_bomb_random import BombRandomConfig
from lerobot_policy_bomb.bomb_random.processor_bomb_random import make_bomb_random_pre_post_processors

__all__ = ["BombRandomConfig", "make_bomb_random_pre_post_processors"]
