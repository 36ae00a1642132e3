"""Can a policy learn a few episodes by heart, and does it do so by looking and reading?

Eight episodes start alike, to the last pixel, and only the instruction says which intersection is meant. A
policy is trained on them without the robot's state, and evaluated on the same episodes, by LeRobot's own
commands. Two controls change what the trained policy is shown:

    permuted instructions   each episode is given the instruction of another: the stone must go to the place
                            that is named, so the instruction decides, not the episode
    blank images            the cameras show black: the policy must fail, so it uses what it sees

    python benchmarks/overfit.py --policy.type=vla0_smol --json overfit.json

The recipe is configs/overfit_TYPE.yaml. A policy that reads the state passes such a test blind. Flags
--policy.NAME=VALUE go to `lerobot-train`, so that the proof can be repeated with an option of the policy.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import finish, make_parser, parse_with_policy_flags, positive
from recipes import POLICY_TYPES, last_checkpoint, read_recipe, recipe_path

from lerobot_bomb.bomb.episode import EpisodeSpec, Failure
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.tables import print_table

SEED = 1007  # its board is empty, so nothing but the instruction tells the target
TASK_IDS = (0, 4, 7, 11, 13, 15, 22, 24)  # all black
TARGETS: dict[int, Any] = {task: specs_of_tasks(EpisodeSpec(SEED), [task])[0].target for task in TASK_IDS}
SHIFT = 3  # an episode is given the instruction of the task so many places further on
IMAGE_SIZE = 128
PICTURES = (f"image_size={IMAGE_SIZE}",)
DEPTH_PICTURES = ("image_size=64", "depth=true")  # LeRobot takes 85 ms to read a sample with larger depth
REPO_ID = "overfit/bomb_place"
MAX_MINUTES = 25


@dataclass(frozen=True)
class Control:
    """One evaluation of the trained policy, with the bounds of what is counted over its episodes."""

    name: str
    counted: str
    at_least: int
    at_most: int

    @property
    def folder_name(self) -> str:
        return self.name.replace(" ", "_")

    def bar(self, count: int) -> tuple[str, bool]:
        """Return what was counted beside its bar, in words, and True if the bar is kept."""
        bound = f"at least {self.at_least}" if self.at_least else f"at most {self.at_most}"
        text = f"{self.name}: {count}/{len(TASK_IDS)} {self.counted} (bar: {bound})"
        return text, self.at_least <= count <= self.at_most


LEARNT = Control("as recorded", "successes", at_least=8, at_most=8)
PERMUTED = Control("permuted instructions", "stones on the named square", at_least=6, at_most=8)
BLANK = Control("blank images", "successes", at_least=0, at_most=2)


def main() -> None:
    """Record, train, evaluate three times, print what was counted; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument("--policy.type", dest="policy_type", required=True, choices=POLICY_TYPES)
    parser.add_argument("--output_dir", type=Path, help="new folder to keep (default: a temporary one)")
    parser.add_argument("--steps", type=positive, help="training steps (default: the recipe's)")
    depth = "record and show depth, and train with --policy.depth_source=observation"
    parser.add_argument("--depth", action="store_true", help=depth)
    args = parse_with_policy_flags(parser)
    if args.output_dir is not None and args.output_dir.exists():
        parser.error(f"--output_dir={args.output_dir} exists already; name a new folder or delete it")
    if args.depth:
        args.policy_flags.append("--policy.depth_source=observation")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # deletes the temporary folder
    with tempfile.TemporaryDirectory() as temporary:
        try:
            prove(args, args.output_dir or Path(temporary) / "overfit")
        except RuntimeError as error:
            sys.exit(f"overfit.py: {error}")


def prove(args: argparse.Namespace, folder: Path) -> None:
    """Run the whole proof in `folder`; exit with code 1 if a bar is missed."""
    started = time.monotonic()
    images = DEPTH_PICTURES if args.depth else PICTURES
    record(folder / "dataset", images)
    instructions = read_instructions(folder / "dataset")
    checkpoint = train(args, folder)
    given = {task: TASK_IDS[(i + SHIFT) % len(TASK_IDS)] for i, task in enumerate(TASK_IDS)}
    replaced = {instructions[task]: instructions[given[task]] for task in TASK_IDS}
    counts = {}
    for control, path in {LEARNT: checkpoint, **change_what_is_shown(checkpoint, replaced)}.items():
        rows = evaluate(path, folder / control.folder_name, images)
        print_episodes(control, rows)
        counts[control] = sum(
            is_on(row, given[task]) if control is PERMUTED else row.is_success for task, row in rows.items()
        )
    minutes = (time.monotonic() - started) / 60
    bars = dict(control.bar(count) for control, count in counts.items())
    bars[f"the whole run: {minutes:.1f} minutes (bar: at most {MAX_MINUTES})"] = minutes <= MAX_MINUTES
    trained = " ".join([args.policy_type, *args.policy_flags])
    print(f"{trained}: {len(TASK_IDS)} episodes of seed {SEED}, without state")
    figures = {
        "policy": args.policy_type,
        "flags": args.policy_flags,
        "seed": SEED,
        "steps": args.steps or read_recipe("overfit", args.policy_type)["steps"],
        "episodes": len(TASK_IDS),
        **{control.name: count for control, count in counts.items()},
        "minutes": minutes,
    }
    finish(args.json, figures, bars)


