"""Perturbation axis `object`: shade of the block."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import pygame

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import Board, PushTTransform

BLOCK_RGB = np.array(pygame.Color("LightSlateGray")[:3])
# Darker than any board, and none like the agent's blue or the target's green
SHADE_RGB = ((60, 50, 50), (150, 60, 50), (170, 105, 30), (125, 60, 140), (110, 85, 55))


@dataclass(frozen=True)
class BlockShade(PushTTransform):
    """Another colour of the block."""

    rgb: tuple[int, int, int]

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        share = pusht_magnitude("object", "shade", level)
        rgb = (1 - share) * BLOCK_RGB + share * np.array(SHADE_RGB[rng.integers(len(SHADE_RGB))])
        return cls(tuple(np.rint(rgb).astype(int).tolist()))

    def edit(self, board: Board) -> None:
        for shape in board.block.shapes:
            shape.color = pygame.Color(*self.rgb)
