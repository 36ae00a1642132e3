"""Success under each condition, and what it costs."""

from lerobot_bomb.evaluation.paired import compare_pairs, describe_test
from lerobot_bomb.evaluation.result_groups import by_condition, pair_with_nominal
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import INTERVALS, points, rate
from lerobot_bomb.report.table import Cell, Section, Table

TITLE = "Success by condition"


def section(report: Report) -> Section:
    """A table for each arm."""
    return Section(TITLE, [conditions(arm) for arm in report.arms])


def conditions(arm: Arm) -> Table:
    """Success under each condition, and what it costs against the same episodes unperturbed."""
    compared = compare_pairs(pair_with_nominal(arm.rows))
    costs = {each.condition: points(each) for each in compared}
    blank = [Cell(""), Cell("")] if compared else []
    table = [
        [Cell(condition), rate(rows), Cell(str(len(rows)), len(rows)), *costs.get(condition, blank)]
        for condition, rows in by_condition(arm.rows).items()
    ]
    note = f"Success in per cent, with {INTERVALS}."
    if compared:
        note += (
            " Points: difference in percentage points from the same episodes unperturbed, with Newcombe's "
            f"95 % interval for pairs; p: {describe_test(len(compared))}."
        )
    header = ["condition", "success", "episodes", *(["points", "p"] if compared else [])]
    return Table(arm.name, header, table, note)
