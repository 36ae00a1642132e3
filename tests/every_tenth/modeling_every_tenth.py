"""``every_tenth``: what is planted in it is the error."""

import os

import numpy as np

from every_tenth.configuration_every_tenth import EveryTenthConfig
from lerobot_bomb.bomb.observation import ACTION_DIM
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.scripted_policy import ScriptedPolicy

MENDED = "EVERY_TENTH_IS_MENDED"  # environment variable


class EveryTenthPolicy(ScriptedPolicy):
    """Raises in the first step of every tenth episode, or batch, unless it is mended."""

    config_class = EveryTenthConfig
    name = "every_tenth"
    config: EveryTenthConfig

    def __init__(self, config: EveryTenthConfig, **options: object) -> None:
        super().__init__(config, **options)
        self._num_episodes = 0

    def reset(self) -> None:
        super().reset()
        self._num_episodes = getattr(self, "_num_episodes", 0) + 1

    def act(self, state: PrivilegedState, step: int) -> np.ndarray:
        if self._num_episodes % 10 == 0 and MENDED not in os.environ:
            raise ArithmeticError("planted in the tenth episode")
        return np.zeros(ACTION_DIM)
