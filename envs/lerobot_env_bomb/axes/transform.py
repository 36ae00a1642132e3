# pyright: reportAttributeAccessIssue=false
"""What every perturbation axis is: a transform of an episode, frozen once drawn."""

from abc import ABC, abstractmethod
from typing import Self

import numpy as np

from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.mujoco_gl import mujoco


class Transform(ABC):
    """What one axis does to an episode; a method that it does not override leaves things as they are.

    The level sets how far it goes, the random generator only where to, so that the same seed at a higher
    level goes further the same way.
    """

    @classmethod
    @abstractmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        """At a level of 1..5; `nominal` is the episode without perturbations."""

    def edit_model(self, model: mujoco.MjModel) -> None:  # noqa: B027  (most do nothing)
        """Change the compiled model in place."""

    def arrange(self, layout: Layout, stone: int) -> Layout:
        """The layout after the change; `stone` is to be moved."""
        return layout

    def reword(self, instruction: str, nominal: Episode) -> str:
        """The instruction after the change; it means the same."""
        return instruction

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        """(H, W, 3) uint8 -> the same, the `number`-th image of the episode after the change."""
        return rgb
