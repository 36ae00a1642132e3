"""Perturbation axis `dynamics`: how heavy and slippery objects are, and how the arm obeys.

It acts once the objects have settled, so that none has moved before the episode.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import LiberoScene, LiberoTransform
from lerobot_env_bomb.shared.transforms import scale_mass


@dataclass(frozen=True)
class LiberoDynamics(LiberoTransform):
    """Mass and friction of the objects; noise and latency of the arm."""

    mass_factor: float
    friction_factor: float
    noise: float  # standard deviation on the executed motion, whose range is -1..1
    latency: int  # control steps

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        heavier, rougher = rng.choice((-1, 1), 2)
        return cls(
            mass_factor=float(libero_magnitude("dynamics", "mass", level) ** heavier),
            friction_factor=float(libero_magnitude("dynamics", "friction", level) ** rougher),
            noise=libero_magnitude("dynamics", "noise", level),
            latency=int(libero_magnitude("dynamics", "latency", level)),
        )

    def release(self, scene: LiberoScene) -> None:
        model, bodies = scene.model, list(scene.movable.values())
        scale_mass(model, bodies, self.mass_factor)
        model.geom_friction[scene.geoms_of(bodies), 0] *= self.friction_factor
