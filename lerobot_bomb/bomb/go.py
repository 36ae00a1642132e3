"""The rules of Go that an episode needs: is a position legal, is a move legal."""

from collections.abc import Mapping

from lerobot_bomb.bomb.board import BOARD, Intersection


def is_legal_position(stones: Mapping[Intersection, str]) -> bool:
    """Return True if every group in {(row, column): colour} has a liberty."""
    return all(_has_liberty(stones, cell) for cell in stones)


def is_legal_move(stones: Mapping[Intersection, str], cell: Intersection, color: str) -> bool:
    """Return True if `color` may play on `cell`: it is free, and the move captures or is no suicide."""
    if cell in stones:
        return False
    after = {**stones, cell: color}
    captures = any(
        after.get(other, color) != color and not _has_liberty(after, other) for other in near(cell)
    )
    return captures or _has_liberty(after, cell)


def near(cell: Intersection) -> list[Intersection]:
    """The intersections beside one."""
    row, column = cell
    cells = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
    return [(r, c) for r, c in cells if 0 <= r < BOARD.num_lines and 0 <= c < BOARD.num_lines]


def group_of(stones: Mapping[Intersection, str], cell: Intersection) -> set[Intersection]:
    """The stones that are connected with the one on `cell`, it among them."""
    group, frontier = {cell}, [cell]
    while frontier:
        for other in near(frontier.pop()):
            if stones.get(other) == stones[cell] and other not in group:
                group.add(other)
                frontier.append(other)
    return group


def liberties_of(stones: Mapping[Intersection, str], cell: Intersection) -> set[Intersection]:
    """Free intersections that touch the group of the stone on `cell`."""
    return {other for member in group_of(stones, cell) for other in near(member) if other not in stones}


def _has_liberty(stones: Mapping[Intersection, str], cell: Intersection) -> bool:
    return bool(liberties_of(stones, cell))
