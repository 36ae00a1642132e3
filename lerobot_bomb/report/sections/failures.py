"""Section `failures`: why episodes failed."""

from collections import Counter

from lerobot_bomb.evaluation.bomb_lines import is_grounded, put_down
from lerobot_bomb.evaluation.result_groups import by_condition
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import count, rate
from lerobot_bomb.report.table import Cell, Section, Table


def section(report: Report) -> Section:
    """A table for each arm."""
    return Section("Why episodes failed", [failures(arm) for arm in report.arms])


def failures(arm: Arm) -> Table:
    """Count each class of failure, by condition."""
    classes = Counter(row["failure"] for row in arm.rows if row["failure"] is not None)
    names = [name for name, _ in classes.most_common()]
    is_placed = all(row.get("target") is not None for row in arm.rows)
    table = []
    for condition, rows in by_condition(arm.rows).items():
        counted = Counter(row["failure"] for row in rows)
        cells = [count(counted[name], len(rows)) for name in names]
        if is_placed:
            down = put_down(rows)
            cells += [rate(down, is_grounded), rate([row for row in down if is_grounded(row)])]
        table.append([Cell(condition), Cell(str(len(rows)), len(rows)), *cells])
    split_names = ["right intersection", "success there"] if is_placed else []
    note = (
        "Right intersection: of the stones that were put down on the board, how many lie nearest to the "
        "intersection that was named; success there: of those, how many lie within the tolerance, with no "
        "other stone moved."
    )
    header = ["condition", "episodes", *names, *split_names]
    return Table(arm.name, header, table, note if is_placed else "")
