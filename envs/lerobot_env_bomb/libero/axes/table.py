"""Perturbation axis `table`: colour and pattern of table and floor."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import LiberoScene, LiberoTransform

SURFACE_RGB = (
    (158, 76, 66),
    (168, 128, 62),
    (112, 142, 66),
    (56, 128, 122),
    (72, 92, 158),
    (128, 82, 148),
    (148, 112, 102),
)
PATTERNS = ("stripes", "checks", "speckles")
TILES = 16  # of a pattern along a texture; stripes and checks are half as wide
SPECKLE_SHARE = 0.3


@dataclass(frozen=True)
class SurfaceLook(LiberoTransform):
    """Colour of table and floor, and a pattern on them."""

    table_rgb: tuple[int, int, int]
    floor_rgb: tuple[int, int, int]
    pattern: str
    color_share: float
    contrast: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        table, floor = rng.choice(len(SURFACE_RGB), 2, replace=False)
        return cls(
            table_rgb=SURFACE_RGB[table],
            floor_rgb=SURFACE_RGB[floor],
            pattern=PATTERNS[rng.integers(len(PATTERNS))],
            color_share=libero_magnitude("table", "color", level),
            contrast=libero_magnitude("table", "pattern", level),
        )

    def edit(self, scene: LiberoScene) -> None:
        for texture, material in scene.surfaces().items():
            rgb = self.floor_rgb if "floor" in material else self.table_rgb
            scene.change_texture(texture, partial(self._changed, rgb=rgb))

    def _changed(self, pixels: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
        """(H, W, 3) uint8 -> (H, W, 3) uint8, with colour and pattern."""
        dark = 1 - self.contrast * _pattern(self.pattern, *pixels.shape[:2])[..., None]
        mixed = (1 - self.color_share) * pixels.astype(np.float32) + self.color_share * np.array(
            rgb, np.float32
        )
        return np.rint(mixed * dark).astype(np.uint8)


def _pattern(pattern: str, height: int, width: int) -> np.ndarray:
    """(H, W) float32, 1 where it is dark."""
    side = min(height, width)  # a cube's six faces stand one below the other
    y, x = np.indices((height, width), sparse=True)
    tile = max(2, side // TILES)
    if pattern == "speckles":
        cells = np.random.default_rng(0).random((TILES * 4, TILES * 4)) < SPECKLE_SHARE
        cell = max(1, side // cells.shape[0])
        return cells[(y // cell) % len(cells), (x // cell) % len(cells)].astype(np.float32)
    if pattern == "checks":
        return ((x % tile < tile // 2) ^ (y % tile < tile // 2)).astype(np.float32)
    return ((x + y) % tile < tile // 2).astype(np.float32)
