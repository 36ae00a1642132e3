"""Goals of the expert: which stone it brings where, by the moves made and by what lies where.

The choice shows: of equal stones the one that the fingers hold, or else the first in the tray, row by row; of
several places the first that is free.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.commands import TRAY_XY_M
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.move import TRAY, Made, Place, Plan, places_left, stones_left
from lerobot_bomb.bomb.privileged_state import Goal


@dataclass(frozen=True)
class Course:
    """State of a plan: its moves that have been made or begun."""

    plan: Plan
    made: Made
    lying: Made  # those made, and those whose stones lie in place but have not been judged
    carried: tuple[int, int] | None = None  # an open move, and the stone that makes it


def course_goals(course: Course, layout: Layout, stone_xyz: np.ndarray) -> Iterator[tuple[int, Goal]]:
    """Yield moves' numbers and goals: those whose stones lie in place, that of the carried stone, the others.

    A made move whose stone lies elsewhere, as it may in the tray, has none: it must not be taken again.
    """

    def goal(number: int, stone: int, xy: np.ndarray) -> tuple[int, Goal]:
        return number, Goal(np.array([*xy, layout.rest_height_m]), stone, course.plan[number].is_slid)

    stone_xy = stone_xyz[:, :2].copy()  # after the moves so far
    for number, (stone, place) in course.lying.items():
        spots = [xy for _, xy in _spots([place])]
        away_m, nearest = min((float(np.linalg.norm(xy - stone_xy[stone])), i) for i, xy in enumerate(spots))
        is_near = away_m <= layout.stone_radius_m
        if is_near or number not in course.made:
            yield goal(number, stone, spots[nearest] if is_near or place != TRAY else stone_xy[stone])
    carried, planned = dict([course.carried] if course.carried else []), dict(course.lying)
    for number in dict.fromkeys([*carried, *range(len(course.plan))]):
        if number in planned:
            continue
        move = course.plan[number]
        stone = carried[number] if number in carried else min(stones_left(move, planned))
        is_other = layout.stone_in_play & (np.arange(len(stone_xy)) != stone)
        spots = list(_spots(places_left(move, planned)))
        free = (spot for spot in spots if _is_free(spot[1], stone_xy[is_other], 2 * layout.stone_radius_m))
        place, xy = next(free, spots[0])
        planned[number], stone_xy[stone] = (stone, place), xy
        yield goal(number, stone, xy)


def _spots(places: Collection[Place]) -> Iterator[tuple[Place, np.ndarray]]:
    """Yield places and where on them the expert puts stones, (2,) metres, in its order: the tray first."""
    if TRAY in places:
        yield from ((TRAY, np.array(xy)) for xy in TRAY_XY_M)
    else:
        intersections = sorted(place for place in places if not isinstance(place, str))
        yield from ((intersection, BOARD.intersection_xy(*intersection)) for intersection in intersections)


def _is_free(xy: np.ndarray, others_xy: np.ndarray, apart_m: float) -> bool:
    return bool((np.linalg.norm(others_xy - xy, axis=1) >= apart_m).all())
