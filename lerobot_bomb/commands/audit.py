"""``lerobot-bomb audit``: does a policy's success rate mean what it seems to?"""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE
from lerobot_bomb.checkpoints.training import trained_image_size
from lerobot_bomb.commands.arguments import ANSWER_IS_NO, check_at_least, checkpoint_flag, path_flag
from lerobot_bomb.conditions import ALL
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import flag_value
from lerobot_bomb.report import verdicts
from lerobot_bomb.report.page import render
from lerobot_bomb.report.table import Section
from lerobot_bomb.report.verdicts import (
    AGAIN,
    ALONE,
    BLANK,
    EXPERT,
    HELDOUT,
    OTHER_INSTRUCTION,
    POLICY,
    RANDOM,
    TRAIN,
    judge,
)
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.instructions import other_instructions
from lerobot_bomb.results.record import Record
from lerobot_bomb.sweep.claim import claimed
from lerobot_bomb.sweep.local import run_part
from lerobot_bomb.sweep.manifest import Job, Manifest, check_flags, largest_divisor
from lerobot_bomb.tables import print_table

if TYPE_CHECKING:
    from lerobot.processor import ProcessorStep

MAX_BATCH = 10
TURN_BY_TURN = ("long", ALL)  # an instruction that changes in an episode cannot be exchanged


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.usage = "lerobot-bomb audit FOLDER --policy.path=CHECKPOINT [--env.NAME=VALUE ...]"
    add = parser.add_argument
    add("folder", type=path_flag, metavar="FOLDER", help="new folder, or one of an audit to resume")
    add(
        "--policy.path", dest="policy_path", type=checkpoint_flag, required=True, help="a checkpoint's folder"
    )
    add("--episodes", type=int, default=50, help="episodes of each run (default: 50)")
    add("--seed", type=int, default=TEST_SEEDS[0], help=f"first seed (default: {TEST_SEEDS[0]})")
    add("--workers", type=int, default=1, help="processes (default: 1)")
    add("rest", nargs="*", metavar="FLAG", help="flags of lerobot-eval, of --env.type=bomb")


def run(args: argparse.Namespace) -> int:
    """Run all groups, write the page, print the verdicts; exit code 3 if one is no."""
    check_at_least(args, episodes=2, seed=0, workers=1)
    task = flag_value(args.rest, "--env.task")
    if task in TURN_BY_TURN:
        raise ValueError(f"--env.task={task} has episodes whose instruction changes; audit another suite")
    check_flags([flag for flag in args.rest if not flag.startswith("--env.task=")])
    groups = _run_jobs(args, args.folder / "first", _first_groups(args))
    groups |= _run_jobs(args, args.folder / "second", _second_groups(args, groups[POLICY]))
    from lerobot_bomb.hub.history import History  # LeRobot: seconds

    found = judge(groups, History.read(args.policy_path).seeds)
    section = Section("Audit", verdicts.verdict_tables(groups, found))
    html, tables = (args.folder / f"audit{suffix}" for suffix in (".html", ".json"))
    with written_whole(html, tables) as (page, as_json):
        page.write_text(render(f"Audit of {args.policy_path}", [section]))
        as_json.write_text(json.dumps(section.as_json(), indent=1) + "\n")
    print_table(["", "", ""], [[each.question, each.answer, each.evidence] for each in found])
    print(html, tables, sep="\n")
    return ANSWER_IS_NO if any(each.answer == verdicts.NO for each in found) else 0


def _first_groups(args: argparse.Namespace) -> dict[str, Job]:
    checkpoint = f"--policy.path={args.policy_path}"
    from lerobot_bomb.explain.interventions import BlankImages  # LeRobot: seconds

    groups = {POLICY: _job(args, checkpoint)}
    if groups[POLICY].batch_size > 1:
        groups[ALONE] = _job(args, checkpoint, batch_size=1)
    groups |= {
        BLANK: _job(args, _changed(args, "blank_images", BlankImages())),
        RANDOM: _job(args, "--policy.type=bomb_random"),
        EXPERT: _job(args, "--policy.type=bomb_expert"),
    }
    if not any(flag.startswith(("--env.split", "--env.task_ids", "--env.target")) for flag in args.rest):
        groups |= {TRAIN: _job(args, checkpoint, "train"), HELDOUT: _job(args, checkpoint, "heldout")}
    return groups


def _second_groups(args: argparse.Namespace, evaluated: list[Record]) -> dict[str, Job]:
    """Return the jobs of the second groups, which need the instructions of the first."""
    groups = {AGAIN: _job(args, f"--policy.path={args.policy_path}")}
    others = other_instructions([each for each in evaluated if isinstance(each, EpisodeResult)])
    if others:
        from lerobot_bomb.explain.interventions import ReplaceTasks

        groups[OTHER_INSTRUCTION] = _job(args, _changed(args, "other_instruction", ReplaceTasks(others)))
    return groups


def _changed(args: argparse.Namespace, name: str, step: "ProcessorStep") -> str:
    """Return --policy.path of the checkpoint with an intervention; write that checkpoint unless it exists."""
    from lerobot_bomb.explain.interventions import intervene

    folder = args.folder / name
    if not folder.is_dir():
        intervene(args.policy_path, [step], folder)
    return f"--policy.path={folder}"


def _job(args: argparse.Namespace, policy: str, split: str = "", batch_size: int = MAX_BATCH) -> Job:
    of_policy = [flag for flag in args.rest if flag.startswith("--policy.")]
    of_env = [flag for flag in args.rest if not flag.startswith("--policy.")]
    size = trained_image_size(args.policy_path)  # of the groups without a checkpoint, too
    if size not in (None, DEFAULT_IMAGE_SIZE) and flag_value(of_env, "--env.image_size") is None:
        of_env.append(f"--env.image_size={size}")
    is_scripted = policy.startswith("--policy.type")
    return Job(
        policy=(policy, *([] if is_scripted else of_policy)),
        env=("--env.type=bomb", *of_env, *([f"--env.split={split}"] if split else [])),
        seed=args.seed,
        num_episodes=args.episodes,
        batch_size=largest_divisor(args.episodes, batch_size),
    )


def _run_jobs(args: argparse.Namespace, folder: Path, jobs: dict[str, Job]) -> dict[str, list[Record]]:
    """Run the jobs; return {group: its records}.

    Raises:
        ValueError: the folder is of another audit.
        RuntimeError: a run failed.
    """
    with claimed(folder, Manifest(tuple(jobs.values()))) as store:
        run_part(store, "0/1", args.workers)
        store.merge()
    missing = [name for name, job in jobs.items() if not store.is_finished(job) or store.errors(job)]
    if missing:
        raise RuntimeError("\n".join([f"no records of: {', '.join(missing)}", *store.lines()]))
    return {name: read_results(store.file(job, "jsonl")) for name, job in jobs.items()}
