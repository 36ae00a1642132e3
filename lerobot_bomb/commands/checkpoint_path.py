"""``lerobot-bomb checkpoint path``: where a checkpoint lies that comes with this package."""

import argparse

from lerobot_bomb.checkpoints.shipped import FOLDER, shipped_checkpoint, shipped_names
from lerobot_bomb.results.names import SHIPPED_PREFIX


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the checkpoint's name."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="print only the folder of this one")


def run(args: argparse.Namespace) -> int:
    """Print the folder of one, or name and folder of all."""
    if args.name is not None:
        print(shipped_checkpoint(args.name.removeprefix(SHIPPED_PREFIX)))
        return 0
    for name in shipped_names():
        print(f"{SHIPPED_PREFIX}{name}  {FOLDER / name}")
    return 0
