"""What every perturbation axis is: a transform of an episode, frozen once drawn."""

from typing import TYPE_CHECKING

import numpy as np

from lerobot_bomb.envs.perturbation import EpisodeTransform

if TYPE_CHECKING:
    from lerobot_env_bomb_pusht.board import Board


class PushTTransform(EpisodeTransform):
    """What one axis does to an episode of PushT."""

    def edit(self, board: "Board") -> None:
        """Change the board that gym-pusht has just set up, before block and agent are placed."""

    def arrange(self, state: np.ndarray) -> np.ndarray:
        """(5,) agent's x, y, block's x, y in pixels and angle in radians -> the same after the change."""
        return state
