"""Perturbation axis `reflectance`: gloss of objects, table and floor."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb_libero.scene import LiberoScene, LiberoTransform


@dataclass(frozen=True)
class LiberoGloss(LiberoTransform):
    """Table and floor mirror, objects shine."""

    mirror: float
    gloss: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        return cls(*(libero_magnitude("reflectance", name, level) for name in ("mirror", "gloss")))

    def edit(self, scene: LiberoScene) -> None:
        model = scene.model
        for material in scene.surfaces():
            model.mat_reflectance[material] = max(float(model.mat_reflectance[material]), self.mirror)
        materials = np.unique(model.geom_matid[scene.geoms_of(list(scene.movable.values()))])
        for part in (model.mat_specular, model.mat_shininess):
            part[materials[materials >= 0]] += self.gloss * (1 - part[materials[materials >= 0]])
