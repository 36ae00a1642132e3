"""Section `conditions`: success under each condition, and its cost."""

from lerobot_bomb.report.cells import INTERVALS, points, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.groups import Group, by_condition
from lerobot_bomb.results.pairs import compare_pairs, describe_test, pair_with_nominal

TITLE = "Success by condition"


def section(report: Report) -> Section:
    """Write the section: a table for each group."""
    return Section(TITLE, [conditions(group) for group in report.groups])


def conditions(group: Group) -> Table:
    """Write the table of success under each condition, and its cost against the same episodes unperturbed."""
    compared = compare_pairs(pair_with_nominal(group.records))
    costs = {each.condition: points(each) for each in compared}
    blank = [Cell(""), Cell("")] if compared else []
    table = [
        [Cell(condition), rate(records), Cell(str(len(records)), len(records)), *costs.get(condition, blank)]
        for condition, records in by_condition(group.records).items()
    ]
    note = f"Success in per cent, with {INTERVALS}."
    if compared:
        note += (
            " Points: difference in percentage points from the same episodes unperturbed, with Newcombe's "
            f"95 % interval for pairs; p: {describe_test(len(compared))}."
        )
    header = ["condition", "success", "episodes", *(["points", "p"] if compared else [])]
    return Table(group.name, header, table, note)
