"""``lerobot-bomb``: commands beside LeRobot's own."""

import argparse
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any, NoReturn

from lerobot_bomb import __version__
from lerobot_bomb.checkpoints.names import check_checkpoint
from lerobot_bomb.commands.arguments import long_forms
from lerobot_bomb.commands.table import COMMANDS, FAMILIES, PROGRAM, RENAMED, overview, subcommands
from lerobot_bomb.compat.use import use

SHELLS = ("bash", "zsh")
# flags of lerobot-eval that have no prefix, as --env.task has
EVAL_FLAGS = ("--config_path", "--job_name", "--output_dir", "--rename_map", "--seed", "--trust_remote_code")


class Parser(argparse.ArgumentParser):
    """A parser whose help begins with the purpose of the command."""

    opening = ""

    def format_help(self) -> str:
        return f"{self.opening}\n\n{super().format_help()}"

    def error(self, message: str) -> NoReturn:
        """End with one line, which argparse would print below up to twenty lines of usage."""
        self.exit(2, f"{self.prog}: {message} (`{self.prog} --help` lists all flags)\n")


def program_parser() -> Parser:
    """Build the parser of flags that stand in place of a command."""
    parser = Parser(prog=PROGRAM, usage=f"{PROGRAM} COMMAND ...")
    parser.opening = overview()
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    about = f"print a script with which {' or '.join(SHELLS)} completes commands, flags and paths"
    parser.add_argument("--completion", choices=SHELLS, metavar="SHELL", help=about)
    return parser


def command_parser(name: str) -> Parser:
    """Build a command's parser, which imports its module."""
    command = COMMANDS[name]
    parser = Parser(
        prog=f"{PROGRAM} {name}",
        allow_abbrev=False,
        epilog="\n".join(_listed(name)),
        formatter_class=_HelpFormatter,
    )
    examples = [f"  {PROGRAM} {name} {flags}".rstrip() for flags in command.examples]
    parser.opening = "\n".join([*examples, "", f"{command.summary[0].upper()}{command.summary[1:]}."])
    module_of(name).add_arguments(parser)
    return parser


class _HelpFormatter(argparse.HelpFormatter):
    """Formatter that keeps the lines of a list of commands."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)


def _listed(word: str) -> Iterator[str]:
    """List the commands that begin with a word."""
    others = subcommands(word)
    width = max(map(len, others), default=0)
    yield from ("commands:",) * bool(others)
    for name, command in others.items():
        yield f"  {PROGRAM} {name:<{width}}  {command.summary}"


def module_of(name: str) -> Any:
    """Import the module of a command."""
    return importlib.import_module(f"lerobot_bomb.commands.{name.replace(' ', '_').replace('-', '_')}")


def _split(argv: Sequence[str]) -> tuple[str, Sequence[str]] | None:
    """Return a command's name, of one or two words, and its flags; None if there is none."""
    for number in (2, 1):
        name = " ".join(argv[:number])
        if name in COMMANDS:
            return name, argv[number:]
    return None


def _unknown(argv: Sequence[str]) -> int:
    """Print help on words that are no command; return the exit code."""
    word, *others = argv
    if word in FAMILIES and (not others or others[0] in ("-h", "--help")):
        print(*_listed(word), sep="\n")
        return 0
    if word in RENAMED:
        told = f"`{PROGRAM} {word}` is now `{PROGRAM} {RENAMED[word]}`"
    else:
        given = " ".join(argv[:2]) if word in FAMILIES else word
        near = get_close_matches(given, [*COMMANDS, *FAMILIES], n=1)
        names = [name.partition(" ")[2] for name in subcommands(word)]
        known = f"; there are {', '.join(names)}" if names else f"; `{PROGRAM} --help` lists all"
        told = f"{given!r} is no command{f'; nearest: {near[0]}' if near else ''}{known}"
    print(f"{PROGRAM}: {told}", file=sys.stderr)
    return 2


def _may_be_of_eval(flag: str) -> bool:
    name = flag.partition("=")[0]
    return "." in name or name in EVAL_FLAGS


def _parse(name: str, words: Sequence[str]) -> argparse.Namespace:
    """Read a command's flags, and check the paths of checkpoints among them."""
    parser = command_parser(name)
    # before argparse misses the flag that is misspelt
    _refuse(parser, _unknown_flags(parser, words))
    args, unknown = parser.parse_known_args(words)
    if "rest" in args:  # of a command that has LeRobot's parser read them
        args.rest, unknown = long_forms(unknown), []
    _refuse(parser, unknown)
    if (checkpoint := getattr(args, "policy_path", None)) is not None:
        check_checkpoint(checkpoint)
    return args


def _unknown_flags(parser: Parser, words: Sequence[str]) -> list[str]:
    """Return the flags among the words that neither the command nor LeRobot's parser reads."""
    if any(action.nargs == argparse.REMAINDER for action in parser._actions):
        return []
    known = parser._option_string_actions
    flags = [word for word in words if word.startswith("--") and word.partition("=")[0] not in {*known, "--"}]
    if "rest" not in {*parser._defaults, *(action.dest for action in parser._actions)}:
        return flags
    return [flag for flag in long_forms(flags) if not _may_be_of_eval(flag)]


def _refuse(parser: Parser, unknown: Sequence[str]) -> None:
    if unknown:
        from lerobot_bomb.flag_errors import nearest  # draccus: half a second

        near = nearest(unknown, parser._option_string_actions)
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{near}")


def _told() -> tuple[type[Exception], ...]:
    """Return the errors whose messages are for the user; draccus' own only once it is loaded."""
    draccus = sys.modules.get("draccus.utils")
    return (ValueError, OSError, RuntimeError, *((draccus.DecodingError,) if draccus else ()))


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; an error in its flags or files becomes one line on stderr and exit code 1."""
    argv = sys.argv[1:] if argv is None else list(argv)
    if not argv or argv[0].startswith("-"):
        args = program_parser().parse_args(argv or ["--help"])
        print(importlib.import_module("lerobot_bomb.commands.completion").script(args.completion))
        return 0
    found = _split(argv)
    if found is None:
        return _unknown(argv)
    name, words = found
    use()
    try:
        return module_of(name).run(_parse(name, words))
    except BrokenPipeError:  # of `| head`; what is printed at exit must not raise it again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except _told() as error:
        print(f"{PROGRAM} {name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{PROGRAM} {name}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
