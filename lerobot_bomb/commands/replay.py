"""``lerobot-bomb replay``: an episode of a results file once more, as it was or with other perturbations."""

import argparse
from pathlib import Path
from typing import Any, cast

from lerobot_bomb.commands.arguments import (
    ANSWER_IS_NO,
    add_checkpoint_arguments,
    add_env_flag,
    add_episode_files_argument,
    path_flag,
    switch,
)
from lerobot_bomb.commands.results_files import read_record
from lerobot_bomb.conditions import NONE
from lerobot_bomb.results.record import ORIGIN, Record, different_fields, outcome_fields
from lerobot_bomb.tables import print_lines
from lerobot_bomb.viewing.episode import check_new, paths_of, write_episodes
from lerobot_bomb.viewing.replay import Replay

DEFAULT_FOLDER = Path("outputs/replay")
RECORDED, CHANGED = "recorded", "changed"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.usage = "lerobot-bomb replay FILE [--line=N] [--set=AXIS=LEVEL,...] (and flags --policy.NAME)"
    add = parser.add_argument
    add("path", type=path_flag, metavar="FILE", help="file of --env.results_path")
    add("--line", type=int, default=1, help="line of the record, from 1 on (default: 1)")
    add(
        "--set",
        type=_levels,
        metavar="AXIS=LEVEL,...",
        help="run it a second time, with these axes changed: camera=0,light=3, or camera:0,light:3",
    )
    add_checkpoint_arguments(parser, "the checkpoint's folder, if it has moved")
    add_env_flag(parser, "depth", **switch(), help="the evaluation had --env.depth")
    add_episode_files_argument(parser, DEFAULT_FOLDER)
    add("rest", nargs="*", metavar="FLAG", help="flags of the policy in that evaluation: --policy.NAME=VALUE")


def _levels(text: str) -> dict[str, int]:
    parts = [part.replace(":", "=").partition("=") for part in text.split(",")]
    if not all(name and level.isdigit() for name, _, level in parts):
        raise argparse.ArgumentTypeError(
            f"{text!r} must be AXIS=LEVEL or AXIS:LEVEL, several joined by commas"
        )
    return {name: int(level) for name, _, level in parts}


def run(args: argparse.Namespace) -> int:
    """Run the episode, write both files, print its result and whether it equals the record."""
    if unknown := [flag for flag in args.rest if not flag.startswith("--policy.")]:
        raise ValueError(f"{unknown[0]} is unknown; see `lerobot-bomb replay --help`")
    record = read_record(args.path, args.line)
    policy_flags = [f"--{flag.removeprefix('--policy.')}" for flag in args.rest]
    replay = Replay(record, args.policy_path, args.policy_device, policy_flags, args.depth)
    runs = {RECORDED: replay.viewed_run()}
    if args.set is not None:
        runs[CHANGED] = replay.viewed_run(_changed(record, args.set))
    policy = "policy" if record.policy is None else record.policy.type
    name = runs[RECORDED].viewed.name(policy)
    name += f"_{runs[CHANGED].viewed.group}" if args.set is not None else ""
    paths = paths_of(args.output, DEFAULT_FOLDER, name)
    check_new(paths)
    results = [result for result, _ in write_episodes(runs, name, *paths)]
    for (label, run), result in zip(runs.items(), results, strict=True):
        viewed, values = run.viewed, cast("Any", result)
        print_lines(f"{label} ({viewed.spec.perturbations}): {values.instruction}")
        print(viewed.log.describe(result))
    print(*paths, sep="\n")
    return _compare(record, results[0])


def _changed(record: Record, levels: dict[str, int]) -> str:
    """Return the condition of an episode with other levels; other drawn levels stay as they were."""
    merged = record.levels | levels
    text = "+".join(f"{axis}:{level}" for axis, level in merged.items()) or NONE
    try:
        return record.condition(text)
    except ValueError as error:
        raise ValueError(str(error).replace(f"--env.perturbations={text!r}", "--set", 1)) from None


def _compare(record: Record, result: Record) -> int:
    different = different_fields(record, result)
    if not different:
        print(f"as recorded, bit for bit: {', '.join(outcome_fields(record))}")
        return 0
    first, then, now = different[0], record.as_json(), result.as_json()
    print(f"not as recorded: {first} was {then[first]!r} and is {now.get(first)!r}")
    origins = [
        name for name in then if name in ORIGIN - {"policy", "task_ids"} and then[name] != now.get(name)
    ]
    if origins:
        print_lines(*(f"  {name}: {then[name]} then, {now.get(name)} now" for name in origins))
    return ANSWER_IS_NO
