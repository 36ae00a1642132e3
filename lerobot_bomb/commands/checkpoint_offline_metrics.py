"""``lerobot-bomb checkpoint offline-metrics``: a checkpoint's loss, accuracy and L1 on recorded frames."""

import argparse
import json
import sys
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING, Any

from lerobot_bomb.checkpoints.training import read_train_config
from lerobot_bomb.commands.arguments import (
    add_dataset_arguments,
    check_at_least,
    checkpoint_flag,
    path_flag,
)
from lerobot_bomb.files import check_writable, written_whole

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_bomb.evaluation.splits import Split


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    path = "folder of the checkpoint that lerobot-train names pretrained_model"
    add("--policy.path", dest="policy_path", type=checkpoint_flag, required=True, help=path)
    add("--device", "--policy.device", help="cpu, cuda, ... (default: as the checkpoint says)")
    add_dataset_arguments(parser)
    spelling = "episodes as [180,181], 180-205 or [0-9,20]"
    add("--train_episodes", help=f"{spelling} (default: what the checkpoint was trained on)")
    add("--val_episodes", help=f"{spelling} (default: all others)")
    frames = "frames of each split, evenly spaced; 0 = all of them (default: 500)"
    add("--max_frames", type=int, default=500, help=frames)
    add("--batch_size", type=int, default=16, help="frames that are decoded at once (default: 16)")
    add("--json", type=path_flag, help="also write all figures to this file, those of every step too")


def run(args: argparse.Namespace) -> int:
    """Measure, print the tables, write the JSON file."""
    _check_flags(args)
    # LeRobot and torch: seconds
    from lerobot_bomb.checkpoints.folder import read_config
    from lerobot_bomb.data.columns import read_meta
    from lerobot_bomb.data.dataset_files import check_readable
    from lerobot_bomb.evaluation.offline_metrics import measure_columns, print_columns
    from lerobot_bomb.evaluation.predictions import check_policy

    config = read_config(args.policy_path, args.device)
    meta = read_meta(args.repo_id, args.root)
    check_readable(meta.root)
    train_config = read_train_config(args.policy_path)
    check_policy(config, meta, train_config.get("rename_map") or {})
    split = _split(args, meta, train_config)
    columns = measure_columns(config, meta, split, args.max_frames, args.batch_size)
    print(f"{args.policy_path} ({config.type}) on {meta.repo_id}")
    print_columns(columns)
    if args.json is not None:
        figures = {
            "policy_path": str(args.policy_path),
            "policy_type": config.type,
            "device": str(config.device),
            "batch_size": args.batch_size,
            "dataset": meta.repo_id,
            "validation_episodes_trained_on": split.seen,
            "columns": {name: asdict(column) for name, column in columns.items()},
        }
        with written_whole(args.json) as (path,):
            path.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")
    return 0


def _check_flags(args: argparse.Namespace) -> None:
    check_at_least(args, max_frames=0, batch_size=1)
    if args.json is not None:
        check_writable("--json", args.json)


def _split(args: argparse.Namespace, meta: "LeRobotDatasetMetadata", train_config: dict[str, Any]) -> "Split":
    from lerobot_bomb.evaluation.splits import make_split, parse_episodes, trained_episodes
    from lerobot_bomb.hub.history import History

    if not train_config and args.val_episodes is None:
        raise ValueError(
            f"--policy.path={args.policy_path} has no train_config.json to tell which episodes it was "
            "trained on; name those to judge it by with --val_episodes"
        )
    train, validation = (
        None if text is None else parse_episodes(flag, text, meta.total_episodes)
        for flag, text in (("--train_episodes", args.train_episodes), ("--val_episodes", args.val_episodes))
    )
    history = History.read(args.policy_path)
    if not history.is_whole:
        print(
            "warning: not every training of the checkpoint is known, so validation episodes may have been "
            "trained on",
            file=sys.stderr,
        )
    trained = chain(*(trained_episodes(each.train_config, meta) or [] for each in history.trainings))
    split = make_split(meta.total_episodes, sorted(set(trained)), train, validation)
    if split.seen:
        print(
            f"warning: {len(split.seen)} of the {len(split.validation)} validation episodes were trained on",
            file=sys.stderr,
        )
    return split
