"""Charts of dots with intervals: rows down, one dot for each series in each row."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lerobot_bomb.report.chart import COLORS, INK, MARKERS, WIDTH, chart_text, chart_texts, draw, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DOT_INCHES = 0.13  # between the dots of a row
ROW_INCHES = 0.13  # between rows
FRAME_INCHES = 0.75  # around the rows of a block: title, ticks, axis label
LEGEND_INCHES = 0.3


@dataclass(frozen=True)
class Dot:
    """A value and its interval."""

    value: float
    low: float | None
    high: float | None
    is_filled: bool = True


@dataclass(frozen=True)
class DotColumn:
    """One quantity of every row: {series: a dot for each row, or none}."""

    label: str
    dots: dict[int, list[Dot | None]]  # by the place of the series in the legend
    limits: tuple[float, float] | None = None
    line: float | None = None  # where a line is drawn


@dataclass(frozen=True)
class Block:
    """Rows under one title, with the same columns as other blocks."""

    title: str
    rows: list[str]
    columns: list[DotColumn]


def dot_chart(title: str, series: Sequence[str], blocks: Sequence[Block]) -> str:
    """Draw blocks below each other, their columns side by side."""
    num_series = max(len(column.dots) for block in blocks for column in block.columns)
    row_inches = ROW_INCHES + DOT_INCHES * max(num_series, 1)
    heights = [FRAME_INCHES + row_inches * len(block.rows) for block in blocks]
    num_columns = max(len(block.columns) for block in blocks)

    def paint(figure: "Figure") -> None:
        grid = figure.subplots(len(blocks), num_columns, squeeze=False, height_ratios=heights)
        for axes_of_row, block in zip(grid, blocks, strict=True):
            for number, axes in enumerate(axes_of_row):
                if number < len(block.columns):
                    _paint_column(axes, block, block.columns[number], num_series, number == 0)
                else:
                    axes.set_axis_off()
        if len(series) > 1:
            add_legend(figure, series)

    legend = LEGEND_INCHES * -(-len(series) // 3) if len(series) > 1 else 0.0
    return draw(title, (WIDTH, sum(heights) + legend), paint)


def add_legend(figure: "Figure", series: Sequence[str]) -> None:
    """Name the series above all axes."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=COLORS[i % len(COLORS)], marker=MARKERS[i % len(MARKERS)], linestyle="-")
        for i in range(len(series))
    ]
    figure.legend(handles, chart_texts(series), loc="outside upper left", ncols=3)


def _paint_column(axes: "Axes", block: Block, column: DotColumn, num_series: int, has_names: bool) -> None:
    from matplotlib.ticker import MaxNLocator

    height = 0.8 / max(num_series, 1)
    for place, (number, dots) in enumerate(column.dots.items()):
        shift = (place - (len(column.dots) - 1) / 2) * height
        for row, dot in enumerate(dots):
            if dot is not None:
                _paint_dot(axes, dot, row + shift, number)
    names = chart_texts(block.rows) if has_names else [""] * len(block.rows)
    axes.set_yticks(range(len(block.rows)), names)
    axes.set_ylim(len(block.rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    if column.limits:
        axes.set_xlim(*column.limits)
    if column.line is not None:
        axes.axvline(column.line, color=INK, linewidth=0.8, alpha=0.6)
    for row in range(1, len(block.rows)):
        axes.axhline(row - 0.5, color=INK, linewidth=0.4, alpha=0.12)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel(column.label)
    if has_names and block.title:
        axes.set_title(chart_text(block.title), loc="left", fontweight="bold")
    tidy(axes)


def _paint_dot(axes: "Axes", dot: Dot, y: float, number: int) -> None:
    color: Any = COLORS[number % len(COLORS)]
    if dot.low is not None and dot.high is not None:
        axes.plot([dot.low, dot.high], [y, y], color=color, linewidth=1.4, solid_capstyle="butt")
    face = color if dot.is_filled else "none"
    marker = MARKERS[number % len(MARKERS)]
    axes.plot([dot.value], [y], marker, color=color, markerfacecolor=face, markersize=4.5)
