"""Section `board`: where on the board stones were asked for, and where they lie."""

from collections import Counter
from collections.abc import Callable, Iterable

from lerobot_bomb.evaluation.bomb_lines import is_grounded, put_down
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import count, rate
from lerobot_bomb.report.table import Cell, Section, Table


def section(report: Report) -> Section:
    """Write the section: up to two tables for each arm."""
    return Section("The board", [table for arm in report.arms for table in boards(arm)])


def boards(arm: Arm) -> Iterable[Table]:
    """Success by intersection, and where stones were put down; of episodes with one target."""
    rows = [row for row in arm.rows if row.get("target") is not None]
    if not rows:
        return
    size = 1 + max(max(*row["target"], *row["nearest_intersection"]) for row in rows)
    header = ["row", *(f"column {column}" for column in range(size))]

    def board(title: str, cell: Callable[[list[int]], Cell]) -> Table:
        table = [[Cell(str(row)), *(cell([row, column]) for column in range(size))] for row in range(size)]
        return Table(f"{arm.name}: {title}", header, table)

    yield board(
        "success by intersection that was named", lambda at: rate([r for r in rows if r["target"] == at])
    )
    missed = [row for row in put_down(rows) if not is_grounded(row)]
    if missed:
        most = max(Counter(tuple(row["nearest_intersection"]) for row in missed).values())
        yield board(
            "where stones lie that were put down elsewhere",
            lambda at: count(sum(row["nearest_intersection"] == at for row in missed), most),
        )
