"""``lerobot-bomb record``: the scripted expert's episodes as a LeRobotDataset."""

import argparse
import shlex
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE
from lerobot_bomb.checkpoints.names import WEIGHTS
from lerobot_bomb.checkpoints.training import trained_image_size
from lerobot_bomb.commands.arguments import (
    SETTINGS,
    add_episode_arguments,
    add_new_dataset_arguments,
    checkpoint_flag,
    switch,
)
from lerobot_bomb.commands.cluster_jobs import (
    SUBMITIT,
    SUBMITIT_FLAGS,
    add_job_arguments,
    check_num_jobs,
    shard_of,
    submitted,
    write_job_array,
)
from lerobot_bomb.commands.record_libero import (
    BOMB_LIBERO,
    FLAG_OF,
    add_env_type_arguments,
    libero_recording,
    refuse_libero_flags,
)
from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.data.kept_blocks import Progress, read_progress
from lerobot_bomb.data.parts import Part, check_part, join, num_whole_blocks, record_part, unfinished_parts
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recorded_blocks import BehaviorPolicy, EpisodeSource, describe_failures
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.resumable import (
    block_episodes,
    default_root,
    terminated_in_order,
)
from lerobot_bomb.data.unfinished import METADATA_FILE, unfinished_folder
from lerobot_bomb.flags import rewording_errors
from lerobot_bomb.sweep.local import PYTHON

JOBS, SCRIPT = "jobs", "record.sbatch"  # the folder ROOT.jobs, and a file in it
NOT_OF_JOBS = ("command", "default_of", "root", "resume", "shard", "join", "slurm", *SUBMITIT_FLAGS)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_new_dataset_arguments(parser)
    add = parser.add_argument
    add_env_type_arguments(parser)
    _add_what_is_recorded(parser)
    add(
        "--seed",
        type=int,
        default=0,
        help="seed of the first episode; the others count up (default: 0); do "
        f"not record the test episodes, {TEST_SEEDS[0]} to {TEST_SEEDS[-1]}",
    )
    add_episode_arguments(parser)
    parser.set_defaults(render_preset=None)  # each environment has its own default
    add("--images", **switch(), help="store images (lossless) instead of videos")
    add("--workers", type=int, default=1, help="simulator processes; one keeps two cores busy (default: 1)")
    add(
        "--noise",
        type=float,
        default=0.0,
        help="standard deviation of noise on the executed action, in units of 40 mm; the stored action is "
        "clean; the expert copes with 0.05 (default: 0)",
    )
    resume = "continue an interrupted recording (with --shard and --join, always)"
    add("--resume", **switch(), help=resume)
    where = add_job_arguments(parser, "episodes", f"ROOT.{JOBS}/{SCRIPT}")
    where.add_argument("--join", **switch(), help="make the dataset of the parts of --shard, and delete them")


def _add_what_is_recorded(parser: argparse.ArgumentParser) -> None:
    """Declare the number of episodes or scenes, who acts in them, and their labels."""
    add = parser.add_argument
    number = parser.add_mutually_exclusive_group(required=True)
    number.add_argument("--episodes", type=int, help="successful episodes to record")
    number.add_argument(
        "--static",
        type=int,
        help="static scenes to record instead: single frames of boards as in mid-episode, with the labels of "
        "--pointing",
    )
    add("--relabel", **switch(), help="let --policy.path run the episodes, and store the expert's actions")
    add(
        "--policy.path",
        dest="policy_path",
        type=checkpoint_flag,
        help="checkpoint that runs the episodes of --relabel, failed ones included",
    )
    add(
        "--pointing",
        **switch(),
        help="also store what --policy.pointing=true learns from: which stone goes where, and the expert's "
        "actions for other places",
    )


def run(args: argparse.Namespace) -> int:
    """Record episodes; print which failed, and where the dataset is."""
    recording = _recording(args)
    root = args.root or default_root(recording.repo_id)
    shard = shard_of(args)
    check_num_jobs(args, num_whole_blocks(recording), f"parts of at least {len(block_episodes(0))} episodes")
    if num_jobs := args.slurm or args.submitit:
        return _record_by_jobs(args, [Part(recording, index, num_jobs) for index in range(num_jobs)], root)
    if isinstance(recording, Recording):
        _warn_of_test_seeds(recording)
    with terminated_in_order():
        behavior = None
        if isinstance(recording, Recording) and recording.relabel:
            behavior = _behavior_policy(recording, args.policy_path)
        if shard is not None:
            return _record_part(Part(recording, *shard), root, EpisodeSource(args.workers, behavior=behavior))
        if args.join:
            progress = join(recording, root, EpisodeSource(args.workers, behavior=behavior))
        else:
            progress = record(
                recording, root, num_workers=args.workers, resume=args.resume, behavior=behavior
            )
    _print(recording, progress, root)
    return 0


