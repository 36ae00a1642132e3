"""``lerobot-bomb record``: the scripted expert's episodes as a LeRobotDataset.

A recording grows in a folder beside its final place (see ``growing.py``). LeRobot and torch are
imported only after the flags have been checked and the workers are playing.
"""

import argparse
import re
from collections.abc import Iterable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from lerobot_bomb.data.growing import (
    BLOCK_EPISODES,
    default_root,
    grow,
    missing_blocks,
    switch,
    terminated_in_order,
    write_blocks,
)
from lerobot_bomb.data.kept_blocks import Progress, reached
from lerobot_bomb.data.recording import Recording, recorder_flags
from lerobot_bomb.data.rollout import Expert, Rollout, RolloutPool, RolloutSettings, make_env
from lerobot_bomb.expert import expert_action
from lerobot_bomb.flags import path_flag
from lerobot_bomb.perturbations import NONE
from lerobot_bomb.schema import (
    CONTROL_MODES,
    DEFAULT_FPS,
    DEFAULT_IMAGE_SIZE,
    ROBOTS,
    SPLITS,
    SUITES,
)

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, Episode

# the expert counts as broken when, after so many seeds, fewer succeed
MIN_TRIED = 20
MIN_SUCCESS_RATE = 0.1


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb record``."""
    add = parser.add_argument
    add("--repo_id", required=True, help="name of the dataset on the Hub, USER/NAME")
    add(
        "--root",
        type=path_flag,
        help="new folder of the dataset (default: LeRobot's, $HF_LEROBOT_HOME/REPO_ID)",
    )
    add("--episodes", type=int, required=True, help="successful episodes to record")
    add("--seed", type=int, default=0, help="seed of the first episode; the others count up (default: 0)")
    add_episode_arguments(parser)
    add(
        "--task_ids",
        type=parse_numbers,
        default=(),
        help="numbered tasks, as [0,7,12]: every seed is played with each (25 x colour + 5 x row + column; "
        "black = 0, white = 1; default: target and colour are drawn per episode)",
    )
    add(
        "--perturbations",
        "--env.perturbations",
        type=parse_conditions,
        default=(NONE,),
        help='conditions, as ["all:1-5"]: every seed is played with each; a range such as all:1-5 or '
        "camera:0-3 draws a level per episode and axis (default: none)",
    )
    add("--images", **switch(), help="store images (lossless) instead of videos")
    add("--depth", **switch(), help="store each camera's depth (metres, lossless), intrinsics and pose too")
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


def add_episode_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what every command that plays episodes is told about them, but for seeds and targets."""
    add = parser.add_argument
    add("--task", default="place", help=f"suite: {', '.join(SUITES)} (default: place)")
    add("--robot", default="scara", help=f"{', '.join(ROBOTS)} (default: scara)")
    add("--control_mode", default="relative", help=f"{' or '.join(CONTROL_MODES)} (default: relative)")
    add("--fps", type=int, default=DEFAULT_FPS, help=f"control steps a second (default: {DEFAULT_FPS})")
    add("--image_size", type=int, default=DEFAULT_IMAGE_SIZE, help="pixels (default: %(default)s)")
    add("--split", default="all", help=f"draw from {', '.join(SPLITS)} (default: all)")


def run_record(args: argparse.Namespace) -> int:
    """Record as told; prints which episodes failed and where the dataset is."""
    flags = vars(args)
    recording = Recording(**{f.name: flags[f.name] for f in fields(Recording) if f.name in flags})
    if not 1 <= args.workers <= recording.episodes:
        raise ValueError(f"--workers={args.workers} must lie in 1..{recording.episodes} (--episodes)")
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


