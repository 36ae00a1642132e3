"""Perturbation axis `table`: colour and pattern of the board."""

from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
import pygame

from lerobot_bomb.pusht.episode import BOARD_PX
from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import Board, PushTTransform

# None like the target's light green, the block's slate grey or the agent's blue
BOARD_RGB = (
    (246, 214, 178),
    (240, 196, 196),
    (222, 200, 236),
    (250, 236, 160),
    (214, 206, 196),
    (204, 224, 246),
)
PATTERNS = ("stripes", "checks", "speckles")
TILE_PX = 32  # of a pattern; stripes and checks are half as wide
SPECKLE_PX = 8
SPECKLE_SHARE = 0.3


@dataclass(frozen=True)
class BoardLook(PushTTransform):
    """Colour of the board and of a pattern on it."""

    rgb: tuple[int, int, int]
    dark_rgb: tuple[int, int, int]
    pattern: str

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        share = pusht_magnitude("table", "color", level)
        rgb = 255 + share * (np.array(BOARD_RGB[rng.integers(len(BOARD_RGB))]) - 255)
        dark = (1 - pusht_magnitude("table", "pattern", level)) * rgb
        return cls(
            tuple(np.rint(rgb).astype(int).tolist()),
            tuple(np.rint(dark).astype(int).tolist()),
            PATTERNS[rng.integers(len(PATTERNS))],
        )

    def edit(self, board: Board) -> None:
        board.background = self.draw_background

    def draw_background(self, screen: pygame.Surface) -> None:
        """Draw board and pattern over the whole screen."""
        pattern = pattern_surface(self.pattern)
        pattern.set_palette([self.rgb, self.dark_rgb])
        screen.blit(pattern, (0, 0))


@cache
def pattern_surface(pattern: str) -> pygame.Surface:
    """Draw the pattern in the board's size, with a palette of two colours, the second for the pattern."""
    x, y = np.indices((BOARD_PX, BOARD_PX))
    if pattern == "speckles":
        small = np.random.default_rng(0).random((BOARD_PX // SPECKLE_PX,) * 2) < SPECKLE_SHARE
        is_dark = small.repeat(SPECKLE_PX, 0).repeat(SPECKLE_PX, 1)
    else:
        is_dark = (x + y) % TILE_PX < TILE_PX // 2
        if pattern == "checks":
            is_dark = (x % TILE_PX < TILE_PX // 2) ^ (y % TILE_PX < TILE_PX // 2)
    surface = pygame.Surface((BOARD_PX, BOARD_PX), depth=8)
    pygame.surfarray.blit_array(surface, is_dark.astype(np.uint8))
    return surface
