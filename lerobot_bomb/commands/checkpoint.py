"""``lerobot-bomb checkpoint``: where a checkpoint lies that comes with this package."""

import argparse

from lerobot_bomb.checkpoints.shipped import FOLDER, PREFIX, shipped_checkpoint, shipped_names


def add_checkpoint_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the argument of ``lerobot-bomb checkpoint``."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="print only the folder of this one")


def run_checkpoint(args: argparse.Namespace) -> int:
    """Print the folder of one, or name and folder of all."""
    if args.name is not None:
        print(shipped_checkpoint(args.name.removeprefix(PREFIX)))
        return 0
    for name in shipped_names():
        print(f"{PREFIX}{name}  {FOLDER / name}")
    return 0
