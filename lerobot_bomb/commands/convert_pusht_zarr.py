"""``lerobot-bomb convert pusht-zarr``: PushT demonstrations as a LeRobotDataset."""

import argparse

from lerobot_bomb.commands.conversions import add_conversion_arguments, new_root
from lerobot_bomb.data.resumable import terminated_in_order


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the source, the dataset and the copies."""
    add_conversion_arguments(parser, "the folder of the zarr")
    add = parser.add_argument
    add(
        "--task",
        default="",
        help="instruction of every frame (default: none, which is what lerobot-eval gives a policy on "
        "--env.type=pusht)",
    )
    add(
        "--copies",
        type=int,
        default=0,
        help="copies of each demonstration to add: rotated by any angle, half of them mirrored, shifted, "
        "with the goal (default: 0)",
    )


def run(args: argparse.Namespace) -> int:
    """Convert, and print where the dataset is."""
    root = new_root(args)
    from lerobot_bomb.data.pusht_conversion import convert_pusht

    with terminated_in_order():
        progress = convert_pusht(args.path, args.repo_id, root, args.task, args.resume, args.copies)
    print(f"{progress.num_episodes} episodes, {progress.num_frames} frames: {root}")
    return 0
