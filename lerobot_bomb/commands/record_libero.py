"""Flags of ``lerobot-bomb record --env.type=bomb_libero``."""

import argparse
from dataclasses import fields

from lerobot_bomb.data.libero_recording import IMAGE_SIZE, LiberoRecording
from lerobot_bomb.libero.episode import RENDER_PRESETS
from lerobot_bomb.libero.goals import check_goals
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.libero import LiberoResult

BOMB, BOMB_LIBERO = EpisodeResult.env_type, LiberoResult.env_type
RECORDING_FLAGS = {each.name for each in fields(LiberoRecording)} - {"env_type"}
# arguments that bomb alone has
BOMB_ONLY = (
    "static", "relabel", "policy_path", "pointing", "robot", "control_mode", "fps", "image_size",
    "depth", "split", "target", "color", "success_tolerance_mm",
)  # fmt: skip
# arguments -> flags that are not --NAME
FLAG_OF = {"policy_path": "policy.path", "env_type": "env.type"}
FLAG_OF |= {name: f"env.{name}" for name in IMAGE_SIZE}


def add_env_type_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the environment, and what bomb_libero alone has."""
    parser.add_argument(
        "--env.type",
        dest="env_type",
        choices=(BOMB, BOMB_LIBERO),
        default=BOMB,
        help="environment (default: bomb); bomb_libero takes --env.task (default: libero_spatial), "
        "--env.task_ids (default: all), --env.perturbations, the size of its images and "
        f"--env.render_preset ({', '.join(RENDER_PRESETS)}; default: {LiberoRecording.render_preset})",
    )
    for name in IMAGE_SIZE:
        default = getattr(LiberoRecording, name)
        help = f"of bomb_libero's images, in pixels (default: {default})"
        parser.add_argument(f"--env.{name}", dest=name, type=int, help=help)
    parser.set_defaults(default_of=parser.get_default)  # tells which arguments were given


def libero_recording(args: argparse.Namespace) -> LiberoRecording:
    """Return the recording that flags ask for.

    Raises:
        ValueError: a flag is not of bomb_libero or wrong, or LIBERO or its assets are missing.
    """
    for name in BOMB_ONLY:
        if getattr(args, name) != args.default_of(name):
            flag = FLAG_OF.get(name, name)
            raise ValueError(f"--{flag} is of --env.type={BOMB}; leave it out with --env.type={BOMB_LIBERO}")
    given = {name: value for name, value in vars(args).items() if name in RECORDING_FLAGS}
    own_defaults = (*IMAGE_SIZE, "render_preset", "task")
    left_out = {name for name in own_defaults if given[name] == args.default_of(name)}
    recording = LiberoRecording(**{name: value for name, value in given.items() if name not in left_out})
    check_goals(recording.conditions)
    return recording


def refuse_libero_flags(args: argparse.Namespace) -> None:
    """Raise a ValueError for a flag that bomb does not have."""
    for name in IMAGE_SIZE:
        if (value := getattr(args, name)) is not None:
            raise ValueError(f"--env.{name}={value} is of --env.type={BOMB_LIBERO}; leave it out")
