"""Section `map`: success of every policy under every condition at a glance."""

from typing import TYPE_CHECKING

from lerobot_bomb.conditions import NONE
from lerobot_bomb.report.chart import Chart, chart_text, chart_texts, draw
from lerobot_bomb.report.panels import Panel, Series
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Every policy under every condition"
MAX_POLICIES = 40  # rows of a map
MAX_STRENGTH = 0.55  # text stays readable on it, black or white
RGB = (0.0, 114 / 255, 178 / 255)
CELL_INCHES = 0.38


def section(report: Report) -> Section:
    """Write the section: a map for each panel of several policies and conditions."""
    panels = [each for each in report.panels if len(each.series) > 1 and len(each.conditions) > 1]
    return Section(TITLE, [], charts=[_chart(panel) for panel in panels])


def _chart(panel: Panel) -> Chart:
    title = f"Success, per cent: {panel.name}" if panel.name else "Success, per cent"
    shown = panel.ranked[:MAX_POLICIES]
    left = len(panel.series) - len(shown)
    notes = ["Policies by rank, conditions by loss.", panel.left_out]
    notes += [f"Shown: the first {len(shown)} of {len(panel.series)} policies."] if left else []
    table = _table(panel, shown)
    return Chart(title, _draw(title, table), [table], " ".join(filter(None, notes)))


def _table(panel: Panel, shown: list[Series]) -> Table:
    """Write the rates of the conditions that charts show."""
    conditions = panel.shown_conditions
    header = ["unperturbed" if each == NONE else str(each) for each in conditions]
    rows = [[Cell(each.policy), *(_cell(each, condition) for condition in conditions)] for each in shown]
    return Table("", ["policy", *header], rows)


def _cell(series: Series, condition: str) -> Cell:
    found = series.rates.get(condition)
    return Cell("-") if found is None else Cell(f"{100 * found.share:.0f}", found.share, found.share)


def _draw(title: str, table: Table) -> str:
    names = chart_texts([row[0].text for row in table.rows])
    num_rows, num_columns = len(table.rows), len(table.header) - 1
    left = 0.4 + 0.075 * max(map(len, names))
    top = 0.2 + 0.065 * max(map(len, map(chart_text, table.header)))

    def paint(figure: "Figure") -> None:
        axes = figure.subplots()
        for y, row in enumerate(table.rows):
            for x, cell in enumerate(row[1:]):
                share = cell.value
                if share is not None:
                    color = (*RGB, MAX_STRENGTH * share)
                    axes.bar([x], [0.96], width=0.96, bottom=y - 0.48, color=color, linewidth=0)
                axes.text(x, y, cell.text, ha="center", va="center")
        axes.set_xlim(-0.5, num_columns - 0.5)
        axes.set_ylim(num_rows - 0.5, -0.5)
        axes.set_yticks(range(num_rows), names)
        axes.xaxis.tick_top()
        axes.set_xticks(range(num_columns), [*map(chart_text, table.header[1:])], rotation=60, ha="left")
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)

    size = (left + CELL_INCHES * num_columns + 0.6, top + 0.27 * num_rows + 0.2)
    return draw(title, size, paint)
