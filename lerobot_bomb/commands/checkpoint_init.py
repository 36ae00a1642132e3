"""``lerobot-bomb checkpoint init``: a policy before its training, as a checkpoint for a dataset.

LeRobot trains adapters on a checkpoint only: `lerobot-train --policy.path=DIR --peft.method_type=LORA`.
"""

import argparse

from lerobot_bomb.commands.arguments import add_dataset_arguments, path_flag
from lerobot_bomb.files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare dataset, folder and seed; LeRobot's parser reads the policy's flags."""
    parser.set_defaults(rest=[])
    flags = "--policy.type=TYPE --dataset.repo_id=ID --output=DIR (all flags --policy.*)"
    parser.usage = f"{parser.prog} {flags}"
    add_dataset_arguments(parser)
    add = parser.add_argument
    add("--output", type=path_flag, required=True, help="new folder for the checkpoint")
    add("--seed", type=int, default=1000, help="of what has random weights (default: 1000, lerobot-train's)")


def run(args: argparse.Namespace) -> int:
    """Write config, weights and processors with the dataset's features and statistics."""
    check_new_folder("--output", args.output)
    from lerobot_bomb.checkpoints.initial import write_initial  # LeRobot and torch: seconds

    write_initial(args.rest, args.repo_id, args.root, args.output, args.seed)
    print(f"written to {args.output}: train it with lerobot-train --policy.path={args.output}")
    return 0
