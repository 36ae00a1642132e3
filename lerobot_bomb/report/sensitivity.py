"""Sensitivity to the axes: how much success each of them costs."""

import numpy as np

from lerobot_bomb.bootstrap import Slope, fit_slope, variance_share
from lerobot_bomb.report.table import Cell, Table
from lerobot_bomb.results.groups import Group
from lerobot_bomb.results.record import Record


def sensitivity(group: Group) -> Table | None:
    """Write a table of axes by their effect; None if no axis was on alone at several levels, or drawn.

    Columns: the cost of a level where the axis was on alone; where levels of several axes were drawn, the
    share of the variance of success that each explains.
    """
    slopes, shares = _slopes(group), _shares(group)
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
        "The intervals are not adjusted for the number of axes. "
        "Share: of the variance of success where the levels of several axes were drawn, what this axis "
        "explains alone (epsilon squared: 0 on average where it has no effect)."
    )
    return Table(f"Sensitivity: {group.name}", ["axis", "points per level", "share of variance"], table, note)


def _slopes(group: Group) -> dict[str, Slope]:
    alone: dict[str, list[Record]] = {}
    for record in group.records:
        if len(record.levels) == 1:
            alone.setdefault(next(iter(record.levels)), []).append(record)
    found = {}
    for axis, perturbed in alone.items():
        records = [*group.nominal, *perturbed]
        levels = np.array([each.levels.get(axis, 0) for each in records], dtype=float)
        successes = np.array([each.is_success for each in records], dtype=float)
        seeds = np.array([each.spec.seed for each in records], dtype=float)
        if of_slope := fit_slope(levels, successes, seeds):
            found[axis] = of_slope
    return found


def _shares(group: Group) -> dict[str, float]:
    drawn = [
        each for each in group.records if sum(low < high for _, low, high in each.spec.condition.ranges) > 1
    ]
    axes = dict.fromkeys(axis for each in drawn for axis in each.levels)
    successes = np.array([each.is_success for each in drawn], dtype=float)
    shares = {
        axis: variance_share(successes, np.array([each.levels.get(axis, 0) for each in drawn]))
        for axis in axes
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
