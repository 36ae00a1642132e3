"""Perturbation axis `reflectance`: gloss of objects, table and floor."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import LiberoScene, LiberoTransform

LAMPS = 3  # per row, and as many rows, on a texture
LAMP_RADIUS = 0.28  # of the distance between two


@dataclass(frozen=True)
class LiberoGloss(LiberoTransform):
    """Gloss of objects, and lamps' reflections drawn on table and floor; the renderer's own are weak."""

    glare: float
    gloss: float
    offset: tuple[float, float]  # of the lamps, in distances between two

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        x, y = rng.random(2).tolist()
        glare, gloss = (libero_magnitude("reflectance", name, level) for name in ("glare", "gloss"))
        return cls(glare, gloss, (x, y))

    def edit(self, scene: LiberoScene) -> None:
        for texture in scene.surfaces():
            scene.change_texture(texture, self._lit)
        model = scene.model
        materials = np.unique(model.geom_matid[scene.geoms_of(list(scene.movable.values()))])
        materials = materials[materials >= 0]
        for part in (model.mat_specular, model.mat_shininess):
            part[materials] += self.gloss * (1 - part[materials])

    def _lit(self, pixels: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 -> (H, W, 3) uint8, with soft discs of light."""
        height, width = pixels.shape[:2]
        side = min(height, width) / LAMPS  # a cube's six faces stand one below the other
        x, y = (
            (np.arange(count, dtype=np.float32) / side + offset) % 1 - 0.5
            for count, offset in zip((width, height), self.offset, strict=True)
        )
        light = np.exp(-(x**2 + y[:, None] ** 2) / (2 * (LAMP_RADIUS / 2) ** 2))[..., None]
        return np.rint(pixels + self.glare * light * (255 - pixels.astype(np.float32))).astype(np.uint8)
