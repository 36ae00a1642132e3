"""``lerobot-bomb view``: one episode as a recording for Rerun's viewer and as a video."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE, RenderOptions
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.checkpoints.names import CONFIG
from lerobot_bomb.checkpoints.training import trained_image_size
from lerobot_bomb.commands.arguments import (
    add_checkpoint_arguments,
    add_env_flag,
    add_episode_arguments,
    add_episode_files_argument,
    switch,
)
from lerobot_bomb.envs.rollout import Agent, expert_agent, one_of_batch, random_agent
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import one_of
from lerobot_bomb.pusht.episode import IMAGE_SIZE, INSTRUCTIONS, MAX_STEPS, PushTSpec
from lerobot_bomb.viewing.episode import (
    EXPERT,
    RANDOM,
    Player,
    Viewed,
    bomb_episode,
    check_new,
    paths_of,
    pusht_episode,
    write_episodes,
)

DEFAULT_FOLDER = Path("outputs/view")
PUSHT_FLAGS = {"instruction": None, "max_steps": None}  # and what they are unless given


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("--policy", help=f"who acts: {EXPERT} or {RANDOM} (default: {EXPERT}; bomb_pusht has {RANDOM} only)")
    add_checkpoint_arguments(parser, "who acts: the checkpoint in this folder")
    ignore = "let a checkpoint act that was trained for another environment"
    add_env_flag(parser, "ignore_checkpoint", **switch(), help=ignore)
    add("--seed", type=int, default=0, help="seed of the episode (default: 0)")
    add_viewed_arguments(parser)
    add_episode_files_argument(parser, DEFAULT_FOLDER)


def add_viewed_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare which episode of which environment is looked at, beside its seed."""
    env_types = f"{' or '.join(VIEWED)} (default: bomb)"
    parser.add_argument("--env.type", dest="env_type", default="bomb", help=env_types)
    others = vars(parser.parse_args([]))
    add_episode_arguments(parser)
    shared = ("image_size", "perturbations")
    of_bomb = {
        name: value
        for name, value in vars(parser.parse_args([])).items()
        if name not in others and name not in shared
    }
    add_env_flag(
        parser,
        "instruction",
        help="of bomb_pusht, which takes --env.perturbations and --env.image_size (default: "
        f"{IMAGE_SIZE}) of the flags above: {' or '.join(INSTRUCTIONS)} (default: {INSTRUCTIONS[0]})",
    )
    max_steps = f"of bomb_pusht: control steps (default: {MAX_STEPS})"
    add_env_flag(parser, "max_steps", type=int, help=max_steps)
    parser.set_defaults(own_flags={"bomb": of_bomb, "bomb_pusht": PUSHT_FLAGS})


def run(args: argparse.Namespace) -> int:
    """Run an episode, write both files, print the instruction, the outcome and the paths."""
    viewed = viewed_of(args)
    policy = _policy(args, viewed.policies)
    name = viewed.name(policy)
    paths = paths_of(args.output, DEFAULT_FOLDER, name)
    player = Player(viewed, partial(_agent, args, policy, viewed, paths))
    (result,) = write_episodes({policy: player}, name, *paths)
    values: Any = result
    print(values.instruction, viewed.log().describe(result), *paths, sep="\n")
    return 0


def viewed_of(args: argparse.Namespace) -> Viewed:
    """The episode that `add_viewed_arguments` lets a user name."""
    one_of("--env.type", args.env_type, VIEWED)
    _refuse_flags_of_others(args)
    if args.image_size is None and args.policy_path is not None:
        args.image_size = trained_image_size(args.policy_path)
    return VIEWED[args.env_type](args)


def _refuse_flags_of_others(args: argparse.Namespace) -> None:
    for env_type, defaults in args.own_flags.items():
        for name, default in defaults.items():
            value = getattr(args, name)
            if env_type != args.env_type and value != default:
                raise ValueError(f"--env.{name}={value} is a flag of --env.type={env_type} only; drop it")


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


def _bomb(args: argparse.Namespace) -> Viewed:
    if len(args.task_ids) > 1:
        raise ValueError(f"--env.task_ids={list(args.task_ids)} must be one task: one episode is played")
    spec = EpisodeSpec(
        seed=args.seed,
        suite=args.task,
        robot=args.robot,
        split=args.split,
        control_mode=args.control_mode,
        fps=args.fps,
        target=args.target,
        color=args.color,
        success_tolerance_mm=args.success_tolerance_mm,
        perturbations=_condition(args),
    )
    image_size = DEFAULT_IMAGE_SIZE if args.image_size is None else args.image_size
    options = RenderOptions(image_size, args.render_preset, args.depth)
    return bomb_episode(specs_of_tasks(spec, args.task_ids)[0], options)


def _pusht(args: argparse.Namespace) -> Viewed:
    spec = PushTSpec(
        seed=args.seed,
        instruction=INSTRUCTIONS[0] if args.instruction is None else args.instruction,
        max_steps=MAX_STEPS if args.max_steps is None else args.max_steps,
        perturbations=_condition(args),
    )
    return pusht_episode(spec, IMAGE_SIZE if args.image_size is None else args.image_size)


VIEWED = {"bomb": _bomb, "bomb_pusht": _pusht}  # by --env.type


def _condition(args: argparse.Namespace) -> str:
    if len(args.perturbations) != 1:
        raise ValueError(
            f"--env.perturbations={','.join(args.perturbations)} must be one condition: one episode is played"
        )
    return args.perturbations[0]


@contextmanager
def _agent(
    args: argparse.Namespace, policy: str, viewed: Viewed, paths: list[Path], env: gymnasium.Env
) -> Iterator[Agent]:
    """Yield the agent that acts; other errors are told before that of files that exist."""
    with _accepted_agent(args, policy, viewed, env) as agent:
        check_new(paths)
        yield agent


@contextmanager
def _accepted_agent(
    args: argparse.Namespace, policy: str, viewed: Viewed, env: gymnasium.Env
) -> Iterator[Agent]:
    if policy in (EXPERT, RANDOM):
        yield expert_agent() if policy == EXPERT else random_agent(env, viewed.spec.seed)
        return
    from lerobot_bomb.viewing.checkpoint import load_policy  # LeRobot and torch: seconds

    flags = viewed.env_flags | {"ignore_checkpoint": args.ignore_checkpoint}
    seed = viewed.spec.seed
    loaded = load_policy(args.policy_path, args.policy_device, args.env_type, flags, seed)
    with one_of_batch(loaded.agent, viewed.make_env, seed, row=0, size=1) as agent:
        yield agent
