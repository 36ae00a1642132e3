"""``lerobot-bomb push``: a checkpoint that was trained earlier, with its card, to the Hub."""

import argparse

from lerobot_bomb.checkpoints.names import TRAIN_CONFIG
from lerobot_bomb.commands.arguments import add_hub_arguments, path_flag
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.resumable import check_repo_id
from lerobot_bomb.hub.evaluated import check_environment_of, check_weights_of
from lerobot_bomb.hub.push import publish, read_checkpoint
from lerobot_bomb.results.groups import read_results


def add_push_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb push``."""
    add = parser.add_argument
    folder = "the folder that lerobot-train names pretrained_model"
    add("checkpoint", type=path_flag, metavar="CHECKPOINT", help=folder)
    add_hub_arguments(parser, "model")
    add(
        "--results",
        nargs="+",
        type=path_flag,
        default=[],
        metavar="RESULTS.jsonl",
        help="files that --env.results_path wrote for this checkpoint; the card states their rates",
    )
    add(
        "--dataset.root",
        dest="dataset_root",
        type=path_flag,
        help="folder of the dataset, if it is no longer where the training found it; the card states what "
        "it shows",
    )


def run_push(args: argparse.Namespace) -> int:
    """Check the checkpoint, then publish all of it in one commit; prints where."""
    check_repo_id(args.repo_id)
    results = [read_results(path) for path in args.results]
    dataset = None if args.dataset_root is None else DatasetFacts.read(args.dataset_root)
    from lerobot_bomb.checkpoints.checks import checkpoint_files  # imports torch: seconds
    from lerobot_bomb.hub.upload import check_token

    files = {name: args.checkpoint / name for name in checkpoint_files(args.checkpoint)}
    for path, rows in zip(args.results, results, strict=True):
        check_weights_of(path, rows, args.checkpoint)
    if (args.checkpoint / TRAIN_CONFIG).is_file():
        files[TRAIN_CONFIG] = args.checkpoint / TRAIN_CONFIG
    if not args.dry_run:
        check_token()
    checkpoint = read_checkpoint(args.checkpoint, args.repo_id, dataset, results)
    for path, rows in zip(args.results, results, strict=True):
        check_environment_of(path, rows, checkpoint.environment)
    if args.dry_run:
        print(checkpoint.card(), *sorted(files), sep="\n")
        return 0
    print(publish(checkpoint, files, args.private or None).commit_url)
    return 0
