"""Split of a dataset's episodes: those that a checkpoint was trained on, and those to validate it."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_bomb.checkpoints.training import dataset_of


@dataclass(frozen=True)
class Split:
    """Episodes of the two columns; `seen` are validation episodes that were trained on."""

    train: list[int]
    validation: list[int]
    seen: list[int]


def parse_episodes(flag: str, text: str, num_episodes: int) -> list[int]:
    """'[180,181]', '180-205' or '[0-9,20]' -> sorted numbers of a dataset's episodes, each once.

    Raises:
        ValueError: it is spelled otherwise, or an episode does not exist.
    """
    parts = [part.strip() for part in text.strip().removeprefix("[").removesuffix("]").split(",")]
    episodes: set[int] = set()
    for part in parts:
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise ValueError(f"{flag}={text}: give numbers and ranges, as [180,181], 180-205 or [0-9,20]")
        if last >= num_episodes:  # before a range fills the memory
            raise ValueError(f"{flag}={text}: the dataset has the episodes 0..{num_episodes - 1}, not {last}")
        episodes.update(range(first, last + 1))
    return sorted(episodes)


def trained_episodes(train_config: Mapping[str, Any], meta: LeRobotDatasetMetadata) -> list[int] | None:
    """Episodes of this dataset that lerobot-train trained on; None if it trained on another dataset.

    With `dataset.eval_split` LeRobot holds out the last episodes of every task.
    """
    dataset, root = train_config.get("dataset") or {}, dataset_of(train_config)
    if root is None:
        return None
    moved = not root.is_dir()  # a checkpoint of another machine names that machine's folder
    if dataset.get("repo_id") != meta.repo_id or not (moved or root.resolve() == meta.root.resolve()):
        return None
    chosen = dataset.get("episodes")
    chosen = list(range(meta.total_episodes)) if chosen is None else chosen
    absent = [episode for episode in chosen if episode >= meta.total_episodes]
    if absent:
        raise ValueError(
            f"the checkpoint was trained on the episodes {absent[:5]} of {meta.repo_id}, which in "
            f"{meta.root} has only 0..{meta.total_episodes - 1}"
        )
    by_task: dict[str, list[int]] = {}
    for episode in chosen:
        tasks = meta.episodes[episode]["tasks"] if meta.episodes is not None else []
        by_task.setdefault(tasks[0] if tasks else "", []).append(episode)
    share = dataset.get("eval_split") or 0.0
    kept = [episodes[: len(episodes) - math.ceil(len(episodes) * share)] for episodes in by_task.values()]
    return sorted(episode for episodes in kept for episode in episodes)


def make_split(
    num_episodes: int,
    trained: list[int] | None,
    train: list[int] | None,
    validation: list[int] | None,
) -> Split:
    """Split by the flags; by default, the episodes that were trained on, and all others.

    Raises:
        ValueError: an episode is named for both, or no episode is held out.
    """
    known = set(trained or [])
    if train is None:
        train = sorted(known - set(validation or []))
    if validation is None:
        validation = [episode for episode in range(num_episodes) if episode not in known | set(train)]
    if both := sorted(set(train) & set(validation)):
        raise ValueError(f"--train_episodes and --val_episodes both name the episodes {both[:5]}")
    if not validation:
        raise ValueError(
            f"all {num_episodes} episodes are training episodes, none is held out; name some with "
            "--val_episodes=[...] (the loss on those is no validation), or give another dataset with "
            "--dataset.repo_id and --dataset.root"
        )
    return Split(train, validation, sorted(set(validation) & known))
