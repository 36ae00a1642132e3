"""Perturbation axis `start`: where block and agent are at the start."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import MIDDLE_PX, PushTTransform


@dataclass(frozen=True)
class PushTStart(PushTTransform):
    """Block and agent start elsewhere, nearer to the middle in x and y: at a wall no T can be pushed."""

    agent_px: tuple[float, float]  # along x and y
    block_px: tuple[float, float]
    turn_rad: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        agent_rad, block_rad = rng.uniform(0, np.pi / 2, 2)
        agent_px, block_px = (pusht_magnitude("start", name, level) for name in ("agent", "block"))
        turn_rad = np.radians(pusht_magnitude("start", "turn", level)) * rng.choice((-1.0, 1.0))
        return cls(
            (float(agent_px * np.cos(agent_rad)), float(agent_px * np.sin(agent_rad))),
            (float(block_px * np.cos(block_rad)), float(block_px * np.sin(block_rad))),
            float(turn_rad),
        )

    def arrange(self, state: np.ndarray) -> np.ndarray:
        inwards = np.where(state[:4] < MIDDLE_PX, 1.0, -1.0)
        moved = state[:4] + inwards * np.array([*self.agent_px, *self.block_px])
        return np.append(moved, state[4] + self.turn_rad)
