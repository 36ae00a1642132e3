"""Section `summary`: the results at a glance."""

from collections.abc import Iterator

from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.comparison import can_compare
from lerobot_bomb.results.groups import Group, by_condition, rate_of
from lerobot_bomb.results.record import NO_VALUE, Measure, Record

HEADER = [
    "policy, suite", "unperturbed", "perturbed, all conditions", "worst condition", "its success", "measures",
    "episodes",
]  # fmt: skip
NOTE = (
    f"Success in per cent, with {INTERVALS}: the conditions of one seed are no independent episodes. "
    "Perturbed, worst condition: of the episodes that all policies have which compare here; the worst is "
    "the lowest rate that was seen, and its interval does not allow for the choice. Measures: of the "
    "unperturbed episodes, if any"
)


def section(report: Report) -> Section:
    """Write a line for each group; below, missing episodes and comparisons that do not hold."""
    shared = [_shared(group, _peers(group, report.groups)) for group in report.groups]
    lines = [*report.missing, *_left_out(report.groups, shared), *_other_nominal(report.groups)]
    return Section("Summary", [_summary(report.groups, shared)], lines)


def _summary(groups: list[Group], shared_records: list[list[Record]]) -> Table:
    table, notes = [], dict[str, str]()
    for group, shared in zip(groups, shared_records, strict=True):
        measures = _measures(group)
        notes |= {measure.name: measure.note for measure, _ in measures}
        table.append(
            [
                Cell(group.name),
                rate(group.nominal),
                rate(shared),
                *_worst(shared),
                Cell(", ".join(f"{measure.name} {value}" for measure, value in measures)),
                Cell(str(len(group.records)), len(group.records)),
            ]
        )
    explained = [f"{name}: {note}" for name, note in notes.items() if note]
    return Table("", HEADER, table, f"{'; '.join([NOTE, *explained])}.")


def _peers(group: Group, groups: list[Group]) -> list[Group]:
    """Return the other groups that differ from this one in the policy only."""
    return [other for other in groups if other is not group and can_compare(group, other)]


def _shared(group: Group, peers: list[Group]) -> list[Record]:
    """Return the group's perturbed records whose episodes all peers with perturbed records have too."""
    records = group.perturbed
    for peer in peers:
        episodes = {each.spec for each in peer.perturbed}
        records = [each for each in records if not episodes or each.spec in episodes]
    return records


def _worst(records: list[Record]) -> list[Cell]:
    """Return the condition with the lowest rate, and that rate; all such conditions if several tie."""
    by = by_condition(records)
    rates = {condition: rate_of(condition_records).share for condition, condition_records in by.items()}
    worst = [condition for condition, share in rates.items() if share == min(rates.values())]
    if not worst:
        return [Cell("-"), Cell("-")]
    if len(worst) == 1:
        return [Cell(worst[0]), rate(by[worst[0]])]
    names = f"all {len(worst)} alike" if len(worst) == len(rates) else f"tie: {', '.join(worst)}"
    share = rates[worst[0]]
    return [Cell(names, worst), Cell(f"{100 * share:.0f} %", share, share)]


def _left_out(groups: list[Group], shared_records: list[list[Record]]) -> Iterator[str]:
    """Yield a line for each group that has perturbed records which its peers lack."""
    for group, shared in zip(groups, shared_records, strict=True):
        if num_left := len(group.perturbed) - len(shared):
            yield f"{group.name}: {num_left} perturbed episodes are left out, which not all policies have"


def _other_nominal(groups: list[Group]) -> Iterator[str]:
    """Yield a line for each group whose unperturbed records are of other episodes than those of its peers."""
    for group in groups:
        if peers := [peer for peer in _peers(group, groups) if peer.nominal]:
            own = {each.spec for each in group.nominal}
            if own and any(own != {each.spec for each in peer.nominal} for peer in peers):
                yield f"{group.name}: other policies have other unperturbed episodes; pairs compare below"


def _measures(group: Group) -> list[tuple[Measure, str]]:
    """Return the measures that have a value for the group's episodes, with that value."""
    records = group.nominal or group.records
    values = [(measure, measure.value(records)) for measure in group.record_type.measures]
    return [(measure, value) for measure, value in values if value != NO_VALUE]
