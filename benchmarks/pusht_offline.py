r"""Does a policy learn from real data? PushT's human demonstrations, held-out episodes, predictors to beat.

The recipe configs/pusht_TYPE.yaml and its variants, each with several seeds, are trained by the stock
`lerobot-train` on episodes 0-179; `lerobot-bomb checkpoint offline-metrics` measures the decoded actions on
episodes 180-205, beside predictors that look at no image. With --eval_episodes the recipe's checkpoints also
run in LeRobot's environment `pusht`.

All start from one small backbone that first learned to see on the same episodes. From random weights, a model
that may read the state ignores the image for a long time (docs/pusht.md).

    python benchmarks/pusht_offline.py --policy.type=vla0_smol --source pusht_cchi_v7_replay.zarr \
        --output_dir pusht

What is finished stays in the output folder and is not done again: the dataset, each training, each
measurement. Every process uses one thread; a training is two processes, one of which reads the frames.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from machine import make_parser, positive, write_figures
from pusht_report import Seed, print_report
from recipes import PUSHT_TYPES, last_checkpoint, recipe_path

from lerobot_bomb.commands.run import run_command

REPO_ID = "lerobot_bomb/pusht"
NUM_TRAIN_EPISODES = 180
MAX_COVERAGE_REWARD = 0.95  # coverage from which gym-pusht's reward is 1

# absolute positions that no state tells must be found in the image; the near ones are found first
LOOK_FLAGS = ["--policy.use_state=false", "--policy.optimizer_lr=1.0e-3"]
NEAR_FLAGS = [
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
    "--policy.scheduler_decay_steps=2500",
    "--steps=2500",
]
ABSOLUTE = ["--policy.relative_actions=false"]
BASE_STAGES: dict[str, list[list[str]]] = {
    "fdvla": [NEAR_FLAGS],
    "spatialvla_grid": [NEAR_FLAGS],
    "vla0_smol": [[*LOOK_FLAGS, *ABSOLUTE, *NEAR_FLAGS], [*LOOK_FLAGS, *ABSOLUTE]],
}
RECIPE = "recipe"
VARIANTS: dict[str, dict[str, list[str]]] = {
    "fdvla": {
        RECIPE: [],
        "flow_only": ["--policy.use_denoise_head=false"],
        "diffusion_only": ["--policy.use_flow_head=false"],
    },
    "spatialvla_grid": {
        RECIPE: [],
        "uniform": ["--policy.grid_distribution=uniform"],
    },
    "vla0_smol": {
        RECIPE: [],
        "no_masking": ["--policy.mask_max_fraction=0"],
        "absolute": ABSOLUTE,
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
    def train_dir(self) -> Path:
        return self.folder / "train"

    @property
    def checkpoint(self) -> Path:
        return last_checkpoint(self.train_dir)

    @property
    def times_path(self) -> Path:
        """File that is written when the training is complete."""
        return self.folder / "training.json"

    def times(self) -> dict[str, float]:
        """Return the training's wall-clock and CPU minutes."""
        return json.loads(self.times_path.read_text())


def main() -> None:
    """Convert, train, measure, print the tables; exit with code 1 if a predictor beats the recipe."""
    parser = make_parser(__doc__)
    parser.add_argument("--policy.type", dest="policy_type", required=True, choices=PUSHT_TYPES)
    parser.add_argument("--source", type=Path, help="the zarr; not needed once it is converted")
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--variants", nargs="+", help="default: all")
    parser.add_argument("--seeds", type=positive, default=3, help="trainings of each (default: 3)")
    parser.add_argument("--jobs", type=positive, default=2, help="trainings at once (default: 2)")
    parser.add_argument("--frames", type=positive, default=1000, help="held-out frames (default: 1000)")
    parser.add_argument("--eval_episodes", type=positive, help="episodes in the environment, each seed")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    args = parser.parse_args()
    known = VARIANTS[args.policy_type]
    if unknown := set(args.variants or ()) - set(known):
        parser.error(f"--variants: unknown {sorted(unknown)}; choose from {', '.join(known)}")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        variants = prove(args, args.variants or list(known))
    except RuntimeError as error:
        sys.exit(f"pusht_offline.py: {error}")
    print(f"\n{args.policy_type}, episodes {NUM_TRAIN_EPISODES}-205, {args.seeds} seeds")
    beaten = print_report(variants, RECIPE)
    write_figures(args.json, {"policy": args.policy_type, "variants": as_figures(variants)})
    sys.exit(0 if beaten else 1)


