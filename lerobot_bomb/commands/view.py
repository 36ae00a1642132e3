"""``lerobot-bomb view``: one episode as a recording for Rerun's viewer and as a video."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE, RenderOptions
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.checkpoints.names import CONFIG
from lerobot_bomb.commands.arguments import (
    add_episode_arguments,
    checkpoint_flag,
    path_flag,
    switch,
)
from lerobot_bomb.envs.rollout import Agent, expert_agent, make_env, make_pusht_env, play, random_agent
from lerobot_bomb.files import read_json, written_whole
from lerobot_bomb.flags import flags_without_group, one_of
from lerobot_bomb.pusht.episode import (
    FPS,
    IMAGE_SIZE,
    INSTRUCTIONS,
    MAX_STEPS,
    PushTSpec,
    check_image_size,
    check_installed,
)
from lerobot_bomb.pusht.perturbations import PushTCondition

if TYPE_CHECKING:
    from lerobot_bomb.viewing.rerun_file import RerunFile

EXPERT, RANDOM = "expert", "random"
DEFAULT_FOLDER = Path("outputs/view")
SUFFIXES = (".rrd", ".mp4")
PUSHT_FLAGS = {"instruction": None, "max_steps": None}  # and what they are unless given


@dataclass(frozen=True)
class Viewed:
    """An episode of one environment, and how it is played and shown."""

    spec: EpisodeSpec | PushTSpec
    group: str  # "place.camera-3"
    fps: int
    policies: tuple[str, ...]  # who can act without a checkpoint; the first does unless another is named
    env_flags: dict[str, Any]  # of LeRobot's config, for a checkpoint
    make_env: Callable[[], gymnasium.Env]
    recording: Callable[[Path, str], "RerunFile"]  # of this path and name


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb view``."""
    add = parser.add_argument
    add("--policy", help=f"who acts: {EXPERT} or {RANDOM} (default: {EXPERT}; bomb_pusht has {RANDOM} only)")
    add(
        "--policy.path",
        dest="policy_path",
        type=checkpoint_flag,
        help="who acts: the checkpoint in this folder",
    )
    add("--policy.device", dest="policy_device", help="cpu, cuda, ... (default: as the checkpoint says)")
    add(
        "--policy.ignore_environment",
        "--ignore_checkpoint",
        dest="ignore_environment",
        **switch(),
        help="let a checkpoint act that was trained for another environment",
    )
    add("--seed", type=int, default=0, help="seed of the episode (default: 0)")
    env_types = " or ".join(VIEWED)
    add("--env.type", dest="env_type", default="bomb", help=f"{env_types} (default: bomb)")
    others = vars(parser.parse_args([]))
    add_episode_arguments(parser)
    shared = ("image_size", "perturbations")
    of_bomb = {
        name: value
        for name, value in vars(parser.parse_args([])).items()
        if name not in others and name not in shared
    }
    add(
        "--instruction",
        help=f"of bomb_pusht, which takes --perturbations and --image_size (default: {IMAGE_SIZE}) of the "
        f"flags above: {' or '.join(INSTRUCTIONS)} (default: {INSTRUCTIONS[0]})",
    )
    add("--max_steps", type=int, help=f"of bomb_pusht: control steps (default: {MAX_STEPS})")
    parser.set_defaults(image_size=None, own_flags={"bomb": of_bomb, "bomb_pusht": PUSHT_FLAGS})
    add(
        "--output",
        type=path_flag,
        help="the files' path without .rrd and .mp4, or a folder that exists (default: in "
        f"{DEFAULT_FOLDER}, named after episode and policy)",
    )


def run_view(args: argparse.Namespace) -> int:
    """Play, write both files, print the instruction, the outcome and the paths."""
    one_of("--env.type", args.env_type, VIEWED)
    _refuse_flags_of_others(args)
    with flags_without_group():
        viewed = VIEWED[args.env_type](args)
    policy = _policy(args, viewed.policies)
    paths = _output_paths(args.output, _name(viewed, policy))
    with flags_without_group():
        env = viewed.make_env()
    try:
        with flags_without_group():
            agent = _agent(args, policy, env, viewed)
        outcome = write_episode(env, viewed, agent, policy, *paths)
    finally:
        env.close()
    print(env.get_wrapper_attr("task_description"), outcome, *paths, sep="\n")
    return 0


