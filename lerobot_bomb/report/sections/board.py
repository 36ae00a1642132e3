"""Section `board`: where on the board stones should go, and where they lie."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.report.cells import rate
from lerobot_bomb.report.chart import INK, MAX_SERIES, Chart, chart_text, draw
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.bomb import EpisodeResult, is_grounded, put_down
from lerobot_bomb.results.groups import Group, rate_of
from lerobot_bomb.stats import Rate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "The board"
SIZE = BOARD.num_lines
BOARD_INCHES = 2.4
BLUE, RED = "#0072b2", "#d55e00"
SUCCESS_TITLE = "Success by intersection that was named, per cent"
MISSED_TITLE = "Stones put down nearest to another intersection than their target"
MISSED_NOTE = (
    "An arrow leads from the target to the intersection to which the stone lies nearest, with the number of "
    "such stones beside it. Row 0 is the far row. Policies without an arrow have no such stone."
)
MAX_WIDE = 5  # stones of the widest arrow
type Intersection = tuple[int, int]


@dataclass(frozen=True)
class BoardResults:
    """Episodes of a group with one target each."""

    name: str
    records: list[EpisodeResult]

    @cached_property
    def rates(self) -> dict[Intersection, Rate]:
        """Rate of success by target."""
        by_target: dict[Intersection, list[EpisodeResult]] = {}
        for each in self.records:
            by_target.setdefault(_target(each), []).append(each)
        return {target: rate_of(records) for target, records in sorted(by_target.items())}

    @cached_property
    def missed(self) -> Counter[tuple[Intersection, Intersection]]:
        """Number of stones by target and intersection where they lie, if it is another one."""
        missed = [each for each in put_down(self.records) if not is_grounded(each)]
        return Counter((_target(each), each.nearest_intersection) for each in missed)


def _target(record: EpisodeResult) -> Intersection:
    assert record.target is not None
    return record.target


def section(report: Report) -> Section:
    """Write the section: a board of successes, and one of misplaced stones, for each group."""
    boards = [board for group in report.groups if (board := _board(report.label(group), group)).records]
    if not boards:
        return Section(TITLE, [])
    shown = boards[:MAX_SERIES]
    left = f" Shown: the first {len(shown)}; the numbers are of all." if len(boards) > len(shown) else ""
    charts = [Chart(SUCCESS_TITLE, _draw(SUCCESS_TITLE, shown, _paint_rates), [_rates(boards)], left.strip())]
    if any(each.missed for each in boards):
        svg = _draw(MISSED_TITLE, [each for each in shown if each.missed] or shown, _paint_missed)
        charts.append(Chart(MISSED_TITLE, svg, [_missed(boards)], MISSED_NOTE + left))
    return Section(TITLE, [], charts=charts)


def _board(name: str, group: Group) -> BoardResults:
    records = [each for each in group.records if isinstance(each, EpisodeResult) and each.target is not None]
    return BoardResults(name, records)


def _rates(boards: Sequence[BoardResults]) -> Table:
    rows = [
        [Cell(board.name), *map(_place_cell, target), rate([r for r in board.records if r.target == target])]
        for board in boards
        for target in board.rates
    ]
    return Table("", ["policy, suite", "row", "column", "success"], rows)


def _missed(boards: Sequence[BoardResults]) -> Table:
    rows = [
        [Cell(board.name), *map(_place_cell, (*target, *place)), Cell(str(number), number)]
        for board in boards
        for (target, place), number in board.missed.most_common()
    ]
    header = ["policy, suite", "row", "column", "lies in row", "lies in column", "stones"]
    return Table("", header, rows)


def _place_cell(line: int) -> Cell:
    return Cell(str(line), line)


def _draw(title: str, boards: Sequence[BoardResults], paint_board: Any) -> str:
    columns = min(len(boards), 3)
    rows = -(-len(boards) // columns)

    def paint(figure: "Figure") -> None:
        grid = figure.subplots(rows, columns, squeeze=False).flatten()
        for axes, board in zip(grid, boards, strict=False):
            _paint_lines(axes, board.name)
            paint_board(axes, board)
        for axes in grid[len(boards) :]:
            axes.set_axis_off()

    return draw(title, (columns * (BOARD_INCHES + 0.5), rows * (BOARD_INCHES + 0.4)), paint)


def _paint_lines(axes: "Axes", name: str) -> None:
    """Draw the lines of an empty board, row 0 on top."""
    axes.set_title(chart_text(name), loc="left")
    axes.set_aspect("equal")
    for line in range(SIZE):
        axes.plot([0, SIZE - 1], [line, line], color=INK, linewidth=0.6, alpha=0.35, zorder=1)
        axes.plot([line, line], [0, SIZE - 1], color=INK, linewidth=0.6, alpha=0.35, zorder=1)
    axes.set_xlim(-0.6, SIZE - 0.4)
    axes.set_ylim(SIZE - 0.4, -0.6)
    axes.set_xticks(range(SIZE), [str(line) for line in range(SIZE)])
    axes.set_yticks(range(SIZE), [str(line) for line in range(SIZE)])
    axes.set_xlabel("column")
    axes.set_ylabel("row")
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _paint_rates(axes: "Axes", board: BoardResults) -> None:
    for (row, column), found in board.rates.items():
        axes.scatter(column, row, s=420, color=BLUE, alpha=0.1 + 0.5 * found.share, linewidth=0, zorder=2)
        axes.text(column, row, f"{100 * found.share:.0f}", ha="center", va="center", zorder=3)


def _paint_missed(axes: "Axes", board: BoardResults) -> None:
    arrow = {
        "arrowstyle": "-|>",
        "color": RED,
        "shrinkA": 2,
        "shrinkB": 5,
        "connectionstyle": "arc3,rad=0.15",
    }
    for ((row, column), (to_row, to_column)), number in board.missed.items():
        width = 0.6 + 0.6 * min(number, MAX_WIDE)
        axes.annotate(
            "", (to_column, to_row), (column, row), arrowprops=arrow | {"linewidth": width}, zorder=2
        )
        axes.plot([column], [row], "o", color=INK, markersize=2.5, zorder=3)
        x, y = (column + to_column) / 2, (row + to_row) / 2
        axes.text(x + 0.16, y - 0.1, str(number), color=RED, fontweight="bold", zorder=4)
