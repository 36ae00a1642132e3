"""Other instructions for an episode, each with one word changed."""

from collections.abc import Iterator
from dataclasses import replace

from lerobot_bomb.bomb.board import BOARD, COLORS, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.suite import find_suite
from lerobot_env_bomb.bomb.axes.language import Wording
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode


def alternatives(episode: PerturbedEpisode) -> dict[str, tuple[str, Intersection]]:
    """{row, column or color: (another instruction, the intersection that it names)}, in the same words.

    {} for an episode whose instruction names no intersection.
    """
    if episode.target is None or episode.color is None:
        return {}
    row, column = episode.target
    steps = (2, 3, 4, 1)  # the first is two lines away
    asked = {
        "row": [{"target": ((row + step) % BOARD.num_lines, column)} for step in steps],
        "column": [{"target": (row, (column + step) % BOARD.num_lines)} for step in steps],
        "color": [{"color": color} for color in COLORS if color != episode.color and _says_color(episode)],
    }
    found = {word: next(_reworded(episode, changes), None) for word, changes in asked.items()}
    return {word: other for word, other in found.items() if other is not None}


def _reworded(episode: PerturbedEpisode, changes: list[dict]) -> Iterator[tuple[str, Intersection]]:
    """Yield the instructions and targets of the changes for which the split has an episode."""
    suite, wording = find_suite(episode.spec.suite), episode.perturbation.of(Wording)
    stone = {"color": episode.color} if _says_color(episode) else {"task_id": episode.task_id}
    for change in changes:
        spec: EpisodeSpec = replace(episode.spec, **{"target": episode.target, **stone, **change})
        try:
            suite.check(spec)
        except ValueError:
            continue
        other = suite.sample(spec)
        # the words would name this target as the one that is not meant
        if other.target is not None and (wording is None or wording.other != other.target):
            yield episode.perturbation.reword(other.instruction, other), other.target


def _says_color(episode: PerturbedEpisode) -> bool:
    """Return True if the instruction names the stone by its colour alone."""
    return "color" in episode.turns[0].words
