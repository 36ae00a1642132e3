r"""Comparison on PushT: our policies and LeRobot's `act` and `diffusion`, trained for equal minutes.

Each starts from random weights and is trained by the stock `lerobot-train` on the 206 human demonstrations
and copies of them that are turned, mirrored and shifted; the stock `lerobot-eval --env.type=pusht` runs it
on new seeds. Two short trainings measure a step, so that the learning rate's decay ends when the minutes do:
CPU minutes on a CPU, wall-clock minutes on a GPU.

    python benchmarks/play_pusht.py --source pusht_cchi_v7_replay.zarr --output_dir play --minutes 60
    python benchmarks/play_pusht.py --source ... --output_dir play --minutes 15 --device cuda --jobs 7

What is finished stays in the output folder and is not done again: the dataset, each training, each
evaluation. Every process uses one thread.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from machine import make_parser, parse_on_idle_machine, positive, write_figures
from recipes import FOLDER, last_checkpoint, read_recipe, recipe_path

from lerobot_bomb.bootstrap import Estimate
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.tables import print_table

REPO_ID = "lerobot_bomb/pusht"
MAX_COVERAGE_REWARD = 0.95  # coverage from which gym-pusht's reward is 1
FIRST_UNSEEN_SEED = 100_000
COPIES = 7  # of each demonstration
CALIBRATION_STEPS = {"cpu": (5, 35), "cuda": (100, 400)}
# of a batch that fills a GPU, read by processes of their own
ON = {"cpu": ["--num_workers=0"], "cuda": ["--num_workers=2", "--batch_size=128"]}
POLICIES = sorted(path.stem.removeprefix("play_pusht_") for path in FOLDER.glob("play_pusht_*.yaml"))


@dataclass(frozen=True)
class Seconds:
    """Seconds that a training took, by the clock and of CPU."""

    clock: float
    cpu: float

    def on(self, device: str) -> float:
        """Return the seconds that count on a device: of CPU on a CPU, else by the clock."""
        return self.cpu if device == "cpu" else self.clock

    def minutes(self) -> dict[str, float]:
        """Return both in minutes, ready for JSON."""
        return {"minutes": self.clock / 60, "cpu_minutes": self.cpu / 60}


@dataclass(frozen=True)
class Contender:
    """One policy: how it was trained, and how it performs."""

    name: str
    steps: int
    minutes: float
    cpu_minutes: float
    max_coverages: list[float]  # of each episode
    num_successes: int


def main() -> None:
    """Convert, train all, evaluate all, print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--source", type=Path, help="the zarr; not needed once it is converted")
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--minutes", type=float, required=True, help="of each training")
    parser.add_argument("--device", choices=ON, default="cpu")
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=POLICIES)
    parser.add_argument("--jobs", type=positive, default=1, help="trainings at once (default: 1)")
    parser.add_argument("--episodes", type=positive, default=100, help="of each evaluation (default: 100)")
    args = parse_on_idle_machine(parser)
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        dataset = convert(args.source, args.output_dir / "dataset", COPIES)
        with ThreadPoolExecutor(args.jobs) as pool:
            contenders = list(pool.map(lambda name: compete(args, name, dataset), args.policies))
    except RuntimeError as error:
        sys.exit(f"play_pusht.py: {error}")
    print_contenders(contenders)
    write_figures(args.json, {"device": args.device, "contenders": [asdict(each) for each in contenders]})


def compete(args: argparse.Namespace, name: str, dataset: Path) -> Contender:
    """Train and evaluate one policy."""
    folder, times_path = args.output_dir / name, args.output_dir / name / "training.json"
    flags = [f"--config_path={recipe_path('play_pusht', name)}", f"--dataset.root={dataset}"]
    flags += [f"--policy.device={args.device}", *ON[args.device]]
    if not times_path.exists():
        shutil.rmtree(folder, ignore_errors=True)
        steps = max(1, int(60 * args.minutes / step_s(folder, flags, args.device)))
        seconds = train(folder / "train", [*flags, *decay(name, steps), *steps_flags(steps)])
        times_path.write_text(json.dumps({"steps": steps, **seconds.minutes()}) + "\n")
    coverages, num_successes = evaluate(
        last_checkpoint(folder / "train"),
        folder / f"eval_{args.episodes}",
        [
            f"--seed={FIRST_UNSEEN_SEED}",
            f"--eval.n_episodes={args.episodes}",
            f"--eval.batch_size={min(50, args.episodes)}",
        ],
    )
    return Contender(
        name, max_coverages=coverages, num_successes=num_successes, **json.loads(times_path.read_text())
    )


