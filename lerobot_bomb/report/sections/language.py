"""Section `language`: the same episodes under another instruction, to see if a policy reads its own."""

from collections.abc import Iterable

from lerobot_bomb.checkpoints.names import REPLACE_TASKS
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.bomb_lines import is_grounded, put_down
from lerobot_bomb.evaluation.comparison import compare
from lerobot_bomb.evaluation.paired import describe_test
from lerobot_bomb.report.arms import Policy, Report, policies_of
from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.table import Cell, Section, Table

TITLE = "Language use"
NOTE = (
    "The same episodes and weights, but the policy is told other words than the episode's. Both are judged "
    "by what the episode asked for, so a policy that reads loses its success, and puts the stone elsewhere. "
    "p: {test}."
)


def section(report: Report) -> Section:
    """A table for each policy that was told something else, beside the one that was not."""
    policies = policies_of(report.arms)
    tables = [
        table
        for own in policies
        if not _interventions(own)
        for other in policies
        if _interventions(other) == [REPLACE_TASKS] and _weights(own) == _weights(other) != ""
        for table in _tables(own, other)
    ]
    return Section(TITLE, tables)


def _tables(own: Policy, other: Policy) -> Iterable[Table]:
    try:
        found = compare(own.rows, other.rows)
    except ValueError:  # no episode in common
        return
    rows = [row for each in found.conditions for pair in each.pairs for row in pair]
    is_placed = all(row.get("target") is not None for row in rows)
    table = []
    for each in found.conditions:
        told, told_other = (list(rows) for rows in zip(*each.pairs, strict=True))
        cells = [rate(told), rate(told_other), *points(each)]
        cells += [_grounding(told), _grounding(told_other)] if is_placed else []
        table.append([Cell(each.condition), *cells, Cell(str(len(each.pairs)), len(each.pairs))])
    grounding = ["right intersection, its own", "right intersection, another"] if is_placed else []
    header = ["condition", "its own", "another", "points", "p", *grounding, "pairs"]
    note = NOTE.format(test=describe_test(len(found.conditions)))
    yield Table(f"{own.name}; told otherwise: {other.name}", header, table, note)


def _grounding(rows: list[Row]) -> Cell:
    return rate(put_down(rows), is_grounded)


def _interventions(of: Policy) -> list[str]:
    return list((of.rows[0].get("policy") or {}).get("interventions", ()))


def _weights(of: Policy) -> str:
    return (of.rows[0].get("policy") or {}).get("weights_sha256") or ""
