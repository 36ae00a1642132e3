"""``lerobot-bomb results``: what files of ``--env.results_path`` say."""

import argparse
from pathlib import Path

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.results_files import read_undamaged
from lerobot_bomb.evaluation.result_groups import by_condition, differing, rate_of
from lerobot_bomb.evaluation.results import pair_lines, summarise
from lerobot_bomb.report.arms import Arm, arms_of
from lerobot_bomb.tables import print_lines, print_table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path"
    )
    parser.add_argument("--strict", action="store_true", help="a damaged line is an error, not a message")


def run(args: argparse.Namespace) -> int:
    """Print, of each file, what compares: rates by condition, and what perturbations changed in pairs."""
    for path in args.paths:
        file = read_undamaged(path)
        if args.strict and file.num_damaged:
            raise ValueError(f"{path}: damaged lines, which --strict refuses: {file.num_damaged}")
        _print_file(path, arms_of(file.rows), file.num_damaged)
    return 0


def _print_file(path: Path, arms: list[Arm], num_damaged: int) -> None:
    groups = [arm.group for arm in arms]
    if num_damaged:
        print(f"{path}: damaged lines, which are not counted: {num_damaged}")
    if len(groups) > 1:
        print(
            f"{path}: {len(groups)} groups of episodes, neither pooled nor paired with each other; they "
            f"differ in {', '.join(differing(groups))}"
        )
        _print_rates(arms)
    for group in groups:
        print_lines(*(f"{path}: {line}" for line in group.lines()))
        if group.missing_fields:
            version = group.rows[0]["protocol_version"]
            lacking = ", ".join(group.missing_fields)
            print(f"{path}: lines of protocol {version} are incomplete: they lack {lacking}")
        if group.num_replaced:
            print(f"{path}: {group.num_replaced} lines count no more, a later one is of the same episode")
        conditions = by_condition(group.rows)
        for condition, rows in conditions.items():
            label = f" (perturbations={condition})" if len(conditions) > 1 else ""
            print(f"{path}{label}: {len(rows)} episode{'s' * (len(rows) != 1)}")
            print_lines(*(f"  {line}" for line in summarise(rows).lines()))
        against = pair_lines(group, groups)
        if against:
            print(f"{path}: against the same episodes unperturbed", *against, sep="\n")


def _print_rates(arms: list[Arm]) -> None:
    """Print a line for each group and condition, before what else there is to say of them."""
    cells = [
        [arm.name, condition, str(rate_of(rows))]
        for arm in arms
        for condition, rows in by_condition(arm.rows).items()
    ]
    print()
    print_table(["policy, suite", "perturbations", "success, 95 % Wilson interval by seed"], cells)
    print()
