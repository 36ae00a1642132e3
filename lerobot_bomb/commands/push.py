"""``lerobot-bomb push``: a checkpoint, a recorded dataset or an environment, with its card, to the Hub."""

import argparse
import sys

from lerobot_bomb.checkpoints.names import CONFIG, TRAIN_CONFIG
from lerobot_bomb.commands.arguments import path_flag, switch
from lerobot_bomb.data.resumable import check_repo_id
from lerobot_bomb.results.groups import read_results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare source, repository and options."""
    parser.usage = f"{parser.prog} [FOLDER] --repo_id=USER/NAME ... (and, without FOLDER, --env.* flags)"
    add = parser.add_argument
    folder = "checkpoint (pretrained_model of lerobot-train), or dataset of lerobot-bomb record or convert"
    add("folder", type=path_flag, metavar="FOLDER", nargs="?", help=folder)
    add("--repo_id", required=True, help="name on the Hub, USER/NAME")
    add("--private", **switch(), help="make a new repository that only you see")
    dry_run = "print the card and the names of the files; publish nothing, ask no Hub"
    add("--dry_run", **switch(), help=dry_run)
    add(
        "--results",
        nargs="+",
        type=path_flag,
        default=[],
        metavar="RESULTS.jsonl",
        help="results files of this checkpoint, whose rates go into the card",
    )
    add(
        "--dataset.root",
        dest="dataset_root",
        type=path_flag,
        help="folder of the checkpoint's dataset, if it has moved; the card describes it",
    )
    about = "in place of FOLDER, an environment: --env.type=bomb --env.task=goal, as lerobot-eval takes them"
    add("rest", nargs="*", metavar="FLAG", help=about)


def run(args: argparse.Namespace) -> int:
    """Publish an environment, a checkpoint, or a folder that is a dataset."""
    check_repo_id(args.repo_id)
    if args.folder is None:
        return _push_environment(args)
    if args.rest:
        raise ValueError(f"{args.rest[0]} is of an environment; drop it or {args.folder}")
    if not args.folder.is_dir():
        raise ValueError(f"{args.folder}: there is no such folder; give a checkpoint's or a dataset's")
    return (_push_dataset if (args.folder / "meta").is_dir() else _push_checkpoint)(args)


def _refuse_flags_of_checkpoints(args: argparse.Namespace, source: str) -> None:
    for flag, value in {"--results": args.results, "--dataset.root": args.dataset_root}.items():
        if value:
            raise ValueError(f"{flag} is of a checkpoint, and {source}; drop it")


def _push_environment(args: argparse.Namespace) -> int:
    """Check the environment's flags, then publish `env.py` and card in one commit; print its URL."""
    if not args.rest:
        raise ValueError("give a folder, or an environment: --env.type=bomb --env.task=goal")
    _refuse_flags_of_checkpoints(args, "this is an environment")
    from lerobot_bomb.hub.environment import publish_environment, read_environment  # LeRobot: seconds

    environment = read_environment(args.repo_id, args.rest)
    if args.dry_run:
        print(environment.card, environment.code, sep="\n")
        return 0
    print(publish_environment(environment, args.private or None).commit_url)
    return 0


def _push_dataset(args: argparse.Namespace) -> int:
    """Check the dataset, publish all of it in one commit and tag it for LeRobot; print the commit's URL."""
    _refuse_flags_of_checkpoints(args, f"{args.folder} is a dataset")
    from lerobot_bomb.hub.dataset import publish_dataset, read_dataset  # LeRobot: seconds
    from lerobot_bomb.hub.push import CARD

    dataset = read_dataset(args.folder, args.repo_id)
    if args.dry_run:
        print(dataset.card, *sorted(dataset.contents.keys() - {CARD}), sep="\n")
        return 0
    print(publish_dataset(dataset, args.private or None).commit_url)
    return 0


def _push_checkpoint(args: argparse.Namespace) -> int:
    """Check the checkpoint, then publish all of it in one commit; print the commit's URL."""
    results = [read_results(path) for path in args.results]
    if not (args.folder / CONFIG).is_file():
        raise ValueError(
            f"{args.folder} holds neither {CONFIG}, as a checkpoint does, nor meta/, as a dataset does"
        )
    from lerobot_bomb.checkpoints.checks import checkpoint_files  # imports torch: seconds
    from lerobot_bomb.data.facts import DatasetFacts
    from lerobot_bomb.hub.evaluated import check_environment_of, check_policy_of
    from lerobot_bomb.hub.push import publish, read_checkpoint
    from lerobot_bomb.hub.rates import FIGURE
    from lerobot_bomb.hub.upload import check_token

    dataset = None if args.dataset_root is None else DatasetFacts.read(args.dataset_root)
    files = {name: args.folder / name for name in checkpoint_files(args.folder)}
    for path, rows in zip(args.results, results, strict=True):
        check_policy_of(path, rows, args.folder)
    if (args.folder / TRAIN_CONFIG).is_file():
        files[TRAIN_CONFIG] = args.folder / TRAIN_CONFIG
    if not args.dry_run:
        check_token()
    checkpoint = read_checkpoint(args.folder, args.repo_id, dataset, results)
    for path, rows in zip(args.results, results, strict=True):
        check_environment_of(path, rows, checkpoint.environment)
    if args.dry_run:
        names = [*files, *([FIGURE] if results else [])]
        print(checkpoint.card(), *sorted(names), sep="\n")
        if checkpoint.history.datasets:
            print(f"not asked: is {checkpoint.history.datasets[0]} on the Hub?", file=sys.stderr)
        return 0
    print(publish(checkpoint, files, args.private or None).commit_url)
    return 0
