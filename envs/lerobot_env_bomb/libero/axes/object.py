"""Perturbation axis `object`: shade of the objects; a red mug stays red."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import LiberoScene, LiberoTransform


@dataclass(frozen=True)
class ObjectShade(LiberoTransform):
    """Darker colours of the objects, a little of one channel missing; another hue would belie the text."""

    factors: tuple[float, float, float]  # of red, green and blue

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        factors = np.full(3, libero_magnitude("object", "shade", level))
        factors[rng.integers(3)] *= 1 - libero_magnitude("object", "tint", level)
        red, green, blue = factors.tolist()
        return cls((red, green, blue))

    def edit(self, scene: LiberoScene) -> None:
        model = scene.model
        geoms = scene.geoms_of(list(scene.movable.values()))
        materials = model.geom_matid[geoms]
        model.mat_rgba[np.unique(materials[materials >= 0]), :3] *= self.factors
        model.geom_rgba[geoms[materials < 0], :3] *= self.factors
