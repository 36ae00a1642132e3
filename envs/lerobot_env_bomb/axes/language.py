"""Perturbation axis `language`: the same instruction in other words. Each form states its convention."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.axes.transform import Transform

# Forms 1 to 5. `row` and `column` count from 0, row 0 is the far one; `_from_1` counts from 1, `near_`
# from the near edge; `other_` is a place that is not meant.
FORMS = (
    (  # a paraphrase
        "Please place a {color} stone on the Go board at row {row}, column {column}.",
        "Take a {color} stone and put it on the board at row {row}, column {column}.",
        "A {color} stone belongs at row {row}, column {column}. Put it there.",
    ),
    (  # other words, other order
        "In column {column}, row {row} of the grid: one {color} stone, please.",
        "Grab the {color} piece from the tray and leave it where row {row} crosses column {column}.",
        "Where column {column} meets row {row} a {color} piece should lie; bring one there.",
    ),
    (  # clauses that distract
        "Not at row {other_row}, column {other_column}: place a {color} stone at row {row}, column {column}.",
        "There are 5 rows and 5 columns. Never mind what lies there and place a {color} stone at "
        "row {row}, column {column}.",
        "Row {other_row} and column {other_column} can wait. First, a {color} stone at row {row}, "
        "column {column}.",
    ),
    (  # another convention
        "Counting rows and columns from 1, place a {color} stone at row {row_from_1}, "
        "column {column_from_1}.",
        "With row 0 at the near edge of the board, place a {color} stone at row {near_row}, column {column}.",
        "With rows counted from 1 at the near edge and columns from 0, place a {color} stone at "
        "row {near_row_from_1}, column {column}.",
    ),
    (  # a letter and a number, and a clause that distracts
        "Columns are A to E from left to right, rows 1 to 5 from the near edge. Leave {other_letter}"
        "{other_near_row_from_1} alone and place a {color} stone at {letter}{near_row_from_1}.",
        "If rows are 1 to 5 from the far edge and columns A to E from the left, a {color} stone is missing "
        "at {letter}{row_from_1}, not at {other_letter}{other_row_from_1}. Put it there.",
    ),
)


@dataclass(frozen=True)
class Wording(Transform):
    """Another template in place of the episode's."""

    template: str
    other: tuple[int, int]  # row, column that the instruction may name but does not mean

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        templates = FORMS[int(magnitude("language", "form", level)) - 1]
        template = templates[rng.integers(len(templates))]
        target, places = nominal.target, BOARD.num_lines**2
        # another place, whichever the target is
        other = (BOARD.num_lines * target[0] + target[1] + rng.integers(1, places)) % places
        row, column = divmod(int(other), BOARD.num_lines)
        return cls(template, (row, column))

    def reword(self, instruction: str, nominal: Episode) -> str:
        return self.template.format(
            color=nominal.color, **_coordinates("", *nominal.target), **_coordinates("other_", *self.other)
        )


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
