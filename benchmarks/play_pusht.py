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
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

from machine import make_parser, parse_on_idle_machine, positive, write_figures
from pusht_commands import convert, evaluate, train
from pusht_report import over_episodes
from recipes import FOLDER, last_checkpoint, read_recipe, recipe_path

from lerobot_bomb.tables import print_table

FIRST_UNSEEN_SEED = 100_000
COPIES = 7  # of each demonstration
CALIBRATION_STEPS = {"cpu": (5, 35), "cuda": (100, 400)}
# of a batch that fills a GPU, read by processes of their own
ON = {"cpu": ["--num_workers=0"], "cuda": ["--num_workers=2", "--batch_size=128"]}
POLICIES = sorted(path.stem.removeprefix("play_pusht_") for path in FOLDER.glob("play_pusht_*.yaml"))


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


if __name__ == "__main__":
    main()
