"""Perturbation axis `photometric`: the cameras' sensor."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.suite import Episode
from lerobot_bomb.envs.photometric import Photometric
from lerobot_env_bomb.axes.transform import Transform


@dataclass(frozen=True)
class Sensor(Transform):
    """Colour balance, brightness and noise of the cameras' sensor."""

    photometric: Photometric

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        return cls(Photometric.draw(level, rng))

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        return self.photometric(rgb, number)
