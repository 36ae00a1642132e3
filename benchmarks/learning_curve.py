"""Learning curve of a policy: each checkpoint's results file, as a table and a plot."""

from dataclasses import dataclass
from pathlib import Path
from statistics import median

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from lerobot_bomb.bomb.episode import Failure, Stage
from lerobot_bomb.results.bomb import EpisodeResult, is_grounded, put_down
from lerobot_bomb.stats import format_rate, wilson_interval
from lerobot_bomb.tables import print_table

LIFTED = (Stage.LIFTED, Stage.PLACED)

SUCCESS, GROUNDED, LIFTED_COLOR, BAND = "#1450a0", "#288c28", "#c83c3c", "#bed7eb"


@dataclass(frozen=True)
class Point:
    """One checkpoint's episodes, counted."""

    step: int  # of training
    cpu_minutes: float  # of training so far
    num_episodes: int
    num_successes: int
    num_lifted: int
    num_grounded: int  # stones that were put down nearest to the target
    num_precise: int  # of these: within the tolerance
    median_error_mm: float | None  # of the stones that were put down


def count(rows: list[EpisodeResult], step: int, cpu_minutes: float) -> Point:
    """Count the outcomes of one checkpoint's episodes."""
    down = put_down(rows)
    grounded = [row for row in down if is_grounded(row)]
    return Point(
        step=step,
        cpu_minutes=cpu_minutes,
        num_episodes=len(rows),
        num_successes=sum(row.is_success for row in rows),
        num_lifted=sum(row.stage in LIFTED for row in rows),
        num_grounded=len(grounded),
        num_precise=sum(row.failure != Failure.IMPRECISE for row in grounded),
        median_error_mm=median(row.placement_error_mm for row in down) if down else None,
    )


def print_points(points: dict[str, Point]) -> None:
    """Print a table of {name: point}; rates with their 95 % Wilson intervals."""
    header = ["", "CPU minutes", "success", "lifted", "right intersection", "precise there", "median error"]
    print_table(header, [[name, *_cells(point)] for name, point in points.items()])


def draw(points: list[Point], title: str, path: Path) -> None:
    """Write a PNG: rates over CPU minutes of training, the success rate with its interval."""
    figure = Figure(figsize=(6.6, 4.8), layout="constrained")
    axes = figure.subplots()
    minutes = [point.cpu_minutes for point in points]
    intervals = [wilson_interval(point.num_successes, point.num_episodes) for point in points]
    axes.vlines(minutes, *zip(*intervals, strict=True), color=BAND, linewidth=6)
    curves = {
        "lifted": ([point.num_lifted for point in points], LIFTED_COLOR),
        "right intersection": ([point.num_grounded for point in points], GROUNDED),
        "success (within 10 mm)": ([point.num_successes for point in points], SUCCESS),
    }
    for number, (name, (counts, color)) in enumerate(curves.items()):
        rates = [count / point.num_episodes for count, point in zip(counts, points, strict=True)]
        width = 2 * (len(curves) - number)  # the later ones are drawn over the others, where they agree
        axes.plot(minutes, rates, marker="o", color=color, linewidth=width, label=name)
    set_up_rates(axes, title)
    axes.legend(loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def set_up_rates(axes: Axes, title: str) -> None:
    """Set up axes of rates over CPU minutes of training."""
    set_up(axes, title)
    axes.set(ylim=(-0.02, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1))


def set_up(axes: Axes, title: str) -> None:
    """Set up axes of something that is never negative, over CPU minutes of training."""
    axes.set(title=title, xlabel="CPU minutes of training", xlim=(0, None), ylim=(0, None))
    axes.grid(axis="y", color="#e1e1e1")


def _cells(point: Point) -> list[str]:
    n, error_mm = point.num_episodes, point.median_error_mm
    return [
        f"{point.cpu_minutes:.1f}",
        format_rate(point.num_successes, n),
        f"{point.num_lifted}/{n}",
        format_rate(point.num_grounded, n),
        format_rate(point.num_precise, point.num_grounded) if point.num_grounded else "-",
        "-" if error_mm is None else f"{error_mm:.1f} mm",
    ]
