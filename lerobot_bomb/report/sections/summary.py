"""What a reviewer reads in a minute."""

from lerobot_bomb.conditions import NONE
from lerobot_bomb.evaluation.result_groups import by_condition
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.cells import rate
from lerobot_bomb.report.table import Cell, Section, Table


def section(report: Report) -> Section:
    """Of all arms."""
    return Section("Summary", [summary(report.arms)])


def summary(arms: list[Arm]) -> Table:
    """A line for each arm: what a reviewer reads in a minute."""
    table = []
    for arm in arms:
        perturbed = [row for row in arm.rows if row["spec"]["perturbations"] != NONE]
        worst = min(
            by_condition(perturbed).items(), key=lambda item: rate(item[1]).shade or 0.0, default=None
        )
        measures = [f"{m.name} {m.value(arm.nominal or arm.rows)}" for m in arm.group.kind.measures]
        shown = ", ".join(text for text in measures if not text.endswith(" -"))
        table.append(
            [
                Cell(arm.name),
                rate(arm.nominal),
                rate(perturbed),
                Cell("-") if worst is None else Cell(f"{worst[0]}: {rate(worst[1]).text}", worst[0]),
                Cell(shown),
                Cell(str(len(arm.rows)), len(arm.rows)),
            ]
        )
    header = [
        "policy, suite",
        "unperturbed",
        "perturbed, all conditions",
        "worst condition",
        "measures",
        "episodes",
    ]
    return Table("", header, table, "Success with 95 % Wilson intervals; per cent.")
