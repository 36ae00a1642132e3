"""Sections of a report, one file each, in the order of the page; those of other packages come last."""

from collections.abc import Callable

from lerobot_bomb.registry import Registry
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Section

NAMES = (
    "summary", "conditions", "axes", "sensitivity", "comparisons", "language", "failures", "samples", "board",
    "efficiency", "published", "run", "missing",
)  # fmt: skip
SECTIONS = Registry[Callable[[Report], Section]](
    "lerobot_bomb.report_sections", {name: f"{__name__}.{name}:section" for name in NAMES}
)


def build(report: Report) -> list[Section]:
    """Build the sections, without those that have neither tables nor lines."""
    sections = [section(report) for section in SECTIONS.values()]
    return [section for section in sections if section.tables or section.lines]
