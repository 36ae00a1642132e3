"""``lerobot-bomb view``: one episode as a recording for Rerun's viewer and as a video."""

import argparse
from pathlib import Path
from typing import cast

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.arguments import (
    add_episode_arguments,
    checkpoint_flag,
    path_flag,
    switch,
)
from lerobot_bomb.envs.results import EpisodeResult
from lerobot_bomb.envs.rollout import Agent, expert_agent, make_env, play, random_agent
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import flags_without_group

POLICIES = ("expert", "random")
DEFAULT_FOLDER = Path("outputs/view")
SUFFIXES = (".rrd", ".mp4")


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb view``."""
    add = parser.add_argument
    add("--policy", help=f"who acts: {' or '.join(POLICIES)} (default: expert)")
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
    add_episode_arguments(parser)
    add(
        "--output",
        type=path_flag,
        help="the files' path without .rrd and .mp4, or a folder that exists (default: in "
        f"{DEFAULT_FOLDER}, named after episode and policy)",
    )


def run_view(args: argparse.Namespace) -> int:
    """Play, write both files, print the instruction, the outcome and the paths."""
    policy = _policy(args)
    with flags_without_group():
        spec = _spec(args)
        options = RenderOptions(args.image_size, args.render_preset, args.depth)
        paths = _output_paths(args.output, _name(spec, policy))
        env = make_env(spec, options)
    try:
        with flags_without_group():
            agent = _agent(args, policy, env, spec, options)
        result = write_episode(env, spec, agent, policy, *paths)
    finally:
        env.close()
    from lerobot_bomb.viewing.rerun_file import describe_result

    print(result.instruction, describe_result(result), *paths, sep="\n")
    return 0


def write_episode(
    env: gymnasium.Env, spec: EpisodeSpec, agent: Agent, name: str, rrd: Path, mp4: Path
) -> EpisodeResult:
    """Play a spec's episode in an `env` of that spec and write what happened; `name` says who acted."""
    from lerobot_bomb.viewing.rerun_file import RerunFile
    from lerobot_bomb.viewing.video import VideoFile

    with (
        written_whole(rrd, mp4) as (unfinished_rrd, unfinished_mp4),
        RerunFile(unfinished_rrd, spec, _name(spec, name)) as recording,
        VideoFile(unfinished_mp4, spec.fps) as video,
    ):
        for moment in play(env, spec, agent):
            recording.add(moment)
            video.add(cast("np.ndarray", env.render()))
        result = env.get_wrapper_attr("episode_result")()
        recording.add_result(result)
    return result


def _policy(args: argparse.Namespace) -> str:
    """Who acts, as a word for names: expert, random or checkpoint."""
    if args.policy_path is None:
        if args.policy_device is not None:
            raise ValueError(f"--policy.device={args.policy_device} needs a checkpoint, --policy.path=FOLDER")
        policy = args.policy or POLICIES[0]
        if policy not in POLICIES:
            raise ValueError(
                f"--policy={policy!r} is unknown; choose {' or '.join(POLICIES)}, or --policy.path=FOLDER"
            )
        return policy
    if args.policy is not None:
        raise ValueError(f"--policy={args.policy} and --policy.path={args.policy_path}: give one of them")
    return "checkpoint"


def _spec(args: argparse.Namespace) -> EpisodeSpec:
    if len(args.perturbations) != 1:
        raise ValueError(
            f"--perturbations={','.join(args.perturbations)} must be one condition: one episode is played"
        )
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
        perturbations=args.perturbations[0],
    )
    return spec.for_tasks(args.task_ids)[0]


def _agent(
    args: argparse.Namespace, policy: str, env: gymnasium.Env, spec: EpisodeSpec, options: RenderOptions
) -> Agent:
    if policy == "expert":
        return expert_agent()
    if policy == "random":
        return random_agent(env, spec)
    from lerobot_bomb.viewing.checkpoint import checkpoint_agent  # LeRobot and torch: seconds

    return checkpoint_agent(args.policy_path, args.policy_device, spec, options, args.ignore_environment)


def _name(spec: EpisodeSpec, policy: str) -> str:
    """Name of an episode and of its files: "place.camera-3_expert_seed0"."""
    return f"{spec.suite}.{Condition.parse(spec.perturbations).key}_{policy}_seed{spec.seed}"


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
