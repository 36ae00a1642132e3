"""Section `summary`: what a reviewer reads in a minute."""

from collections.abc import Iterator

from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.comparison import can_compare
from lerobot_bomb.evaluation.result_groups import by_condition, episode_of, rate_of
from lerobot_bomb.evaluation.result_kind import NO_VALUE, Measure
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.table import Cell, Section, Table

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
    """A line for each arm; below, what is missing, or is no basis for a comparison."""
    shared = [_shared(arm, _peers(arm, report.arms)) for arm in report.arms]
    lines = [*report.missing, *_left_out(report.arms, shared), *_other_nominal(report.arms)]
    return Section("Summary", [_summary(report.arms, shared)], lines)


def _summary(arms: list[Arm], shared_rows: list[list[Row]]) -> Table:
    table, notes = [], dict[str, str]()
    for arm, shared in zip(arms, shared_rows, strict=True):
        measures = _measures(arm)
        notes |= {measure.name: measure.note for measure, _ in measures}
        table.append(
            [
                Cell(arm.name),
                rate(arm.nominal),
                rate(shared),
                *_worst(shared),
                Cell(", ".join(f"{measure.name} {value}" for measure, value in measures)),
                Cell(str(len(arm.rows)), len(arm.rows)),
            ]
        )
    explained = [f"{name}: {of}" for name, of in notes.items() if of]
    return Table("", HEADER, table, f"{'; '.join([NOTE, *explained])}.")


def _perturbed(arm: Arm) -> list[Row]:
    return [row for row in arm.rows if row["spec"]["perturbations"] != NONE]


def _peers(arm: Arm, arms: list[Arm]) -> list[Arm]:
    """Return the other arms that differ from this one in the policy only."""
    return [other for other in arms if other is not arm and can_compare(arm.group, other.group)]


def _shared(arm: Arm, peers: list[Arm]) -> list[Row]:
    """The arm's perturbed rows of the episodes that its peers with such rows have, too."""
    rows = _perturbed(arm)
    for peer in peers:
        episodes = {episode_of(row) for row in _perturbed(peer)}
        rows = [row for row in rows if not episodes or episode_of(row) in episodes]
    return rows


def _worst(rows: list[Row]) -> list[Cell]:
    """The condition with the lowest rate, and that rate; all of them where several have it."""
    rates = {condition: rate_of(of).share for condition, of in by_condition(rows).items()}
    worst = [condition for condition, share in rates.items() if share == min(rates.values())]
    if not worst:
        return [Cell("-"), Cell("-")]
    if len(worst) == 1:
        return [Cell(worst[0]), rate(by_condition(rows)[worst[0]])]
    names = f"all {len(worst)} alike" if len(worst) == len(rates) else f"tie: {', '.join(worst)}"
    share = rates[worst[0]]
    return [Cell(names, worst), Cell(f"{100 * share:.0f} %", share, share)]


def _left_out(arms: list[Arm], shared_rows: list[list[Row]]) -> Iterator[str]:
    """A line for each arm that has perturbed rows which its peers lack."""
    for arm, shared in zip(arms, shared_rows, strict=True):
        if num_left := len(_perturbed(arm)) - len(shared):
            yield f"{arm.name}: {num_left} perturbed episodes are left out, which not all policies have"


def _other_nominal(arms: list[Arm]) -> Iterator[str]:
    """A line for each arm whose unperturbed rows are of other episodes than those of its peers."""
    for arm in arms:
        if peers := [peer for peer in _peers(arm, arms) if peer.nominal]:
            own = {episode_of(row) for row in arm.nominal}
            if own and any(own != {episode_of(row) for row in peer.nominal} for peer in peers):
                yield f"{arm.name}: other policies have other unperturbed episodes; pairs compare below"


def _measures(arm: Arm) -> list[tuple[Measure, str]]:
    """Return the measures that the arm's episodes have a value of, with their values."""
    values = [(measure, measure.value(arm.nominal or arm.rows)) for measure in arm.group.kind.measures]
    return [(measure, value) for measure, value in values if value != NO_VALUE]
