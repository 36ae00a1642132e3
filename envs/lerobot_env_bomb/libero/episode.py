"""Draws an episode of LIBERO: its instruction, and one frozen transform per axis that is on."""

from dataclasses import dataclass

from lerobot_bomb.envs.perturbation import EpisodePerturbation
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_env_bomb.libero.scene import LiberoTransform


@dataclass(frozen=True)
class LiberoEpisode:
    """An episode under its condition."""

    spec: LiberoSpec
    instruction: str
    perturbation: EpisodePerturbation[LiberoTransform]


def sample_libero_episode(spec: LiberoSpec, instruction: str) -> LiberoEpisode:
    """Draw the episode that the spec determines; `instruction` is the task's own."""
    perturbation = EpisodePerturbation.draw(spec.condition, spec.seed, None)
    return LiberoEpisode(spec, perturbation.reword(instruction, None), perturbation)
