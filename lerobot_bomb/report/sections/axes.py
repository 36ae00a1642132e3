"""Success by axis and level."""

from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.groups import Group
from lerobot_bomb.results.record import Record

NOTE = f"A column for each level of the axis; 0: unperturbed. With {INTERVALS}."


def section(report: Report) -> Section:
    """Write the section: a table for each group in which an axis was on alone."""
    return Section("Axis by level", [table for group in report.groups if (table := axes(group))])


def axes(group: Group) -> Table | None:
    """Write the table of success by axis and level, of records with one axis on; None without any."""
    cells: dict[tuple[str, int], list[Record]] = {}
    for record in group.records:
        if len(record.levels) == 1:
            cells.setdefault(next(iter(record.levels.items())), []).append(record)
    if not cells:
        return None
    names = list(dict.fromkeys(axis for axis, _ in cells))
    levels = [level for level in range(1, MAX_LEVEL + 1) if any(recorded == level for _, recorded in cells)]
    zero = [rate(group.nominal)] if group.nominal else []
    table = [[Cell(axis), *zero, *(rate(cells.get((axis, level), [])) for level in levels)] for axis in names]
    return Table(group.name, ["axis", *(["0"] if zero else []), *map(str, levels)], table, NOTE)
