"""Arguments that several commands share, and how their text is read."""

import argparse
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.episode import CONTROL_MODES, DEFAULT_FPS, ROBOTS, SIMULATORS, SPLITS, EpisodeSpec
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE, RENDER_PRESETS
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.conditions import NONE

# flags of `bomb` that hold for all tasks and conditions of an evaluation
SETTINGS = (
    *("task", "robot", "simulator", "control_mode", "fps"),
    *("image_size", "render_preset", "depth", "split"),
)
# short form of a flag of the environment -> the flag as LeRobot spells it
LONG_FORMS = {
    f"--{name}": f"--env.{name}"
    for name in (
        *SETTINGS,
        *("target", "color", "task_ids", "perturbations", "success_tolerance_mm", "instruction", "max_steps"),
        "ignore_checkpoint",
    )
}
ANSWER_IS_NO = 3  # exit code of a command that answers a question with no; 1 is an error, 2 an unknown flag


def path_flag(text: str) -> Path:
    """Return the path that a flag gives, for argparse; ~ is the home folder, also in --root=~/x.

    Raises:
        argparse.ArgumentTypeError: it is empty, of an unknown user, or not UTF-8.
    """
    if not text:
        raise argparse.ArgumentTypeError("a path must not be empty")
    try:
        text.encode()
        return Path(text).expanduser()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"{text!a} is not UTF-8") from None
    except RuntimeError:
        raise argparse.ArgumentTypeError(f"{text}: this user has no home folder here") from None


