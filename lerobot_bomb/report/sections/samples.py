"""Failures to look at."""

from lerobot_bomb.report.report import Report, Sample
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.record import NO_VALUE

TITLE = "Failures to look at"
NOTE = (
    "A random sample of each class. 'replay' writes a video and a recording for Rerun; add the flags "
    "--policy.NAME=VALUE of the evaluation, if it had any. 'explain' shows what its actions depend on."
)


def section(report: Report) -> Section:
    """Write the section: a table for each group with failures."""
    by_group: dict[str, list[Sample]] = {}
    for sample in report.samples:
        by_group.setdefault(sample.group, []).append(sample)
    return Section(TITLE, [_table(name, samples) for name, samples in by_group.items()])


def _table(name: str, samples: list[Sample]) -> Table:
    has_videos = any(each.video or each.note for each in samples)
    header = ["failure", "condition", "seed", "instruction", "replay", "explain"]
    header += ["video"] if has_videos else []
    rows = [_row(each)[: len(header)] for each in samples]
    return Table(name, header, rows, NOTE)


def _row(sample: Sample) -> list[Cell]:
    spec = sample.record.spec
    return [
        Cell(sample.record.failure or ""),
        Cell(spec.perturbations),
        Cell(str(spec.seed), spec.seed),
        Cell(getattr(sample.record, "instruction", NO_VALUE)),
        Cell(sample.command),
        Cell(sample.explanation),
        Cell(sample.note, sample.video or sample.note, video=sample.video),
    ]
