"""``bomb_random``: the floor of the benchmark."""

import numpy as np

from lerobot_bomb.bomb.observation import action_bounds
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.scripted_policy import ScriptedPolicy
from lerobot_policy_bomb.bomb_random.configuration_bomb_random import BombRandomConfig


class BombRandomPolicy(ScriptedPolicy):
    """Draws every action uniformly from the action space."""

    config_class = BombRandomConfig
    name = "bomb_random"
    config: BombRandomConfig

    def act(self, state: PrivilegedState, step: int) -> np.ndarray:
        # seeded by step and state: episodes differ, and a row does not depend on the rest of its batch
        bits = state.gripper_xyz.astype(np.float32).view(np.uint32).tolist()
        rng = np.random.default_rng([self.config.seed, step, *bits])
        return rng.uniform(*action_bounds(state.control_mode))