def checkpoint_flag(text: str) -> Path:
    """Return the checkpoint folder of a flag, for argparse; `bomb:NAME` is one of the package's.

    Raises:
        argparse.ArgumentTypeError: no checkpoint of this name comes with the package, or it is no path.
    """
    try:
        return path_flag(checkpoint_path(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_names_flag(parser: argparse.ArgumentParser) -> None:
    """Declare the short names of policies."""
    names = "short names: a policy's type, path or bomb:NAME, and its name (default: the shortest)"
    parser.add_argument("--names", type=_names, metavar="A=NAME,B=NAME", default={}, help=names)


def _names(text: str) -> dict[str, str]:
    """Read 'A=NAME,B=NAME'.

    Raises:
        argparse.ArgumentTypeError: a part has no name, or two have the same one.
    """
    parts = [part.rpartition("=") for part in text.split(",")]
    names = {policy: name for policy, _, name in parts if policy and name}
    if len(names) < len(parts) or len(set(names.values())) < len(names):
        raise argparse.ArgumentTypeError(
            f"{text!r} must be POLICY=NAME, several joined by commas, each name once"
        )
    return names


def add_checkpoint_arguments(parser: argparse.ArgumentParser, help: str, required: bool = False) -> None:
    """Declare which checkpoint acts, and on which device."""
    add = parser.add_argument
    add("--policy.path", dest="policy_path", type=checkpoint_flag, required=required, help=help)
    add("--policy.device", dest="policy_device", help="cpu, cuda, ... (default: as the checkpoint says)")


def add_file_and_eval_flags(parser: argparse.ArgumentParser, help: str) -> None:
    """Declare ``FILE FLAG ...``: a file, and the flags of lerobot-eval, which its own parser reads."""
    parser.usage = f"{parser.prog} FILE --policy.path=... --env.type=... (all flags of lerobot-eval)"
    parser.add_argument("path", type=path_flag, metavar="FILE", help=help)
    flags = "flags of lerobot-eval"
    rest = parser.add_argument("flags", nargs=argparse.REMAINDER, metavar="FLAG", help=flags)
    rest.required = False  # without FILE, argparse would ask for both


def add_episode_files_argument(parser: argparse.ArgumentParser, folder: Path) -> None:
    """Declare where an episode's recording and video are written."""
    parser.add_argument(
        "--output",
        type=path_flag,
        help="the files' path without .rrd and .mp4, or a folder that exists (default: in "
        f"{folder}, named after episode and policy)",
    )


def check_at_least(args: argparse.Namespace, **lowest: int) -> None:
    """Raise a ValueError if a flag is below its lowest value: `episodes=1`."""
    for name, bound in lowest.items():
        if getattr(args, name) < bound:
            raise ValueError(f"--{name}={getattr(args, name)} must be at least {bound}")


def switch() -> dict[str, Any]:
    """Arguments of a flag that works alone and as LeRobot writes it: --resume, --resume=true."""
    return {"nargs": "?", "const": True, "default": False, "type": _parse_bool}


def _parse_bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{text!r} must be true or false")
    return text.lower() == "true"


def parse_numbers(text: str) -> tuple[int, ...]:
    """Read a list of whole numbers: (0, 7) from "[0,7]", as LeRobot writes lists, and from "0,7"."""
    if not re.fullmatch(r"\d+(,\d+)*|\[\d+(,\d+)*\]", text.replace(" ", "")):
        raise argparse.ArgumentTypeError(f"{text!r} must be a list of whole numbers, as [0,7]")
    return tuple(int(number) for number in re.findall(r"\d+", text))


def parse_conditions(text: str) -> tuple[str, ...]:
    """Read a list of conditions: ("none", "all:1-5") from '["none","all:1-5"]' and from "none,all:1-5"."""
    return tuple(part.strip().strip("\"'") for part in text.strip().strip("[]").split(",") if part.strip())


def add_dataset_arguments(parser: argparse.ArgumentParser, about: str = "") -> None:
    """Declare which dataset is read."""
    add = parser.add_argument
    add("--dataset.repo_id", dest="repo_id", required=True, help=f"name of the dataset{about}")
    root = "folder of the dataset (default: $HF_LEROBOT_HOME/REPO_ID)"
    add("--dataset.root", dest="root", type=path_flag, help=root)


def add_new_dataset_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare name and folder of a new dataset."""
    parser.add_argument("--repo_id", required=True, help="name of the dataset on the Hub, USER/NAME")
    root = "new folder of the dataset (default: $HF_LEROBOT_HOME/REPO_ID)"
    parser.add_argument("--root", type=path_flag, help=root)


def add_env_flag(parser: argparse.ArgumentParser, name: str, *others: str, **options: Any) -> None:
    """Declare a flag of an environment as LeRobot spells it, --env.NAME, and its short form, if any."""
    short = [f"--{name}"] if f"--{name}" in LONG_FORMS else []
    parser.add_argument(f"--env.{name}", *short, *others, dest=name, **options)


def long_forms(flags: Sequence[str]) -> list[str]:
    """Return flags of lerobot-eval as it spells them: --env.image_size=64 for --image_size=64."""
    words = [flag.partition("=") for flag in flags]
    return [f"{LONG_FORMS.get(name, name)}{sign}{value}" for name, sign, value in words]


def add_episode_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of --env.type=bomb, except the seed, for a command that runs episodes."""
    add = partial(add_env_flag, parser)
    lines = f"0..{BOARD.num_lines - 1}"
    tolerance = EpisodeSpec.success_tolerance_mm
    add("task", default="place", help=f"suite: {', '.join(SUITES)} (default: place)")
    add("robot", default="scara", help=f"{', '.join(ROBOTS)} (default: scara)")
    add("simulator", default="mujoco", help=f"of the physics: {' or '.join(SIMULATORS)} (default: mujoco)")
    add("control_mode", default="relative", help=f"{' or '.join(CONTROL_MODES)} (default: relative)")
    add("fps", type=int, default=DEFAULT_FPS, help=f"control steps a second (default: {DEFAULT_FPS})")
    add(
        "image_size",
        type=int,
        help=f"pixels (default: those that the checkpoint was trained on, else {DEFAULT_IMAGE_SIZE})",
    )
    add("render_preset", default="fast", help=f"{', '.join(RENDER_PRESETS)} (default: fast)")
    add("depth", **switch(), help="observe each camera's depth (metres), intrinsics and pose too")
    add("split", default="all", help=f"draw from {', '.join(SPLITS)} (default: all)")
    add("target", type=parse_numbers, help=f"[row, column], each in {lines} (default: drawn)")
    add("color", help=f"of the stone to be moved: {' or '.join(COLORS)} (default: drawn)")
    add(
        "task_ids",
        type=parse_numbers,
        default=(),
        help="numbered tasks of the suite, as [0,7,12], each run from every seed (of place 25 x colour + "
        "5 x row + column; black = 0, white = 1; default: target and colour as above)",
    )
    add(
        "perturbations",
        type=parse_conditions,
        default=(NONE,),
        help='conditions, as ["camera:3","camera:2+light:3"], each run from every seed; a range such as '
        "all:1-5 or camera:0-3 draws a level per episode and axis (default: none)",
    )
    add(
        "success_tolerance_mm",
        type=float,
        default=tolerance,
        help=f"distance from the intersection within which a placement counts (default: {tolerance:g})",
    )


def add_folder_arguments(parser: argparse.ArgumentParser, checkpoint: str, output: str) -> None:
    """Declare --policy.path, a checkpoint's folder, and --output, a new one."""
    path = f"folder of {checkpoint} that lerobot-train names pretrained_model"
    parser.add_argument("--policy.path", dest="policy_path", type=checkpoint_flag, required=True, help=path)
    parser.add_argument("--output", type=path_flag, required=True, help=output)
