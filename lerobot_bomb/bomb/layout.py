"""Layout at the start of an episode, and the snapshot that the simulator measures after each step."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lerobot_bomb.bomb.board import BOARD, Intersection


@dataclass(frozen=True)
class Layout:
    """Positions at the start of an episode. Stones rest flat; those not in play are parked."""

    gripper_xyz: np.ndarray  # (3,) metres
    stone_xy: np.ndarray  # (NUM_STONES, 2) metres
    stone_is_white: np.ndarray  # (NUM_STONES,) bool
    stone_in_play: np.ndarray  # (NUM_STONES,) bool
    stone_radius_m: float = BOARD.stone_radius_m
    stone_height_m: float = BOARD.stone_height_m

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of a stone that rests; board and tray are equally high."""
        return BOARD.thickness_m + self.stone_height_m / 2


def put_on_board(stones: Mapping[Intersection, str], layout: Layout) -> Layout:
    """Return the layout with stones that were not in play put on these intersections."""
    stone_xy, stone_is_white = layout.stone_xy.copy(), layout.stone_is_white.copy()
    in_play = layout.stone_in_play.copy()
    for i, (intersection, color) in zip(np.flatnonzero(~in_play), stones.items(), strict=False):
        stone_xy[i] = BOARD.intersection_xy(*intersection)
        stone_is_white[i] = color == "white"
        in_play[i] = True
    return replace(layout, stone_xy=stone_xy, stone_is_white=stone_is_white, stone_in_play=in_play)


@dataclass(frozen=True)
class SceneState:
    """Measurements of the simulator after a control step."""

    gripper_xyz: np.ndarray  # (3,) metres, point between the pads' lower ends
    finger_opening: float  # metres between the pads
    stone_xyz: np.ndarray  # (NUM_STONES, 3) metres, centres
    stone_touched: np.ndarray  # (NUM_STONES, 2) bool: by the left and the right pad
