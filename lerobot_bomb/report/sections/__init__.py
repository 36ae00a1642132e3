"""The sections of a report, a file each, in the order of the page."""

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import (
    axes,
    board,
    comparisons,
    conditions,
    efficiency,
    failures,
    language,
    missing,
    published,
    run,
    samples,
    sensitivity,
    summary,
)
from lerobot_bomb.report.table import Section

SECTIONS = (
    summary, conditions, axes, sensitivity, comparisons, language, failures, samples, board, efficiency,
    published, run, missing,
)  # fmt: skip


def build(report: Report) -> list[Section]:
    """Build the sections that the episodes have something for."""
    sections = [module.section(report) for module in SECTIONS]
    return [section for section in sections if section.tables or section.lines]
