"""``lerobot-bomb demo``: evaluate a policy that comes with the package, by the commands that users have."""

import argparse
import os
import time
from datetime import datetime
from pathlib import Path

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.results_files import read_undamaged
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.conditions import NONE
from lerobot_bomb.files import check_new_folder
from lerobot_bomb.results.names import SHIPPED_PREFIX
from lerobot_bomb.results.record import Record
from lerobot_bomb.sweep.store import RESULTS

POLICY = "fdvla_suites"
SUITES = ("place", "spatial", "goal")
CONDITIONS = (NONE, "all:3")
SEED = TEST_SEEDS[0]  # no demonstration had it
IMAGE_SIZE = 64  # pixels, as the policy was trained with; so the expert's episodes pair with the policy's
MAX_WORKERS = 2
CLOSING = """\
bomb:{policy} is a small model, trained from scratch on one CPU core; docs/results.md says what it can do.
Next:
  train one yourself, in minutes   make demo-train
  your own checkpoint              lerobot-eval --policy.path=FOLDER --env.type=bomb ... (docs/benchmark.md)
  every perturbation               docs/perturbations.md
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--output_dir", type=path_flag, help="new folder (default: outputs/demo/DATE_TIME)")
    parser.add_argument(
        "--episodes", type=int, default=10, help="episodes of each suite and condition (default: 10)"
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate the policy and the expert, replay a failure and a success, write a report."""
    if args.episodes < 1:
        raise ValueError(f"--episodes={args.episodes} must be at least 1")
    output_dir = args.output_dir or Path("outputs/demo") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    check_new_folder("--output_dir", output_dir)
    started = time.monotonic()
    results, report = output_dir / RESULTS, output_dir / "report.html"
    _say(1, f"Evaluate {POLICY} and the expert on {len(SUITES)} suites, unperturbed and perturbed")
    run_command(
        "lerobot-bomb",
        "sweep",
        str(output_dir),
        f"--policies={SHIPPED_PREFIX}{POLICY},bomb_expert",
        "--env.type=bomb",
        f"--env.task={','.join(SUITES)}",
        f"--env.perturbations={','.join(CONDITIONS)}",
        f"--episodes={args.episodes}",
        f"--seed={SEED}",
        f"--workers={min(MAX_WORKERS, os.cpu_count() or 1)}",
        "--policy.device=cpu",
        f"--env.image_size={IMAGE_SIZE}",
    )
    records = {
        line: record
        for line, record in read_undamaged(results).numbered.items()
        if record.policy is not None and record.policy.type != "bomb_expert"
    }
    _say(2, "Replay a failure")
    _replay(output_dir, "failure", {line: each for line, each in records.items() if each.failure})
    _say(3, "Replay a success")
    _replay(output_dir, "success", {line: each for line, each in records.items() if each.is_success})
    _say(4, "Write a page with every rate and failure")
    run_command("lerobot-bomb", "report", str(results), f"--output={report}")
    _say(5, "Print the rates")
    run_command("lerobot-bomb", "results", str(results))
    print(f"\n{CLOSING.format(policy=POLICY)}")
    print(f"films   {output_dir}/*.mp4, and .rrd for Rerun")
    print(f"report  {report}")
    print(f"Done in {(time.monotonic() - started) / 60:.1f} minutes")
    return 0


def _replay(folder: Path, name: str, records: dict[int, Record]) -> None:
    """Replay the last of the episodes, a perturbed one if there is, to FOLDER/NAME.mp4 and .rrd."""
    lines = [line for line, record in records.items() if record.spec.perturbations != NONE] or [*records]
    if not lines:
        print(f"There is no {name}.")
        return
    results, output = folder / RESULTS, folder / name
    run_command("lerobot-bomb", "replay", str(results), f"--line={lines[-1]}", f"--output={output}")


def _say(step: int, text: str) -> None:
    print(f"\n=== {step}/5  {text}", flush=True)
