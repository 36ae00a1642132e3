"""What a reviewer reads in a minute."""

from lerobot_bomb.conditions import NONE
from lerobot_bomb.evaluation.result_groups import by_condition
from lerobot_bomb.evaluation.result_kind import Measure
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import rate
from lerobot_bomb.report.table import Cell, Section, Table

HEADER = [
    "policy, suite", "unperturbed", "perturbed, all conditions", "worst condition", "its success", "measures",
    "episodes",
]  # fmt: skip
NOTE = "Success in per cent, with 95 % Wilson intervals. Measures: of the unperturbed episodes, if any"


def section(report: Report) -> Section:
    """Of all arms."""
    return Section("Summary", [summary(report.arms)], report.missing)


def summary(arms: list[Arm]) -> Table:
    """A line for each arm: what a reviewer reads in a minute."""
    table, notes = [], dict[str, str]()
    for arm in arms:
        perturbed = [row for row in arm.rows if row["spec"]["perturbations"] != NONE]
        worst, of_worst = min(
            by_condition(perturbed).items(),
            key=lambda item: rate(item[1]).shade or 0.0,
            default=("-", []),
        )
        measures = _measures(arm)
        notes |= {measure.name: measure.note for measure, _ in measures}
        table.append(
            [
                Cell(arm.name),
                rate(arm.nominal),
                rate(perturbed),
                Cell(worst),
                rate(of_worst),
                Cell(", ".join(f"{measure.name} {value}" for measure, value in measures)),
                Cell(str(len(arm.rows)), len(arm.rows)),
            ]
        )
    explained = [f"{name}: {of}" for name, of in notes.items() if of]
    return Table("", HEADER, table, f"{'; '.join([NOTE, *explained])}.")


def _measures(arm: Arm) -> list[tuple[Measure, str]]:
    """Those that the arm's episodes have a value of."""
    values = [(measure, measure.value(arm.nominal or arm.rows)) for measure in arm.group.kind.measures]
    return [(measure, value) for measure, value in values if value != "-"]
