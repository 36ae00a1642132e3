"""``lerobot-bomb view``: an episode as a recording for Rerun and a video, or recorded ones as a sheet."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from lerobot_bomb.checkpoints.names import CONFIG
from lerobot_bomb.checkpoints.training import trained_image_size
from lerobot_bomb.commands.arguments import (
    add_checkpoint_arguments,
    add_env_flag,
    add_episode_arguments,
    add_episode_files_argument,
    parse_numbers,
    path_flag,
    switch,
)
from lerobot_bomb.commands.view_dataset import NUM_EPISODES, view_dataset
from lerobot_bomb.environments import BOMB, ENVIRONMENTS
from lerobot_bomb.envs.rollout import Agent, expert_agent, one_of_batch, random_agent
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import one_of
from lerobot_bomb.viewing.episode import (
    EXPERT,
    RANDOM,
    Viewed,
    ViewedRun,
    check_new,
    paths_of,
    write_episodes,
)

DEFAULT_FOLDER = Path("outputs/view")
SHARED_FLAGS = ("perturbations", "image_size")  # by all environments that are shown


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("--policy", help=f"who acts: {EXPERT} or {RANDOM} (default: {EXPERT}, if the environment has one)")
    add_checkpoint_arguments(parser, "who acts: the checkpoint in this folder")
    add("--seed", type=int, default=0, help="seed of the episode (default: 0)")
    add_viewed_arguments(parser)
    add_episode_files_argument(parser, DEFAULT_FOLDER)
    recorded = "show episodes of this LeRobotDataset instead: a sheet (--output=x.png) or a video (x.mp4)"
    add("--dataset", type=path_flag, metavar="ROOT", help=recorded)
    numbers = f"of --dataset: which episodes, as 0,5,7 (default: {NUM_EPISODES}, spread over all)"
    add("--episodes", type=parse_numbers, help=numbers)
    parser.set_defaults(defaults=vars(parser.parse_args([])))


def add_viewed_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags that choose an episode and its environment, except the seed."""
    env_types = f"{' or '.join(_viewed_types())} (default: {BOMB.name})"
    parser.add_argument("--env.type", dest="env_type", default=BOMB.name, help=env_types)
    ignore = "let a checkpoint act that was trained for another environment"
    add_env_flag(parser, "ignore_checkpoint", **switch(), help=ignore)
    others = {*vars(parser.parse_args([])), *SHARED_FLAGS}
    add_episode_arguments(parser)
    of_bomb = {name: value for name, value in vars(parser.parse_args([])).items() if name not in others}
    own = {name: (default, [BOMB.name]) for name, default in of_bomb.items()}
    for env_type in _viewed_types():
        for name, options in ENVIRONMENTS[env_type].view.flags.items():
            if name not in own:
                add_env_flag(parser, name, **options | {"help": f"of {env_type}: {options['help']}"})
            own.setdefault(name, (None, []))[1].append(env_type)
    parser.set_defaults(own_flags=own)  # {flag that only some have: its default, their names}


def _viewed_types() -> list[str]:
    return [name for name, each in ENVIRONMENTS.items() if each.view_at]


def run(args: argparse.Namespace) -> int:
    """Run an episode, write both files, print the instruction, the outcome and the paths."""
    if args.dataset is not None:
        return view_dataset(args, args.defaults, DEFAULT_FOLDER)
    if args.episodes is not None:
        raise ValueError(f"--episodes={','.join(map(str, args.episodes))} needs --dataset=ROOT")
    viewed = viewed_of(args)
    policy = _policy(args, viewed.policies)
    name = viewed.name(policy)
    paths = paths_of(args.output, DEFAULT_FOLDER, name)
    run = ViewedRun(viewed, partial(_agent, args, policy, viewed, paths))
    ((result, _),) = write_episodes({policy: run}, name, *paths)
    values: Any = result
    print(values.instruction, viewed.log.describe(result), *paths, sep="\n")
    return 0


def viewed_of(args: argparse.Namespace) -> Viewed:
    """Return the episode that the flags of `add_viewed_arguments` choose."""
    one_of("--env.type", args.env_type, _viewed_types())
    for name, (default, env_types) in args.own_flags.items():
        value = getattr(args, name)
        if value != default and args.env_type not in env_types:
            whose = " or ".join(env_types)
            raise ValueError(f"--env.{name}={value} is a flag of --env.type={whose} only; drop it")
    if len(args.perturbations) != 1:
        raise ValueError(
            f"--env.perturbations={','.join(args.perturbations)} must be one condition: one episode is run"
        )
    if args.image_size is None and args.policy_path is not None:
        args.image_size = trained_image_size(args.policy_path)
    viewed = ENVIRONMENTS[args.env_type].view.of_flags(vars(args) | {"perturbations": args.perturbations[0]})
    return replace(viewed, env_flags=viewed.env_flags | {"ignore_checkpoint": args.ignore_checkpoint})


def _policy(args: argparse.Namespace, policies: tuple[str, ...]) -> str:
    """Return a word for the policy that acts: one of the policies, or a checkpoint's type."""
    if args.policy_path is None:
        if args.policy_device is not None:
            raise ValueError(f"--policy.device={args.policy_device} needs a checkpoint, --policy.path=FOLDER")
        policy = args.policy or policies[0]
        if policy not in policies:
            raise ValueError(
                f"--policy={policy!r} is unknown; choose {' or '.join(policies)}, or --policy.path=FOLDER"
            )
        return policy
    if args.policy is not None:
        raise ValueError(f"--policy={args.policy} and --policy.path={args.policy_path}: give one of them")
    try:
        return str(read_json(args.policy_path / CONFIG)["type"])
    except (OSError, ValueError, KeyError):
        return "checkpoint"  # refused when it is loaded


@contextmanager
def _agent(
    args: argparse.Namespace, policy: str, viewed: Viewed, paths: list[Path], env: gymnasium.Env
) -> Iterator[Agent]:
    """Yield the agent that acts; after all other errors, refuse files that exist."""
    seed = viewed.spec.seed
    if policy in (EXPERT, RANDOM):
        check_new(paths)
        yield expert_agent() if policy == EXPERT else random_agent(env, seed)
        return
    from lerobot_bomb.viewing.checkpoint import load_policy  # LeRobot and torch: seconds

    loaded = load_policy(args.policy_path, args.policy_device, viewed.env_type, viewed.env_flags, seed)
    with one_of_batch(loaded.agent, viewed.make_env, seed, row=0, size=1) as agent:
        check_new(paths)
        yield agent
