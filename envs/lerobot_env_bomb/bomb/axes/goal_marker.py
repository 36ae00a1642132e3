# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `goal_marker`: a dot on the target, as a help."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.shared.mujoco_gl import mujoco


@dataclass(frozen=True)
class GoalMarker(Transform):
    """A blue dot on the target, or on the last of several."""

    level: int
    target_xy: tuple[float, float]  # metres

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        return cls(level, nominal.aims[-1].xy)

    def edit_model(self, model: mujoco.MjModel) -> None:
        geom = model.geom("goal_marker")
        geom.pos[:2] = self.target_xy
        geom.size[0] = 1e-3 * magnitude("goal_marker", "radius", self.level)
        geom.rgba[3] = 1.0
