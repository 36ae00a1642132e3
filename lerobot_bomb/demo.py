"""``lerobot-bomb demo``: the whole road in minutes, with LeRobot's own commands."""

import argparse
import os
import time
from datetime import datetime
from pathlib import Path

from lerobot_bomb.commands import run_command
from lerobot_bomb.evaluation.results import read_results, summarise
from lerobot_bomb.flags import path_flag
from lerobot_bomb.viewing.unfinished import check_new_folder

REPO_ID = "demo/bomb_place"
MAX_EVAL_BATCH = 10
TRAIN_FLAGS = (
    "--policy.type=vla0_smol",
    "--policy.vlm_model_name=nano",
    "--policy.device=cpu",
    # random weights learn faster from short chunks, coarse bins and a high rate than SmolVLM2's recipe
    "--policy.chunk_size=5",
    "--policy.n_action_bins=101",
    "--policy.n_state_bins=101",
    "--policy.bin_mode=levels",
    "--policy.crop_fraction=0.95",
    "--policy.optimizer_lr=2e-3",
    "--policy.scheduler_decay_lr=4e-5",
    "--batch_size=16",
    "--num_workers=0",
    "--log_freq=50",
    "--wandb.enable=false",
)
CLOSING = """\
So short a training of so small a model rarely places a stone: it shows that the road is open, not how
far it leads. For a real run:
  1. more demonstrations: lerobot-bomb record --repo_id=me/bomb_place --episodes=900 --noise=0.05
  2. a real backbone on a GPU: drop --policy.vlm_model_name=nano (SmolVLM2-500M is the default) and
     set --policy.device=cuda --policy.dtype=bfloat16
  3. longer: lerobot-train --steps=30000 --batch_size=32
  4. an honest number: docs/benchmark.md
The pages about libtorchcodec above are LeRobot's: without FFmpeg it reads videos with PyAV."""


def add_demo_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb demo``."""
    parser.add_argument("--output_dir", type=path_flag, help="new folder (default: outputs/demo/DATE_TIME)")
    parser.add_argument("--episodes", type=int, default=100, help="demonstrations to record (default: 100)")
    parser.add_argument("--steps", type=int, default=800, help="training steps (default: 800)")
    parser.add_argument("--eval_episodes", type=int, default=20, help="evaluation episodes (default: 20)")


def run_demo(args: argparse.Namespace) -> int:
    """Record, train, evaluate; print rates, errors, failure classes and where everything lies."""
    for name in ("episodes", "steps", "eval_episodes"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name}={getattr(args, name)} must be at least 1")
    output_dir = args.output_dir or Path("outputs/demo") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    check_new_folder("--output_dir", output_dir)
    started = time.monotonic()
    dataset, train = output_dir / "dataset", output_dir / "train"
    checkpoint = train / "checkpoints" / "last" / "pretrained_model"

    _say(f"1/4  Record {args.episodes} demonstrations of the scripted expert")
    run_command(
        "lerobot-bomb",
        "record",
        f"--repo_id={REPO_ID}",
        f"--root={dataset}",
        f"--episodes={args.episodes}",
        f"--workers={min(os.cpu_count() or 1, args.episodes)}",
    )
    _say(f"2/4  Train vla0_smol on the nano backbone for {args.steps} steps")
    run_command(
        "lerobot-train",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={dataset}",
        *TRAIN_FLAGS,
        f"--output_dir={train}",
        f"--steps={args.steps}",
        f"--save_freq={args.steps}",
    )
    _say("3/4  Evaluate the checkpoint")
    _evaluate(output_dir, "vla0_smol", f"--policy.path={checkpoint}", args.eval_episodes)
    _say("4/4  The ceiling and the floor: the expert and random actions on the same episodes")
    _evaluate(output_dir, "bomb_expert", "--policy.type=bomb_expert", args.eval_episodes)
    _evaluate(output_dir, "bomb_random", "--policy.type=bomb_random", args.eval_episodes)
    _report(output_dir, time.monotonic() - started)
    return 0


def _evaluate(output_dir: Path, name: str, policy_flag: str, num_episodes: int) -> None:
    # a divisor, so that LeRobot plays no more episodes than asked
    batch_size = max(size for size in range(1, MAX_EVAL_BATCH + 1) if num_episodes % size == 0)
    run_command(
        "lerobot-eval",
        policy_flag,
        "--policy.device=cpu",
        "--env.type=bomb",
        "--env.task=place",
        f"--env.results_path={output_dir / name}.jsonl",
        f"--eval.n_episodes={num_episodes}",
        f"--eval.batch_size={batch_size}",
        "--eval.use_async_envs=false",
        f"--output_dir={output_dir / 'eval' / name}",
    )


def _report(output_dir: Path, seconds: float) -> None:
    _say(f"Done in {seconds / 60:.1f} minutes")
    for name in ("vla0_smol", "bomb_expert", "bomb_random"):
        print(name)
        for line in summarise(read_results(output_dir / f"{name}.jsonl")).lines():
            print(f"  {line}")
    print(f"\nvideos     {output_dir}/eval/*/videos\ndataset    {output_dir}/dataset")
    print(f"checkpoint {output_dir}/train/checkpoints/last/pretrained_model\n\n{CLOSING}")


def _say(text: str) -> None:
    print(f"\n=== {text}", flush=True)
