"""``lerobot-bomb record``: the scripted expert's episodes as a LeRobotDataset."""

import argparse
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.checkpoints.names import WEIGHTS
from lerobot_bomb.commands.arguments import (
    add_episode_arguments,
    add_new_dataset_arguments,
    path_flag,
    switch,
)
from lerobot_bomb.data.record import Acting, describe_failures, record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.resumable import (
    BLOCK_EPISODES,
    default_root,
    terminated_in_order,
)
from lerobot_bomb.flags import flags_without_group


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb record``."""
    add_new_dataset_arguments(parser)
    add = parser.add_argument
    _add_what_is_recorded(parser)
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


def _add_what_is_recorded(parser: argparse.ArgumentParser) -> None:
    """Declare how much of what: episodes, whose, or scenes; with which labels."""
    add = parser.add_argument
    number = parser.add_mutually_exclusive_group(required=True)
    number.add_argument("--episodes", type=int, help="successful episodes to record")
    number.add_argument(
        "--static",
        type=int,
        help="scenes to record instead: boards as they may stand midway, the gripper anywhere, with or "
        "without the stone, a frame each, with --pointing; they teach what an instruction means",
    )
    add("--relabel", **switch(), help="let --policy.path act, and store what the expert would have done")
    add(
        "--policy.path",
        dest="policy_path",
        type=path_flag,
        help="folder of the checkpoint that acts, with --relabel; whatever becomes of its episodes",
    )
    add(
        "--pointing",
        **switch(),
        help="also store which stone goes where and what the expert would do for other places, which "
        "--policy.pointing=true is trained on; no policy sees it in an evaluation",
    )


def run_record(args: argparse.Namespace) -> int:
    """Record; prints which episodes failed and where the dataset is."""
    flags = vars(args)
    if args.static == 0:
        raise ValueError("--static=0 records nothing; give a number of scenes, or --episodes")
    given: dict[str, Any] = {f.name: flags[f.name] for f in fields(Recording) if f.name in flags}
    given |= {"episodes": args.episodes or 0, "static": args.static or 0, "relabel": _acting_weights(args)}
    recording = Recording(**given)
    if not 1 <= args.workers <= recording.episodes:
        raise ValueError(
            f"--workers={args.workers} must lie in 1..{recording.episodes} (--episodes or --static)"
        )
    _warn_of_test_seeds(recording)
    root = args.root or default_root(recording.repo_id)
    with terminated_in_order():
        acting = _acting(recording, args.policy_path) if recording.relabel else None
        progress = record(recording, root, num_workers=args.workers, resume=args.resume, acting=acting)
    rounds = -(-progress.num_tried // len(recording.conditions))
    last_seed = recording.seed + rounds * recording.scenes - 1
    seeds = f"{recording.seed}..{last_seed}"
    print(
        f"{progress.num_episodes} episodes, {progress.num_frames} frames, of the seeds {seeds}: {root}\n"
        f"{describe_failures(progress.failures)}"
    )
    return 0


def _acting_weights(args: argparse.Namespace) -> str | None:
    """Return the SHA-256 of the weights that act; None: the expert does."""
    if args.relabel != (args.policy_path is not None):
        raise ValueError(
            "--relabel and --policy.path=FOLDER come together: a policy acts, and the expert says what it "
            "would have done"
        )
    if not args.relabel:
        return None
    if args.workers != 1:
        raise ValueError(
            f"--workers={args.workers}: with --relabel the policy acts in one process; leave it out"
        )
    from lerobot_bomb.checkpoints.identity import sha256_of

    weights = args.policy_path / WEIGHTS
    if not weights.is_file():
        raise ValueError(f"--policy.path={args.policy_path} holds no {WEIGHTS}, so it is no checkpoint")
    return sha256_of(weights)


def _acting(recording: Recording, policy_path: Path) -> Acting:
    """The checkpoint, as lerobot-eval lets it act.

    Raises:
        ValueError: it was trained for another environment.
    """
    from lerobot_bomb.viewing.checkpoint import load_policy  # LeRobot and torch: seconds

    names = ("task", "robot", "control_mode", "fps", "image_size", "render_preset", "depth", "split")
    env_flags = {name: getattr(recording, name) for name in names}
    insist = "insist with --{}=true"
    ways_out = dict.fromkeys(
        map(insist.format, ("policy.ignore_environment", "env.ignore_checkpoint")), "train one for this"
    )
    with flags_without_group({"evaluate with": "record with", **ways_out}):
        loaded = load_policy(policy_path, None, "bomb", env_flags, recording.seed)

    def agent(observation: dict[str, Any], instruction: str) -> np.ndarray:
        return loaded.agent([observation], [instruction])[0]

    return Acting(loaded.begin, agent)


def _warn_of_test_seeds(recording: Recording) -> None:
    rounds = -(-recording.episodes // len(recording.conditions))
    seeds = range(recording.seed, recording.seed + rounds * recording.scenes)
    if seeds[0] <= TEST_SEEDS[-1] and seeds[-1] >= TEST_SEEDS[0]:
        print(
            f"the seeds {seeds[0]}..{seeds[-1]} have episodes that evaluations play, {TEST_SEEDS[0]} to "
            f"{TEST_SEEDS[-1]}: for training begin at --seed=10000",
            file=sys.stderr,
        )
