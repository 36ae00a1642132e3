"""Perturbation axes in an episode: a frozen transform for each axis that is on."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pkgutil import resolve_name
from typing import Any, Self
from zlib import crc32

import numpy as np

from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.envs.photometric import Photometric


class EpisodeTransform(ABC):
    """Effect of one axis on an episode; a method that it does not override leaves things as they are.

    The level sets how far it goes, the random generator only in which direction, so the same seed at a higher
    level goes further the same way. An environment's own base adds what its axes change in the simulator.
    """

    @classmethod
    @abstractmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        """Draw the effect of a level of 1..5; `nominal` is the episode without perturbations."""

    def reword(self, instruction: str, nominal: Any) -> str:
        """Return the instruction after the change, which means the same."""
        return instruction

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        """(H, W, 3) uint8, the `number`-th image of the episode -> the image after the change."""
        return rgb


@dataclass(frozen=True)
class SensorTransform(EpisodeTransform):
    """Colour balance, brightness and noise of the cameras' sensor."""

    photometric: Photometric

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        return cls(Photometric.draw(level, rng))

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        return self.photometric(rgb, number)


def transforms_of(condition: AxisCondition) -> dict[str, Any]:
    """{axis that is on: its class of transforms}."""
    return {axis: _transform(condition.axes[axis].transform) for axis, _, _ in condition.ranges}


_transform = cache(resolve_name)


def _number(condition: AxisCondition, stream: Stream, axis: str) -> int:
    """Return the number of an axis' stream: by its place or, where another package adds it, by its name."""
    own = list(condition.axes.own)
    return stream + own.index(axis) if axis in own else (crc32(axis.encode()) << 32) + stream


@dataclass(frozen=True)
class EpisodePerturbation[T: EpisodeTransform]:
    """An episode's axes that are on, in the order of the environment's table."""

    levels: Mapping[str, int]
    transforms: Mapping[str, T]

    @classmethod
    def draw(cls, condition: AxisCondition, seed: int, nominal: Any) -> Self:
        """Draw the axes of a condition, each from a generator of its own."""
        kinds = transforms_of(condition)

        def rng(stream: Stream, axis: str) -> np.random.Generator:
            return generator(seed, _number(condition, stream, axis))

        levels = {
            axis: level
            for axis, low, high in condition.ranges
            if (level := low if low == high else int(rng(Stream.LEVEL, axis).integers(low, high + 1))) > 0
        }
        drawn = {
            axis: kinds[axis].draw(level, rng(Stream.AXIS, axis), nominal) for axis, level in levels.items()
        }
        return cls(levels, drawn)

    def of[K: EpisodeTransform](self, kind: type[K]) -> K | None:
        """Return the transform of a kind; None if its axis is off."""
        return next((each for each in self.transforms.values() if isinstance(each, kind)), None)

    def reword(self, instruction: str, nominal: Any) -> str:
        """Return the instruction after all changes."""
        for each in self.transforms.values():
            instruction = each.reword(instruction, nominal)
        return instruction

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        """(H, W, 3) uint8, the `number`-th image of the episode -> the image after all changes."""
        for each in self.transforms.values():
            rgb = each.sense(rgb, number)
        return rgb
