"""``bomb_expert``: the scripted expert of the recorder behind LeRobot's policy interface."""

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from lerobot_bomb.expert import expert_action
from lerobot_bomb.schema import PrivilegedState
from lerobot_bomb.scripted import ScriptedPolicy
from lerobot_policy_bomb_expert.configuration_bomb_expert import BombExpertConfig


class BombExpertPolicy(ScriptedPolicy):
    """Acts on the simulator's true state, so it bounds what any policy can reach."""

    config_class = BombExpertConfig
    name = "bomb_expert"

    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Observation ``environment_state`` (B, PrivilegedState.DIM) -> (B, D) actions in env units."""
        if OBS_ENV_STATE not in batch:
            raise ValueError(
                f"--policy.type=bomb_expert needs the observation {OBS_ENV_STATE!r}, which only "
                f"--env.type=bomb gives; got {sorted(batch)}"
            )
        vectors = batch[OBS_ENV_STATE].cpu().numpy()
        states = map(PrivilegedState.from_vector, vectors)
        actions = [expert_action(state, self.config.control_mode, self.config.fps) for state in states]
        return torch.from_numpy(np.stack(actions))
