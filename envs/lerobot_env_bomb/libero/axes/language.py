"""Perturbation axis `language`: the same instruction in other words."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_bomb.libero.wording import reworded
from lerobot_env_bomb.libero.scene import LiberoTransform

MAX_VARIANTS = 1 << 16


@dataclass(frozen=True)
class LiberoWording(LiberoTransform):
    """A form of words, and the number of a variant of it."""

    form: int
    variant: int

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        return cls(int(libero_magnitude("language", "form", level)), int(rng.integers(MAX_VARIANTS)))

    def reword(self, instruction: str, nominal: Any) -> str:
        return reworded(instruction, self.form, self.variant)
