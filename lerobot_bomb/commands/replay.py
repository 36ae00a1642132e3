"""``lerobot-bomb replay``: an episode of a results file once more, as it was or with other perturbations."""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.commands.arguments import (
    ANSWER_IS_NO,
    add_checkpoint_arguments,
    add_episode_files_argument,
    path_flag,
    switch,
)
from lerobot_bomb.commands.results_files import read_undamaged
from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import ORIGIN, PolicyIdentity, ResultLine, Row
from lerobot_bomb.envs.rollout import Agent, BatchAgent, one_of_batch
from lerobot_bomb.evaluation.bomb_lines import spec_of
from lerobot_bomb.evaluation.result_groups import different_fields, outcome
from lerobot_bomb.evaluation.result_lines import kind_of
from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_bomb.viewing.episode import (
    Player,
    Viewed,
    bomb_episode,
    new_paths,
    pusht_episode,
    write_episodes,
)

DEFAULT_FOLDER = Path("outputs/replay")
RECORDED, CHANGED = "recorded", "changed"


def add_replay_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb replay``."""
    parser.usage = "lerobot-bomb replay FILE [--line=N] [--set=AXIS=LEVEL,...] (and flags --policy.NAME)"
    add = parser.add_argument
    add("path", type=path_flag, metavar="FILE", help="file of --env.results_path")
    add("--line", type=int, default=1, help="the episode's line, from 1 on (default: 1)")
    add(
        "--set",
        type=_levels,
        metavar="AXIS=LEVEL,...",
        help="play it a second time, with these axes changed: camera=0,light=3",
    )
    add_checkpoint_arguments(parser, "the checkpoint's folder, where it lies elsewhere now")
    add("--depth", **switch(), help="the policy was shown depth")
    add_episode_files_argument(parser, DEFAULT_FOLDER)
    add("rest", nargs="*", metavar="FLAG", help="flags of the policy in that evaluation: --policy.NAME=VALUE")


def _levels(text: str) -> dict[str, int]:
    parts = [part.partition("=") for part in text.split(",")]
    if not all(name and level.isdigit() for name, _, level in parts):
        raise argparse.ArgumentTypeError(f"{text!r} must be AXIS=LEVEL, several joined by commas")
    return {name: int(level) for name, _, level in parts}


def run_replay(args: argparse.Namespace) -> int:
    """Play, write both files, print what became of it and whether it is what the line says."""
    if unknown := [flag for flag in args.rest if not flag.startswith("--policy.")]:
        raise ValueError(f"{unknown[0]} is unknown; see `lerobot-bomb replay --help`")
    rows, _ = read_undamaged(args.path)
    if not 1 <= args.line <= len(rows):
        raise ValueError(f"--line={args.line} must be in 1..{len(rows)}, the episodes of {args.path}")
    row = rows[args.line - 1]
    viewed = {RECORDED: _viewed(row, row["spec"]["perturbations"], args.depth)}
    if args.set is not None:
        viewed[CHANGED] = _viewed(row, _changed(row, args.set), args.depth)
    policy = row["policy"]["type"] if row.get("policy") else "policy"
    name = viewed[RECORDED].name(policy) + (f"_{viewed[CHANGED].group}" if args.set is not None else "")
    paths = new_paths(args.output, DEFAULT_FOLDER, name)
    players = {label: Player(of, partial(_agent, args, row, of)) for label, of in viewed.items()}
    results = write_episodes(players, name, *paths)
    for (label, of), result in zip(viewed.items(), results, strict=True):
        values: Any = result
        print(f"{label} ({of.spec.perturbations}): {values.instruction}", of.log().describe(result), sep="\n")
    print(*paths, sep="\n")
    return _compare(row, results[0])


def _viewed(row: Row, perturbations: str, depth: bool) -> Viewed:
    match kind_of(row).env_type:
        case "bomb":
            options = RenderOptions(row["image_size"], row.get("render_preset", RenderOptions.preset), depth)
            return bomb_episode(replace(spec_of(row), perturbations=perturbations), options)
        case "bomb_pusht":
            spec = PushTSpec(**row["spec"] | {"perturbations": perturbations})
            return pusht_episode(spec, row["image_size"])
        case env_type:
            flags = " ".join(kind_of(row).eval_flags([row]))
            raise ValueError(
                f"--env.type={env_type} has no recording for Rerun; lerobot-eval plays the episode: {flags} "
                f"--seed={row['spec']['seed']} --eval.n_episodes=1 --eval.batch_size=1"
            )


def _changed(row: Row, levels: dict[str, int]) -> str:
    """The condition of an episode with other levels; levels that were drawn stay as they were."""
    merged = row["levels"] | levels
    text = "+".join(f"{axis}:{level}" for axis, level in merged.items()) or NONE
    try:
        return str(kind_of(row).condition.parse(text))
    except ValueError as error:
        raise ValueError(str(error).replace(f"--env.perturbations={text!r}", "--set", 1)) from None


@contextmanager
def _agent(args: argparse.Namespace, row: Row, viewed: Viewed, _: gymnasium.Env) -> Iterator[Agent]:
    policy = row.get("policy") or {}
    place = {"row": policy.get("batch_row") or 0, "size": policy.get("batch_size") or 1}
    batch_agent = _batch_agent(args, row, viewed)
    with one_of_batch(batch_agent, viewed.make_env, viewed.spec.seed, **place) as agent:
        yield agent


def _batch_agent(args: argparse.Namespace, row: Row, viewed: Viewed) -> BatchAgent:
    from lerobot_bomb._compat import built_policies  # LeRobot and torch: seconds
    from lerobot_bomb.checkpoints.identity import identity_of
    from lerobot_bomb.viewing.checkpoint import checkpoint_agent, scripted_agent

    env = viewed.env_type, viewed.env_flags, viewed.spec.seed
    policy = row.get("policy") or {}
    path = args.policy_path or (Path(policy["path"]) if policy.get("path") else None)
    if path is None and policy:
        return scripted_agent(policy["type"], *env)
    if path is None:
        raise ValueError(f"line {args.line} does not say who played; name it with --policy.path=FOLDER")
    policy_flags = [f"--{flag.removeprefix('--policy.')}" for flag in args.rest]
    agent = checkpoint_agent(path, args.policy_device, *env, policy_flags)
    if viewed.spec.perturbations == row["spec"]["perturbations"]:
        _check_policy(policy, path, identity_of(built_policies()[-1]))
    return agent


def _check_policy(played: dict[str, Any], path: Path, loaded: PolicyIdentity) -> None:
    """Raise a ValueError if it is another than that which played."""
    if played.get("weights_sha256") not in (None, loaded.weights_sha256):
        raise ValueError(
            f"{path} holds other weights than those that played; name the folder that holds them with "
            "--policy.path=FOLDER, or see what these do with `lerobot-bomb view`"
        )
    if played.get("settings_sha256") not in (None, loaded.settings_sha256):
        raise ValueError(
            f"{path} holds the weights that played, but other settings; give the flags --policy.NAME=VALUE "
            "of that evaluation"
        )


def _compare(row: Row, result: ResultLine) -> int:
    now: Row = json.loads(result.to_json())
    different = different_fields(row, now)
    if not different:
        print(f"as recorded, bit for bit: {', '.join(outcome(row))}")
        return 0
    first = different[0]
    print(f"not as recorded: {first} was {row[first]!r} and is {now.get(first)!r}")
    origins = [name for name in row if name in ORIGIN - {"policy", "task_ids"} and row[name] != now.get(name)]
    if origins:
        print(*(f"  {name}: {row[name]} then, {now.get(name)} now" for name in origins), sep="\n")
    return ANSWER_IS_NO
