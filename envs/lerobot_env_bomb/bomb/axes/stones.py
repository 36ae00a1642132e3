"""Perturbation axis `stones`: more stones, none exactly in place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, Intersection
from lerobot_bomb.bomb.go import is_legal_position
from lerobot_bomb.bomb.layout import Layout, put_on_board
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform


@dataclass(frozen=True)
class Stones(Transform):
    """More stones on the board; no stone, old or new, is exactly on its intersection."""

    extra: Mapping[Intersection, str]  # (row, column) -> colour
    directions_rad: tuple[float, ...]  # of the shift of each stone, first those of the opening
    shift_m: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        opening = nominal.opening
        directions_rad = rng.uniform(-np.pi, np.pi, BOARD.num_lines**2)
        shift_m = 1e-3 * magnitude("stones", "shift", level)
        num_in_play = int(nominal.layout.stone_in_play.sum())
        num_extra = min(int(magnitude("stones", "extra", level)), NUM_STONES - num_in_play)
        # As for the opening: the candidates do not depend on the move, the first that allows it is taken.
        while True:
            extra = _grow(opening, num_extra, nominal.extra_colors, rng)
            if len(extra) == num_extra and nominal.allows({**opening, **extra}):
                return cls(extra, tuple(directions_rad.tolist()), shift_m)

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        layout = put_on_board(self.extra, layout)
        stone_xy = layout.stone_xy.copy()
        on_board = np.setdiff1d(np.flatnonzero(layout.stone_in_play), supply)
        angles_rad = np.array(self.directions_rad[: len(on_board)])
        stone_xy[on_board] += self.shift_m * np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])
        return replace(layout, stone_xy=stone_xy)


def _grow(
    opening: Mapping[Intersection, str], num_extra: int, colors: Sequence[str], rng: np.random.Generator
) -> dict[Intersection, str]:
    """{(row, column): colour} of stones that can join the opening, colours in turn."""
    extra: dict[Intersection, str] = {}
    first = int(rng.integers(len(COLORS)))
    for place in rng.permutation(BOARD.num_lines**2):
        row, column = divmod(int(place), BOARD.num_lines)
        if len(extra) == num_extra:
            break
        grown = {**extra, (row, column): colors[(first + len(extra)) % len(colors)]}
        if (row, column) not in opening and is_legal_position({**opening, **grown}):
            extra = grown
    return extra
