"""Can BOMB's demonstrations be learnt at all? The gate that opens before a big model is trained.

A small image policy (lerobot_policy_keypoint_probe/) is trained by the stock `lerobot-train` on
demonstrations of the scripted expert, and its checkpoints are evaluated by the stock `lerobot-eval` on seeds
that it has not seen; the last one twice more: with black images, and told the sentence of another episode.

    OMP_NUM_THREADS=1 python benchmarks/gate.py one_target --output_dir gate

What is finished stays in the output folder and is not done again: the dataset, the training, each evaluation.
A training that was killed starts anew. Flags --policy.NAME=VALUE go to `lerobot-train`.
"""

import argparse
import json
import os
import resource
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learning_curve import Point, as_figures, count, draw, print_points
from machine import add_machine_arguments, positive, require_idle_machine, write_figures

from lerobot_bomb.commands import run_command
from lerobot_bomb.evaluation.results import PUT_DOWN, Row, read_results

PLUGIN = "lerobot_policy_keypoint_probe"  # not installed: LeRobot finds it by --*.discover_packages_path
REPO_ID = "gate/bomb_place"
IMAGE_SIZE = 64  # pixels
NOISE = 0.05  # on the executed actions, so that recoveries are in the data
BATCH_SIZE = 64
FIRST_SEED = 1000  # of the demonstrations
FIRST_UNSEEN_SEED = 100_000
EVAL_EPISODES = 100
NUM_CHECKPOINTS = 6
NO_IMAGES, OTHER_SENTENCE = "blank images", "another episode's sentence"


@dataclass(frozen=True)
class Rung:
    """A step of difficulty: which tasks, how many demonstrations, how long a training."""

    task_ids: tuple[int, ...]  # empty: target and colour are drawn for each episode
    demonstrations: int
    steps: int
    bar: float | None  # success rate that the last checkpoint must reach; None: it is only measured


RUNGS = {
    "one_target": Rung((12,), demonstrations=200, steps=3000, bar=0.90),
    "all_targets": Rung((), demonstrations=400, steps=6000, bar=None),
}


def main() -> None:
    """Record, train, evaluate every checkpoint, print the curve; exit code 1 where the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("rung", choices=RUNGS)
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to go on with")
    parser.add_argument("--demonstrations", type=positive, help="default: the rung's")
    parser.add_argument("--steps", type=positive, help="training steps (default: the rung's)")
    parser.add_argument("--picture", type=Path, help="write the learning curve to this PNG")
    add_machine_arguments(parser)
    args, args.policy_flags = parser.parse_known_args()
    unknown = [flag for flag in args.policy_flags if not flag.startswith("--policy.")]
    if unknown:
        parser.error(f"unknown: {' '.join(unknown)}")
    require_idle_machine(args.force)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    here = str(Path(__file__).parent)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    try:
        sys.exit(climb(args))
    except RuntimeError as error:
        sys.exit(f"gate.py: {error}")


def climb(args: argparse.Namespace) -> int:
    """The whole rung in args.output_dir; 0 if the bar was reached."""
    rung, folder = RUNGS[args.rung], args.output_dir
    demonstrations, steps = args.demonstrations or rung.demonstrations, args.steps or rung.steps
    run = {"rung": args.rung, "demonstrations": demonstrations, "steps": steps, "flags": args.policy_flags}
    claim(folder, run)
    record(rung, demonstrations, folder / "dataset")
    minutes = train(folder, steps, args.policy_flags)

    results = evaluate_checkpoints(rung, folder)
    told = other_sentences(results[steps])
    controls = evaluate_controls(rung, folder, told)
    minutes_per_step = minutes["cpu_minutes"] / steps
    points = {f"step {step}": count(rows, step, step * minutes_per_step) for step, rows in results.items()}
    points |= {name: count(rows, steps, minutes["cpu_minutes"]) for name, rows in controls.items()}

    num_named = count_named(controls[OTHER_SENTENCE], told)
    print_points(points)
    print(f"{OTHER_SENTENCE}: {num_named}/{EVAL_EPISODES} stones put down on the intersection that it names")
    if args.picture is not None:
        title = f"{args.rung}: {demonstrations} demonstrations, {EVAL_EPISODES} unseen seeds"
        draw([points[f"step {step}"] for step in results], title, args.picture)
    write_figures(
        args.json, {**run, "training": minutes, "points": as_figures(points), "on_named": num_named}
    )
    return 0 if rung.bar is None else verdict(points[f"step {steps}"], rung.bar)


def verdict(last: Point, bar: float) -> int:
    """Say whether the last checkpoint reaches the bar; 0 if it does."""
    is_open = last.num_successes >= bar * last.num_episodes
    print(f"bar {100 * bar:.0f} %: {'reached' if is_open else 'MISSED'}")
    return 0 if is_open else 1


def claim(folder: Path, run: dict[str, Any]) -> None:
    """Make the folder, or refuse one in which something else was run."""
    path = folder / "run.json"
    if path.exists() and json.loads(path.read_text()) != run:
        raise RuntimeError(
            f"--output_dir={folder} holds a run of {path.read_text().strip()}; name another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(run) + "\n")


def record(rung: Rung, demonstrations: int, dataset: Path) -> None:
    """The expert's episodes."""
    if dataset.exists():
        return
    tasks = [f"--task_ids={list(rung.task_ids)}"] if rung.task_ids else []
    resume = ["--resume"] if dataset.with_name(f"{dataset.name}.recording").exists() else []
    run_command(
        "lerobot-bomb",
        "record",
        f"--repo_id={REPO_ID}",
        f"--root={dataset}",
        f"--episodes={demonstrations}",
        f"--seed={FIRST_SEED}",
        f"--noise={NOISE}",
        "--images",
        f"--image_size={IMAGE_SIZE}",
        *tasks,
        *resume,
    )