def _recording(args: argparse.Namespace) -> BaseRecording:
    recording = libero_recording(args) if args.env_type == BOMB_LIBERO else _bomb_recording(args)
    if not 1 <= args.workers <= recording.episodes:
        raise ValueError(
            f"--workers={args.workers} must lie in 1..{recording.episodes} (--episodes or --static)"
        )
    return recording


def _bomb_recording(args: argparse.Namespace) -> Recording:
    flags = vars(args)
    refuse_libero_flags(args)
    if args.static == 0:
        raise ValueError("--static=0 records nothing; give a number of scenes, or --episodes")
    if args.image_size is None:
        trained = None if args.policy_path is None else trained_image_size(args.policy_path)
        args.image_size = flags["image_size"] = trained or DEFAULT_IMAGE_SIZE
    given = {f.name: flags[f.name] for f in fields(Recording) if flags.get(f.name) is not None}
    given |= {"episodes": args.episodes or 0, "static": args.static or 0, "relabel": _acting_weights(args)}
    return Recording(**given)


def _print(recording: BaseRecording, progress: Progress, where: Path, num_before: int = 0) -> None:
    """Print what was recorded, after `num_before` episodes that other parts tried."""
    conditions, scenes = len(recording.conditions), recording.scenes
    first = recording.seed + num_before // conditions * scenes
    end = recording.seed - (-(num_before + progress.num_tried) // conditions) * scenes
    print(
        f"{progress.num_episodes} episodes, {progress.num_frames} frames, of the seeds {first}..{end - 1}: "
        f"{where}\n{describe_failures(progress.failures)}"
    )


def _record_part(part: Part, root: Path, source: EpisodeSource) -> int:
    progress = record_part(part, root, source)
    if progress is None:
        print(f"{root} is there, joined")
    else:
        num_before = block_episodes(part.blocks.start).start
        _print(part.recording, progress, part.folder(root), num_before)
    return 0


def _record_by_jobs(args: argparse.Namespace, parts: list[Part], root: Path) -> int:
    """Write the script of a job array and print the next steps; or submit the jobs, and join their parts."""
    check_part(parts[0], root)
    command, folder = _job_command(args, root), unfinished_folder(root, JOBS)
    if args.slurm is not None:
        write_job_array(command, args.slurm, folder / SCRIPT)
        print(shlex.join([*command, "--join"]))
        return 0
    failed = f"jobs ended before they had recorded everything; {folder / SUBMITIT} says why"
    if not root.exists():
        shards = [[*command, f"--shard={part}"] for part in unfinished_parts(parts, root)]
        with submitted(shards, args, folder):
            pass
        if unfinished := unfinished_parts(parts, root):
            raise RuntimeError(f"{failed}: parts {', '.join(map(str, unfinished))} are not finished")
    with submitted([[*command, "--join"]], args, folder):
        pass
    if not root.exists():
        raise RuntimeError(f"{failed}: the parts are not joined")
    _print(parts[0].recording, read_progress(root / METADATA_FILE), root)
    return 0


def _job_command(args: argparse.Namespace, root: Path) -> list[str]:
    """Return the command that records as the flags say; with --shard it records a part."""
    flags = [f"--root={root.absolute()}"]
    for name, value in vars(args).items():
        if name in NOT_OF_JOBS or value in (None, False, ()):
            continue
        flag = FLAG_OF.get(name, name)
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        flags.append(f"--{flag}={'true' if value is True else text}")
    return [*PYTHON, "lerobot_bomb.commands.main", "record", *flags]


def _acting_weights(args: argparse.Namespace) -> str | None:
    """Return the SHA-256 of the weights that act; None if the expert does."""
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


def _behavior_policy(recording: Recording, policy_path: Path) -> BehaviorPolicy:
    """Load the checkpoint, to act as in lerobot-eval.

    Raises:
        ValueError: it was trained for another environment.
    """
    from lerobot_bomb.checkpoints.acting import OVERRIDE  # LeRobot and torch: seconds
    from lerobot_bomb.viewing.checkpoint import load_policy

    env_flags = {name: getattr(recording, name) for name in SETTINGS}
    with rewording_errors({"evaluate with": "record with", OVERRIDE: "train one for this"}):
        loaded = load_policy(policy_path, None, "bomb", env_flags, recording.seed)

    def agent(observation: dict[str, Any], instruction: str) -> np.ndarray:
        return loaded.agent([observation], [instruction])[0]

    return BehaviorPolicy(loaded.begin, agent)


def _warn_of_test_seeds(recording: Recording) -> None:
    rounds = -(-recording.episodes // len(recording.conditions))
    seeds = range(recording.seed, recording.seed + rounds * recording.scenes)
    if seeds[0] <= TEST_SEEDS[-1] and seeds[-1] >= TEST_SEEDS[0]:
        print(
            f"the seeds {seeds[0]}..{seeds[-1]} have episodes that evaluations run, {TEST_SEEDS[0]} to "
            f"{TEST_SEEDS[-1]}: for training begin at --seed=200000",
            file=sys.stderr,
        )
