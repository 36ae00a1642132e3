"""``lerobot-bomb record merge``: several datasets as one."""

import argparse

from lerobot_bomb.commands.arguments import add_new_dataset_arguments, path_flag
from lerobot_bomb.commands.conversions import new_root


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the datasets and the new one."""
    parser.add_argument("folders", type=path_flag, nargs="+", metavar="FOLDER", help="a dataset's folder")
    add_new_dataset_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Merge, and print where the dataset is."""
    root = new_root(args)
    from lerobot_bomb.data.merge import merge_datasets

    episodes, frames = merge_datasets(args.folders, args.repo_id, root)
    print(f"{episodes} episodes, {frames} frames: {root}")
    return 0
