"""Suite `goal`: stones stand on the board, and the instruction says what is to be done with them."""

from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, Intersection
from lerobot_bomb.bomb.commands import (
    INTERSECTIONS,
    TRAY_XY_M,
    Case,
    Task,
    TaskInstance,
    command_suite,
    draw_stones,
    is_graspable,
    only,
    other_color,
)
from lerobot_bomb.bomb.move import TRAY, Aim, Move, Plan, aim_at, in_order, one_move

MIN_STONES, MAX_STONES = 2, 6
MAX_MOVED = 3
SIDE_COLUMNS = 2  # of the left side, to which stones are gathered
FAR_COLUMN = 3  # from here on stones are gathered: none of them stands beside a place of the left side


def _draw_board(rng: np.random.Generator) -> dict[Intersection, str]:
    return draw_stones(rng, int(rng.integers(MIN_STONES, MAX_STONES + 1)))


def _to_tray(drawn: TaskInstance, intersections: list[Intersection]) -> tuple[Plan, tuple[Aim, ...]]:
    """Return the plan and the aims that put all of these stones into the tray, in whichever order."""
    stones = [drawn.stone_on(intersection) for intersection in intersections]
    plan = tuple(one_move(stone, [TRAY]) for stone in stones)
    return plan, tuple(Aim(stone, xy) for stone, xy in zip(stones, TRAY_XY_M, strict=False))


@dataclass(frozen=True)
class RemoveColor(Task):
    """Task: put the only stone of a colour into the tray."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        return TaskInstance(
            (int(rng.integers(len(COLORS))), int(rng.integers(BOARD.num_lines))), _draw_board(rng)
        )

    def case(self, drawn: TaskInstance) -> Case | None:
        color, row = COLORS[drawn.about[0]], drawn.about[1]
        intersection = only(drawn.stones, color)
        if intersection is None or intersection[0] != row or not is_graspable(drawn.stones, intersection):
            return None
        plan, aims = _to_tray(drawn, [intersection])
        command = f"take the {color} stone off the board and put it in the tray"
        return Case((command,), (plan,), aims, (other_color(color),))


@dataclass(frozen=True)
class RemoveAt(Task):
    """Task: put the stone on an intersection into the tray."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        row, column = INTERSECTIONS[rng.integers(len(INTERSECTIONS))]
        return TaskInstance((row, column), _draw_board(rng))

    def case(self, drawn: TaskInstance) -> Case | None:
        row, column = intersection = drawn.about[0], drawn.about[1]
        if intersection not in drawn.stones or not is_graspable(drawn.stones, intersection):
            return None
        plan, aims = _to_tray(drawn, [intersection])
        command = f"take the stone at row {row}, column {column} off the board and put it in the tray"
        return Case((command,), (plan,), aims)


