"""``lerobot-bomb push-dataset``: a recorded dataset, with its card, to the Hub."""

import argparse
from contextlib import suppress
from pathlib import Path

from huggingface_hub import DatasetCardData, HfApi
from huggingface_hub.errors import RevisionNotFoundError

from lerobot_bomb.commands.arguments import add_hub_arguments, path_flag
from lerobot_bomb.data.dataset_files import check_dataset
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.resumable import check_repo_id
from lerobot_bomb.data.statistics import check_statistics
from lerobot_bomb.data.unfinished import METADATA_FILE
from lerobot_bomb.hub.markdown import code, command, fenced, plain
from lerobot_bomb.hub.push import CARD
from lerobot_bomb.hub.upload import check_token, hub_errors, upload

FOLDERS = ("meta", "data", "videos")


def add_push_dataset_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb push-dataset``."""
    help = "folder that lerobot-bomb record or convert wrote"
    parser.add_argument("root", type=path_flag, metavar="ROOT", help=help)
    add_hub_arguments(parser, "dataset")


def run_push_dataset(args: argparse.Namespace) -> int:
    """Check the dataset, publish all of it in one commit and tag it for LeRobot; prints where."""
    check_repo_id(args.repo_id)
    facts = DatasetFacts.read(args.root)
    if not facts.bomb:
        raise ValueError(
            f"{args.root} holds no {METADATA_FILE}, so lerobot-bomb did not write it; "
            "LeRobotDataset.push_to_hub publishes other datasets"
        )
    check_dataset(args.root)
    check_statistics(args.root)
    if not args.dry_run:
        check_token()
    files: dict[str, Path | bytes] = {
        path.relative_to(args.root).as_posix(): path
        for folder in FOLDERS
        for path in sorted((args.root / folder).rglob("*"))
        if path.is_file()
    }
    card = dataset_card(args.repo_id, facts)
    if args.dry_run:
        print(card, *files, sep="\n")
        return 0
    files[CARD] = card.encode()
    message = f"{facts.info['total_episodes']} episodes and card"
    commit = upload(args.repo_id, "dataset", files, _is_data, message, private=args.private or None)
    with hub_errors(args.repo_id):
        _tag(args.repo_id, facts.info["codebase_version"])
    print(commit.commit_url)
    return 0


def _is_data(path: str) -> bool:
    """LeRobot reads every such file, so none may be left of a longer recording."""
    return path.split("/")[0] in FOLDERS


def dataset_card(repo_id: str, facts: DatasetFacts) -> str:
    """Write the dataset's card: what the dataset shows, and how to train on it."""
    metadata = DatasetCardData(
        license="apache-2.0",
        tags=["LeRobot", "lerobot_bomb"],
        task_categories=["robotics"],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    rows = [
        f"| {code(name)} | {feature['dtype']} | {tuple(feature['shape'])} |"
        for name, feature in facts.info["features"].items()
    ]
    train = command(
        "lerobot-train",
        f"--dataset.repo_id={repo_id}",
        "--policy.type=TYPE",
        "--policy.push_to_hub=false",
        "--output_dir=outputs/train",
    )
    flags = facts.eval_flags() or []
    evaluate = command(
        "lerobot-eval", "--policy.path=outputs/train/checkpoints/last/pretrained_model", *flags
    )
    lines = [
        f"# {repo_id.split('/')[-1]}",
        "",
        f"A LeRobotDataset {facts.info['codebase_version']}, written by `lerobot-bomb`.",
        "",
        *map(plain, facts.lines()),
        "",
        "## Use",
        "",
        "`pip install .` in a checkout of lerobot_bomb adds its environment and its policy types to LeRobot; "
        "TYPE is one of these, or of LeRobot's own.",
        "",
        fenced(f"{train}\n{evaluate}"),
        "",
        "## Features",
        "",
        "| feature | type | shape |",
        "|---|---|---|",
        *rows,
        "",
    ]
    return f"---\n{metadata.to_yaml()}\n---\n\n" + "\n".join(lines)


def _tag(repo_id: str, version: str) -> None:
    """Tag the commit with the version: LeRobot loads the one that has its tag."""
    api = HfApi()
    with suppress(RevisionNotFoundError):
        api.delete_tag(repo_id, tag=version, repo_type="dataset")
    api.create_tag(repo_id, tag=version, repo_type="dataset")
