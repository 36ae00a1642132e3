"""Section `errors`: how far from their targets stones were put down."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from lerobot_bomb.report.chart import COLORS, INK, MAX_SERIES, WIDTH, Chart, chart_texts, draw, tidy
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import MAX_TOLD, Cell, Section, Statement, Table
from lerobot_bomb.results.bomb import EpisodeResult, put_down
from lerobot_bomb.results.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

type Errors = Mapping[tuple[str, str], list[float]]  # of a group and "unperturbed" or "perturbed"

TITLE = "Placement error"
PERCENTILES = range(0, 101, 5)
SMALLEST_MM = 0.05  # of the axis
MAX_STEPS = 400  # of a curve
NOTE = (
    "Share of the stones, put down on the board, that lie within a distance of their target; the vertical "
    "line is what is allowed. Stones that were "
    "dropped, never grasped or still held do not count."
)


def section(report: Report) -> Section:
    """Write the section: the distribution of each policy, unperturbed and perturbed."""
    errors = _errors(report)
    if not errors:
        return Section(TITLE, [])
    rows = [_row(name, found) for name, found in errors.items()]
    table = Table("", ["policy, suite", "stones", *(f"p{each}, mm" for each in PERCENTILES)], rows)
    groups = list(dict.fromkeys(group for group, _ in errors))
    shown = groups[:MAX_SERIES]
    note = (
        f"{NOTE} Shown: the first {MAX_SERIES}; the numbers are of all." if len(groups) > MAX_SERIES else NOTE
    )
    tolerances = sorted(
        {each.spec.success_tolerance_mm for group in report.groups for each in _placed(group.records)}
    )
    title = "How precisely stones were put down"
    chart = Chart(title, _curves(title, shown, errors, tolerances), [table], note)
    return Section(TITLE, [], statements=_told(errors)[:MAX_TOLD], charts=[chart])


def _told(errors: Errors) -> list[Statement]:
    """Give the median errors of each group: 'act: median 0.5 mm (20 unperturbed stones).'."""
    medians: dict[str, list[str]] = {}
    for (group, kind), found in errors.items():
        medians.setdefault(group, []).append(f"{median(found):.1f} mm ({len(found)} {kind} stones)")
    return [Statement(f"{name}:", f"median {' and '.join(each)}.") for name, each in medians.items()]


def _placed(records: Sequence[Record]) -> list[EpisodeResult]:
    return [each for each in put_down(records) if each.target is not None]


def _errors(report: Report) -> Errors:
    """Return the sorted errors of each group, unperturbed and perturbed, in mm."""
    found = {
        (report.label(group), kind): sorted(each.placement_error_mm for each in _placed(records))
        for group in report.groups
        for kind, records in (("unperturbed", group.nominal), ("perturbed", group.perturbed))
    }
    return {name: errors for name, errors in found.items() if errors}


def _row(name: tuple[str, str], errors: list[float]) -> list[Cell]:
    """Return the percentiles of a group's errors."""
    found = np.percentile(errors, PERCENTILES, method="inverted_cdf").tolist()
    return [Cell(", ".join(name)), Cell(str(len(errors)), len(errors)), *(Cell(f"{e:.2f}", e) for e in found)]


def _curves(title: str, shown: list[str], errors: Errors, tolerances: list[float]) -> str:
    def paint(figure: "Figure") -> None:
        axes = figure.subplots()
        labels = chart_texts([f"{group}, {kind}" for group, kind in errors])
        for ((group, kind), found), label in zip(errors.items(), labels, strict=True):
            if group in shown:
                style, color = "-" if kind == "unperturbed" else ":", COLORS[shown.index(group)]
                # of very many stones, so many steps that none is seen
                counts = np.linspace(0, len(found), min(len(found), MAX_STEPS) + 1).astype(int)
                errors_mm = np.maximum(found, SMALLEST_MM)[np.maximum(counts - 1, 0)]
                shares = 100 * counts / len(found)
                axes.plot(errors_mm, shares, style, color=color, label=label, drawstyle="steps-post")
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
