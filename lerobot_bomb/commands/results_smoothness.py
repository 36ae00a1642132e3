"""``lerobot-bomb results smoothness``: how smoothly people and policies moved, side by side."""

import argparse
import json
import math
from dataclasses import asdict, replace

from lerobot_bomb.commands.arguments import add_dataset_arguments, path_flag
from lerobot_bomb.files import check_new_file, written_whole

LEGEND = """
Mean length of second (J2) and third (J3) differences {per}; in the dataset's units, and normalised by the
standard deviations in {dataset} [95 % bootstrap interval over episodes]"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add_dataset_arguments(parser, ", whose units count")
    paths = "to compare with it: files of `lerobot-bomb results actions`, folders of LeRobotDatasets"
    add("paths", nargs="*", type=path_flag, metavar="PATH", help=paths)
    exclude = "action dims that do not count, as x,y; empty: all count (default: all named 'gripper')"
    add("--exclude", type=lambda text: [name for name in text.split(",") if name], help=exclude)
    add("--per_second", action="store_true", help="differences per s^2 and s^3 instead of per step")
    add("--fps", type=float, help="actions a second (default: as each dataset and file says)")
    add("--json", type=path_flag, help="also write all figures to this new file, those of every episode too")


def run(args: argparse.Namespace) -> int:
    """Measure, print the tables, write the JSON file."""
    _check_flags(args)
    # LeRobot and torch: seconds
    from lerobot.utils.constants import ACTION

    from lerobot_bomb.data.columns import dim_names, read_meta
    from lerobot_bomb.evaluation import smoothness_report as report
    from lerobot_bomb.evaluation.executed import executed_in_dataset, read_executed

    meta = read_meta(args.repo_id, args.root)
    dataset = executed_in_dataset(meta, args.repo_id)
    names = dim_names(meta.features[ACTION])
    units = report.make_units(dataset, names, args.exclude, args.per_second)
    compared = [dataset, *map(read_executed, args.paths)]
    if args.fps is not None:
        compared = [replace(executed, fps=args.fps) for executed in compared]
    report.check_comparable(compared, args.per_second)
    rows = {executed.name: report.measure_row(executed, units) for executed in compared}
    first, *others = [executed.name for executed in compared if executed.is_seeded] or [""]
    differences = {name: report.measure_difference(first, name, rows) for name in others}
    excluded = [names[dim] for dim in units.exclude]
    print(f"action dims {', '.join(names)}; left out: {', '.join(excluded) or 'none'}")
    report.print_rows(rows)
    if differences:
        report.print_differences(first, differences)
    per = "per s^2 and s^3" if units.per_second else "per step"
    print(LEGEND.format(per=per, dataset=args.repo_id))
    if args.json is not None:
        figures = {
            "dims": names,
            "excluded": excluded,
            "std": units.std.tolist(),
            "per_second": units.per_second,
            "rows": {name: asdict(row) for name, row in rows.items()},
            "differences": {name: {"from": first, **asdict(change)} for name, change in differences.items()},
        }
        with written_whole(args.json) as (path,):
            path.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")
    return 0


def _check_flags(args: argparse.Namespace) -> None:
    if args.json is not None:
        check_new_file("--json", args.json)
    if args.fps is not None and not 0 < args.fps < math.inf:
        raise ValueError(f"--fps={args.fps:g} must be a positive number of actions a second")
