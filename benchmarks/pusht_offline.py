"""Does a policy learn from real data? PushT's human demonstrations, held-out episodes, predictors to beat.

The recipe configs/pusht_TYPE.yaml and its variants, each with several seeds, are trained by the stock
`lerobot-train` on episodes 0-179; `lerobot-bomb offline-metrics` measures the decoded actions on episodes
180-205, beside predictors that look at no picture. The recipe's checkpoints also play in LeRobot's `pusht`.

    python benchmarks/pusht_offline.py --policy.type=vla0_smol --output_dir pusht \\
        --source pusht_cchi_v7_replay.zarr

What is finished stays in the output folder and is not done again: the dataset, each training, each measurement.
Every process uses one thread; a training is two processes, one of which reads the frames.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from machine import positive, print_table, write_figures
from recipes import PUSHT_TYPES, pusht_recipe_path

from lerobot_bomb.commands import run_command
from lerobot_bomb.stats import bootstrap_interval

REPO_ID = "lerobot_bomb/pusht"
NUM_TRAIN_EPISODES = 180
T_QUANTILE = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}  # 97.5 % of Student's t, by number of seeds
MAX_COVERAGE_REWARD = 0.95  # coverage from which gym-pusht's reward is 1

RECIPE = "recipe"
VARIANTS: dict[str, dict[str, list[str]]] = {
    "vla0_smol": {
        RECIPE: [],
        "no_masking": ["--policy.mask_max_fraction=0"],
        "absolute": ["--policy.relative_actions=false"],
        "no_state": ["--policy.use_state=false"],
    },
}


@dataclass(frozen=True)
class Run:
    """One training: a variant of the recipe and a seed."""

    variant: str
    seed: int
    folder: Path

    @property
    def checkpoint(self) -> Path:
        return self.folder / "train" / "checkpoints" / "last" / "pretrained_model"


def main() -> None:
    """Convert, train, measure, print the table; exit code 1 unless the recipe beats every trivial predictor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policy.type", dest="policy_type", required=True, choices=PUSHT_TYPES)
    parser.add_argument("--source", type=Path, help="the zarr; not needed once it is converted")
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to go on with")
    parser.add_argument("--variants", nargs="+", help="default: all")
    parser.add_argument("--seeds", type=positive, default=3, help="trainings of each (default: 3)")
    parser.add_argument("--jobs", type=positive, default=2, help="at once (default: 2)")
    parser.add_argument("--frames", type=positive, default=1000, help="held-out frames (default: 1000)")
    parser.add_argument("--eval_episodes", type=positive, help="episodes in the environment, by seed")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    args = parser.parse_args()
    variants = VARIANTS[args.policy_type]
    chosen = args.variants or list(variants)
    if unknown := set(chosen) - set(variants):
        parser.error(f"--variants: unknown {sorted(unknown)}; choose from {', '.join(variants)}")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        dataset = convert(args.source, args.output_dir / "dataset")
        runs = [
            Run(variant, seed, args.output_dir / f"{variant}_{seed}")
            for seed in range(args.seeds)
            for variant in chosen
        ]
        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(lambda run: train(run, args.policy_type, dataset), runs))
            metrics = list(pool.map(lambda run: measure(run, dataset, args.frames), runs))
        played = [run for run in runs if run.variant == RECIPE] if args.eval_episodes else []
        coverages = {run.seed: play(run, args.eval_episodes) for run in played}
    except RuntimeError as error:
        sys.exit(f"pusht_offline.py: {error}")
    sys.exit(report(args, dict(zip(runs, metrics, strict=True)), coverages))


def convert(source: Path | None, dataset: Path) -> Path:
    """The demonstrations as a LeRobotDataset."""
    if not dataset.exists():
        if source is None:
            raise RuntimeError(f"{dataset} does not exist yet; name the demonstrations with --source")
        resume = ["--resume"] if dataset.with_name(f"{dataset.name}.conversion").exists() else []
        flags = [f"--repo_id={REPO_ID}", f"--root={dataset}", *resume]
        run_command("lerobot-bomb", "convert", "pusht-zarr", str(source), *flags)
    return dataset


