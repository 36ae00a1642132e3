"""Do policies learn from random weights, on one CPU core, to place stones on boards they have not seen?

A policy is trained by the stock `lerobot-train` on demonstrations of the scripted expert, and its checkpoints
are evaluated by the stock `lerobot-eval` on unseen seeds. The last one is evaluated twice more: with black
images, and with the instruction of another episode. The policy is a small probe made for this task
(lerobot_policy_keypoint_probe/: can it be learnt at all?), one of ours by configs/TASK_TYPE.yaml, or
LeRobot's `act` or `diffusion` (pip install 'lerobot[diffusion]') with about as many CPU minutes.

    OMP_NUM_THREADS=1 python benchmarks/learn.py one_target --policy.type=vla0_smol --output_dir learn

What is finished stays in the output folder and is not done again: the dataset, the training, each evaluation.
A training that was killed starts anew. Flags --policy.NAME=VALUE go to `lerobot-train`; `robust` trains on
from --policy.path=CHECKPOINT, or else from where its recipe says. Recipes are chosen on other seeds than the
reported ones: --first_seed=50000.
"""

import argparse
import fcntl
import json
import os
import resource
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from learning_curve import Point, count, draw, print_points
from learning_tasks import (
    PROBE,
    RIVALS,
    TASKS,
    Bar,
    Part,
    Task,
    by_suite,
    by_what_is_left_out,
    shown_pairs,
)
from machine import make_parser, parse_with_policy_flags, positive, write_figures
from recipes import POLICY_TYPES, last_checkpoint, read_recipe, recipe_path

from lerobot_bomb.checkpoints.identity import sha256_of
from lerobot_bomb.checkpoints.names import CONFIG, WEIGHTS
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.conditions import NONE
from lerobot_bomb.files import read_json
from lerobot_bomb.results.bomb import EpisodeResult, put_down
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.instructions import named_targets, other_instructions

PLUGIN = f"lerobot_policy_{PROBE}"  # not installed: LeRobot finds it by --*.discover_packages_path
REPO_ID = "learn/bomb_place"
IMAGE_SIZE = 64  # pixels
NOISE = 0.05  # on the executed actions, so that recoveries are in the data
BATCH_SIZE = 64
FIRST_UNSEEN_SEED = 100_000
NUM_CHECKPOINTS = 6
CURVE_EPISODES = 50  # of every checkpoint but the last
MAX_CONTROL_EPISODES = 200
PLACE = "place"
NO_IMAGES, OTHER_INSTRUCTION = "blank images", "another episode's instruction"


