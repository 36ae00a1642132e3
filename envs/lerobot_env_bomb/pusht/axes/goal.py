"""Perturbation axis `goal`: the target lies elsewhere, and the instruction says where."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import Board, PushTTransform


@dataclass(frozen=True)
class GoalPose(PushTTransform):
    """Shift and turn of the target, whole numbers, so that words name them exactly."""

    right_px: int
    down_px: int
    clockwise_deg: int

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        direction_rad = rng.uniform(-np.pi, np.pi)
        shift_px = pusht_magnitude("goal", "shift", level)
        turn_deg = pusht_magnitude("goal", "turn", level) * rng.choice((-1, 1))
        right_px, down_px = shift_px * np.cos(direction_rad), shift_px * np.sin(direction_rad)
        return cls(round(float(right_px)), round(float(down_px)), round(float(turn_deg)))

    def edit(self, board: Board) -> None:
        # y points down in the image, so a positive angle turns clockwise
        board.goal_pose += self.right_px, self.down_px, np.radians(self.clockwise_deg)

    def reword(self, instruction: str, nominal: Any) -> str:
        across = f"{abs(self.right_px)} pixels {'left' if self.right_px < 0 else 'right'} of"
        along = f"{abs(self.down_px)} pixels {'above' if self.down_px < 0 else 'below'}"
        turn = f"{abs(self.clockwise_deg)} degrees {'anti' * (self.clockwise_deg < 0)}clockwise"
        where = f" that lies {across} and {along} its usual place and is turned {turn}"
        return instruction.replace("{where}", where)
