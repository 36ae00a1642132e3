"""Section `missing`: what the episodes have nothing for, and how to get it."""

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import efficiency, language
from lerobot_bomb.report.table import Section

LANGUAGE = (
    "Language use: no line says that its policy was told another instruction than the episode's (lines of "
    "earlier releases never do). lerobot-bomb audit FOLDER --policy.path=CHECKPOINT plays that on bomb; "
    "report on FOLDER/first/results.jsonl and FOLDER/second/results.jsonl together. Elsewhere: evaluate "
    "CHECKPOINT and a copy of it with ReplaceTasks (lerobot_bomb.explain.interventions), and report on both."
)
EFFICIENCY = (
    "Efficiency: these lines do not say what queries took, nor how smooth actions were; earlier releases did "
    "not measure it. Evaluate again."
)
VIDEOS = "Videos: lerobot-bomb report ... --videos=N plays N failures of each class again, and shows them."


def section(report: Report) -> Section:
    """Write a line for each part that is missing."""
    is_missing = {
        LANGUAGE: not language.section(report).tables,
        EFFICIENCY: not efficiency.is_measured(report),
        VIDEOS: bool(report.samples) and not any(each.video or each.note for each in report.samples),
    }
    lines = [line for line, missing in is_missing.items() if missing]
    return Section("Not in these files", [], lines)