def main() -> None:
    """Record, train, evaluate every checkpoint, print the curve; exit with code 1 if the bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument("task", choices=TASKS)
    types = [PROBE, *POLICY_TYPES, *RIVALS]
    parser.add_argument("--policy.type", dest="policy_type", choices=types, default=PROBE)
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--demonstrations", type=positive, help="default: the task's")
    parser.add_argument("--steps", type=positive, help="training steps (default: the recipe's)")
    points = f"points of the curve (default: {NUM_CHECKPOINTS})"
    parser.add_argument("--checkpoints", type=positive, default=NUM_CHECKPOINTS, help=points)
    seeds = f"of the evaluations (default: {FIRST_UNSEEN_SEED})"
    parser.add_argument("--first_seed", type=positive, default=FIRST_UNSEEN_SEED, help=seeds)
    parser.add_argument("--plot", type=Path, help="write the learning curve to this PNG")
    args = parse_with_policy_flags(parser)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    here = str(Path(__file__).parent)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    try:
        sys.exit(run_task(args))
    except RuntimeError as error:
        sys.exit(f"learn.py: {error}")
    except KeyboardInterrupt:
        sys.exit("learn.py: interrupted; the same command resumes (a training that was stopped starts anew)")


def run_task(args: argparse.Namespace) -> int:
    """Run the whole task in args.output_dir; return 0 if the bar was reached."""
    task, folder = TASKS[args.task], args.output_dir
    if args.policy_type not in task.trainings:
        raise RuntimeError(f"{args.task} is for --policy.type={' or '.join(task.trainings)}")
    training = task.trainings[args.policy_type]
    demonstrations = args.demonstrations or training.demonstrations
    run = {
        "task": args.task,
        "policy": args.policy_type,
        "demonstrations": demonstrations,
        "steps": args.steps
        or training.steps
        or read_recipe(recipe_task(args.task), args.policy_type)["steps"],
        "checkpoints": args.checkpoints,
        "first_seed": args.first_seed,
        "flags": args.policy_flags,
    }
    claim(folder, run)
    with locked(folder):
        return run_claimed(args, task, run)


def run_claimed(args: argparse.Namespace, task: Task, run: dict[str, Any]) -> int:
    """Run the whole task in its folder, which nothing else writes to; return 0 if the bar was reached."""
    folder, training = args.output_dir, task.trainings[args.policy_type]
    demonstrations = run["demonstrations"]
    record(task, demonstrations, folder / "dataset")
    minutes = train(folder, run)

    results = evaluate_checkpoints(task, folder, args.first_seed, run["steps"])
    given = other_instructions(results[run["steps"]]) if task.is_said_at_once else {}
    controls = evaluate_controls(task, folder, args.first_seed, given)
    minutes_per_step = minutes["cpu_minutes"] / run["steps"]
    points = {f"step {step}": count(rows, step, step * minutes_per_step) for step, rows in results.items()}
    others = controls | (by_what_is_left_out(results[run["steps"]]) if task.is_partial else {})
    others |= by_suite(results[run["steps"]])
    points |= {name: count(rows, run["steps"], minutes["cpu_minutes"]) for name, rows in others.items()}

    print_points(points)
    num_named = None
    rows = controls.get(OTHER_INSTRUCTION)
    if rows is not None and task.suite == PLACE:  # of the others, what is meant depends on the board
        num_named = count_named(rows, given, named_targets(results[run["steps"]]))
        print(
            f"{OTHER_INSTRUCTION}: {num_named}/{len(rows)} stones put down on the intersection that it names"
        )
    conditions = evaluate_conditions(task, folder, args.first_seed)
    if args.plot is not None:
        title = f"{args.policy_type}, {args.task}: {demonstrations} demonstrations, {task.episodes} new seeds"
        draw([points[f"step {step}"] for step in results], title, args.plot)
    write_figures(
        args.json,
        {
            **run,
            "training": minutes,
            # two trainings that end in other bits part between two of these
            "weights_sha256": {
                step: sha256_of(path / WEIGHTS) for step, path in checkpoints(folder / "train").items()
            },
            "points": {name: asdict(point) for name, point in points.items()},
            "on_named": num_named,
            "conditions": conditions,
        },
    )
    checkpoint = last_checkpoint(folder / "train")
    task_flag = f" --env.task_ids={list(task.task_ids)}".replace(" ", "") if task.task_ids else ""
    task_flag += "" if task.suite == PLACE else f" --env.task={task.suite}"
    view = (
        f"lerobot-bomb view --policy.path={checkpoint} --env.image_size={IMAGE_SIZE} --seed={args.first_seed}"
    )
    print(f"The policy: {checkpoint}\nAn episode of it as a video: {view} {task_flag}".rstrip())
    return 0 if training.bar is None else verdict(points[f"step {run['steps']}"], training.bar)


def recipe_task(task: str) -> str:
    """Return the task whose name the recipes' files carry."""
    return TASKS[task].recipe or task


def verdict(last: Point, bar: Bar) -> int:
    """Print whether the last checkpoint reaches the bar; return 0 if it does."""
    is_reached = last.num_successes >= bar.success * last.num_episodes and last.cpu_minutes <= bar.cpu_minutes
    print(
        f"To be reached: {100 * bar.success:.0f} % within {bar.cpu_minutes:.0f} CPU minutes: "
        f"{'reached' if is_reached else 'MISSED'}"
    )
    return 0 if is_reached else 1


