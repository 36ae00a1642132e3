"""Sections of a report, one file each, in the order of the page; those of other packages come last."""

from collections.abc import Callable

from lerobot_bomb.registry import Registry
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Section

NAMES = (
    "answer", "failures", "errors", "board", "samples", "axes", "map",
    "efficiency", "comparisons", "language", "published", "run", "missing",
)  # fmt: skip
SECTIONS = Registry[Callable[[Report], Section]](
    "lerobot_bomb.report_sections", {name: f"{__name__}.{name}:section" for name in NAMES}
)


def build(report: Report) -> list[Section]:
    """Build the sections, without those that are empty."""
    sections = [section(report) for section in SECTIONS.values()]
    return [each for each in sections if each.tables or each.lines or each.charts or each.statements]
