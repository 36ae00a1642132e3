"""The tables of a report, counted from lines of results."""

import json
import shlex
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.bomb_lines import is_grounded, put_down
from lerobot_bomb.evaluation.comparison import POLICY, compare
from lerobot_bomb.evaluation.result_groups import (
    Group,
    by_condition,
    count_pairs,
    groups_of,
    pair_with_nominal,
)
from lerobot_bomb.stats import (
    PairedCounts,
    Slope,
    holm,
    paired_difference_interval,
    slope,
    variance_share,
    wilson_interval,
)

SHOWN_DIGITS = 6  # of a SHA-256, where names are the same otherwise


@dataclass(frozen=True)
class Cell:
    """What is shown, what it is as a number or text, and how strongly it is coloured."""

    text: str
    value: Any = None
    shade: float | None = None  # 0..1


@dataclass(frozen=True)
class Table:
    """Rows under columns; the first column names the row."""

    title: str
    header: list[str]
    rows: list[list[Cell]]
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """Its numbers."""
        rows = [[cell.text if cell.value is None else cell.value for cell in row] for row in self.rows]
        return {"title": self.title, "note": self.note, "header": self.header, "rows": rows}


@dataclass(frozen=True)
class Section:
    """Tables that answer one question."""

    title: str
    tables: list[Table]
    lines: list[str] = field(default_factory=list)  # of text below

    def as_json(self) -> dict[str, Any]:
        """Its numbers."""
        return {"title": self.title, "tables": [each.as_json() for each in self.tables], "lines": self.lines}


@dataclass(frozen=True)
class Arm:
    """Episodes of one policy under one set of settings, with a short name."""

    name: str
    group: Group

    @property
    def rows(self) -> list[Row]:
        return self.group.rows

    @property
    def nominal(self) -> list[Row]:
        """The unperturbed episodes."""
        return by_condition(self.rows).get(NONE, [])


def arms_of(rows: list[Row]) -> list[Arm]:
    """Lines apart that must not be pooled, each with a name that no other has."""
    groups = groups_of(rows)
    names = [_name(group.rows[0]) for group in groups]
    doubled = {name for name, number in Counter(names).items() if number > 1}
    long = [
        f"{name} {_weights(group.rows[0])}".strip() if name in doubled else name
        for name, group in zip(names, groups, strict=True)
    ]
    still = {name for name, number in Counter(long).items() if number > 1}
    numbers = Counter[str]()
    arms = []
    for name, group in zip(long, groups, strict=True):
        numbers[name] += 1
        arms.append(Arm(f"{name} ({numbers[name]})" if name in still else name, group))
    return arms


def policy_name(row: Row) -> str:
    """'TYPE'; of a checkpoint with its folder: 'act outputs/act'."""
    policy = row.get("policy") or {"type": "policy not recorded", "path": None}
    path = "" if policy["path"] is None else f" {'/'.join(policy['path'].rstrip('/').split('/')[-2:])}"
    return f"{policy['type']}{path}"


def _name(row: Row) -> str:
    """'act outputs/act, place'."""
    suite = row["spec"].get("suite")
    return policy_name(row) + (f", {suite}" if suite else "")


def _weights(row: Row) -> str:
    return ((row.get("policy") or {}).get("weights_sha256") or "")[:SHOWN_DIGITS]


# Cells


def rate(rows: list[Row], is_counted: Callable[[Row], bool] = lambda row: row["is_success"]) -> Cell:
    """'96 % [87, 99]' of rows; '-' of none."""
    if not rows:
        return Cell("-")
    number = sum(map(is_counted, rows))
    share, (low, high) = number / len(rows), wilson_interval(number, len(rows))
    text = f"{100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
    return Cell(text, {"successes": number, "n": len(rows), "low": low, "high": high}, share)


def _points(counts: PairedCounts, p_value: float) -> list[Cell]:
    low, high = paired_difference_interval(counts)
    value = {"difference": counts.difference, "low": low, "high": high, **vars(counts)}
    text = f"{100 * counts.difference:+.0f} [{100 * low:+.0f}, {100 * high:+.0f}]"
    return [Cell(text, value), Cell(f"{p_value:.2g}", p_value)]


def _count(number: int, of: int) -> Cell:
    return Cell(str(number) if number else "", number, number / of if of else 0.0)


# Sections


def build(rows: list[Row]) -> list[Section]:
    """All sections that these episodes have something for, the summary first."""
    arms = arms_of(rows)
    sections = [
        Section("Summary", [summary(arms)]),
        Section("Success by condition", [conditions(arm) for arm in arms]),
        Section("Axis by level", [table for arm in arms if (table := axes(arm))]),
        Section("Sensitivity to an axis", [table for arm in arms if (table := sensitivity(arm))]),
        Section("Two policies on the same episodes", list(comparisons(arms))),
        Section("Why episodes failed", [failures(arm) for arm in arms]),
        Section("The board", [table for arm in arms for table in boards(arm)]),
        Section("What was run", [], [line for arm in arms for line in (arm.name, *commands(arm))]),
    ]
    return [section for section in sections if section.tables or section.lines]


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