def claim(folder: Path, run: dict[str, Any]) -> None:
    """Make the folder, or refuse one in which something else was run."""
    path = folder / "run.json"
    if path.exists() and json.loads(path.read_text()) != run:
        raise RuntimeError(
            f"--output_dir={folder} holds a run of {path.read_text().strip()}; name another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(run) + "\n")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; commands run meanwhile hold it too, even if this process is killed.

    Raises:
        RuntimeError: another process holds it.
    """
    with (folder / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RuntimeError(
                f"--output_dir={folder} is in use: by another run, or by a lerobot-train or lerobot-eval "
                "that a killed run has left; wait until it ends, or end it"
            ) from None
        os.set_inheritable(file.fileno(), True)
        yield


def record(task: Task, demonstrations: int, dataset: Path) -> None:
    """Record the expert's episodes, or record and merge the parts of a task."""
    if dataset.exists():
        return
    if not task.parts:
        run_record(task, dataset, Part(task.suite, demonstrations, task_ids=task_ids_of(task)))
        return
    folders = [dataset.with_name(part.name) for part in task.parts]
    for part, folder in zip(task.parts, folders, strict=True):
        if not folder.exists():
            run_record(task, folder, part, "--pointing")
    merge(folders, dataset)


def merge(folders: Sequence[Path], dataset: Path) -> None:
    """Merge recordings into one dataset."""
    run_command(
        "lerobot-bomb", "record", "merge", *map(str, folders), f"--repo_id={REPO_ID}", f"--root={dataset}"
    )


def task_ids_of(task: Task) -> tuple[int, ...]:
    """Return the task ids of the demonstrations; () if they are drawn."""
    return tuple(shown_pairs()) if task.is_partial else task.task_ids


def run_record(task: Task, folder: Path, part: Part, *flags: str) -> None:
    """Make one recording of the task."""
    number = (
        [f"--static={part.number}"] if part.is_static else [f"--episodes={part.number}", f"--noise={NOISE}"]
    )
    task_flags = [f"--task_ids={list(part.task_ids)}"] if part.task_ids else []
    resume = ["--resume"] if folder.with_name(f"{folder.name}.recording").exists() else []
    run_command(
        "lerobot-bomb",
        "record",
        f"--repo_id={REPO_ID}",
        f"--root={folder}",
        f"--seed={part.first_seed}",
        *number,
        f"--task={part.suite}",
        f"--perturbations={task.perturbations}",
        f"--split={'train' if task.is_partial else 'all'}",
        "--images",
        f"--image_size={IMAGE_SIZE}",
        *task.env_flags,
        *task_flags,
        *flags,
        *resume,
    )


def train(folder: Path, run: dict[str, Any]) -> dict[str, float]:
    """Train a run by stock `lerobot-train`; return the {"minutes", "cpu_minutes"} that it took."""
    times = folder / "training.json"
    if times.exists():
        return json.loads(times.read_text())
    if (folder / "train").exists():
        print("A training that was stopped is deleted, and starts anew: its minutes would not be known")
        shutil.rmtree(folder / "train")
    started, cpu_started = time.monotonic(), _children_cpu_s()
    recipe = [f"--config_path={recipe_path(recipe_task(run['task']), run['policy'])}"]
    run_command(
        "lerobot-train",
        *(probe_recipe() if run["policy"] == PROBE else recipe),
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={folder / 'dataset'}",
        f"--output_dir={folder / 'train'}",
        f"--steps={run['steps']}",
        f"--save_freq={-(-run['steps'] // run['checkpoints'])}",
        "--num_workers=0",  # a second process would use a second core
        *run["flags"],
    )
    minutes = {
        "minutes": (time.monotonic() - started) / 60,
        "cpu_minutes": (_children_cpu_s() - cpu_started) / 60,
    }
    times.write_text(json.dumps(minutes) + "\n")
    return minutes


def probe_recipe() -> list[str]:
    """Return the flags of `lerobot-train` for the probe."""
    return [
        f"--policy.discover_packages_path={PLUGIN}",
        f"--policy.type={PROBE}",
        "--policy.device=cpu",
        f"--batch_size={BATCH_SIZE}",
    ]


def checkpoints(train_dir: Path) -> dict[int, Path]:
    """Return the checkpoints of `lerobot-train --output_dir=train_dir`, {training step: folder}."""
    paths = sorted((train_dir / "checkpoints").glob("[0-9]*"))
    return {int(path.name): path / "pretrained_model" for path in paths}


def evaluate_checkpoints(
    task: Task, folder: Path, first_seed: int, last: int
) -> dict[int, list[EpisodeResult]]:
    """Evaluate each checkpoint, {training step: results}; all but the last in fewer episodes."""
    return {
        step: evaluate(
            task,
            checkpoint,
            folder / f"eval_{step:06d}",
            first_seed,
            task.episodes if step == last else min(CURVE_EPISODES, task.episodes),
        )
        for step, checkpoint in checkpoints(folder / "train").items()
    }


def evaluate_controls(
    task: Task, folder: Path, first_seed: int, given: dict[str, str]
) -> dict[str, list[EpisodeResult]]:
    """Evaluate the last checkpoint with black images and with other instructions, {control: results}.

    If all episodes have one target, ``given`` is empty and the second control is left out.
    """
    import lerobot_policy_keypoint_probe  # noqa: F401  its processor step must be known when it is loaded

    from lerobot_bomb.explain.interventions import BlankImages, ReplaceTasks, intervene

    checkpoint = last_checkpoint(folder / "train")
    controls = [(NO_IMAGES, BlankImages(), "blank_images")]
    if given:
        controls.append((OTHER_INSTRUCTION, ReplaceTasks(given), "other_instruction"))
    results = {}
    for name, step, changed in controls:
        shutil.rmtree(checkpoint.with_name(changed), ignore_errors=True)
        intervene(checkpoint, [step], checkpoint.with_name(changed))
        output_dir = folder / f"eval_{changed}"
        episodes = min(task.episodes, MAX_CONTROL_EPISODES)
        results[name] = evaluate(task, checkpoint.with_name(changed), output_dir, first_seed, episodes)
    return results


def evaluate_conditions(task: Task, folder: Path, first_seed: int) -> dict[str, int]:
    """Evaluate the last checkpoint, CURVE_EPISODES each; print a table, return {condition: successes}."""
    if not task.conditions:
        return {}
    checkpoint, output_dir = last_checkpoint(folder / "train"), folder / "eval_conditions"
    rows = evaluate(task, checkpoint, output_dir, first_seed, CURVE_EPISODES, task.conditions)
    run_command("lerobot-bomb", "results", f"{output_dir / 'results.jsonl'}")
    successes = dict.fromkeys(task.conditions, 0)
    for row in rows:
        successes[row.spec.perturbations] += row.is_success
    return successes


def evaluate(
    task: Task,
    checkpoint: Path,
    output_dir: Path,
    first_seed: int,
    episodes: int,
    conditions: Sequence[str] = (NONE,),
) -> list[EpisodeResult]:
    """Run stock `lerobot-eval` on unseen seeds, so many under each condition; return their results."""
    results = output_dir / "results.jsonl"
    finished = output_dir / "finished"  # an evaluation that was killed leaves results of some episodes
    if not finished.exists():
        shutil.rmtree(output_dir, ignore_errors=True)
        task_flags = [f"--env.task_ids={list(task.task_ids)}"] if task.task_ids else []
        is_probe = read_json(checkpoint / CONFIG)["type"] == PROBE
        # not --policy.*, which would become an override of the checkpoint's config
        probe_flags = [f"--env.discover_packages_path={PLUGIN}"] if is_probe else []
        run_command(
            "lerobot-eval",
            *probe_flags,
            f"--policy.path={checkpoint}",
            "--env.type=bomb",
            f"--env.task={task.suite}",
            f"--env.image_size={IMAGE_SIZE}",
            f"--env.results_path={results}",
            *task.env_flags,
            *task_flags,
            f"--env.perturbations={json.dumps(conditions)}",
            f"--seed={first_seed}",
            f"--eval.n_episodes={episodes}",
            f"--eval.batch_size={min(10, episodes)}",
            "--eval.use_async_envs=false",
            f"--output_dir={output_dir / 'eval'}",
        )
        finished.touch()
    return read_results(results, EpisodeResult)


def count_named(rows: list[EpisodeResult], given: dict[str, str], targets: dict[str, tuple[int, int]]) -> int:
    """Count the stones put down nearest to the intersection in the instruction that the policy was given."""
    return sum(row.nearest_intersection == targets[given[row.instruction]] for row in put_down(rows))


def _children_cpu_s() -> float:
    """Return the CPU seconds, user and system, of all commands that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
