"""Failures to look at."""

from html import escape

from lerobot_bomb.report.page import film_figure
from lerobot_bomb.report.report import Report, Sample
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.tables import shorten

TITLE = "Failures to look at"
NOTE = (
    "A random sample of each class. 'replay' writes a video and a recording for Rerun; add the flags "
    "--policy.NAME=VALUE of the evaluation, if it had any. 'explain' shows what its actions depend on."
)
LEGEND = (
    "Each filmstrip is an episode that was run again: its start, its first lift (or where the gripper "
    "closed without one, or its middle), its end. Pink outlines are the targets; r0 to r4 and c0 to c4 "
    "number rows and columns of BOMB's board; 'covered' is the share of PushT's target under the block."
)
MAX_NAME = 100  # characters of a group's name in a heading


def section(report: Report) -> Section:
    """Write the section: filmstrips by class, if there are any, and a table for each group with failures."""
    by_group: dict[str, list[Sample]] = {}
    for sample in report.samples:
        by_group.setdefault(sample.group, []).append(sample)
    tables = [_table(name, samples) for name, samples in by_group.items()]
    return Section(TITLE, tables, figures=_films(by_group))


def _films(by_group: dict[str, list[Sample]]) -> str:
    """Return HTML: the filmstrips of each group and class; '' if there are none."""
    parts = []
    for name, samples in by_group.items():
        by_class: dict[str, list[Sample]] = {}
        for sample in samples:
            if sample.film is not None:
                by_class.setdefault(str(sample.record.failure), []).append(sample)
        for failure, filmed in by_class.items():
            heading = f'<h3 title="{escape(name)}">{escape(shorten(name, MAX_NAME))}: {escape(failure)}</h3>'
            parts += [heading, *map(_film, filmed)]
    return "\n".join([f'<p class="note">{escape(LEGEND)}</p>', *parts]) if parts else ""


def _film(sample: Sample) -> str:
    """Return HTML: a filmstrip, what it shows in words, and the commands that show more."""
    assert sample.film is not None
    spec, record = sample.record.spec, sample.record
    words = [getattr(record, "instruction", ""), f"{record.failure}, {spec.perturbations}, seed {spec.seed}"]
    words += [sample.note] if sample.note else []
    told = ". ".join(word.rstrip(".") for word in words if word)
    commands = "\n".join(filter(None, (sample.command, sample.explanation)))
    return film_figure(
        sample.film, told, f"<figcaption>{escape(told)}</figcaption><pre>{escape(commands)}</pre>"
    )


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
        Cell(getattr(sample.record, "instruction", "-")),
        Cell(sample.command),
        Cell(sample.explanation),
        Cell(sample.note, sample.video or sample.note, video=sample.video),
    ]
