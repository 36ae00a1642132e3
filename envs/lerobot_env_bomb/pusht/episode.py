"""Draws an episode of PushT: its instruction, and one frozen transform per axis that is on."""

from dataclasses import dataclass

from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.perturbation import EpisodePerturbation
from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_env_bomb.pusht.board import PushTTransform

# The first is the task of LeRobot's published dataset; {where} is the axis `goal`'s.
TEMPLATES = (
    "Push the T-shaped block onto the T-shaped target{where}.",
    "Push the T onto the target{where}.",
    "Push the block onto the green T{where}.",
)


@dataclass(frozen=True)
class PushTEpisode:
    """An episode under its condition; gym-pusht draws from the seed where block and agent start."""

    spec: PushTSpec
    instruction: str
    perturbation: EpisodePerturbation[PushTTransform]


def sample_pusht_episode(spec: PushTSpec) -> PushTEpisode:
    """Draw the episode that the spec determines."""
    template = TEMPLATES[generator(spec.seed, Stream.TEMPLATE).integers(len(TEMPLATES))]
    perturbation = EpisodePerturbation.draw(spec.condition, spec.seed, None)
    worded = perturbation.reword("" if spec.instruction == NONE else template, None)
    return PushTEpisode(spec, worded.replace("{where}", ""), perturbation)
