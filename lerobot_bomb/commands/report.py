"""``lerobot-bomb report``: files of results as one page, and their tables as JSON and CSV."""

import argparse
import csv
import io
import json
from pathlib import Path

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.results_files import check_outputs, read_undamaged
from lerobot_bomb.files import written_whole
from lerobot_bomb.report.page import render
from lerobot_bomb.report.tables import Section, build

TITLE, DEFAULT = "Evaluation", Path("report.html")


def add_report_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb report``."""
    parser.add_argument(
        "paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path"
    )
    parser.add_argument("--output", type=path_flag, default=DEFAULT, help=f"default: {DEFAULT}")
    parser.add_argument("--title", default=TITLE, help=f"of the page (default: {TITLE})")


def run_report(args: argparse.Namespace) -> int:
    """Write FILE.html, FILE.json and FILE.csv; print their paths."""
    output = args.output / DEFAULT if args.output.is_dir() else args.output
    if output.suffix not in ("", ".html"):
        raise ValueError(f"--output={output} must be the page's path, .html, or a folder")
    page, tables, rates = (output.with_suffix(suffix) for suffix in (".html", ".json", ".csv"))
    check_outputs(args.paths, (page, tables, rates))
    sections = build([row for path in args.paths for row in read_undamaged(path)[0]])
    with written_whole(page, tables, rates) as (html, as_json, as_csv):
        html.write_text(render(args.title, sections))
        as_json.write_text(json.dumps([section.as_json() for section in sections], indent=1) + "\n")
        as_csv.write_text(_csv(sections))
    print(page, tables, rates, sep="\n")
    return 0


def _csv(sections: list[Section]) -> str:
    """The rates by condition, a line each."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["arm", "condition", "successes", "n", "low", "high"])
    for table in (
        table for section in sections if section.title == "Success by condition" for table in section.tables
    ):
        for condition, success, *_ in table.rows:
            writer.writerow([table.title, condition.text, *success.value.values()])
    return text.getvalue()
