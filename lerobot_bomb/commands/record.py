"""``lerobot-bomb record``: the scripted expert's episodes as a LeRobotDataset."""

import argparse
import sys
from dataclasses import fields

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.commands.arguments import (
    add_episode_arguments,
    add_new_dataset_arguments,
    switch,
)
from lerobot_bomb.data.record import describe_failures, record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.resumable import (
    BLOCK_EPISODES,
    default_root,
    terminated_in_order,
)


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb record``."""
    add_new_dataset_arguments(parser)
    add = parser.add_argument
    add("--episodes", type=int, required=True, help="successful episodes to record")
    add(
        "--seed",
        type=int,
        default=0,
        help="seed of the first episode; the others count up (default: 0); leave "
        f"out {TEST_SEEDS[0]} to {TEST_SEEDS[-1]}, of which evaluations are",
    )
    add_episode_arguments(parser)
    add("--images", **switch(), help="store images (lossless) instead of videos")
    add("--workers", type=int, default=1, help="simulator processes; one keeps two cores busy (default: 1)")
    add(
        "--noise",
        type=float,
        default=0.0,
        help="standard deviation of noise on the executed action, in units of the largest step, 40 mm; the "
        "stored action is clean, so recoveries are in the data; the expert bears 0.05 (default: 0)",
    )
    add(
        "--resume",
        **switch(),
        help=f"continue a recording that was interrupted; its blocks of {BLOCK_EPISODES} episodes are kept",
    )


def run_record(args: argparse.Namespace) -> int:
    """Record; prints which episodes failed and where the dataset is."""
    flags = vars(args)
    recording = Recording(**{f.name: flags[f.name] for f in fields(Recording) if f.name in flags})
    if not 1 <= args.workers <= recording.episodes:
        raise ValueError(f"--workers={args.workers} must lie in 1..{recording.episodes} (--episodes)")
    _warn_of_test_seeds(recording)
    root = args.root or default_root(recording.repo_id)
    with terminated_in_order():
        progress = record(recording, root, num_workers=args.workers, resume=args.resume)
    last_seed = recording.seed + (progress.num_tried - 1) // len(recording.conditions)
    seeds = f"{recording.seed}..{last_seed}"
    print(
        f"{progress.num_episodes} episodes, {progress.num_frames} frames, of the seeds {seeds}: {root}\n"
        f"{describe_failures(progress.failures)}"
    )
    return 0


def _warn_of_test_seeds(recording: Recording) -> None:
    seeds = range(recording.seed, recording.seed - (-recording.episodes // len(recording.conditions)))
    if seeds[0] <= TEST_SEEDS[-1] and seeds[-1] >= TEST_SEEDS[0]:
        print(
            f"the seeds {seeds[0]}..{seeds[-1]} have episodes that evaluations play, {TEST_SEEDS[0]} to "
            f"{TEST_SEEDS[-1]}: for training begin at --seed=10000",
            file=sys.stderr,
        )
