"""Draws an episode under its condition: one frozen transform per axis that is on."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.perturbations import AXES, Condition
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_env_bomb.axes import TRANSFORMS
from lerobot_env_bomb.axes.transform import Transform
from lerobot_env_bomb.scene import ModelEdit


@dataclass(frozen=True)
class Perturbation:
    """An episode's axes that are on, in the order of AXES."""

    levels: Mapping[str, int]
    transforms: Mapping[str, Transform]

    def of[T: Transform](self, kind: type[T]) -> T | None:
        """The transform of a kind; None where its axis is off."""
        return next((each for each in self.transforms.values() if isinstance(each, kind)), None)

    @property
    def model_edits(self) -> tuple[ModelEdit, ...]:
        """What is done to the compiled model."""
        return tuple(each.edit_model for each in self.transforms.values())

    def arrange(self, layout: Layout, stone: int) -> Layout:
        """The layout after all changes; `stone` is to be moved."""
        for each in self.transforms.values():
            layout = each.arrange(layout, stone)
        return layout

    def reword(self, nominal: Episode) -> str:
        """The instruction after all changes."""
        instruction = nominal.instruction
        for each in self.transforms.values():
            instruction = each.reword(instruction, nominal)
        return instruction

    def sense(self, rgb: np.ndarray, number: int) -> np.ndarray:
        """(H, W, 3) uint8 -> the same, the `number`-th image of the episode after all changes."""
        for each in self.transforms.values():
            rgb = each.sense(rgb, number)
        return rgb


@dataclass(frozen=True)
class PerturbedEpisode(Episode):
    """An episode with its condition's instruction and layout; the model is still to be edited."""

    perturbation: Perturbation


def sample_episode(spec: EpisodeSpec) -> PerturbedEpisode:
    """Draw the suite's episode, then its perturbation; the same spec, the same episode."""
    nominal = find_suite(spec.suite).sample(spec)
    perturbation = draw_perturbation(nominal)
    changed = {
        "instruction": perturbation.reword(nominal),
        "layout": perturbation.arrange(nominal.layout, nominal.stone),
    }
    return PerturbedEpisode(**{**vars(nominal), **changed}, perturbation=perturbation)


def draw_perturbation(nominal: Episode) -> Perturbation:
    """The axes of the episode's condition, each drawn from a generator of its own."""
    spec, levels = nominal.spec, {}
    for axis, low, high in Condition.parse(spec.perturbations).ranges:
        level = int(_rng(spec, Stream.LEVEL, axis).integers(low, high + 1))
        if level > 0:
            levels[axis] = level
    drawn = {
        axis: TRANSFORMS[axis].draw(level, _rng(spec, Stream.AXIS, axis), nominal)
        for axis, level in levels.items()
    }
    return Perturbation(levels, drawn)


def _rng(spec: EpisodeSpec, stream: Stream, axis: str) -> np.random.Generator:
    return generator(spec.seed, stream + list(AXES).index(axis))
