"""``lerobot-bomb completion``: a script with which a shell completes the commands and their flags."""

import argparse

import shtab

from lerobot_bomb.commands.arguments import checkpoint_flag, path_flag
from lerobot_bomb.commands.main import COMMANDS, build_parser

SHELLS = ("bash", "zsh")


def complete_paths(parser: argparse.ArgumentParser) -> None:
    """Have files and folders offered where a flag takes a path."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                complete_paths(command)
        elif action.type in (path_flag, checkpoint_flag):
            action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]


def add_completion_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the shell."""
    parser.add_argument("shell", choices=SHELLS, help="whose script is printed")


def run_completion(args: argparse.Namespace) -> int:
    """Print the script. Every command is imported for its flags, which takes seconds."""
    parser, _ = build_parser(COMMANDS)
    complete_paths(parser)
    print(shtab.complete(parser, shell=args.shell))
    return 0