def record(dataset: Path, images: Iterable[str] = PICTURES) -> None:
    """Record the expert's episodes of one seed and eight targets; ``images``: flags, without their dashes."""
    run_command(
        "lerobot-bomb",
        "record",
        f"--repo_id={REPO_ID}",
        f"--root={dataset}",
        f"--episodes={len(TASK_IDS)}",
        f"--seed={SEED}",
        f"--task_ids={list(TASK_IDS)}",
        "--images",
        *(f"--{flag}" for flag in images),
    )


def read_instructions(dataset: Path) -> dict[int, str]:
    """Return {task id: instruction}; exit with code 1 unless all episodes begin with the same frame."""
    from lerobot.datasets import LeRobotDataset

    frames: Any = LeRobotDataset(REPO_ID, root=dataset, video_backend="pyav")
    episodes = frames.meta.episodes
    starts = [frames[episode["dataset_from_index"]] for episode in episodes]
    for key in ("observation.images.workspace", "observation.images.wrist", "observation.state"):
        if any(not start[key].equal(starts[0][key]) for start in starts):
            raise SystemExit(f"the episodes do not start alike: {key} differs")
    return {task: start["task"] for task, start in zip(TASK_IDS, starts, strict=True)}


def train(args: argparse.Namespace, folder: Path) -> Path:
    """Train the recipe by stock `lerobot-train`; return the checkpoint's folder."""
    override = [f"--steps={args.steps}"] if args.steps else []
    run_command(
        "lerobot-train",
        f"--config_path={recipe_path('overfit', args.policy_type)}",
        f"--dataset.root={folder / 'dataset'}",
        f"--output_dir={folder / 'train'}",
        "--save_checkpoint=true",
        *override,
        *args.policy_flags,
    )
    return last_checkpoint(folder / "train")


def change_what_is_shown(checkpoint: Path, replacements: dict[str, str]) -> dict[Control, Path]:
    """Write the controls' checkpoints: the trained weights behind a preprocessor that intervenes."""
    from lerobot_bomb.explain.interventions import BlankImages, ReplaceTasks, intervene

    steps = {PERMUTED: ReplaceTasks(replacements), BLANK: BlankImages()}
    for control, step in steps.items():
        intervene(checkpoint, [step], checkpoint.with_name(control.folder_name))
    return {control: checkpoint.with_name(control.folder_name) for control in steps}


def evaluate(checkpoint: Path, output_dir: Path, images: Iterable[str]) -> dict[int, EpisodeResult]:
    """Run stock `lerobot-eval` on the recorded seed, one episode per task; return {task id: result}."""
    run_command(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=bomb",
        f"--env.task_ids={list(TASK_IDS)}",
        *(f"--env.{flag}" for flag in images),
        f"--env.results_path={output_dir / 'results.jsonl'}",
        f"--seed={SEED}",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--output_dir={output_dir / 'eval'}",
    )
    rows = {row.target: row for row in read_results(output_dir / "results.jsonl", EpisodeResult)}
    if rows.keys() != set(TARGETS.values()):
        raise SystemExit(f"{output_dir}: results of the targets {[*rows]}, not of {list(TARGETS.values())}")
    return {task: rows[target] for task, target in TARGETS.items()}


def is_on(row: EpisodeResult, task_id: int) -> bool:
    """Return True if the stone was put down nearest to this task's intersection, not the episode's."""
    is_there = row.nearest_intersection == TARGETS[task_id]
    return is_there and row.failure == Failure.WRONG_INTERSECTION


def print_episodes(control: Control, rows: dict[int, EpisodeResult]) -> None:
    """Print the outcome of each episode."""
    print(f"\n{control.name}")
    header = ["target", "stone ends nearest to", "error, mm", "steps", "outcome"]
    cells = [
        [
            str(row.target),
            str(row.nearest_intersection),
            f"{row.placement_error_mm:.1f}",
            str(row.steps),
            row.failure or "success",
        ]
        for row in rows.values()
    ]
    print_table(header, cells)
    print(flush=True)


if __name__ == "__main__":
    main()
