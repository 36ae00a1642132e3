"""Section `failures`: why episodes failed."""

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lerobot_bomb.report.cells import count, rate
from lerobot_bomb.report.chart import COLORS, INK, MAX_BARS, WIDTH, Chart, chart_text, chart_texts, draw, tidy
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import MAX_TOLD, Cell, Section, Statement, Table
from lerobot_bomb.results.bomb import are_placed, is_grounded, put_down
from lerobot_bomb.results.groups import Group, by_condition
from lerobot_bomb.results.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Why episodes failed"
HATCHES = ("", "///", "...")  # of classes beyond the colours
SUCCESS_ALPHA = 0.12
MAX_LABEL_SHARE = 6  # per cent; a narrower part has no number in it
SPLIT_NOTE = (
    "Right intersection: of the stones that were put down on the board, how many lie nearest to the "
    "intersection that was named; success there: of those, how many lie within the tolerance, with no "
    "other stone moved."
)


def section(report: Report) -> Section:
    """Write the section: stacked classes of each policy, unperturbed and perturbed."""
    if all(map(_all_succeed, report.groups)):
        return Section(TITLE, [])
    title = "How episodes ended: share of each class of failure"
    bars = outcomes(report)
    svg = stacked(title, bars.header[2:], bars)
    told = [_told(report.label(group), group) for group in report.groups if not _all_succeed(group)]
    note = f"Each bar is 100 % of its episodes. {_meanings(report.groups)}".strip()
    chart = Chart(title, svg, [bars, *map(failures, report.groups)], note)
    return Section(TITLE, [], statements=told[:MAX_TOLD], charts=[chart])


def _all_succeed(group: Group) -> bool:
    return all(each.is_success for each in group.records)


def _meanings(groups: Sequence[Group]) -> str:
    """Say what the classes that occur mean: 'imprecise: nearest to the target, but ...'."""
    met = {each.failure for group in groups for each in group.records}
    types = dict.fromkeys(group.record_type for group in groups)
    told = [f"{each}: {each.meaning}" for kind in types for each in kind.failures if each in met]
    return f"{'. '.join(told)}." if told else ""


def _told(name: str, group: Group) -> Statement:
    """Say how the failed episodes ended: 'act fails 7 of 220 episodes: 4 dropped, 3 timeout.'."""
    classes = Counter(each.failure for each in group.records if each.failure is not None)
    ends = ", ".join(f"{number} {name}" for name, number in classes.most_common())
    return Statement(name, f"fails {classes.total()} of {len(group.records)} episodes: {ends}.")


def outcomes(report: Report) -> Table:
    """Count how episodes ended: a row for each group, unperturbed and perturbed."""
    groups = report.groups
    classes = Counter(each.failure for group in groups for each in group.records if each.failure is not None)
    names = [name for name, _ in classes.most_common()]
    rows = []
    for group in groups:
        for kind, records in (("unperturbed", group.nominal), ("perturbed", group.perturbed)):
            if records:
                counted = Counter(each.failure for each in records)
                cells = [count(counted[name], len(records)) for name in (None, *names)]
                rows.append(
                    [Cell(f"{report.label(group)}, {kind}"), Cell(str(len(records)), len(records)), *cells]
                )
    return Table("", ["policy, suite", "episodes", "success", *names], rows)


def stacked(title: str, classes: Sequence[str], bars: Table) -> str:
    """Draw the bars of a table of `outcomes`."""
    rows = bars.rows[:MAX_BARS]

    def paint(figure: "Figure") -> None:
        axes = figure.subplots()
        left = [0.0] * len(rows)
        for number, name in enumerate(classes):
            shares = [100 * row[2 + number].value / row[1].value for row in rows]
            color = INK if number == 0 else COLORS[(number - 1) % len(COLORS)]
            hatch = "" if number == 0 else HATCHES[(number - 1) // len(COLORS) % len(HATCHES)]
            alpha = SUCCESS_ALPHA if number == 0 else 0.75
            axes.barh(
                range(len(rows)), shares, left=left, height=0.7, color=color, alpha=alpha, hatch=hatch,
                linewidth=0, label=chart_text(name),
            )  # fmt: skip
            for row, share in enumerate(shares):
                if share >= MAX_LABEL_SHARE:
                    axes.text(left[row] + share / 2, row, f"{share:.0f}", ha="center", va="center")
            left = [start + share for start, share in zip(left, shares, strict=True)]
        axes.set_yticks(range(len(rows)), chart_texts([row[0].text for row in rows]))
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0, 100)
        axes.set_xlabel("per cent of episodes")
        tidy(axes)
        figure.legend(loc="outside upper left", ncols=5)

    return draw(title, (WIDTH, 1.2 + 0.3 * len(rows)), paint)


def failures(group: Group) -> Table:
    """Count each class of failure, by condition."""
    classes = Counter(each.failure for each in group.records if each.failure is not None)
    names = [name for name, _ in classes.most_common()]
    is_placed = are_placed(group.records)

    def row(condition: str, records: list[Record]) -> list[Cell]:
        counted = Counter(each.failure for each in records)
        cells = [count(counted[name], len(records)) for name in names]
        if is_placed:
            down = put_down(records)
            cells += [rate(down, is_grounded), rate([each for each in down if is_grounded(each)])]
        return [Cell(condition), Cell(str(len(records)), len(records)), *cells]

    table = [row(condition, records) for condition, records in by_condition(group.records).items()]
    split_names = ["right intersection", "success there"] if is_placed else []
    header = ["condition", "episodes", *names, *split_names]
    return Table(group.name, header, table, SPLIT_NOTE if is_placed else "")
