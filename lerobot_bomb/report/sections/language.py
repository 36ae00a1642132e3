"""Section `language`: the same episodes under another instruction, to see if a policy reads its own."""

from collections.abc import Iterable

from lerobot_bomb.checkpoints.names import REPLACE_TASKS
from lerobot_bomb.report.cells import points, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.bomb import are_placed, is_grounded, put_down
from lerobot_bomb.results.comparison import compare
from lerobot_bomb.results.groups import Policy, policies_of
from lerobot_bomb.results.pairs import describe_test
from lerobot_bomb.results.record import Record

TITLE = "Language use"
NOTE = (
    "The same episodes and weights, but the policy is given another instruction than the episode's. Both are "
    "judged by the episode's, so a policy that reads loses its success, and puts the stone elsewhere. "
    "p: {test}."
)


def section(report: Report) -> Section:
    """Write a table for each policy with other instructions, beside the policy with its own."""
    policies = policies_of(report.groups)
    tables = [
        table
        for own in policies
        if not _interventions(own)
        for other in policies
        if _interventions(other) == [REPLACE_TASKS] and _differ_in_processors(own, other)
        for table in _tables(own, other)
    ]
    return Section(TITLE, tables)


def _tables(own: Policy, other: Policy) -> Iterable[Table]:
    try:
        found = compare(own.records, other.records)
    except ValueError:  # no episode in common
        return
    is_placed = are_placed([record for each in found.conditions for pair in each.pairs for record in pair])
    table = []
    for each in found.conditions:
        told, told_other = (list(records) for records in zip(*each.pairs, strict=True))
        cells = [rate(told), rate(told_other), *points(each)]
        cells += [_grounding(told), _grounding(told_other)] if is_placed else []
        table.append([Cell(each.condition), *cells, Cell(str(len(each.pairs)), len(each.pairs))])
    grounding = ["right intersection, its own", "right intersection, another"] if is_placed else []
    header = ["condition", "its own", "another", "points", "p", *grounding, "pairs"]
    note = NOTE.format(test=describe_test(found.conditions))
    yield Table(f"{own.name}; with another instruction: {other.name}", header, table, note)


def _grounding(records: list[Record]) -> Cell:
    return rate(put_down(records), is_grounded)


def _interventions(reported: Policy) -> list[str]:
    policy = reported.records[0].policy
    return [] if policy is None else list(policy.interventions)


def _differ_in_processors(reported: Policy, reported_too: Policy) -> bool:
    """Return True for the same weights with the same config, which earlier releases did not record."""
    policy, other = (each.records[0].policy for each in (reported, reported_too))
    if policy is None or other is None or policy.weights_sha256 is None:
        return False
    is_recorded = None not in (policy.config_sha256, other.config_sha256)
    return policy.weights_sha256 == other.weights_sha256 and (
        not is_recorded or policy.config_sha256 == other.config_sha256
    )
