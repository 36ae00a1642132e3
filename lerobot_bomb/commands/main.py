"""``lerobot-bomb``: what LeRobot's own commands do not do."""

import argparse
import importlib
import sys
from collections.abc import Collection, Sequence
from typing import Any

from draccus.utils import DecodingError

from lerobot_bomb import __version__
from lerobot_bomb.compat.use import use
from lerobot_bomb.flag_errors import nearest

DESCRIPTION = "What lerobot-train and lerobot-eval do not do for BOMB: record, summarise, check."

# of lerobot-eval, those that are of no group as --env.task is
EVAL_FLAGS = ("--config_path", "--job_name", "--output_dir", "--rename_map", "--seed", "--trust_remote_code")

# command -> help; NAME stands in commands/NAME.py, a hyphen as an underscore, with add_NAME_arguments and
# run_NAME, and is imported only when called
COMMANDS = {
    "record": "record the scripted expert as a LeRobotDataset",
    "convert": "published demonstrations as a LeRobotDataset",
    "results": "summarise files written by --env.results_path",
    "lines": "lines of results of LeRobot's own pusht or libero, from what lerobot-eval wrote",
    "report": "files of results as one page, with tables as JSON and CSV",
    "export": "files of results as a LaTeX table, a model-index and the Hub's .eval_results",
    "sweep": "evaluate policies x tasks x conditions; goes on after a kill",
    "replay": "play an episode of a file of results again, bit for bit or with other perturbations",
    "audit": "does a policy read, look, repeat itself: arms and verdicts that a success rate needs",
    "compare": "two policies on the same episodes: difference, interval, test",
    "eval": "lerobot-eval, which also writes the executed actions to a file",
    "smoothness": "second and third differences of executed actions, of demonstrations and evaluations",
    "offline-metrics": "loss, accuracy and L1 of a checkpoint on recorded frames, beside trivial predictors",
    "statistics": "compare a dataset's statistics of numbers with all of its frames, and mend them",
    "fit-grid": "an action grid on a dataset: its fit, its edges and what it rounds off",
    "init": "a policy before its training, as a checkpoint that adapters can be trained on",
    "merge": "adapters and their base as one checkpoint",
    "convert-spatialvla": "a published SpatialVLA folder as a checkpoint for LeRobot",
    "export-backbone": "a checkpoint's vision-language model as a folder that other policies can start from",
    "serve": "LeRobot's server of action chunks for a robot elsewhere, for every policy type",
    "push": "a checkpoint to the Hub, with a card and its evaluation",
    "push-dataset": "a recorded dataset to the Hub, with a card",
    "explain": "what a policy's actions depend on: patches, objects, words, layers, heads",
    "view": "play one episode into a recording for Rerun and a video",
    "gallery": "draw what every perturbation axis changes",
    "checkpoint": "the folder of a checkpoint that comes with this package",
    "demo": "a policy that comes with this package plays, beside expert and random",
    "doctor": "check this installation",
    "completion": "a script with which bash or zsh completes these commands and their flags",
}


def _may_be_of_eval(flag: str) -> bool:
    name = flag.partition("=")[0]
    return "." in name or name in EVAL_FLAGS


def _function(command: str) -> str:
    return command.replace("-", "_")


def _module(command: str) -> Any:
    return importlib.import_module(f"lerobot_bomb.commands.{_function(command)}")


def build_parser(
    imported: Collection[str],
) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser of all commands, and each command's; those that are ``imported`` have their arguments."""
    parser = argparse.ArgumentParser(prog="lerobot-bomb", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"lerobot-bomb {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        if name in imported:
            getattr(_module(name), f"add_{_function(name)}_arguments")(command)
    return parser, commands.choices


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; what is wrong with its flags or files becomes one line on stderr and exit code 1."""
    argv = sys.argv[1:] if argv is None else list(argv)
    argv = argv or ["--help"]
    use()
    try:
        parser, commands = build_parser(argv[:1])
        args, unknown = parser.parse_known_args(argv)
        if "rest" in args:  # of a command that has LeRobot's parser read them
            args.rest = unknown
            unknown = [word for word in unknown if word.startswith("--") and not _may_be_of_eval(word)]
        if unknown:
            command = commands[args.command]
            near = nearest(unknown, command._option_string_actions)
            command.error(f"unrecognized arguments: {' '.join(unknown)}{near}")
        return getattr(_module(args.command), f"run_{_function(args.command)}")(args)
    except (ValueError, OSError, RuntimeError, DecodingError) as error:
        print(f"lerobot-bomb {argv[0]}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"lerobot-bomb {argv[0]}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
