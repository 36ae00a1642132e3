"""``lerobot-bomb checkpoint merge``: adapters and their base as one checkpoint that loads without `peft`."""

import argparse

from lerobot_bomb.commands.arguments import add_folder_arguments
from lerobot_bomb.files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the adapters and the new folder."""
    add_folder_arguments(parser, "the adapters' checkpoint", "new folder for the checkpoint")


def run(args: argparse.Namespace) -> int:
    """Write config, merged weights and processors."""
    check_new_folder("--output", args.output)
    from lerobot_bomb.checkpoints.merging import merge  # LeRobot and torch: seconds

    merge(args.policy_path, args.output)
    print(f"written to {args.output}: --policy.path={args.output}")
    return 0
