"""Learning curve of a policy: each checkpoint's results file, as a table and a plot."""

from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np

from lerobot_bomb.bomb.episode import Failure, Stage
from lerobot_bomb.results.bomb import EpisodeResult, is_grounded, put_down
from lerobot_bomb.stats import format_rate, wilson_interval
from lerobot_bomb.tables import print_table

NEAR_MM = 20.0
LIFTED = (Stage.LIFTED, Stage.PLACED)

PANEL_PX = (520, 360)  # width, height of the plot's inside
MARGIN_PX = (70, 70)  # left and right, top and bottom
INK, GRID, BAND = (40, 40, 40), (225, 225, 225), (235, 215, 190)  # blue, green, red
SUCCESS_BGR, GROUNDED_BGR, LIFTED_BGR = (160, 80, 20), (40, 140, 40), (60, 60, 200)


@dataclass(frozen=True)
class Point:
    """One checkpoint's episodes, counted."""

    step: int  # of training
    cpu_minutes: float  # of training so far
    num_episodes: int
    num_successes: int
    num_lifted: int
    num_near: int  # stones that were put down within NEAR_MM of the target
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
        num_near=sum(row.placement_error_mm <= NEAR_MM for row in down),
        num_grounded=len(grounded),
        num_precise=sum(row.failure != Failure.IMPRECISE for row in grounded),
        median_error_mm=median(row.placement_error_mm for row in down) if down else None,
    )


def print_points(points: dict[str, Point]) -> None:
    """Print a table of {name: point}; rates with their 95 % Wilson intervals."""
    header = [
        "", "training, CPU min", "success", "lifted", f"within {NEAR_MM:.0f} mm", "right intersection",
        "precise there", "median error",
    ]  # fmt: skip
    print_table(header, [[name, *_cells(point)] for name, point in points.items()])


def as_figures(points: dict[str, Point]) -> dict[str, Any]:
    """Return the points ready for JSON."""
    return {name: asdict(point) for name, point in points.items()}


def draw(points: list[Point], title: str, path: Path) -> None:
    """Write a PNG: rates over CPU minutes of training, the success rate with its interval."""
    plot = np.full((PANEL_PX[1] + 2 * MARGIN_PX[1], PANEL_PX[0] + 2 * MARGIN_PX[0], 3), 255, dtype=np.uint8)
    end = max(point.cpu_minutes for point in points)
    _draw_axes(plot, title, end)
    for point in points:
        low, high = wilson_interval(point.num_successes, point.num_episodes)
        across = point.cpu_minutes / end
        cv2.line(plot, _place(across, low), _place(across, high), BAND, 7)
    curves = {
        "lifted": ([p.num_lifted / p.num_episodes for p in points], LIFTED_BGR),
        "right intersection": ([p.num_grounded / p.num_episodes for p in points], GROUNDED_BGR),
        "success (within 10 mm)": ([p.num_successes / p.num_episodes for p in points], SUCCESS_BGR),
    }
    for number, (name, (shares, color)) in enumerate(curves.items()):
        places = [_place(p.cpu_minutes / end, share) for p, share in zip(points, shares, strict=True)]
        thickness = 2 * (len(curves) - number)  # the later ones are drawn over the others, where they agree
        cv2.polylines(plot, [np.array(places)], False, color, thickness, cv2.LINE_AA)
        for place in places:
            cv2.circle(plot, place, 2 + thickness, color, -1, cv2.LINE_AA)
        legend = (MARGIN_PX[0] + number * PANEL_PX[0] // len(curves), plot.shape[0] - 10)
        _write(plot, name, legend, color)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), plot):
        raise OSError(f"{path} cannot be written")


def _cells(point: Point) -> list[str]:
    n, error_mm = point.num_episodes, point.median_error_mm
    return [
        f"{point.cpu_minutes:.1f}",
        format_rate(point.num_successes, n),
        f"{point.num_lifted}/{n}",
        f"{point.num_near}/{n}",
        format_rate(point.num_grounded, n),
        format_rate(point.num_precise, point.num_grounded) if point.num_grounded else "-",
        "-" if error_mm is None else f"{error_mm:.1f} mm",
    ]


def _place(across: float, up: float) -> tuple[int, int]:
    """Pixel of shares of the plot's width and height."""
    return round(MARGIN_PX[0] + across * PANEL_PX[0]), round(MARGIN_PX[1] + (1 - up) * PANEL_PX[1])


def _draw_axes(plot: np.ndarray, title: str, end_minutes: float) -> None:
    for tenths in range(0, 11, 2):
        up, across = tenths / 10, tenths / 10
        cv2.line(plot, _place(0, up), _place(1, up), GRID, 1)
        _write(plot, f"{10 * tenths} %", (MARGIN_PX[0] - 58, _place(0, up)[1] + 5), INK)
        x = _place(across, 0)[0]
        _write(plot, f"{across * end_minutes:.1f}", (x - 14, MARGIN_PX[1] + PANEL_PX[1] + 20), INK)
    cv2.rectangle(plot, _place(0, 0), _place(1, 1), INK, 1)
    _write(plot, title, (MARGIN_PX[0], MARGIN_PX[1] - 18), INK)
    _write(plot, "CPU minutes of training", (_place(0.35, 0)[0], plot.shape[0] - 32), INK)


def _write(plot: np.ndarray, text: str, place: tuple[int, int], color: tuple[int, int, int]) -> None:
    cv2.putText(plot, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.48, color, 1, cv2.LINE_AA)
