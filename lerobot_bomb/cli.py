"""``lerobot-bomb``: what LeRobot's own commands do not do."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from draccus.utils import DecodingError

from lerobot_bomb import __version__

DESCRIPTION = "What lerobot-train and lerobot-eval do not do for BOMB: record, summarise, check."

# command -> (help, module with add_<command>_arguments and run_<command>, in which a hyphen is an
# underscore); imported only when called
COMMANDS = {
    "record": ("record the scripted expert as a LeRobotDataset", "lerobot_bomb.data.record"),
    "convert": ("published demonstrations as a LeRobotDataset", "lerobot_bomb.data.convert"),
    "results": ("summarise files written by --env.results_path", "lerobot_bomb.evaluation.results"),
    "eval": (
        "lerobot-eval, which also writes the executed actions to a file",
        "lerobot_bomb.evaluation.eval_logged",
    ),
    "smoothness": (
        "second and third differences of executed actions, of demonstrations and evaluations",
        "lerobot_bomb.evaluation.smoothness_report",
    ),
    "offline-metrics": (
        "loss, accuracy and L1 of a checkpoint on recorded frames, beside trivial predictors",
        "lerobot_bomb.evaluation.offline_metrics",
    ),
    "fit-grid": (
        "an action grid on a dataset: its fit, its edges and what it rounds off",
        "lerobot_bomb.actions.fit_grid",
    ),
    "init": (
        "a policy before its training, as a checkpoint that adapters can be trained on",
        "lerobot_bomb.base_checkpoint",
    ),
    "merge": ("adapters and their base as one checkpoint", "lerobot_bomb.merge"),
    "convert-spatialvla": (
        "a published SpatialVLA folder as a checkpoint of spatialvla_grid",
        "lerobot_bomb.vlm.convert_spatialvla",
    ),
    "export-backbone": (
        "a checkpoint's vision-language model as a folder that other policies can start from",
        "lerobot_bomb.vlm.export",
    ),
    "serve": (
        "LeRobot's server of action chunks for a robot elsewhere, for every policy type",
        "lerobot_bomb.serve",
    ),
    "push": ("a checkpoint to the Hub, with a card and its evaluation", "lerobot_bomb.hub.push"),
    "push-dataset": ("a recorded dataset to the Hub, with a card", "lerobot_bomb.hub.push_dataset"),
    "view": ("play one episode into a recording for Rerun and a video", "lerobot_bomb.viewing.view"),
    "gallery": ("draw what every perturbation axis changes", "lerobot_bomb.viewing.gallery"),
    "checkpoint": ("the folder of a checkpoint that comes with this package", "lerobot_bomb.shipped"),
    "demo": ("record, train and evaluate on this machine in minutes", "lerobot_bomb.demo"),
    "doctor": ("check this installation", "lerobot_bomb.doctor"),
}


def _function(command: str) -> str:
    return command.replace("-", "_")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; what is wrong with its flags or files becomes one line on stderr and exit code 1."""
    argv = sys.argv[1:] if argv is None else list(argv)
    argv = argv or ["--help"]
    parser = argparse.ArgumentParser(prog="lerobot-bomb", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"lerobot-bomb {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    modules = {}
    try:
        for name, (summary, module) in COMMANDS.items():
            command = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
            if name in argv[:1]:
                modules[name] = importlib.import_module(module)
                getattr(modules[name], f"add_{_function(name)}_arguments")(command)
        args, unknown = parser.parse_known_args(argv)
        if "rest" in args:  # of a command that has LeRobot's parser read them
            args.rest = unknown
        elif unknown:
            commands.choices[args.command].error(f"unrecognized arguments: {' '.join(unknown)}")
        return getattr(modules[args.command], f"run_{_function(args.command)}")(args)
    except (ValueError, OSError, RuntimeError, DecodingError) as error:
        print(f"lerobot-bomb {argv[0]}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"lerobot-bomb {argv[0]}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
