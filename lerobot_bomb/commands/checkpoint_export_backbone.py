"""``lerobot-bomb checkpoint export-backbone``: a vision-language model as a folder, a base for others.

A policy of any type that reads the same family of models can start from it:
``--policy.vlm_model_name=FOLDER``.
"""

import argparse

from lerobot_bomb.commands.arguments import add_folder_arguments
from lerobot_bomb.files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the checkpoint and the new folder."""
    add_folder_arguments(parser, "the checkpoint", "new folder")


def run(args: argparse.Namespace) -> int:
    """Write config, weights and tokenizer in transformers' format."""
    check_new_folder("--output", args.output)
    from lerobot_bomb.checkpoints.backbone import export_backbone  # LeRobot and torch: seconds

    export_backbone(args.policy_path, args.output)
    print(f"written to {args.output}: start from it with --policy.vlm_model_name={args.output}")
    return 0
