"""Section `comparisons`: two policies on the same episodes."""

from collections.abc import Iterable
from itertools import combinations

from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.comparison import compare
from lerobot_bomb.results.groups import Group, policies_of
from lerobot_bomb.results.pairs import describe_test

NOTE = (
    "Points: difference in percentage points, with Newcombe's 95 % interval for pairs, an approximation; "
    "p: {test}. With few pairs they may disagree: then trust p."
)


def section(report: Report) -> Section:
    """Write the section: a table for each pair of policies."""
    return Section("Two policies on the same episodes", list(comparisons(report.groups)))


def comparisons(groups: list[Group]) -> Iterable[Table]:
    """Yield a table for each pair of policies whose episodes differ in nothing else."""
    for first, second in combinations(policies_of(groups), 2):
        try:
            found = compare(first.records, second.records)
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
