"""Section `missing`: what these files lack, and how to get it."""

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import efficiency, language
from lerobot_bomb.report.table import Section

LANGUAGE = (
    "Language use: no policy was given another instruction than the episode's (records of earlier releases "
    "do not say it). lerobot-bomb audit FOLDER --policy.path=CHECKPOINT does that on bomb; "
    "report on FOLDER/first/results.jsonl and FOLDER/second/results.jsonl together. Elsewhere: evaluate "
    "CHECKPOINT and a copy of it with ReplaceTasks (lerobot_bomb.explain.interventions), and report on both."
)
EFFICIENCY = (
    "Efficiency: these records have neither the cost of queries nor smoothness, which earlier releases did "
    "not measure. Evaluate again."
)
FILMS = (
    "Filmstrips: lerobot-bomb report ... --films=N replays N failures of each class, and shows them; "
    "--videos=N adds videos."
)


def section(report: Report) -> Section:
    """Write a line for each part that is missing."""
    is_missing = {
        LANGUAGE: not language.section(report).tables,
        EFFICIENCY: not efficiency.is_measured(report),
        FILMS: bool(report.samples) and not any(each.film or each.note for each in report.samples),
    }
    lines = [line for line, missing in is_missing.items() if missing]
    return Section("Not in these files", [], lines)