def train(run: Run, policy_type: str, dataset: Path) -> None:
    """Stock `lerobot-train`; a training that was killed starts anew."""
    times = run.folder / "training.json"
    if times.exists():
        return
    shutil.rmtree(run.folder, ignore_errors=True)
    started = time.monotonic()
    cpu_s = run_logged(
        run.folder / "train.log",
        "lerobot-train",
        f"--config_path={pusht_recipe_path(policy_type)}",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={dataset}",
        f"--dataset.episodes={list(range(NUM_TRAIN_EPISODES))}",
        f"--output_dir={run.folder / 'train'}",
        f"--seed={run.seed}",
        *VARIANTS[policy_type][run.variant],
    )
    minutes = {"minutes": (time.monotonic() - started) / 60, "cpu_minutes": cpu_s / 60}
    times.write_text(json.dumps(minutes) + "\n")


def measure(run: Run, dataset: Path, num_frames: int) -> dict[str, Any]:
    """What `lerobot-bomb offline-metrics` finds on the episodes that were not trained on."""
    path = run.folder / f"metrics_{num_frames}.json"
    if not path.exists():
        run_logged(
            run.folder / "metrics.log",
            "lerobot-bomb",
            "offline-metrics",
            f"--policy.path={run.checkpoint}",
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={dataset}",
            f"--max_frames={num_frames}",
            "--batch_size=64",
            f"--json={path}",
        )
    return json.loads(path.read_text())["columns"]


def play(run: Run, num_episodes: int) -> list[float]:
    """Maximal coverage of each episode of the stock `lerobot-eval --env.type=pusht`."""
    folder = run.folder / f"eval_{num_episodes}"
    info = folder / "eval_info.json"
    if not info.exists():
        shutil.rmtree(folder, ignore_errors=True)
        run_logged(
            run.folder / "eval.log",
            "lerobot-eval",
            f"--policy.path={run.checkpoint}",
            "--env.type=pusht",
            f"--eval.n_episodes={num_episodes}",
            "--eval.batch_size=10",
            "--eval.use_async_envs=false",
            f"--output_dir={folder}",
        )
    per_task = json.loads(info.read_text())["per_task"]
    return [MAX_COVERAGE_REWARD * reward for task in per_task for reward in task["metrics"]["max_rewards"]]


def run_logged(log: Path, command: str, *flags: str) -> float:
    """Run a command of this Python's environment, its output to a file; CPU seconds of all its processes."""
    log.parent.mkdir(parents=True, exist_ok=True)
    print(f"{log.parent.name}: {command} {' '.join(flags[:2])} ... > {log}", flush=True)
    with log.open("w") as output:
        process = subprocess.Popen(
            [Path(sys.executable).with_name(command), *flags], stdout=output, stderr=output
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"`{command}` ended with exit code {process.returncode}; see {log}")
    return usage.ru_utime + usage.ru_stime


def report(
    args: argparse.Namespace, metrics: dict[Run, dict[str, Any]], coverages: dict[int, list[float]]
) -> int:
    """Print and write the tables; 0 if the recipe's L1 is below every trivial predictor's."""
    of_variant = {variant: [] for variant in dict.fromkeys(run.variant for run in metrics)}
    for run, columns in metrics.items():
        of_variant[run.variant].append((run, columns))
    print(f"\n{args.policy_type}, {args.seeds} seeds; mean and 95 % t-interval over seeds")
    header = ["", "L1 held out, px", "of the seeds", "L1 train, px", "value accuracy", "loss", "CPU min"]
    print_table(header, [row(variant, of) for variant, of in of_variant.items()])
    validation = next(iter(metrics.values()))["validation"]
    trivial = {name: of for name, of in validation["l1"].items() if name != "policy"}
    print("\nL1 held out by step of the chunk, px")
    first = next(iter(of_variant))
    steps = {first: [fmean(each) for each in zip(*(step_means(c, "policy") for _, c in of_variant[first]), strict=True)]}
    steps |= {name: step_means({"validation": validation}, name) for name in trivial}
    shown = [i for i in (0, 1, 2, 4, 7, 9, 15) if i < len(steps[first])]
    print_table(
        ["", "all", *(str(i + 1) for i in shown)],
        [
            [name, f"{overall(validation, name, of_variant[first]):.1f}", *(f"{values[i]:.1f}" for i in shown)]
            for name, values in steps.items()
        ],
    )
    for seed, values in coverages.items():
        print(f"pusht, seed {seed}: maximal coverage {interval_text(values)} over {len(values)} episodes")
    missed = verdict(of_variant.get(RECIPE, []), trivial)
    write_figures(
        args.json,
        {
            "policy": args.policy_type,
            "runs": [
                {"variant": run.variant, "seed": run.seed, **times(run), **columns}
                for run, columns in metrics.items()
            ],
            "coverages": coverages,
        },
    )
    return 1 if missed else 0
