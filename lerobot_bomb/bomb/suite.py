"""What a suite is: a kind of episode. Each has a file in `suites/`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from lerobot_bomb.bomb.board import BOARD, Cell
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.privileged_state import Goal


@dataclass(frozen=True)
class Episode:
    """What an EpisodeSpec stands for."""

    spec: EpisodeSpec
    target: Cell
    color: str
    instruction: str
    opening: Mapping[Cell, str]  # colours of the stones that stand on the board
    layout: Layout
    stone: int  # index of the stone to be moved

    @property
    def goals(self) -> tuple[Goal, ...]:
        """What the expert aims at."""
        return (Goal(self.target_xyz, self.stone),)

    @property
    def target_xyz(self) -> np.ndarray:
        """(3,) metres, centre of a stone that rests on the target."""
        return np.array([*BOARD.intersection_xy(*self.target), self.layout.rest_height_m])


@dataclass(frozen=True)
class Suite:
    """How its episodes are drawn and how long they may last.

    ``check`` raises a ValueError that names the flag for a spec of which no episode can be drawn.
    """

    sample: Callable[[EpisodeSpec], Episode]  # the same spec, the same episode, without perturbations
    check: Callable[[EpisodeSpec], None]
    max_steps: int  # at DEFAULT_FPS; scaled with fps
    num_goals: int = 1  # of each of its episodes


def find_suite(name: str) -> Suite:
    """The suite of a name in SUITES."""
    return import_module(f"lerobot_bomb.bomb.suites.{name}").SUITE
