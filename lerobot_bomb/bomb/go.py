"""The rules of Go that an episode needs: is a position legal, is a move legal."""

from lerobot_bomb.bomb.board import BOARD, Cell


def is_legal_position(stones: dict[Cell, str]) -> bool:
    """Whether every group in {(row, column): colour} has a liberty."""
    return all(_has_liberty(stones, cell) for cell in stones)


def is_legal_move(stones: dict[Cell, str], cell: Cell, color: str) -> bool:
    """Whether `color` may play on `cell`: it is free, and the move captures or is no suicide."""
    if cell in stones:
        return False
    after = {**stones, cell: color}
    captures = any(after.get(near, color) != color and not _has_liberty(after, near) for near in _near(cell))
    return captures or _has_liberty(after, cell)


def _near(cell: Cell) -> list[Cell]:
    row, column = cell
    cells = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
    return [(r, c) for r, c in cells if 0 <= r < BOARD.num_lines and 0 <= c < BOARD.num_lines]


def _has_liberty(stones: dict[Cell, str], cell: Cell) -> bool:
    """Whether the group of the stone on `cell` touches a free intersection."""
    group, frontier = {cell}, [cell]
    while frontier:
        for near in _near(frontier.pop()):
            if near not in stones:
                return True
            if stones[near] == stones[cell] and near not in group:
                group.add(near)
                frontier.append(near)
    return False
