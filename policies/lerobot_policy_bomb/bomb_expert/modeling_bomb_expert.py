"""``bomb_expert``: the scripted expert of the recorder behind LeRobot's policy interface."""

import numpy as np

from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.scripted_policy import ScriptedPolicy
from lerobot_bomb.libero.expert import LiberoState, libero_expert_action
from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig


class BombExpertPolicy(ScriptedPolicy):
    """Acts on the simulator's true state, so it bounds what any policy can reach."""

    config_class = BombExpertConfig
    name = "bomb_expert"

    def act(self, state: PrivilegedState, step: int) -> np.ndarray:
        return expert_action(state)

    def _act(self, vector: np.ndarray) -> np.ndarray:
        if len(vector) == LiberoState.DIM:
            return libero_expert_action(LiberoState.from_vector(vector))
        return super()._act(vector)
