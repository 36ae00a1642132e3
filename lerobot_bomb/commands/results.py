"""``lerobot-bomb results``: summary of the files of ``--env.results_path``."""

import argparse
from pathlib import Path

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.results_files import read_undamaged
from lerobot_bomb.results.groups import Group, by_condition, differing, groups_of, rate_of
from lerobot_bomb.results.summary import pair_lines, summarise
from lerobot_bomb.tables import print_lines, print_table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path"
    )
    parser.add_argument("--strict", action="store_true", help="refuse files with damaged records")


def run(args: argparse.Namespace) -> int:
    """Print rates by condition for each file, and the changes under perturbations, in pairs."""
    for path in args.paths:
        file = read_undamaged(path)
        if args.strict and file.num_damaged:
            raise ValueError(f"{path}: damaged records, which --strict refuses: {file.num_damaged}")
        _print_file(path, groups_of(file.records), file.num_damaged)
    return 0


def _print_file(path: Path, groups: list[Group], num_damaged: int) -> None:
    if num_damaged:
        print(f"{path}: damaged records, which are not counted: {num_damaged}")
    if len(groups) > 1:
        print(
            f"{path}: {len(groups)} groups of episodes, neither pooled nor paired with each other; they "
            f"differ in {', '.join(differing(groups))}"
        )
        _print_rates(groups)
    for group in groups:
        print_lines(*(f"{path}: {line}" for line in group.lines()))
        if group.missing_fields:
            version = group.records[0].protocol_version
            lacking = ", ".join(group.missing_fields)
            print(f"{path}: records of protocol {version} lack {lacking}")
        if group.num_replaced:
            print(f"{path}: {group.num_replaced} records are replaced by later ones of the same episode")
        conditions = by_condition(group.records)
        for condition, records in conditions.items():
            label = f" (perturbations={condition})" if len(conditions) > 1 else ""
            print(f"{path}{label}: {len(records)} episode{'s' * (len(records) != 1)}")
            print_lines(*(f"  {line}" for line in summarise(records).lines()))
        against = pair_lines(group, groups)
        if against:
            print(f"{path}: against the same episodes unperturbed", *against, sep="\n")


def _print_rates(groups: list[Group]) -> None:
    """Print a line for each group and condition, before all details."""
    cells = [
        [group.name, condition, str(rate_of(records))]
        for group in groups
        for condition, records in by_condition(group.records).items()
    ]
    print()
    print_table(["policy, suite", "perturbations", "success, 95 % Wilson interval by seed"], cells)
    print()
