"""The board, its intersections and its stones; imports only numpy, as all that simulator workers load."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

COLORS = ("black", "white")
Intersection = tuple[int, int]  # row, column of an intersection
TRAY_CENTER_XY = (0.170, 0.0)  # metres; the tray beside the board from which stones are taken
TRAY_HALF_SIZE_XY = (0.045, 0.125)  # metres; it touches the board
# the small board that shows a pattern, at the tray's near end, where the arm does not hide it at the start
PATTERN_CENTER_XY = (0.170, -0.090)  # metres
PATTERN_PITCH_M = 0.012
PATTERN_HALF_SIZE_M = 0.032
HALVES = tuple(f"board's {side} half" for side in ("left", "right", "far", "near"))
NUM_STONES = 12  # stones in the compiled model: on the board, to be moved, or parked out of sight


@dataclass(frozen=True)
class BoardGeometry:
    """Sizes of board and stones in metres. Row 0 is the far row (+y), columns run along +x."""

    num_lines: int = 5
    pitch_m: float = 0.045
    margin_m: float = 0.035
    thickness_m: float = 0.005
    stone_radius_m: float = 0.013
    stone_height_m: float = 0.009

    @property
    def half_size_m(self) -> float:
        """Distance from the board's centre to its edge."""
        return (self.num_lines - 1) / 2 * self.pitch_m + self.margin_m

    def intersection_xy(self, row: int, column: int) -> np.ndarray:
        """(2,) world xy in metres of an intersection; (0, 0) is the board's centre."""
        if not (0 <= row < self.num_lines and 0 <= column < self.num_lines):
            raise ValueError(
                f"intersection ({row}, {column}) is off the board: "
                f"row and column must lie in 0..{self.num_lines - 1}"
            )
        middle = (self.num_lines - 1) / 2
        return np.array([(column - middle) * self.pitch_m, (middle - row) * self.pitch_m])

    def halves(self, xy: np.ndarray) -> dict[str, np.ndarray]:
        """{half: (...) bool}: world xy (..., 2) in metres that lie in it; left has column 0, far row 0."""
        x, y = xy[..., 0], xy[..., 1]
        return dict(zip(HALVES, (x < 0, x >= 0, y >= 0, y < 0), strict=True))

    def nearest_intersection(self, xy: np.ndarray) -> tuple[int, int]:
        """(row, column) of the intersection nearest to a world xy in metres."""
        middle = (self.num_lines - 1) / 2
        column = np.clip(round(xy[0] / self.pitch_m + middle), 0, self.num_lines - 1)
        row = np.clip(round(middle - xy[1] / self.pitch_m), 0, self.num_lines - 1)
        return int(row), int(column)


BOARD = BoardGeometry()


def task_id(target: Sequence[int], color: str) -> int:
    """Return the number of a task of suite `place`, by its (row, column) and colour."""
    row, column = target
    return BOARD.num_lines**2 * COLORS.index(color) + BOARD.num_lines * row + column
