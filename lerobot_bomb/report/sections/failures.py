"""Section `failures`: why episodes failed."""

from collections import Counter

from lerobot_bomb.report.cells import count, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.bomb import are_placed, is_grounded, put_down
from lerobot_bomb.results.groups import Group, by_condition


def section(report: Report) -> Section:
    """Write the section: a table for each group."""
    return Section("Why episodes failed", [failures(group) for group in report.groups])


def failures(group: Group) -> Table:
    """Count each class of failure, by condition."""
    classes = Counter(each.failure for each in group.records if each.failure is not None)
    names = [name for name, _ in classes.most_common()]
    is_placed = are_placed(group.records)
    table = []
    for condition, records in by_condition(group.records).items():
        counted = Counter(each.failure for each in records)
        cells = [count(counted[name], len(records)) for name in names]
        if is_placed:
            down = put_down(records)
            cells += [rate(down, is_grounded), rate([each for each in down if is_grounded(each)])]
        table.append([Cell(condition), Cell(str(len(records)), len(records)), *cells])
    split_names = ["right intersection", "success there"] if is_placed else []
    note = (
        "Right intersection: of the stones that were put down on the board, how many lie nearest to the "
        "intersection that was named; success there: of those, how many lie within the tolerance, with no "
        "other stone moved."
    )
    header = ["condition", "episodes", *names, *split_names]
    return Table(group.name, header, table, note if is_placed else "")
