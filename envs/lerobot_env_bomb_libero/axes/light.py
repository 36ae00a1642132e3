"""Perturbation axis `light`: intensity and direction of the light."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb_libero.scene import HEADLIGHT, LiberoScene, LiberoTransform
from lerobot_env_mujoco.rotations import rotation


@dataclass(frozen=True)
class LiberoLight(LiberoTransform):
    """Intensity of all light, direction of the lamps."""

    factor: float
    axis: tuple[float, float, float]  # that the lamps' directions turn around
    angle_rad: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        factor = libero_magnitude("light", ("dim", "bright")[rng.integers(2)], level)
        azimuth_rad = rng.uniform(-np.pi, np.pi)
        axis = (float(np.cos(azimuth_rad)), float(np.sin(azimuth_rad)), 0.0)
        return cls(factor, axis, float(np.radians(libero_magnitude("light", "tilt", level))))

    def edit(self, scene: LiberoScene) -> None:
        model = scene.model
        for name in HEADLIGHT:
            getattr(model.vis.headlight, name)[:] *= self.factor
        for part in (model.light_diffuse, model.light_specular, model.light_ambient):
            part[:] *= self.factor
        model.light_dir[:] = model.light_dir @ rotation(np.array(self.axis), self.angle_rad).T
