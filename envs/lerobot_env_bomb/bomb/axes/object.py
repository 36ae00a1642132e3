# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `object`: size, shape and shade of the stones."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.model import NUM_FEET, foot_name, stone_name
from lerobot_env_bomb.shared.mujoco_gl import mujoco

GREY = 0.5


@dataclass(frozen=True)
class StoneLook(Transform):
    """Size, shape and shade of all stones. The sizes go into the layout."""

    level: int
    radius_m: float
    height_m: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            level,
            radius_m=BOARD.stone_radius_m + 1e-3 * float(signs[0]) * magnitude("object", "radius", level),
            height_m=BOARD.stone_height_m + 1e-3 * float(signs[1]) * magnitude("object", "height", level),
        )

    def edit_model(self, model: mujoco.MjModel) -> None:
        radius, half = self.radius_m, self.height_m / 2
        growth = max(1.0, radius / BOARD.stone_radius_m, self.height_m / BOARD.stone_height_m)
        shade = magnitude("object", "shade", self.level)
        for i in range(NUM_STONES):
            name = stone_name(i)
            rim, visual, body = model.geom(name), model.geom(f"{name}_visual"), model.body(name)
            rim.size[:2] = radius, half
            feet = [model.geom(foot_name(i, k)) for k in range(NUM_FEET)]
            for foot in feet:
                foot.size[0] = half
                foot.pos[:2] *= (radius - half) / np.linalg.norm(foot.pos[:2])
            # bounds that collision detection looks at first; too wide does no harm
            for geom in (rim, *feet):
                geom.rbound *= growth
                model.geom_aabb[geom.id] *= growth
            first, count = model.body_bvhadr[body.id], model.body_bvhnum[body.id]
            model.bvh_aabb[first : first + count] *= growth
            if magnitude("object", "flat", self.level):
                visual.type = mujoco.mjtGeom.mjGEOM_CYLINDER
                visual.size[:2] = radius, half
            else:
                visual.size[:] = radius, radius, half
            visual.rgba[:3] = (1 - shade) * visual.rgba[:3] + shade * GREY

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        return replace(layout, stone_radius_m=self.radius_m, stone_height_m=self.height_m)
