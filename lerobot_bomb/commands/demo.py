"""``lerobot-bomb demo``: evaluate a policy that comes with the package, by the commands that users have."""

import argparse
import os
import time
from collections.abc import Callable
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
    )
    records = {
        line: record
        for line, record in read_undamaged(results).numbered.items()
        if record.policy is not None and record.policy.type != "bomb_expert"
    }
    _say(2, "Replay a failure: which perturbation causes it?")
    replayed = [_replay(output_dir, "failure", records, lambda record: not record.is_success)]
    _say(3, "Replay a perturbed success")
    replayed.append(_replay(output_dir, "success", records, lambda record: record.is_success))
    _say(4, "Write a page with every rate and failure")
    run_command("lerobot-bomb", "report", str(results), f"--output={report}")
    _say(5, "Print the rates")
    run_command("lerobot-bomb", "results", str(results))
    print(f"\n{CLOSING.format(policy=POLICY)}")
    print(f"films   {', '.join(replayed)}")
    print(f"report  {report}")
    print(f"Done in {(time.monotonic() - started) / 60:.1f} minutes")
    return 0


def _replay(folder: Path, name: str, records: dict[int, Record], is_shown: Callable[[Record], bool]) -> str:
    """Replay the last such episode, perturbed if one is; return its video's path, "none" without one."""
    found = [line for line, record in records.items() if is_shown(record)]
    perturbed = [line for line in found if records[line].spec.perturbations != NONE]
    if not found:
        print(f"There is no {name}.")
        return "none"
    line = (perturbed or found)[-1]
    run_command(
        "lerobot-bomb", "replay", str(folder / RESULTS), f"--line={line}", f"--output={folder / name}"
    )
    return f"{folder / name}.mp4"


def _say(step: int, text: str) -> None:
    print(f"\n=== {step}/5  {text}", flush=True)