def train(folder: Path, steps: int, policy_flags: list[str]) -> dict[str, float]:
    """Stock `lerobot-train` with NUM_CHECKPOINTS checkpoints; {"minutes", "cpu_minutes"} that it took."""
    times = folder / "training.json"
    if times.exists():
        return json.loads(times.read_text())
    shutil.rmtree(folder / "train", ignore_errors=True)
    started, cpu_started = time.monotonic(), _children_cpu_s()
    run_command(
        "lerobot-train",
        f"--policy.discover_packages_path={PLUGIN}",
        "--policy.type=keypoint_probe",
        "--policy.device=cpu",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={folder / 'dataset'}",
        f"--output_dir={folder / 'train'}",
        f"--batch_size={BATCH_SIZE}",
        f"--steps={steps}",
        f"--save_freq={-(-steps // NUM_CHECKPOINTS)}",
        "--num_workers=0",  # a second process would use a second core
        *policy_flags,
    )
    minutes = {
        "minutes": (time.monotonic() - started) / 60,
        "cpu_minutes": (_children_cpu_s() - cpu_started) / 60,
    }
    times.write_text(json.dumps(minutes) + "\n")
    return minutes


def evaluate_checkpoints(rung: Rung, folder: Path) -> dict[int, list[Row]]:
    """{training step: results}."""
    return {
        int(path.name): evaluate(rung, path / "pretrained_model", folder / f"eval_{path.name}")
        for path in sorted((folder / "train" / "checkpoints").glob("[0-9]*"))
    }


def evaluate_controls(rung: Rung, folder: Path, told: dict[str, str]) -> dict[str, list[Row]]:
    """{control: results} of the last checkpoint with black cameras, and told other sentences."""
    import lerobot_policy_keypoint_probe  # noqa: F401  its processor step must be known when it is loaded

    from lerobot_bomb.explain.interventions import BlankImages, ReplaceTasks, intervene

    checkpoint = folder / "train" / "checkpoints" / "last" / "pretrained_model"
    results = {}
    for name, step, changed in (
        (NO_IMAGES, BlankImages(), "blank_images"),
        (OTHER_SENTENCE, ReplaceTasks(told), "other_sentence"),
    ):
        shutil.rmtree(checkpoint.with_name(changed), ignore_errors=True)
        intervene(checkpoint, [step], checkpoint.with_name(changed))
        results[name] = evaluate(rung, checkpoint.with_name(changed), folder / f"eval_{changed}")
    return results


def evaluate(rung: Rung, checkpoint: Path, output_dir: Path) -> list[Row]:
    """Stock `lerobot-eval` on EVAL_EPISODES unseen seeds; their results."""
    results = output_dir / "results.jsonl"
    finished = output_dir / "finished"  # an evaluation that was killed leaves results of some episodes
    if not finished.exists():
        shutil.rmtree(output_dir, ignore_errors=True)
        tasks = [f"--env.task_ids={list(rung.task_ids)}"] if rung.task_ids else []
        run_command(
            "lerobot-eval",
            # not --policy.*, which would become an override of the checkpoint's config
            f"--env.discover_packages_path={PLUGIN}",
            f"--policy.path={checkpoint}",
            "--env.type=bomb",
            f"--env.image_size={IMAGE_SIZE}",
            f"--env.results_path={results}",
            *tasks,
            f"--seed={FIRST_UNSEEN_SEED}",
            f"--eval.n_episodes={EVAL_EPISODES}",
            "--eval.batch_size=10",
            "--eval.use_async_envs=false",
            f"--output_dir={output_dir / 'eval'}",
        )
        finished.touch()
    return read_results(results)


def other_sentences(rows: list[Row]) -> dict[str, str]:
    """{instruction: that of another episode}; where all episodes have one target, in other words only."""
    sentences = sorted({row["instruction"] for row in rows})
    half = len(sentences) // 2
    return dict(zip(sentences, sentences[half:] + sentences[:half], strict=True))


def count_named(rows: list[Row], told: dict[str, str]) -> int:
    """Stones put down nearest to the intersection that the policy was told."""
    targets = {row["instruction"]: row["target"] for row in rows}
    return sum(
        row["failure"] in PUT_DOWN and row["nearest_intersection"] == targets[told[row["instruction"]]]
        for row in rows
    )


def _children_cpu_s() -> float:
    """CPU seconds, user and system, of all commands that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
