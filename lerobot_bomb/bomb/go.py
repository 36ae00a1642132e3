"""The rules of Go that an episode needs: legal positions and legal moves."""

from collections.abc import Mapping

from lerobot_bomb.bomb.board import BOARD, Intersection


def is_legal_position(stones: Mapping[Intersection, str]) -> bool:
    """Return True if every group in {(row, column): colour} has a liberty."""
    return all(_has_liberty(stones, intersection) for intersection in stones)


def is_legal_move(stones: Mapping[Intersection, str], intersection: Intersection, color: str) -> bool:
    """Return True if a move is legal: its intersection is free, and it captures or is no suicide."""
    if intersection in stones:
        return False
    after = {**stones, intersection: color}
    captures = any(
        after.get(other, color) != color and not _has_liberty(after, other) for other in near(intersection)
    )
    return captures or _has_liberty(after, intersection)


def near(intersection: Intersection) -> list[Intersection]:
    """Return the intersections beside this one."""
    row, column = intersection
    intersections = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
    return [(r, c) for r, c in intersections if 0 <= r < BOARD.num_lines and 0 <= c < BOARD.num_lines]


def group_of(stones: Mapping[Intersection, str], intersection: Intersection) -> set[Intersection]:
    """Return the intersections of the group that the stone on `intersection` belongs to."""
    group, frontier = {intersection}, [intersection]
    while frontier:
        for other in near(frontier.pop()):
            if stones.get(other) == stones[intersection] and other not in group:
                group.add(other)
                frontier.append(other)
    return group


def liberties_of(stones: Mapping[Intersection, str], intersection: Intersection) -> set[Intersection]:
    """Free intersections that touch the group of the stone on `intersection`."""
    return {
        other for member in group_of(stones, intersection) for other in near(member) if other not in stones
    }


def _has_liberty(stones: Mapping[Intersection, str], intersection: Intersection) -> bool:
    return bool(liberties_of(stones, intersection))
