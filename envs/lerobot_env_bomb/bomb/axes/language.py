"""Perturbation axis `language`: the same instruction in other words. Each form states its convention."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_env_bomb.bomb.axes.transform import Transform


@dataclass(frozen=True)
class Wording(Transform):
    """Another template for the episode's instruction."""

    template: str
    other: tuple[int, int]  # row, column that the instruction may name but does not mean

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        templates = find_suite(nominal.spec.suite).forms[int(magnitude("language", "form", level)) - 1]
        template = templates[rng.integers(len(templates))]
        target, places = nominal.target or (0, 0), BOARD.num_lines**2
        # another place, whichever the target is
        other = (BOARD.num_lines * target[0] + target[1] + rng.integers(1, places)) % places
        row, column = divmod(int(other), BOARD.num_lines)
        return cls(template, (row, column))

    def reword(self, instruction: str, nominal: Episode) -> str:
        (turn,) = nominal.turns
        target = {} if nominal.target is None else _coordinates("", *nominal.target)
        return self.template.format(**turn.words, **target, **_coordinates("other_", *self.other))


def _coordinates(prefix: str, row: int, column: int) -> dict[str, int | str]:
    near_row = BOARD.num_lines - 1 - row
    values = {
        "row": row,
        "column": column,
        "row_from_1": row + 1,
        "column_from_1": column + 1,
        "near_row": near_row,
        "near_row_from_1": near_row + 1,
        "letter": "ABCDE"[column],
    }
    return {f"{prefix}{name}": value for name, value in values.items()}
