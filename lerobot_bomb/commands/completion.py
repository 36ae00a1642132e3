"""A script with which a shell completes commands, flags and paths."""

import argparse

import shtab

from lerobot_bomb.commands.arguments import checkpoint_flag, path_flag
from lerobot_bomb.commands.main import module_of, program_parser
from lerobot_bomb.commands.table import COMMANDS, FAMILIES, Command, subcommands


def script(shell: str) -> str:
    """Write the script for bash or zsh; every command's module is imported for its flags."""
    parser = program_parser()
    words = parser.add_subparsers(metavar="COMMAND")
    for word in dict.fromkeys(name.partition(" ")[0] for name in COMMANDS):
        one = words.add_parser(word, help=COMMANDS[word].summary if word in COMMANDS else FAMILIES[word][1])
        if word in COMMANDS:
            module_of(word).add_arguments(one)
        if not one._get_positional_actions():  # else a file may stand where a second word does
            _add_second_words(one, subcommands(word))
    _complete_paths(parser)
    return shtab.complete(parser, shell=shell)


def _add_second_words(parser: argparse.ArgumentParser, commands: dict[str, Command]) -> None:
    if commands:
        words = parser.add_subparsers(metavar="COMMAND")
        for name, command in commands.items():
            module_of(name).add_arguments(words.add_parser(name.partition(" ")[2], help=command.summary))


def _complete_paths(parser: argparse.ArgumentParser) -> None:
    """Have files and folders offered where a flag takes a path."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_paths(command)
        elif action.type in (path_flag, checkpoint_flag):
            action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]