def convert(source: Path | None, dataset: Path, copies: int = 0) -> Path:
    """Convert the demonstrations, and so many rigid copies of each, to a LeRobotDataset in a folder."""
    if not dataset.exists():
        if source is None:
            raise RuntimeError(f"{dataset} does not exist yet; name the demonstrations with --source")
        resume = ["--resume"] if dataset.with_name(f"{dataset.name}.conversion").exists() else []
        flags = [f"--repo_id={REPO_ID}", f"--root={dataset}", f"--copies={copies}", *resume]
        run_command("lerobot-bomb", "convert", "pusht-zarr", str(source), *flags)
    return dataset


def train(output_dir: Path, flags: list[str]) -> Seconds:
    """Run stock `lerobot-train`; return the seconds that it took."""
    started = time.monotonic()
    cpu_s = run_logged(output_dir.with_suffix(".log"), "lerobot-train", *flags, f"--output_dir={output_dir}")
    return Seconds(time.monotonic() - started, cpu_s)


def evaluate(checkpoint: Path, output_dir: Path, flags: list[str]) -> tuple[list[float], int]:
    """Run stock `lerobot-eval --env.type=pusht`; return the episodes' maximal coverages and successes."""
    info = output_dir / "eval_info.json"
    if not info.exists():
        shutil.rmtree(output_dir, ignore_errors=True)
        stock = [f"--policy.path={checkpoint}", "--env.type=pusht", "--eval.use_async_envs=false"]
        log = output_dir.with_name("eval.log")
        run_logged(log, "lerobot-eval", *stock, *flags, f"--output_dir={output_dir}")
    metrics = [task["metrics"] for task in json.loads(info.read_text())["per_task"]]
    coverages = [MAX_COVERAGE_REWARD * reward for each in metrics for reward in each["max_rewards"]]
    return coverages, sum(sum(each["successes"]) for each in metrics)


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


def steps_flags(steps: int) -> list[str]:
    """Return the flags of a training of so many steps with three checkpoints."""
    return [f"--steps={steps}", f"--save_freq={-(-steps // 3)}"]


def decay(name: str, steps: int) -> list[str]:
    """Return the flag that decays the learning rate over the whole training, if the config has one."""
    flag = "scheduler_decay_steps"
    return [f"--policy.{flag}={steps}"] if flag in read_recipe("play_pusht", name)["policy"] else []


def step_s(folder: Path, flags: list[str], device: str) -> float:
    """Return the seconds of a training step, CPU seconds on a CPU: what each further step takes."""
    few, more = CALIBRATION_STEPS[device]
    shorter, longer = (
        train(folder / f"calibration_{steps}", [*flags, *steps_flags(steps)]) for steps in (few, more)
    )
    return (longer.on(device) - shorter.on(device)) / (more - few)


def print_contenders(contenders: list[Contender]) -> None:
    """Print a line for each contender, the best first."""
    print_table(
        ["policy", "mean maximal coverage", "successes", "steps", "minutes", "CPU min"],
        [
            [
                each.name,
                over_episodes(each.max_coverages),
                str(each.num_successes),
                str(each.steps),
                f"{each.minutes:.1f}",
                f"{each.cpu_minutes:.1f}",
            ]
            for each in sorted(contenders, key=lambda each: -fmean(each.max_coverages))
        ],
    )


def over_episodes(values: Sequence[float]) -> str:
    """Format the mean and its bootstrap interval."""
    estimate = Estimate.of(np.array(values), np.ones(len(values)))
    return f"{estimate.text('.3f')} over {len(values)} episodes"


if __name__ == "__main__":
    main()
