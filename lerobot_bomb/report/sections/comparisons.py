"""Section `comparisons`: two policies on the same episodes."""

from collections.abc import Iterable
from itertools import combinations

from lerobot_bomb.evaluation.comparison import compare
from lerobot_bomb.evaluation.paired import describe_test
from lerobot_bomb.report.arms import Arm, Report, policies_of
from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.table import Cell, Section, Table

NOTE = (
    "Points: difference in percentage points, with Newcombe's 95 % interval for pairs, an approximation; "
    "p: {test}. With few pairs they may disagree: then trust p."
)


def section(report: Report) -> Section:
    """A table for each pair of policies."""
    return Section("Two policies on the same episodes", list(comparisons(report.arms)))


def comparisons(arms: list[Arm]) -> Iterable[Table]:
    """Yield a table for each pair of policies whose episodes differ in nothing else."""
    for first, second in combinations(policies_of(arms), 2):
        try:
            found = compare(first.rows, second.rows)
        except ValueError:  # no episode in common
            continue
        table = [
            [
                Cell(each.condition),
                rate([a for a, _ in each.pairs]),
                rate([b for _, b in each.pairs]),
                *points(each),
                Cell(str(len(each.pairs)), len(each.pairs)),
            ]
            for each in found.conditions
        ]
        note = NOTE.format(test=describe_test(len(found.conditions)))
        title = f"A: {first.name}; B: {second.name}"
        yield Table(title, ["condition", "A", "B", "B - A, points", "p", "pairs"], table, note)
