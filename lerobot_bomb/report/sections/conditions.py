"""Success under each condition, and what it costs."""

from lerobot_bomb.evaluation.result_groups import by_condition, count_pairs, pair_with_nominal
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.stats import holm

TITLE = "Success by condition"


def section(report: Report) -> Section:
    """A table for each arm."""
    return Section(TITLE, [conditions(arm) for arm in report.arms])


def conditions(arm: Arm) -> Table:
    """Success under each condition, and what it costs against the same episodes unperturbed."""
    pairs = pair_with_nominal(arm.rows)
    counts = {condition: count_pairs(of) for condition, of in pairs.items()}
    adjusted = dict(zip(counts, holm([each.p_value for each in counts.values()]), strict=True))
    costs = {condition: points(counts[condition], adjusted[condition]) for condition in counts}
    blank = [Cell(""), Cell("")] if counts else []
    table = [
        [Cell(condition), rate(rows), Cell(str(len(rows)), len(rows)), *costs.get(condition, blank)]
        for condition, rows in by_condition(arm.rows).items()
    ]
    note = (
        "Points: difference in percentage points from the same episodes unperturbed, with Newcombe's 95 % "
        "interval for pairs; p: exact McNemar test, adjusted for the number of conditions (Holm)."
    )
    header = ["condition", "success", "episodes", *(["points", "p"] if counts else [])]
    return Table(arm.name, header, table, note if counts else "")
