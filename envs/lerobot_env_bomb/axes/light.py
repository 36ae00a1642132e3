# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `light`: intensity and direction of the light."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.axes.transform import Transform
from lerobot_env_mujoco.mujoco_gl import mujoco
from lerobot_env_mujoco.rotations import rotation


@dataclass(frozen=True)
class Light(Transform):
    """Intensity and direction of the light."""

    factor: float
    axis: tuple[float, float, float]  # that the lamp's direction turns around
    angle_rad: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        factor = magnitude("light", ("dim", "bright")[rng.integers(2)], level)
        azimuth_rad = rng.uniform(-np.pi, np.pi)
        axis = (float(np.cos(azimuth_rad)), float(np.sin(azimuth_rad)), 0.0)
        return cls(factor, axis, float(np.radians(magnitude("light", "tilt", level))))

    def edit_model(self, model: mujoco.MjModel) -> None:
        lamp, headlight = model.light("key"), model.vis.headlight
        for part in (lamp.diffuse, lamp.specular, headlight.ambient, headlight.diffuse):
            part[:] *= self.factor
        lamp.dir[:] = rotation(np.array(self.axis), self.angle_rad) @ lamp.dir