def record(
    recording: Recording,
    root: Path,
    num_workers: int = 1,
    resume: bool = False,
    expert: Expert = expert_action,
) -> Progress:
    """Record into `root`, which must not exist unless `resume` finds the same recording there.

    The dataset depends on `recording` alone, not on the number of workers or on interruptions.

    Raises:
        ValueError: the folder exists, is missing, cannot be written, is in use, or holds another recording.
        RuntimeError: the expert fails too often, the disk is full, or encoding failed.
    """
    return grow(
        recording,
        root,
        resume,
        write=lambda folder: _record_blocks(recording, folder, num_workers, expert),
        layout=lambda: _layout(recording),
    )


def describe_failures(failures: list[dict[str, Any]]) -> str:
    """One line that counts the failed episodes, with their classes and seeds."""
    if not failures:
        return "No episode failed."
    seeds: dict[str, list[str]] = {}
    for failure in failures:
        seeds.setdefault(failure["failure"], []).append(str(failure["seed"]))
    classes = "; ".join(f"{len(of)} {name} (seeds {', '.join(of)})" for name, of in sorted(seeds.items()))
    return f"{len(failures)} failed and were left out: {classes}"


def _record_blocks(recording: Recording, folder: Path, num_workers: int, expert: Expert) -> Progress:
    """Write the blocks that are missing."""
    gaps = missing_blocks(folder, recording.episodes)
    if not gaps:
        return reached(folder)
    # MuJoCo's backend is chosen here, or its absence reported; the workers inherit the choice
    with recorder_flags():
        for spec in recording.conditions:
            make_env(spec, recording.render_options).close()
    settings = RolloutSettings(recording.render_options, recording.noise, expert)
    num_kept = recording.episodes - sum(gap.num_missing for gap in gaps)
    with tqdm(total=recording.episodes, initial=num_kept, unit="episode") as bar:
        for gap in gaps:
            with RolloutPool(settings, recording.specs(gap.progress.num_tried), num_workers) as pool:
                layout = _layout(recording)  # takes seconds, in which the workers play
                write_blocks(folder, layout, gap, partial(_successes, pool, bar))
    return reached(folder)


def _successes(pool: Iterable[Rollout], bar: tqdm, progress: Progress, number: int) -> "Iterator[Episode]":
    """Yield so many successful rollouts; note the failed ones on the way."""
    from lerobot_bomb.data.rollout_dataset import rollout_episode

    for rollout in pool:
        if rollout.result.is_success:
            progress.num_episodes += 1
            number -= 1
            yield rollout_episode(rollout)
            bar.update()
        else:
            progress.failures.append({"seed": rollout.result.spec.seed, "failure": rollout.result.failure})
            bar.set_postfix(failed=len(progress.failures))
            _check_success_rate(progress)
        if number == 0:
            return


def _check_success_rate(progress: Progress) -> None:
    if progress.num_tried >= MIN_TRIED and progress.num_episodes < MIN_SUCCESS_RATE * progress.num_tried:
        raise RuntimeError(
            f"only {progress.num_episodes} of {progress.num_tried} episodes succeeded, too few to go on; "
            f"a smaller --noise may help. {describe_failures(progress.failures)}"
        )


def _layout(recording: Recording) -> "DatasetLayout":
    from lerobot_bomb.data.rollout_dataset import rollout_layout

    return rollout_layout(recording)


def parse_numbers(text: str) -> tuple[int, ...]:
    """Read a list of whole numbers: (0, 7) from "[0,7]", as LeRobot writes lists, and from "0,7"."""
    if not re.fullmatch(r"\d+(,\d+)*|\[\d+(,\d+)*\]", text.replace(" ", "")):
        raise argparse.ArgumentTypeError(f"{text!r} must be a list of whole numbers, as [0,7]")
    return tuple(int(number) for number in re.findall(r"\d+", text))


def parse_conditions(text: str) -> tuple[str, ...]:
    """Read a list of conditions: ("none", "all:1-5") from '["none","all:1-5"]' and from "none,all:1-5"."""
    return tuple(part.strip(" \"'") for part in text.strip("[] ").split(",") if part.strip())
