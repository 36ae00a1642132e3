"""``lerobot-bomb config``: presets of ``lerobot-train`` and ``lerobot-eval``, also without a clone."""

import argparse
import shutil

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.files import check_new_file
from lerobot_bomb.presets import SUFFIX, preset_names, preset_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the preset's name and where to copy it."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="preset to print; without it, all are listed")
    parser.add_argument("--output", type=path_flag, help="file to copy it to, instead of printing it")


def run(args: argparse.Namespace) -> int:
    """List the presets, or print or copy one."""
    if args.name is None:
        if args.output is not None:
            raise ValueError(f"--output={args.output} needs the NAME of a preset")
        print(*preset_names(), sep="\n")
        return 0
    path = preset_path(args.name.removeprefix("configs/").removesuffix(SUFFIX))
    if args.output is None:
        print(path.read_text(), end="")
        return 0
    args.output.parent.mkdir(parents=True, exist_ok=True)
    check_new_file("--output", args.output)
    shutil.copyfile(path, args.output)
    print(args.output)
    return 0
