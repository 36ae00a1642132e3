"""Perturbation axis `goal_marker`: the target's outline, as a help."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import Board, PushTTransform


@dataclass(frozen=True)
class GoalOutline(PushTTransform):
    """A red line around the target, over block and agent."""

    width_px: int

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        return cls(int(pusht_magnitude("goal_marker", "width", level)))

    def edit(self, board: Board) -> None:
        board.outline_px = self.width_px
