"""Arguments that all conversions share."""

import argparse
from pathlib import Path

from lerobot_bomb.commands.arguments import add_new_dataset_arguments, path_flag, switch
from lerobot_bomb.data.resumable import check_repo_id, default_root


def add_conversion_arguments(parser: argparse.ArgumentParser, path: str) -> None:
    """Declare source and dataset of a conversion."""
    parser.add_argument("path", type=path_flag, help=path)
    add_new_dataset_arguments(parser)
    summary = "continue an interrupted conversion"
    parser.add_argument("--resume", **switch(), help=summary)


def new_root(args: argparse.Namespace) -> Path:
    """Return the folder of the new dataset.

    Raises:
        ValueError: its name is not valid on the Hub.
    """
    check_repo_id(args.repo_id)
    return args.root or default_root(args.repo_id)
