"""Section `errors`: how far from their targets stones were put down."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from lerobot_bomb.report.chart import COLORS, INK, MAX_SERIES, WIDTH, Chart, chart_text, draw, tidy
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import MAX_TOLD, Cell, Section, Statement, Table
from lerobot_bomb.results.bomb import EpisodeResult, put_down
from lerobot_bomb.results.groups import Group

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Placement error"
PERCENTILES = range(0, 101, 5)
SMALLEST_MM = 0.05  # of the axis
NOTE = (
    "Share of the stones, put down on the board, that lie within a distance of their target; the vertical "
    "line is what is allowed. Stones that were "
    "dropped, never grasped or still held do not count."
)


def section(report: Report) -> Section:
    """Write the section: the distribution of each policy, unperturbed and perturbed."""
    rows = list(_rows(report))
    if not rows:
        return Section(TITLE, [])
    table = Table("", ["policy, suite", "stones", *(f"p{each}, mm" for each in PERCENTILES)], rows)
    shown = list(dict.fromkeys(row[0].text.rpartition(", ")[0] for row in rows))[:MAX_SERIES]
    left = len({row[0].text.rpartition(", ")[0] for row in rows}) - len(shown)
    note = f"{NOTE} Shown: the first {MAX_SERIES}; the numbers are of all." if left else NOTE
    tolerances = sorted(
        {each.spec.success_tolerance_mm for group in report.groups for each in _placed(group)}
    )
    title = "How precisely stones were put down"
    chart = Chart(title, _curves(title, shown, rows, tolerances), [table], note)
    return Section(TITLE, [], statements=_told(rows)[:MAX_TOLD], charts=[chart])


def _told(rows: list[list[Cell]]) -> list[Statement]:
    """Give the median errors of each group: 'act: median 0.5 mm (20 unperturbed stones).'."""
    medians: dict[str, list[str]] = {}
    for name, number, *errors in rows:
        group, _, kind = name.text.rpartition(", ")
        median = errors[PERCENTILES.index(50)].value
        medians.setdefault(group, []).append(f"{median:.1f} mm ({number.text} {kind} stones)")
    return [Statement(f"{name}:", f"median {' and '.join(each)}.") for name, each in medians.items()]


def _placed(group: Group) -> list[EpisodeResult]:
    return [each for each in put_down(group.records) if each.target is not None]


def _rows(report: Report) -> Iterator[list[Cell]]:
    """Yield percentiles of the errors of each group, unperturbed and perturbed."""
    for group in report.groups:
        for kind, records in (("unperturbed", group.nominal), ("perturbed", group.perturbed)):
            errors = [each.placement_error_mm for each in put_down(records) if each.target is not None]
            if errors:
                found = np.percentile(errors, PERCENTILES, method="inverted_cdf").tolist()
                cells = [Cell(f"{each:.2f}", each) for each in found]
                yield [Cell(f"{report.label(group)}, {kind}"), Cell(str(len(errors)), len(errors)), *cells]


def _curves(title: str, shown: list[str], rows: list[list[Cell]], tolerances: list[float]) -> str:
    def paint(figure: "Figure") -> None:
        axes = figure.subplots()
        for row in rows:
            name, _, kind = row[0].text.rpartition(", ")
            if name in shown:
                errors = [max(cell.value, SMALLEST_MM) for cell in row[2:]]
                style = "-" if kind == "unperturbed" else ":"
                color = COLORS[shown.index(name)]
                label = chart_text(f"{name}, {kind}")
                axes.plot(errors, PERCENTILES, style, color=color, label=label, drawstyle="steps-post")
        for tolerance in tolerances:
            axes.axvline(tolerance, color=INK, linewidth=0.8, alpha=0.6)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("placement error, mm")
        axes.set_ylabel("per cent of stones within")
        axes.set_ylim(0, 101)
        tidy(axes, "both")
        figure.legend(loc="outside right upper")

    return draw(title, (WIDTH, 3.4), paint)
