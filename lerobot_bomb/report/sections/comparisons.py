"""Two policies on the same episodes."""

from collections.abc import Iterable
from itertools import combinations

from lerobot_bomb.evaluation.comparison import POLICY, compare
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.table import Cell, Section, Table

NOTE = (
    "Points: difference in percentage points, with Newcombe's 95 % interval for pairs, an approximation; "
    "p: exact McNemar test, adjusted for the number of conditions (Holm). With few pairs they may disagree: "
    "then trust p."
)


def section(report: Report) -> Section:
    """A table for each pair of policies."""
    return Section("Two policies on the same episodes", list(comparisons(report.arms)))


def comparisons(arms: list[Arm]) -> Iterable[Table]:
    """Each pair of policies whose episodes differ in nothing else."""
    for first, second in combinations(arms, 2):
        if first.group.settings[POLICY] == second.group.settings[POLICY]:
            continue
        try:
            found = compare(first.rows, second.rows)
        except ValueError:  # no episode in common
            continue
        table = [
            [
                Cell(each.condition),
                rate([a for a, _ in each.pairs]),
                rate([b for _, b in each.pairs]),
                *points(each.counts, each.p_value),
                Cell(str(len(each.pairs)), len(each.pairs)),
            ]
            for each in found.conditions
        ]
        title = f"A: {first.name}; B: {second.name}"
        yield Table(title, ["condition", "A", "B", "B - A, points", "p", "pairs"], table, NOTE)
