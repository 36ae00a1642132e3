"""Pictures of an episode that is explained: filmstrips, and paths over the board."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.observation import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from lerobot_bomb.explain.counterfactuals import Counterfactual
from lerobot_bomb.explain.film import EpisodeRun
from lerobot_bomb.report.chart import COLORS, INK, Chart, chart_text, draw
from lerobot_bomb.report.page import film_figure
from lerobot_bomb.report.table import Cell, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BOARD_INCHES = 3.7  # what a phone shows without scrolling
LINE_INCHES = 0.19  # of the legend
LABEL_M = 0.022  # of the numbers beside the board, beyond its outer lines
DASHES = ("-", "--", ":", "-.")


def film_html(name: str, run: EpisodeRun) -> str:
    """Return the filmstrip of an episode, with what became of it; without a filmstrip, the words alone."""
    heading = f"<h3>{escape(name)}: {escape(ending(run))}</h3>"
    return heading if run.film is None else heading + film_figure(run.film, name)


def ending(run: EpisodeRun) -> str:
    """Return how an episode ended, in two words."""
    result = run.result
    return "success" if result.is_success else f"failed, {result.failure}"


def counterfactual_html(run: EpisodeRun, settled: Counterfactual | None) -> str:
    """Return the filmstrips of an episode and of the counterfactual that says most about it."""
    told = film_html("This episode", run)
    if settled is None:
        return told
    return told + film_html(f"The same seed, {settled.name}", settled.run)


def paths_chart(title: str, runs: Mapping[str, EpisodeRun], target_xy: Sequence[float] | None) -> Chart:
    """Draw the gripper's paths over the board from above: the first thick, in the page's own colour."""

    def paint(figure: "Figure") -> None:
        axes = figure.add_subplot()
        _paint_board(axes, target_xy)
        for number, (name, run) in enumerate(runs.items()):
            _paint_path(axes, number, name, run)
        _show_all(axes, [run.stone_xyz[-1, :2] for run in runs.values()])
        figure.legend(loc="outside lower left")  # beside the board, it would be off a phone's screen

    rows = [
        [Cell(name), Cell(ending(run)), Cell(str(len(run.gripper_xyz) - 1)), *_last_xy(run)]
        for name, run in runs.items()
    ]
    header = ["episode", "outcome", "steps", "stone at the end, x mm", "y mm"]
    note = "From above: lines are the gripper's path, dots where the stone ended, the ring is the target."
    size = (BOARD_INCHES, BOARD_INCHES + LINE_INCHES * (len(runs) + 1))
    return Chart(title, draw(title, size, paint), [Table("", header, rows)], note)


def _last_xy(run: EpisodeRun) -> list[Cell]:
    return [Cell(f"{1e3 * value:.0f}", 1e3 * value) for value in run.stone_xyz[-1, :2].tolist()]


def _paint_board(axes: "Axes", target_xy: Sequence[float] | None) -> None:
    last = BOARD.num_lines - 1
    for line in range(BOARD.num_lines):
        for start, end in (((line, 0), (line, last)), ((0, line), (last, line))):
            ends = np.array([BOARD.intersection_xy(*each) for each in (start, end)])
            axes.plot(*ends.T, color=INK, alpha=0.3, linewidth=0.8)
    for line in range(BOARD.num_lines):
        row, column = BOARD.intersection_xy(line, 0), BOARD.intersection_xy(last, line)
        for x, y in ((row[0] - LABEL_M, row[1]), (column[0], column[1] - LABEL_M)):
            axes.text(x, y, str(line), ha="center", va="center", alpha=0.8)
    if target_xy is not None:
        style = {"markersize": 14, "markeredgewidth": 2, "markeredgecolor": COLORS[1]}
        axes.plot(*target_xy, marker="o", fillstyle="none", linestyle="none", label="target", **style)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _show_all(axes: "Axes", stones_xy: Sequence[np.ndarray]) -> None:
    """Show the workspace, and stones that ended outside of it."""
    shown = np.array([WORKSPACE_LOW_M[:2], WORKSPACE_HIGH_M[:2], *stones_xy])
    (left, bottom), (right, top) = shown.min(axis=0), shown.max(axis=0)
    axes.set_xlim(left - 0.02, right + 0.01)
    axes.set_ylim(bottom - 0.01, top + 0.01)


def _paint_path(axes: "Axes", number: int, name: str, run: EpisodeRun) -> None:
    is_first = number == 0
    dashes, shade = divmod(number - 1, len(COLORS))
    color = INK if is_first else COLORS[(shade + 2) % len(COLORS)]
    style = "-" if is_first else DASHES[dashes % len(DASHES)]
    label = chart_text(name)
    axes.plot(*run.gripper_xyz[:, :2].T, style, color=color, linewidth=2.5 if is_first else 1.5, label=label)
    axes.plot(*run.stone_xyz[-1, :2], marker="o", color=color, markersize=6)
