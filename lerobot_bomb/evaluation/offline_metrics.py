"""``lerobot-bomb offline-metrics``: a checkpoint's loss, accuracy and L1 on recorded frames.

Shapes: `R` frames that are measured.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION

from lerobot_bomb.checkpoint import read_config
from lerobot_bomb.data.columns import dim_names, read_meta
from lerobot_bomb.data.dataset_files import check_readable
from lerobot_bomb.evaluation.measures import L1, Measure, measure, measure_l1
from lerobot_bomb.evaluation.predictions import check_policy, load_dataset, load_policy, predict
from lerobot_bomb.evaluation.splits import (
    Split,
    make_split,
    parse_episodes,
    read_train_config,
    trained_episodes,
)
from lerobot_bomb.evaluation.trivial import Demonstrations
from lerobot_bomb.flags import path_flag
from lerobot_bomb.shipped import checkpoint_flag
from lerobot_bomb.tables import print_table
from lerobot_bomb.viewing.unfinished import check_writable, written_whole

POLICY = "policy"
SHOWN_STEPS = (1, 2, 3, 5, 10, 20, 50, 100)  # of the chunk, in the printed table


@dataclass(frozen=True)
class Column:
    """A split's column of the table; `l1` is {policy or trivial predictor: its L1}."""

    episodes: list[int]
    num_frames: int
    num_frames_measured: int
    losses: dict[str, Measure]
    l1: dict[str, L1]


def add_offline_metrics_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb offline-metrics``."""
    add = parser.add_argument
    path = "folder of the checkpoint that lerobot-train names pretrained_model"
    add("--policy.path", dest="policy_path", type=checkpoint_flag, required=True, help=path)
    add("--device", "--policy.device", help="cpu, cuda, ... (default: as the checkpoint says)")
    add("--dataset.repo_id", dest="repo_id", required=True, help="name of the dataset")
    root = "folder of the dataset (default: LeRobot's, $HF_LEROBOT_HOME/REPO_ID)"
    add("--dataset.root", dest="root", type=path_flag, help=root)
    spelling = "episodes as [180,181], 180-205 or [0-9,20]"
    add("--train_episodes", help=f"{spelling} (default: what the checkpoint was trained on)")
    add("--val_episodes", help=f"{spelling} (default: all others)")
    frames = "frames of each split, evenly spaced; 0 = all of them (default: 500)"
    add("--max_frames", type=int, default=500, help=frames)
    add("--batch_size", type=int, default=16, help="frames that are decoded at once (default: 16)")
    add("--json", type=path_flag, help="also write all figures to this file, those of every step too")


def run_offline_metrics(args: argparse.Namespace) -> int:
    """Measure, print the tables, write the JSON file."""
    _check_flags(args)
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
    for flag, lowest in {"max_frames": 0, "batch_size": 1}.items():
        if getattr(args, flag) < lowest:
            raise ValueError(f"--{flag}={getattr(args, flag)} must be at least {lowest}")
    if args.json is not None:
        check_writable("--json", args.json)


def _split(args: argparse.Namespace, meta: LeRobotDatasetMetadata, train_config: dict[str, Any]) -> Split:
    if not train_config and args.val_episodes is None:
        raise ValueError(
            f"--policy.path={args.policy_path} has no train_config.json to tell which episodes it was "
            "trained on; name those to judge it by with --val_episodes"
        )
    train, validation = (
        None if text is None else parse_episodes(flag, text, meta.total_episodes)
        for flag, text in (("--train_episodes", args.train_episodes), ("--val_episodes", args.val_episodes))
    )
    split = make_split(meta.total_episodes, trained_episodes(train_config, meta), train, validation)
    if split.seen:
        print(
            f"warning: {len(split.seen)} of the {len(split.validation)} validation episodes were trained on",
            file=sys.stderr,
        )
    return split


def measure_columns(
    config: PreTrainedConfig,
    meta: LeRobotDatasetMetadata,
    split: Split,
    max_frames: int,
    batch_size: int,
) -> dict[str, Column]:
    """{train, validation: its column}; a split without episodes has none."""
    policy = load_policy(config)
    dataset = load_dataset(config, meta, sorted({*split.train, *split.validation}))
    demonstrations = Demonstrations.read(meta, sorted({*split.train, *split.validation}), split.train)
    columns = {}
    for name, episodes in {"train": split.train, "validation": split.validation}.items():
        if episodes:
            rows = np.flatnonzero(np.isin(demonstrations.episode_index, episodes))
            rows_R = evenly_spaced(rows, max_frames)
            losses, l1 = _measure(policy, dataset, demonstrations, rows_R, batch_size, name)
            columns[name] = Column(episodes, len(rows), len(rows_R), losses, l1)
    return columns


def evenly_spaced(rows_N: np.ndarray, max_rows: int) -> np.ndarray:
    """At most ``max_rows`` of the rows, from the first to the last; 0 means all."""
    if max_rows == 0 or len(rows_N) <= max_rows:
        return rows_N
    return rows_N[np.linspace(0, len(rows_N) - 1, max_rows).round().astype(int)]


def _measure(
    policy: PreTrainedPolicy,
    dataset: LeRobotDataset,
    demonstrations: Demonstrations,
    rows_R: np.ndarray,
    batch_size: int,
    name: str,
) -> tuple[dict[str, Measure], dict[str, L1]]:
    """Losses, and L1 of the policy and of what it must beat."""
    predictions = predict(policy, dataset, rows_R, batch_size, name)
    chunk_size = predictions.chunks.shape[1]
    recorded_RTD, is_pad_RT = demonstrations.recorded(rows_R, chunk_size)
    chunks = {POLICY: predictions.chunks, **demonstrations.trivial(rows_R, chunk_size)}
    episode_R, dims = demonstrations.episode_index[rows_R], dim_names(dataset.features[ACTION])
    return (
        {key: measure(values_R, episode_R) for key, values_R in predictions.losses.items()},
        {key: measure_l1(of, recorded_RTD, is_pad_RT, episode_R, dims) for key, of in chunks.items()},
    )


def print_columns(columns: dict[str, Column]) -> None:
    """Print the columns side by side, and the last one's L1 by step of the chunk."""
    shown = list(columns.values())
    rows = [
        ["episodes", *(str(len(column.episodes)) for column in shown)],
        ["frames", *(f"{column.num_frames_measured} of {column.num_frames}" for column in shown)],
    ]
    for name in shown[-1].losses:
        label = name if name == "loss" else f"forward: {name}"
        rows.append([label, *(_text(column.losses.get(name)) for column in shown)])
    for name, l1 in shown[-1].l1.items():
        rows.append([f"L1, {name}", *(str(column.l1[name].all) for column in shown)])
        if name == POLICY and len(l1.dims) > 1:
            rows += [[f"  {dim}", *(str(column.l1[name].dims[dim]) for column in shown)] for dim in l1.dims]
    print_table(["", *columns], rows)
    l1 = shown[-1].l1
    num_steps = len(l1[POLICY].steps)
    steps = sorted({step for step in SHOWN_STEPS if step < num_steps} | {num_steps})
    print(f"\nL1 by step of the chunk, {list(columns)[-1]}")
    print_table(
        ["step", *l1],
        [[str(step), *(f"{of.steps[step - 1].mean:.4g}" for of in l1.values())] for step in steps],
    )
    print("\n[95 % bootstrap interval over episodes]; L1 of decoded actions, in the dataset's units")


def _text(measure: Measure | None) -> str:
    return "-" if measure is None else str(measure)
