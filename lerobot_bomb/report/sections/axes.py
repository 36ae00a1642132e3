"""Success by axis and level."""

from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.envs.results import Row
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.table import Cell, Section, Table

NOTE = f"A column for each level of the axis; 0: unperturbed. With {INTERVALS}."


def section(report: Report) -> Section:
    """A table for each arm in which an axis was on alone."""
    return Section("Axis by level", [table for arm in report.arms if (table := axes(arm))])


def axes(arm: Arm) -> Table | None:
    """Success by axis and level, where one axis was on; None: nowhere. Drawn levels count at their own."""
    cells: dict[tuple[str, int], list[Row]] = {}
    for row in arm.rows:
        if len(row["levels"]) == 1:
            cells.setdefault(next(iter(row["levels"].items())), []).append(row)
    if not cells:
        return None
    names = list(dict.fromkeys(axis for axis, _ in cells))
    levels = [level for level in range(1, MAX_LEVEL + 1) if any(of == level for _, of in cells)]
    zero = [rate(arm.nominal)] if arm.nominal else []
    table = [[Cell(axis), *zero, *(rate(cells.get((axis, level), [])) for level in levels)] for axis in names]
    return Table(arm.name, ["axis", *(["0"] if zero else []), *map(str, levels)], table, NOTE)
