"""Section `axes`: success over the levels of each axis, and how much each axis matters."""

from typing import TYPE_CHECKING, Any

from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.chart import COLORS, MARKERS, MAX_SERIES, WIDTH, Chart, chart_text, draw, tidy
from lerobot_bomb.report.dots import add_legend
from lerobot_bomb.report.panels import Panel, Series
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sensitivity import sensitivity
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.groups import rate_of
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import Rate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "Success over the levels of an axis"
COLUMNS = 4  # of small charts
AXIS_INCHES = 1.7
SHIFT = 0.07  # of a level, between policies
NOTE = f"Of episodes with this axis alone; level 0: unperturbed. With {INTERVALS}."
type Levels = dict[str, dict[int, list[Record]]]  # by axis


def section(report: Report) -> Section:
    """Write the section: a chart for each panel with several levels, with the tables of all its policies."""
    charts, tables = list[Chart](), list[Table]()
    for panel in report.panels:
        levels = {each.place: _levels(each) for each in panel.series}
        found = [table for each in panel.series if (table := axes(each, levels[each.place]))]
        found += [table for each in panel.series if (table := sensitivity(each.group))]
        names = list(dict.fromkeys(axis for by_axis in levels.values() for axis in by_axis))
        if any(len({*by_level} - {0}) > 1 for by_axis in levels.values() for by_level in by_axis.values()):
            charts.append(_chart(report, panel, levels, names, found))
        else:  # the same numbers as by condition, but for what drawn levels explain
            tables += [table for table in found if table.title.startswith("Sensitivity")]
    return Section(TITLE, tables, charts=charts)


def _levels(series: Series) -> Levels:
    """Return the records with one axis on, by axis and level; level 0 has the unperturbed ones."""
    found: Levels = {}
    for record in series.group.records:
        if len(record.levels) == 1:
            ((axis, level),) = record.levels.items()
            found.setdefault(axis, {}).setdefault(level, []).append(record)
    nominal = series.group.nominal
    return {axis: ({0: nominal} if nominal else {}) | by_level for axis, by_level in found.items()}


def axes(series: Series, levels: Levels) -> Table | None:
    """Write the table of success by axis and level; None if no axis was on alone."""
    shown = [each for each in range(MAX_LEVEL + 1) if any(by_level.get(each) for by_level in levels.values())]
    rows = [
        [Cell(axis), *(rate(by_level.get(level, [])) for level in shown)] for axis, by_level in levels.items()
    ]
    return Table(series.group.name, ["axis", *map(str, shown)], rows, NOTE) if rows else None


def _chart(
    report: Report, panel: Panel, levels: dict[int, Levels], names: list[str], tables: list[Table]
) -> Chart:
    shown = panel.ranked[:MAX_SERIES]
    title = f"{TITLE}: {panel.name}" if panel.name else TITLE
    left = len(panel.series) - len(shown)
    note = f"{NOTE} Shown: the first {len(shown)} policies by rank." if left else NOTE
    number_rows = -(-len(names) // COLUMNS)
    places = {each.place: place for place, each in enumerate(shown)} if left else {}

    def paint(figure: "Figure") -> None:
        grid = figure.subplots(number_rows, COLUMNS, squeeze=False, sharex=True, sharey=True).flatten()
        for small, axis in zip(grid, names, strict=False):
            for number, each in enumerate(shown):
                by_level = levels[each.place].get(axis, {})
                rates = {level: rate_of(records) for level, records in sorted(by_level.items()) if records}
                place = places.get(each.place, each.place)
                _paint_curve(small, rates, place, SHIFT * (number - (len(shown) - 1) / 2))
            small.set_title(chart_text(axis), loc="left")
            small.set_ylim(-3, 103)
            small.set_xticks(range(MAX_LEVEL + 1))
            tidy(small, "y")
        for number, small in enumerate(grid):
            if number < len(names):
                small.tick_params(labelbottom=number + COLUMNS >= len(names))
            else:
                small.set_axis_off()
        figure.supxlabel("level", fontsize="medium")
        figure.supylabel("success, per cent", fontsize="medium")
        if len(report.policies) > 1:
            add_legend(figure, [each.policy for each in shown] if left else list(report.policies))

    return Chart(title, draw(title, (WIDTH, 0.8 + AXIS_INCHES * number_rows), paint), tables, note)


def _paint_curve(small: "Axes", rates: dict[int, Rate], place: int, shift: float) -> None:
    color: Any = COLORS[place % len(COLORS)]
    levels = [level + shift for level in rates]
    small.plot(
        levels, [100 * each.share for each in rates.values()], marker=MARKERS[place % len(MARKERS)],
        color=color, markersize=3.5, linewidth=1.2,
    )  # fmt: skip
    for level, found in zip(levels, rates.values(), strict=True):
        if found.interval is not None:
            small.plot([level, level], [100 * each for each in found.interval], color=color, linewidth=0.9)
