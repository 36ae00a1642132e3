"""``lerobot-bomb report``: files of results as one page, and their tables as JSON and CSV."""

import argparse
import csv
import io
import json
import sys
from pathlib import Path

from tqdm import tqdm

from lerobot_bomb.commands.arguments import add_names_flag, check_at_least, path_flag
from lerobot_bomb.commands.results_files import check_outputs, names_of, read_together, tell_replaced
from lerobot_bomb.files import written_whole
from lerobot_bomb.report.page import render
from lerobot_bomb.report.report import Report, Sample, sample_failures
from lerobot_bomb.report.sections import build
from lerobot_bomb.report.title import title_of
from lerobot_bomb.results.groups import groups_of
from lerobot_bomb.tables import print_lines

DEFAULT = Path("report.html")
NUM_SAMPLES = 3  # of each class of failure, at least


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path")
    add("--output", type=path_flag, default=DEFAULT, help=f"page (default: {DEFAULT})")
    add("--title", help="title of the page (default: the policies, tasks and number of episodes)")
    add_names_flag(parser)
    films = "replay this many failures of each class, and show filmstrips of them (default: 0)"
    add("--films", type=int, metavar="N", default=0, help=films)
    videos = "the same with videos beside the filmstrips (default: 0)"
    add("--videos", type=int, metavar="N", default=0, help=videos)


def run(args: argparse.Namespace) -> int:
    """Write FILE.html, FILE.json and FILE.csv, and videos; print the answers and their paths."""
    check_at_least(args, films=0, videos=0)
    output = args.output / DEFAULT if args.output.is_dir() else args.output
    if output.suffix not in ("", ".html"):
        raise ValueError(f"--output={output} must be the page's path, .html, or a folder")
    page, tables, rates = (output.with_suffix(suffix) for suffix in (".html", ".json", ".csv"))
    check_outputs(args.paths, (page, tables, rates))
    files = read_together(args.paths)
    records = [record for file in files for record in file.records]
    groups = groups_of(records, names_of(args.names, records))
    numbered = {file.path: file.numbered for file in files}
    samples = list(sample_failures(groups, numbered, max(NUM_SAMPLES, args.films, args.videos)))
    folder = page.with_name(f"{page.stem}_videos")
    if args.films or args.videos:
        samples = _add_pictures(samples, folder, args.films, args.videos)
    missing = [file.missing for file in files if file.missing]
    missing += [
        f"{file.path}: {file.num_damaged} damaged records are not counted"
        for file in files
        if file.num_damaged
    ]
    missing += tell_replaced(groups)
    report = Report(groups, samples, missing)
    sections = build(report)
    with written_whole(page, tables, rates) as (html, as_json, as_csv):
        html.write_text(render(args.title or title_of(report), sections))
        as_json.write_text(json.dumps([section.as_json() for section in sections], indent=1) + "\n")
        as_csv.write_text(_csv(report))
    print_lines(*map(str, sections[0].statements), "")  # those of the answer
    print(page, tables, rates, *([folder] if folder.is_dir() and args.videos else []), sep="\n")
    return 0


def _add_pictures(samples: list[Sample], folder: Path, num_films: int, num_videos: int) -> list[Sample]:
    from lerobot_bomb.report.videos import with_pictures  # LeRobot and rerun: seconds

    pictured = with_pictures(samples, folder, num_films, num_videos)
    shown = list(tqdm(pictured, total=len(samples), unit=" failures"))
    missing = [each for each in shown if each.note and not each.film]
    if missing:
        print(
            f"failures that could not be shown: {len(missing)}, as {missing[0].command}: {missing[0].note}",
            file=sys.stderr,
        )
    return shown


def _csv(report: Report) -> str:
    """Write the rates by condition as CSV, a line each."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["group", "condition", "successes", "n", "low", "high"])
    for panel in report.panels:
        for series in panel.series:
            for condition, found in series.rates.items():
                bounds = found.interval or (None, None)
                writer.writerow([series.group.name, condition, found.successes, found.n, *bounds])
    return text.getvalue()
