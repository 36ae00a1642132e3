"""Section `comparisons`: two policies on the same episodes."""

from itertools import combinations

from lerobot_bomb.report.cells import PAIRED_INTERVAL, points, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.comparison import Comparisons
from lerobot_bomb.results.pairs import are_clustered, describe_test

TITLE = "Two policies on the same episodes"
MAX_PAIRS = 10  # of policies that are all compared
NOTE = f"Points: difference in percentage points, with {PAIRED_INTERVAL}, an approximation; p: {{test}}."


def section(report: Report) -> Section:
    """Write the section: a table for each pair of policies, or with many for each beside the best."""
    pairs = list(combinations(report.policies, 2))
    if len(pairs) > MAX_PAIRS:
        best = report.panels[0].ranked[0].policy
        pairs = [(best, each) for each in report.policies if each != best]
    tables = [_table(*pair, found) for pair in pairs if (found := report.compared(*pair))]
    return Section(TITLE, tables, is_folded=True)


def _table(first: str, second: str, found: Comparisons) -> Table:
    rows = [
        [
            Cell(each.condition),
            rate([a for a, _ in each.pairs]),
            rate([b for _, b in each.pairs]),
            *points(each),
            Cell(str(len(each.pairs)), len(each.pairs)),
        ]
        for each in found.conditions
    ]
    note = NOTE.format(test=describe_test(found.conditions))
    if not are_clustered(found.conditions):
        note += " With few pairs they may disagree: then trust p."
    header = ["condition", "A", "B", "B - A, points", "p", "pairs"]
    return Table(f"A: {first}; B: {second}", header, rows, note)