def prove(args: argparse.Namespace, chosen: list[str]) -> dict[str, list[Seed]]:
    """Train and measure the chosen variants, {variant: one `Seed` for each seed}."""
    dataset = convert(args.source, args.output_dir / "dataset")
    start = learn_to_see(args.policy_type, dataset, args.output_dir)
    runs = [
        Run(variant, seed, args.output_dir / f"{variant}_{seed}")
        for seed in range(args.seeds)
        for variant in chosen
    ]

    def prove_one(run: Run) -> Seed:
        train(run, args.policy_type, dataset, [*start, *VARIANTS[args.policy_type][run.variant]])
        columns = measure(run, dataset, args.frames)
        num_episodes = args.eval_episodes if run.variant == RECIPE else None
        coverages = [] if num_episodes is None else coverages_of(run, num_episodes)
        return Seed(columns["train"], columns["validation"], max_coverages=coverages, **run.times())

    variants: dict[str, list[Seed]] = {}
    with ThreadPoolExecutor(args.jobs) as pool:
        for run, seed in zip(runs, pool.map(prove_one, runs), strict=True):
            variants.setdefault(run.variant, []).append(seed)
    return variants


def as_figures(variants: dict[str, list[Seed]]) -> dict[str, list[dict[str, Any]]]:
    """Return the figures ready for JSON."""
    return {name: [asdict(seed) for seed in seeds] for name, seeds in variants.items()}


def convert(source: Path | None, dataset: Path, copies: int = 0) -> Path:
    """Convert the demonstrations, and so many rigid copies of each, to a LeRobotDataset in a folder."""
    if not dataset.exists():
        if source is None:
            raise RuntimeError(f"{dataset} does not exist yet; name the demonstrations with --source")
        resume = ["--resume"] if dataset.with_name(f"{dataset.name}.conversion").exists() else []
        flags = [f"--repo_id={REPO_ID}", f"--root={dataset}", f"--copies={copies}", *resume]
        run_command("lerobot-bomb", "convert", "pusht-zarr", str(source), *flags)
    return dataset


def learn_to_see(policy_type: str, dataset: Path, folder: Path) -> list[str]:
    """Train a backbone to see; return the flags that start a training from it."""
    start: list[str] = []
    for stage, flags in enumerate(BASE_STAGES[policy_type]):
        run = Run("base", 0, folder / f"base_{stage}")
        train(run, policy_type, dataset, [*flags, *start])
        backbone = run.folder / "backbone"
        if not backbone.exists():
            export = [f"--policy.path={run.checkpoint}", f"--output={backbone}"]
            run_logged(run.folder / "export.log", "lerobot-bomb", "checkpoint", "export-backbone", *export)
        start = [f"--policy.vlm_model_name={backbone.resolve()}"]
    return start


def train(run: Run, policy_type: str, dataset: Path, flags: list[str]) -> None:
    """Run stock `lerobot-train`; a training that was killed starts anew."""
    if run.times_path.exists():
        return
    shutil.rmtree(run.folder, ignore_errors=True)
    started = time.monotonic()
    cpu_s = run_logged(
        run.folder / "train.log",
        "lerobot-train",
        f"--config_path={recipe_path('pusht', policy_type)}",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={dataset}",
        f"--dataset.episodes={list(range(NUM_TRAIN_EPISODES))}",
        f"--output_dir={run.train_dir}",
        f"--seed={run.seed}",
        *flags,
    )
    minutes = {"minutes": (time.monotonic() - started) / 60, "cpu_minutes": cpu_s / 60}
    run.times_path.write_text(json.dumps(minutes) + "\n")


def measure(run: Run, dataset: Path, num_frames: int) -> dict[str, Any]:
    """Measure with `lerobot-bomb checkpoint offline-metrics` on the episodes that were not trained on."""
    path = run.folder / f"metrics_{num_frames}.json"
    if not path.exists():
        run_logged(
            run.folder / "metrics.log",
            "lerobot-bomb",
            "checkpoint",
            "offline-metrics",
            f"--policy.path={run.checkpoint}",
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={dataset}",
            f"--max_frames={num_frames}",
            "--batch_size=64",
            f"--json={path}",
        )
    return json.loads(path.read_text())["columns"]


def coverages_of(run: Run, num_episodes: int) -> list[float]:
    """Return the maximal coverage of each episode."""
    flags = [f"--eval.n_episodes={num_episodes}", "--eval.batch_size=10"]
    return max_coverages(evaluate(run.checkpoint, run.folder / f"eval_{num_episodes}", flags))


def evaluate(checkpoint: Path, output_dir: Path, flags: list[str]) -> list[dict[str, Any]]:
    """Run stock `lerobot-eval --env.type=pusht`; return the metrics of each task."""
    info = output_dir / "eval_info.json"
    if not info.exists():
        shutil.rmtree(output_dir, ignore_errors=True)
        run_logged(
            output_dir.with_name("eval.log"),
            "lerobot-eval",
            f"--policy.path={checkpoint}",
            "--env.type=pusht",
            *flags,
            "--eval.use_async_envs=false",
            f"--output_dir={output_dir}",
        )
    return [task["metrics"] for task in json.loads(info.read_text())["per_task"]]


def max_coverages(metrics: list[dict[str, Any]]) -> list[float]:
    """Return the largest coverage of each episode, from gym-pusht's rewards."""
    return [MAX_COVERAGE_REWARD * reward for each in metrics for reward in each["max_rewards"]]


def run_logged(log: Path, command: str, *flags: str) -> float:
    """Run a command of this Python's environment, log its output; return its processes' CPU seconds."""
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


if __name__ == "__main__":
    main()