@dataclass(frozen=True)
class Swap(Task):
    """Task: let two stones change places, one of them by way of the tray or of a free intersection."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        stones = _draw_board(rng)
        (a, b) = [list(stones)[i] for i in rng.permutation(len(stones))[:2]]
        return TaskInstance((*a, *b), stones)

    def case(self, drawn: TaskInstance) -> Case | None:
        a, b = (drawn.about[0], drawn.about[1]), (drawn.about[2], drawn.about[3])
        stones = drawn.stones
        if not {a, b} <= stones.keys() or stones[a] == stones[b]:
            return None
        if not is_graspable(stones, a) or not is_graspable(stones, b):
            return None
        # of these, only free ones can hold a stone
        others = [intersection for intersection in INTERSECTIONS if intersection not in (a, b)]
        first, second = drawn.stone_on(a), drawn.stone_on(b)
        plans = tuple(
            in_order(one_move(one, [TRAY, *others]), one_move(other, [here]), one_move(one, [there]))
            for one, other, here, there in ((first, second, a, b), (second, first, b, a))
        )
        aims = (Aim(first, TRAY_XY_M[0]), aim_at(second, a), aim_at(first, b))
        # with their colours: they alone show when the swap is done
        command = (
            f"swap the {stones[a]} stone at row {a[0]}, column {a[1]} and the {stones[b]} stone at "
            f"row {b[0]}, column {b[1]}"
        )
        return Case((command,), plans, aims)


@dataclass(frozen=True)
class Push(Task):
    """Task: push the only stone of a colour one intersection further, without lifting it."""

    direction: str
    rows: int
    columns: int

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        return TaskInstance(
            (int(rng.integers(len(COLORS))), int(rng.integers(BOARD.num_lines))), _draw_board(rng)
        )

    def case(self, drawn: TaskInstance) -> Case | None:
        color, row = COLORS[drawn.about[0]], drawn.about[1]
        intersection = only(drawn.stones, color)
        if intersection is None or intersection[0] != row:
            return None
        place = intersection[0] + self.rows, intersection[1] + self.columns
        others = {other: stone for other, stone in drawn.stones.items() if other != intersection}
        if place not in INTERSECTIONS or place in others:
            return None
        if not is_graspable(others, intersection) or not is_graspable(others, place):
            return None
        stone = drawn.stone_on(intersection)
        plan = (Move(frozenset([stone]), frozenset([place]), is_slid=True),)
        # with the place: a stone that has been pushed half the way does not show where it stood
        command = (
            f"push the {color} stone one intersection {self.direction}, to row {place[0]}, "
            f"column {place[1]}, along the board and without lifting it"
        )
        return Case((command,), (plan,), (aim_at(stone, place, is_slid=True),), (other_color(color),))


@dataclass(frozen=True)
class ClearRow(Task):
    """Task: put all stones of a row into the tray."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        row, number = int(rng.integers(BOARD.num_lines)), int(rng.integers(1, MAX_MOVED + 1))
        return TaskInstance((row, number), _draw_board(rng))

    def case(self, drawn: TaskInstance) -> Case | None:
        row, number = drawn.about
        intersections = sorted(intersection for intersection in drawn.stones if intersection[0] == row)
        if len(intersections) != number or not all(
            is_graspable(drawn.stones, intersection) for intersection in intersections
        ):
            return None
        plan, aims = _to_tray(drawn, intersections)
        return Case((f"clear row {row}: put its stones in the tray",), (plan,), aims)


@dataclass(frozen=True)
class Gather(Task):
    """Task: move all stones of a colour to the left, unless they stand there."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        return TaskInstance(
            (int(rng.integers(len(COLORS))), int(rng.integers(BOARD.num_lines))), _draw_board(rng)
        )

    def case(self, drawn: TaskInstance) -> Case | None:
        color, row = COLORS[drawn.about[0]], drawn.about[1]
        intersections = sorted(
            intersection
            for intersection, other in drawn.stones.items()
            if other == color and intersection[1] >= SIDE_COLUMNS
        )
        if not 1 <= len(intersections) <= MAX_MOVED or intersections[0][0] != row:
            return None
        if not all(
            column >= FAR_COLUMN and is_graspable(drawn.stones, (r, column)) for r, column in intersections
        ):
            return None
        side = [intersection for intersection in INTERSECTIONS if intersection[1] < SIDE_COLUMNS]
        free = [intersection for intersection in side if intersection not in drawn.stones]
        if len(free) < len(intersections):
            return None
        stones = [drawn.stone_on(intersection) for intersection in intersections]
        plan = tuple(one_move(stone, side) for stone in stones)
        # row by row, from the far one: a stone that is held does not show where it stood
        aims = tuple(aim_at(stone, place) for stone, place in zip(stones, free, strict=False))
        command = f"bring all {color} stones to the left side of the board, into columns 0 and 1"
        return Case((command,), (plan,), aims, (other_color(color),))


TASKS: tuple[Task, ...] = (
    RemoveColor(),
    RemoveAt(),
    Swap(),
    Push("to the left", 0, -1),
    Push("to the right", 0, 1),
    Push("towards the far edge", -1, 0),
    Push("towards the near edge", 1, 0),
    ClearRow(),
    Gather(),
)
# 1.1: a push says its place, a swap its colours; the expert gathers row by row
SUITE = command_suite(TASKS, max_steps=170, num_goals=MAX_MOVED, version="1.1")
