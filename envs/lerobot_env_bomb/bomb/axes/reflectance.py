# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `reflectance`: gloss, and a lamp's reflection on the board.

Nothing mirrors the scene: MuJoCo would render it twice (+50 % a frame).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.model import NUM_GLARE_RINGS, glare_name
from lerobot_env_bomb.shared.mujoco_gl import mujoco

GLARE_SPREAD_M = 0.08  # of the lamp's reflection around the board's middle, in x and in y
MAT_SHARE = 0.25  # of the stones' gloss that tray and table get


@dataclass(frozen=True)
class Reflectance(Transform):
    """Gloss of stones, tray and table, and a lamp's reflection on the board."""

    level: int
    glare_xy: tuple[float, float]  # metres

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        x, y = rng.uniform(-GLARE_SPREAD_M, GLARE_SPREAD_M, 2)
        return cls(level, (float(x), float(y)))

    def edit_model(self, model: mujoco.MjModel) -> None:
        gloss = magnitude("reflectance", "gloss", self.level)
        # a tray as glossy as the stones would be as white as they are
        for name, share in (("stone", 1.0), ("mat", MAT_SHARE), ("table", MAT_SHARE)):
            material = model.material(name)
            material.specular = material.specular[0] + share * gloss
            material.shininess = (1 - gloss) * material.shininess[0]
        model.light("key").specular[:] += gloss
        # several discs of growing size, each as transparent, make one with a soft edge
        opacity = 1 - (1 - magnitude("reflectance", "glare", self.level)) ** (1 / NUM_GLARE_RINGS)
        for ring in range(NUM_GLARE_RINGS):
            geom = model.geom(glare_name(ring))
            geom.pos[:2] = self.glare_xy
            geom.rgba[3] = opacity
