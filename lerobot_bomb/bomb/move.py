"""Moves that an episode asks for: each move of a plan takes a stone to a place."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY, Intersection

TRAY = "tray"
type Place = Intersection | str  # an intersection, or TRAY: anywhere in it


@dataclass(frozen=True)
class Move:
    """Move of one of several stones to one of several places."""

    # any one of these, by index; of several, one that no move has taken before
    stones: frozenset[int]
    places: frozenset[Place]  # any one of these on which no move has put a stone
    after: frozenset[int] = frozenset()  # numbers of the plan's moves that must have been made
    is_slid: bool = False  # pushed or pulled along the board: lifting the stone is a failure


type Plan = tuple[Move, ...]  # all of its moves are to be made, each after those in its `after`
# moves that have been made: {number in the plan: (stone, place)}
type Made = dict[int, tuple[int, Place]]


@dataclass(frozen=True)
class Aim:
    """Next move of the expert: one stone to one place."""

    stone: int
    xy: tuple[float, float]  # metres
    is_slid: bool = False

    @property
    def place(self) -> Place:
        """The place that the aim lies on."""
        xy = np.array(self.xy)
        return TRAY if distance_m(xy, TRAY) == 0 else BOARD.nearest_intersection(xy)


def aim_at(stone: int, intersection: Intersection, is_slid: bool = False) -> Aim:
    """Return the aim of bringing a stone to an intersection."""
    x, y = BOARD.intersection_xy(*intersection)
    return Aim(stone, (float(x), float(y)), is_slid)


def one_move(stone: int, places: Collection[Place]) -> Move:
    """Return a move of this stone to any of these places."""
    return Move(frozenset([stone]), frozenset(places))


def in_order(*moves: Move) -> Plan:
    """Return a plan whose moves come one after the other."""
    return tuple(
        Move(move.stones, move.places, frozenset(range(number)), move.is_slid)
        for number, move in enumerate(moves)
    )


def open_moves(plan: Plan, made: Made) -> Iterator[tuple[int, Move]]:
    """Yield the moves that may be made next, with their numbers."""
    for number, move in enumerate(plan):
        if number not in made and move.after <= made.keys():
            yield number, move


def stones_left(move: Move, made: Made) -> frozenset[int]:
    """Return the stones that may still make a move."""
    return move.stones if len(move.stones) == 1 else move.stones - {stone for stone, _ in made.values()}


def places_left(move: Move, made: Made) -> frozenset[Place]:
    """Return the places of a move that no stone has been put on yet."""
    return move.places - {place for _, place in made.values() if place != TRAY}


def place_name(xy: np.ndarray) -> str:
    """Return "row 1, column 3", "the tray" or "beside the board" for (2,) metres."""
    if distance_m(xy, TRAY) == 0:
        return "the tray"
    if np.abs(xy).max() > BOARD.half_size_m:
        return "beside the board"
    row, column = BOARD.nearest_intersection(xy)
    return f"row {row}, column {column}"


def distance_m(xy: np.ndarray, place: Place) -> float:
    """Return how far a stone at (2,) metres is from a place; 0 anywhere in the tray, if that is the place."""
    if isinstance(place, str):
        outside = np.maximum(abs(xy - np.array(TRAY_CENTER_XY)) - np.array(TRAY_HALF_SIZE_XY), 0.0)
        return float(np.linalg.norm(outside))
    return float(np.linalg.norm(xy - BOARD.intersection_xy(*place)))