def conditions(arm: Arm) -> Table:
    """Success under each condition, and what it costs against the same episodes unperturbed."""
    pairs = pair_with_nominal(arm.rows)
    counts = {condition: count_pairs(of) for condition, of in pairs.items()}
    adjusted = dict(zip(counts, holm([each.p_value for each in counts.values()]), strict=True))
    costs = {condition: _points(counts[condition], adjusted[condition]) for condition in counts}
    blank = [Cell(""), Cell("")] if counts else []
    table = [
        [Cell(condition), rate(rows), Cell(str(len(rows)), len(rows)), *costs.get(condition, blank)]
        for condition, rows in by_condition(arm.rows).items()
    ]
    note = (
        "Points against the same episodes unperturbed (Newcombe's interval for pairs); p: exact McNemar "
        "test, adjusted for the number of conditions (Holm)."
    )
    header = ["condition", "success", "episodes", *(["points", "p"] if counts else [])]
    return Table(arm.name, header, table, note if counts else "")


def axes(arm: Arm) -> Table | None:
    """Success by axis and level, where one axis was on; None: nowhere. Drawn levels count at their own."""
    cells: dict[tuple[str, int], list[Row]] = {}
    for row in arm.rows:
        if len(row["levels"]) == 1:
            cells.setdefault(next(iter(row["levels"].items())), []).append(row)
    if not cells:
        return None
    names = list(dict.fromkeys(axis for axis, _ in cells))
    levels = [level for level in range(1, MAX_LEVEL + 1) if any(of == level for _, of in cells)]
    zero = [rate(arm.nominal)] if arm.nominal else []
    table = [[Cell(axis), *zero, *(rate(cells.get((axis, level), [])) for level in levels)] for axis in names]
    return Table(arm.name, ["axis", *(["0"] if zero else []), *map(str, levels)], table)


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
        "Points: least squares over the levels, each alone, with a 95 % bootstrap interval over episodes. "
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
    text = f"{100 * found.per_level:+.1f} [{100 * found.low:+.1f}, {100 * found.high:+.1f}]"
    return Cell(text, vars(found))


def _share_cell(share: float | None) -> Cell:
    return Cell("") if share is None else Cell(f"{100 * share:.1f} %", share, min(max(share, 0.0), 1.0))


def comparisons(arms: list[Arm]) -> Iterable[Table]:
    """Each pair of policies whose episodes differ in nothing else."""
    for first, second in combinations(arms, 2):
        if first.group.settings[POLICY] == second.group.settings[POLICY]:
            continue
        try:
            found = compare(first.rows, second.rows)
        except ValueError:  # no episode in common
            continue
        table = [
            [
                Cell(each.condition),
                rate([a for a, _ in each.pairs]),
                rate([b for _, b in each.pairs]),
                *_points(each.counts, each.p_value),
                Cell(str(len(each.pairs)), len(each.pairs)),
            ]
            for each in found.conditions
        ]
        title = f"A: {first.name}; B: {second.name}"
        yield Table(title, ["condition", "A", "B", "B - A, points", "p", "pairs"], table)


def failures(arm: Arm) -> Table:
    """How often which class of failure, by condition."""
    classes = Counter(row["failure"] for row in arm.rows if row["failure"] is not None)
    names = [name for name, _ in classes.most_common()]
    is_placed = all(row.get("target") is not None for row in arm.rows)
    table = []
    for condition, rows in by_condition(arm.rows).items():
        counted = Counter(row["failure"] for row in rows)
        cells = [_count(counted[name], len(rows)) for name in names]
        if is_placed:
            down = put_down(rows)
            cells += [rate(down, is_grounded), rate([row for row in down if is_grounded(row)])]
        table.append([Cell(condition), Cell(str(len(rows)), len(rows)), *cells])
    split_names = ["right intersection", "success there"] if is_placed else []
    note = (
        "Of the stones that were put down on the board: how many nearest to the intersection that was named; "
        "of those: how many within the tolerance, with no other stone moved."
    )
    header = ["condition", "episodes", *names, *split_names]
    return Table(arm.name, header, table, note if is_placed else "")


def boards(arm: Arm) -> Iterable[Table]:
    """Success by intersection, and where stones were put down; of episodes with one target."""
    rows = [row for row in arm.rows if row.get("target") is not None]
    if not rows:
        return
    size = 1 + max(max(*row["target"], *row["nearest_intersection"]) for row in rows)
    header = ["row", *(f"column {column}" for column in range(size))]

    def board(title: str, cell: Callable[[list[int]], Cell]) -> Table:
        table = [[Cell(str(row)), *(cell([row, column]) for column in range(size))] for row in range(size)]
        return Table(f"{arm.name}: {title}", header, table)

    yield board(
        "success by intersection that was named", lambda at: rate([r for r in rows if r["target"] == at])
    )
    missed = [row for row in put_down(rows) if not is_grounded(row)]
    if missed:
        most = max(Counter(tuple(row["nearest_intersection"]) for row in missed).values())
        yield board(
            "where stones lie that were put down elsewhere",
            lambda at: _count(sum(row["nearest_intersection"] == at for row in missed), most),
        )


def commands(arm: Arm) -> list[str]:
    """What was evaluated, and the flags that do it again."""
    by = by_condition(arm.rows)
    policy = arm.rows[0].get("policy") or {"type": "TYPE", "path": None}
    who = f"--policy.type={policy['type']}" if policy["path"] is None else f"--policy.path={policy['path']}"
    seeds = {row["spec"]["seed"] for row in arm.rows}
    flags = [who, *arm.group.kind.eval_flags(arm.rows)]
    flags += [f"--env.perturbations={json.dumps(list(by))}"] if arm.group.kind.condition.axes else []
    flags += [f"--seed={min(seeds)}", f"--eval.n_episodes={max(map(len, by.values()))}"]
    return [*(f"  {line}" for line in arm.group.lines()), f"  {shlex.join(['lerobot-eval', *flags])}"]