def write_episode(env: gymnasium.Env, viewed: Viewed, agent: Agent, policy: str, rrd: Path, mp4: Path) -> str:
    """Play an episode in an `env` of its spec, write what happened, return a line of what became of it."""
    from lerobot_bomb.viewing.video import VideoFile

    with (
        written_whole(rrd, mp4) as (unfinished_rrd, unfinished_mp4),
        viewed.recording(unfinished_rrd, _name(viewed, policy)) as recording,
        VideoFile(unfinished_mp4, viewed.fps) as video,
    ):
        for moment in play(env, viewed.spec, agent):
            recording.add(moment)
            video.add(cast("np.ndarray", env.render()))
        result = env.get_wrapper_attr("episode_result")()
        recording.add_result(result)
    return recording.describe(result)


def _refuse_flags_of_others(args: argparse.Namespace) -> None:
    for env_type, defaults in args.own_flags.items():
        for name, default in defaults.items():
            value = getattr(args, name)
            if env_type != args.env_type and value != default:
                raise ValueError(f"--{name}={value} is a flag of --env.type={env_type} only; drop it")


def _policy(args: argparse.Namespace, policies: tuple[str, ...]) -> str:
    """Who acts, as a word for names: one of the policies, or a checkpoint's type."""
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


def bomb_episode(spec: EpisodeSpec, options: RenderOptions) -> Viewed:
    """An episode of `bomb`."""
    env_flags = {
        "task": spec.suite,
        "robot": spec.robot,
        "control_mode": spec.control_mode,
        "fps": spec.fps,
        "image_size": options.image_size,
        "depth": options.depth,
    }
    return Viewed(
        spec=spec,
        group=f"{spec.suite}.{Condition.parse(spec.perturbations).key}",
        fps=spec.fps,
        policies=(EXPERT, RANDOM),
        env_flags=env_flags,
        make_env=lambda: make_env(spec, options),
        recording=partial(_bomb_recording, spec),
    )


def _bomb(args: argparse.Namespace) -> Viewed:
    if len(args.task_ids) > 1:
        raise ValueError(f"--task_ids={list(args.task_ids)} must be one task: one episode is played")
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


def _bomb_recording(spec: EpisodeSpec, path: Path, name: str) -> "RerunFile":
    from lerobot_bomb.viewing.rerun_bomb import BombRerunFile

    return BombRerunFile(path, spec, name)


def _pusht(args: argparse.Namespace) -> Viewed:
    check_installed()
    spec = PushTSpec(
        seed=args.seed,
        instruction=INSTRUCTIONS[0] if args.instruction is None else args.instruction,
        max_steps=MAX_STEPS if args.max_steps is None else args.max_steps,
        perturbations=_condition(args),
    )
    image_size = IMAGE_SIZE if args.image_size is None else args.image_size
    check_image_size(image_size)
    return Viewed(
        spec=spec,
        group=f"pusht.{PushTCondition.parse(spec.perturbations).key}",
        fps=FPS,
        policies=(RANDOM,),
        env_flags={"image_size": image_size, "instruction": spec.instruction, "max_steps": spec.max_steps},
        make_env=lambda: make_pusht_env(spec, image_size),
        recording=_pusht_recording,
    )


def _pusht_recording(path: Path, name: str) -> "RerunFile":
    from lerobot_bomb.viewing.rerun_pusht import PushTRerunFile

    return PushTRerunFile(path, name)


VIEWED = {"bomb": _bomb, "bomb_pusht": _pusht}  # by --env.type


def _condition(args: argparse.Namespace) -> str:
    if len(args.perturbations) != 1:
        raise ValueError(
            f"--perturbations={','.join(args.perturbations)} must be one condition: one episode is played"
        )
    return args.perturbations[0]


def _agent(args: argparse.Namespace, policy: str, env: gymnasium.Env, viewed: Viewed) -> Agent:
    if policy == EXPERT:
        return expert_agent()
    if policy == RANDOM:
        return random_agent(env, viewed.spec.seed)
    from lerobot_bomb.viewing.checkpoint import checkpoint_agent  # LeRobot and torch: seconds

    flags = viewed.env_flags | {"ignore_checkpoint": args.ignore_environment}
    return checkpoint_agent(args.policy_path, args.policy_device, args.env_type, flags, viewed.spec.seed)


def _name(viewed: Viewed, policy: str) -> str:
    """Name of an episode and of its files: "place.camera-3_expert_seed0"."""
    return f"{viewed.group}_{policy}_seed{viewed.spec.seed}"


def _output_paths(output: Path | None, name: str) -> list[Path]:
    """The two files, neither of which exists."""
    stem = output or DEFAULT_FOLDER / name
    if stem.is_dir():
        stem = stem / name
    if stem.suffix in SUFFIXES:
        stem = stem.with_suffix("")
    paths = [Path(f"{stem}{suffix}") for suffix in SUFFIXES]
    for path in paths:
        if path.exists():
            raise ValueError(f"{path} exists already; name other files with --output=PATH, or delete it")
    return paths
