# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `dynamics`: mass, friction, and how the arm follows."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.model import stone_name
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.transforms import scale_mass


@dataclass(frozen=True)
class Dynamics(Transform):
    """Mass and friction of the stones; noise and latency of the arm."""

    mass_factor: float
    friction_factor: float
    noise: float  # standard deviation on executed x, y, z in units of the largest step
    latency: int  # control steps

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        heavy, rough = rng.choice((-1.0, 1.0), 2)
        return cls(
            mass_factor=float(magnitude("dynamics", "mass", level) ** heavy),
            friction_factor=float(magnitude("dynamics", "friction", level) ** rough),
            noise=magnitude("dynamics", "noise", level),
            latency=int(magnitude("dynamics", "latency", level)),
        )

    def edit_model(self, model: mujoco.MjModel) -> None:
        bodies = [model.body(stone_name(i)).id for i in range(NUM_STONES)]
        scale_mass(model, bodies, self.mass_factor)
        model.geom_friction[np.isin(model.geom_bodyid, bodies)] *= self.friction_factor
