"""Section `sensitivity`: how much each axis matters."""

import numpy as np

from lerobot_bomb.bootstrap import Slope, slope, variance_share
from lerobot_bomb.envs.results import Row
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.table import Cell, Section, Table


def section(report: Report) -> Section:
    """A table for each arm that has several levels of an axis."""
    tables = [table for arm in report.arms if (table := sensitivity(arm))]
    return Section("Sensitivity to an axis", tables)


def sensitivity(arm: Arm) -> Table | None:
    """Axes in the order of their effect; None: no axis was on alone at several levels, and none was drawn.

    How much a level costs where the axis was on alone; of the variance of success where the levels of several
    axes were drawn, what each explains.
    """
    slopes, shares = _slopes(arm), _shares(arm)
    if not slopes and not shares:
        return None
    per_level = {axis: found.per_level for axis, found in slopes.items()}
    names = sorted(
        dict.fromkeys([*slopes, *shares]),
        key=lambda axis: (per_level.get(axis, 0.0), -shares.get(axis, 0.0)),
    )
    table = [[Cell(axis), _slope_cell(slopes.get(axis)), _share_cell(shares.get(axis))] for axis in names]
    note = (
        "Points per level: slope of success in percentage points, by least squares over the levels of this "
        "axis alone, with a 95 % bootstrap interval over episodes (all alike: each resample has the same). "
        "Share: of the variance of success where the levels of several axes were drawn, what this axis "
        "explains alone (epsilon squared: 0 on average where it has no effect)."
    )
    return Table(arm.name, ["axis", "points per level", "share of variance"], table, note)


def _slopes(arm: Arm) -> dict[str, Slope]:
    alone: dict[str, list[Row]] = {}
    for row in arm.rows:
        if len(row["levels"]) == 1:
            alone.setdefault(next(iter(row["levels"])), []).append(row)
    found = {}
    for axis, rows in alone.items():
        of_axis = [*arm.nominal, *rows]
        levels, successes, seeds = (
            np.array([value(row) for row in of_axis], dtype=float)
            for value in (
                lambda row, axis=axis: row["levels"].get(axis, 0),
                lambda row: row["is_success"],
                lambda row: row["spec"]["seed"],
            )
        )
        if of_slope := slope(levels, successes, seeds):
            found[axis] = of_slope
    return found


def _shares(arm: Arm) -> dict[str, float]:
    condition = arm.group.kind.condition
    drawn = [
        row
        for row in arm.rows
        if sum(low < high for _, low, high in condition.parse(row["spec"]["perturbations"]).ranges) > 1
    ]
    axes_of = dict.fromkeys(axis for row in drawn for axis in row["levels"])
    successes = np.array([row["is_success"] for row in drawn], dtype=float)
    shares = {
        axis: variance_share(successes, np.array([row["levels"].get(axis, 0) for row in drawn]))
        for axis in axes_of
    }
    return {axis: share for axis, share in shares.items() if share is not None}


def _slope_cell(found: Slope | None) -> Cell:
    if found is None:
        return Cell("")
    interval = "(all alike)"
    if found.low is not None and found.high is not None:
        interval = f"[{100 * found.low:+.1f}, {100 * found.high:+.1f}]"
    text = f"{100 * found.per_level:+.1f} {interval}"
    return Cell(text, vars(found))


def _share_cell(share: float | None) -> Cell:
    return Cell("") if share is None else Cell(f"{100 * share:.1f} %", share, min(max(share, 0.0), 1.0))
