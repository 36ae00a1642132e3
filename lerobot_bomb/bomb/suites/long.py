"""Suite `long`: two to eight moves, from one instruction or turn by turn."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, Intersection
from lerobot_bomb.bomb.commands import (
    INTERSECTIONS,
    TRAY_XY_M,
    Case,
    Task,
    TaskInstance,
    command_suite,
    draw_intersections,
    draw_stones,
    is_graspable,
    other_color,
)
from lerobot_bomb.bomb.go import group_of, is_legal_move, is_legal_position, liberties_of, near
from lerobot_bomb.bomb.move import TRAY, Aim, Move, Plan, aim_at, in_order, one_move

MAX_MOVES = 8
MAX_OTHERS = 3  # stones on the board that an opening has nothing to do with
MAX_CAPTURED = 2
MAX_FILLED = 4
EDGE_COLUMNS = 0, BOARD.num_lines - 1  # of captured stones: fingers go down beside one neighbour at most


def _in_turn(first: int, number: int) -> tuple[str, ...]:
    """Return this number of colours in turn, beginning with the first or the second of COLORS."""
    return tuple(COLORS[(first + i) % 2] for i in range(number))


def _shuffled(rng: np.random.Generator, colors: tuple[str, ...]) -> tuple[str, ...]:
    """Draw an order of these colours: the stones of the tray, row by row."""
    return tuple(colors[i] for i in rng.permutation(len(colors)))


def _supply_plan(
    drawn: TaskInstance, moves: list[tuple[str, Intersection]], is_ordered: bool
) -> tuple[Plan, tuple[Aim, ...]]:
    """Plan moves of stones from the tray to these intersections; any stone of the colour will do.

    The expert takes the first of them in the tray, row by row from the far one.
    """
    of_color = {
        color: frozenset(i for i, other in enumerate(drawn.supply) if other == color) for color in COLORS
    }
    plan = tuple(
        Move(of_color[color], frozenset([intersection]), frozenset(range(number if is_ordered else 0)))
        for number, (color, intersection) in enumerate(moves)
    )
    left = {color: sorted(stones) for color, stones in of_color.items()}
    return plan, tuple(aim_at(left[color].pop(0), intersection) for color, intersection in moves)


@dataclass(frozen=True)
class Opening(Task):
    """Task: play stones from the tray, colours in turn, from one instruction or from one for each move."""

    num_moves: int
    is_by_turns: bool

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        first = int(rng.integers(len(COLORS)))
        supply = _shuffled(rng, _in_turn(first, self.num_moves))
        max_others = min(MAX_OTHERS, NUM_STONES - self.num_moves)
        others = draw_stones(rng, int(rng.integers(max_others + 1)))
        intersections = draw_intersections(
            rng,
            self.num_moves,
            [intersection for intersection in INTERSECTIONS if intersection not in others],
        )
        return TaskInstance(
            (first, *(line for intersection in intersections for line in intersection)), others, supply
        )

    def case(self, drawn: TaskInstance) -> Case | None:
        lines = drawn.about[1:]
        intersections = list(zip(lines[::2], lines[1::2], strict=True))
        colors = _in_turn(drawn.about[0], self.num_moves)
        if Counter(drawn.supply) != Counter(colors) or drawn.pattern:
            return None
        moves = list(zip(colors, intersections, strict=True))
        stones = dict(drawn.stones)
        for color, intersection in moves:
            if not is_legal_move(stones, intersection, color):
                return None
            stones[intersection] = color
            if not is_legal_position(stones):
                return None  # a capture
        plan, aims = _supply_plan(drawn, moves, is_ordered=True)
        said = [f"{color} at row {row}, column {column}" for color, (row, column) in moves]
        if self.is_by_turns:
            return Case(tuple(f"play {move}" for move in said), (plan,), aims)
        return Case((f"play these moves one after the other: {'; '.join(said)}",), (plan,), aims)


@dataclass(frozen=True)
class FillRow(Task):
    """Task: fill the free intersections of a row from left to right, colours in turn.

    The instruction names the last stone's colour, which stays true however many stones are placed.
    """

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        last, row = int(rng.integers(len(COLORS))), int(rng.integers(BOARD.num_lines))
        stones = draw_stones(rng, int(rng.integers(2, 6)))
        free = [
            intersection
            for intersection in INTERSECTIONS
            if intersection[0] == row and intersection not in stones
        ]
        return TaskInstance((last, row), stones, _shuffled(rng, _in_turn(last, len(free))))

    def case(self, drawn: TaskInstance) -> Case | None:
        last, row = drawn.about
        intersections = [
            intersection
            for intersection in INTERSECTIONS
            if intersection[0] == row and intersection not in drawn.stones
        ]
        colors = _in_turn(last, len(intersections))[::-1]
        if (
            Counter(drawn.supply) != Counter(colors)
            or not 2 <= len(intersections) <= MAX_FILLED
            or drawn.pattern
        ):
            return None
        moves = list(zip(colors, intersections, strict=True))
        if not is_legal_position(dict(drawn.stones) | {intersection: color for color, intersection in moves}):
            return None
        plan, aims = _supply_plan(drawn, moves, is_ordered=True)
        command = (
            f"fill the free intersections of row {row} from left to right, the colours in turn, "
            f"{colors[-1]} last"
        )
        return Case((command,), (plan,), aims)


@dataclass(frozen=True)
class Capture(Task):
    """Task: take the last liberty of a group, and put its stones into the tray."""

    size: int

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        color = int(rng.integers(len(COLORS)))
        row, column = int(rng.integers(BOARD.num_lines)), EDGE_COLUMNS[rng.integers(len(EDGE_COLUMNS))]
        group = [(row + i, column) for i in range(self.size)]
        around = [
            intersection
            for intersection in INTERSECTIONS
            if intersection not in group and any(intersection in near(c) for c in group)
        ]
        liberty = around[rng.integers(len(around))]
        stones = dict.fromkeys(
            (intersection for intersection in group if intersection in INTERSECTIONS), COLORS[color]
        )
        stones |= {
            intersection: other_color(COLORS[color]) for intersection in around if intersection != liberty
        }
        free = [
            intersection
            for intersection in INTERSECTIONS
            if intersection not in stones and intersection != liberty
        ]
        stones |= draw_stones(rng, int(rng.integers(3)), free)
        return TaskInstance((color, *group[0]), stones, (other_color(COLORS[color]),))

    def case(self, drawn: TaskInstance) -> Case | None:
        color, stones = COLORS[drawn.about[0]], drawn.stones
        if drawn.supply != (other_color(color),) or (drawn.about[1], drawn.about[2]) not in stones:
            return None
        groups = {
            frozenset(group_of(dict(stones), intersection))
            for intersection, other in stones.items()
            if other == color
        }
        in_atari = [group for group in groups if len(liberties_of(dict(stones), min(group))) == 1]
        if len(in_atari) != 1 or len(in_atari[0]) != self.size:
            return None
        captured = sorted(in_atari[0])
        if captured[0] != (drawn.about[1], drawn.about[2]) or not {c for _, c in captured} <= {*EDGE_COLUMNS}:
            return None
        (intersection,) = liberties_of(dict(stones), captured[0])
        after = {place: other for place, other in stones.items() if place not in captured}
        if not is_legal_position(after | {intersection: drawn.supply[0]}):
            return None
        played, aims = _supply_plan(drawn, [(drawn.supply[0], intersection)], is_ordered=True)
        taken = [drawn.stone_on(place) for place in captured]
        plan = (*played, *(Move(frozenset([stone]), frozenset([TRAY]), frozenset([0])) for stone in taken))
        aims += tuple(Aim(stone, xy) for stone, xy in zip(taken, TRAY_XY_M, strict=False))
        what = f"the {color} stone" if self.size == 1 else f"the {self.size} {color} stones"
        command = (
            f"capture {what} with one liberty left: play {drawn.supply[0]} there, then put what is captured "
            "in the tray"
        )
        return Case((command,), (plan,), aims)


@dataclass(frozen=True)
class TakeBack(Task):
    """Task: undo the last two moves, the later one first."""

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        stones = draw_stones(rng, int(rng.integers(2, 7)))
        a, b = [list(stones)[i] for i in rng.permutation(len(stones))[:2]]
        return TaskInstance((*a, *b), stones)

    def case(self, drawn: TaskInstance) -> Case | None:
        a, b = (drawn.about[0], drawn.about[1]), (drawn.about[2], drawn.about[3])
        stones = drawn.stones
        if drawn.supply or not {a, b} <= stones.keys() or stones[a] == stones[b]:
            return None
        if not is_graspable(stones, a) or not is_graspable(stones, b):
            return None
        plan = in_order(*(one_move(drawn.stone_on(intersection), [TRAY]) for intersection in (b, a)))
        aims = tuple(
            Aim(drawn.stone_on(intersection), xy) for intersection, xy in zip((b, a), TRAY_XY_M, strict=False)
        )
        command = (
            f"take back the last two moves, the later one first: {stones[a]} played at row {a[0]}, column "
            f"{a[1]}, then {stones[b]} at row {b[0]}, column {b[1]}; put both stones in the tray"
        )
        return Case((command,), (plan,), aims)


@dataclass(frozen=True)
class CopyPattern(Task):
    """Task: build on the board what the small board in the tray shows."""

    num_stones: int

    def draw(self, rng: np.random.Generator) -> TaskInstance:
        first = int(rng.integers(len(COLORS)))
        colors = _in_turn(first, self.num_stones)
        intersections = draw_intersections(rng, self.num_stones)
        pattern = dict(zip(intersections, colors, strict=True))
        return TaskInstance((first, *intersections[0]), {}, _shuffled(rng, colors), pattern)

    def case(self, drawn: TaskInstance) -> Case | None:
        if len(drawn.pattern) != self.num_stones or set(drawn.pattern) & set(drawn.stones):
            return None
        if Counter(drawn.supply) != Counter(drawn.pattern.values()):
            return None
        if not is_legal_position(dict(drawn.stones) | dict(drawn.pattern)):
            return None
        moves = [(color, intersection) for intersection, color in sorted(drawn.pattern.items())]
        plan, aims = _supply_plan(drawn, moves, is_ordered=False)
        return Case(("copy the pattern of the small board onto the large one",), (plan,), aims)


TASKS: tuple[Task, ...] = (
    *(Opening(number, is_by_turns=False) for number in (2, 3, 4)),
    *(Opening(number, is_by_turns=True) for number in (2, 4, 8)),
    FillRow(),
    *(Capture(size) for size in (1, MAX_CAPTURED)),
    TakeBack(),
    *(CopyPattern(number) for number in (2, 3, 4)),
)
# 1.1: of equal stones the expert takes the first in the tray; it copies row by row, and waits for moves that
# no instruction has named yet; a row is filled up to the last stone's colour
SUITE = command_suite(TASKS, max_steps=440, num_goals=MAX_MOVES, version="1.1")
